"""Quality flags of a strip's cells: what is known against a height, carried with it to the map."""

from __future__ import annotations

from enum import IntFlag

import numpy as np

from perception.geometry import ground_range
from perception.levels import HIGHLIGHT, SHADOW
from perception.readers.raw import PingFlag
from perception.records import BoolArray, FloatArray, IntArray, Swath


class CellFlag(IntFlag):
    """Bits of a strip's `flags`, one byte a cell."""

    NO_BOTTOM = 1  # the ping shows no bottom: its altitude is carried over
    TURNING = 2  # the vehicle turns: beams of neighbouring pings cross inside the swath
    SATURATED = 4  # the recorder's ceiling: the echo is at least so strong
    SHADOW = 8  # no sound fell here: the height is inferred
    HIGHLIGHT = 16  # far brighter than the floor around
    SURFACE_RETURN = 32  # the echo of the sea's surface lies on this range
    AMBIGUOUS = 64  # another surface has the same range: the echo is both surfaces' (layover)


# So many samples at one and the same greatest value are the recorder's ceiling, not chance.
_CEILING_SAMPLES, _CEILING_SHARE = 20, 1e-4
# The surface's echo stands out of its neighbours by this factor at least, or it is not flagged.
_SURFACE_STANDS = 1.3
# Beams of neighbouring pings cross inside the swath where the turn is tighter than the range; half of that
# already doubles the far pings' spacing.
_TURN = 0.5
# Pings worked on at once.
_PINGS = 512


def saturated_samples(amplitude: FloatArray) -> BoolArray:
    """Return which samples (n, m) lie at the recorder's ceiling; none where there is no ceiling."""
    finite = amplitude[np.isfinite(amplitude)]
    if not finite.size:
        return np.zeros(amplitude.shape, bool)
    top = float(finite.max())
    count = int(np.count_nonzero(finite == top))
    # A file of zeros has one value too.
    if top <= 0 or count < max(_CEILING_SAMPLES, _CEILING_SHARE * finite.size):
        return np.zeros(amplitude.shape, bool)
    return amplitude >= top


def turning_pings(along_m: FloatArray, heading_rad: FloatArray, range_m: float) -> BoolArray:
    """Return the pings (n,) where heading changes by more than half a radian over one range of track."""
    if len(along_m) < 5:
        return np.zeros(len(along_m), bool)
    heading = np.unwrap(heading_rad)
    reach = max(range_m / 8, float(np.median(np.diff(along_m))) * 2)
    ahead = np.interp(along_m + reach, along_m, heading)
    behind = np.interp(along_m - reach, along_m, heading)
    return np.asarray(np.abs(ahead - behind) / (2 * reach) * range_m > _TURN)


def surface_samples(
    ratio: FloatArray, depth_m: FloatArray, altitude_m: FloatArray, sample_m: float
) -> BoolArray:
    """Return which samples (n, m) the surface's echo lies on: slant range equal to the sonar's depth.

    Only where the sonar is deeper than high above the floor (else it falls into the water column), and only
    where it stands out: a calm sea seen at the pattern's edge often gives none.
    """
    n, m = ratio.shape
    out = np.zeros((n, m), bool)
    levels: tuple[list[FloatArray], list[FloatArray]] = ([], [])
    for first in range(0, n, _PINGS):
        rows = slice(first, first + _PINGS)
        at = depth_m[rows] / sample_m
        half = np.maximum(2.0, 0.01 * at)[:, None]
        off = np.abs(np.arange(m) + 0.5 - at[:, None])
        heard = np.isfinite(ratio[rows])
        out[rows] = (off <= half) & (depth_m[rows] > altitude_m[rows])[:, None] & heard
        levels[0].append(ratio[rows][out[rows]])
        levels[1].append(ratio[rows][(off > 2 * half) & (off < 6 * half) & heard])
    on, beside = (np.concatenate(part) for part in levels)
    if len(on) < 50 or len(beside) < 50 or np.median(on) <= _SURFACE_STANDS * np.median(beside):
        out[:] = False
    return out


def cell_flags(
    swath: Swath,
    saturated: tuple[BoolArray, BoolArray],
    labels: tuple[IntArray, IntArray],
    ratios: tuple[FloatArray, FloatArray],
    valid: BoolArray,
    along_m: FloatArray,
    altitude_m: FloatArray,
    across_m: FloatArray,
    sample_m: float,
) -> IntArray:
    """Return the flags (n, columns) of a strip's cells, uint8 bits of `CellFlag`.

    Parameters
    ----------
    saturated, labels, ratios : port and starboard (n, m) samples on `sample_m`.
    valid : (n,) whether a bottom was seen. across_m : columns of the strip.
    """
    n, m = labels[0].shape
    flags = np.zeros((n, len(across_m)), np.uint8)
    depth = np.nan_to_num(np.asarray(swath.depth_m, float))
    for side, columns in ((0, across_m < 0), (1, across_m > 0)):
        bits = (
            saturated[side] * np.uint8(CellFlag.SATURATED)
            | (labels[side] == SHADOW) * np.uint8(CellFlag.SHADOW)
            | (labels[side] == HIGHLIGHT) * np.uint8(CellFlag.HIGHLIGHT)
            | surface_samples(ratios[side], depth, altitude_m, sample_m)
            * np.uint8(CellFlag.SURFACE_RETURN)
        ).astype(np.uint8)
        slant = np.hypot(across_m[columns], altitude_m[:, None]) / sample_m
        sample = slant.astype(np.int32)
        taken = np.take_along_axis(bits, np.clip(sample, 0, m - 1), axis=1)
        flags[:, columns] = np.where(sample < m, taken, 0)
    ground = ground_range(np.array(m * sample_m), altitude_m)
    turning = turning_pings(along_m, swath.heading_rad, float(np.nan_to_num(np.nanmedian(ground))))
    if swath.flags is not None:
        turning |= (np.asarray(swath.flags) & int(PingFlag.TURNING)) > 0
    flags[~valid] |= np.uint8(CellFlag.NO_BOTTOM)
    flags[turning] |= np.uint8(CellFlag.TURNING)
    return flags
