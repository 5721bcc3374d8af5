"""Echoes of two surfaces at one range: where they are, what they may be, and which other looks settle them.

The founding paper: returns of different objects that arrive together are ambiguous, but only from one place; as the
vehicle moves the same two are told apart. A wall that faces the sonar is as near as the floor in front of it, so
its echo and the floor's share a range (layover); from the other side, or from farther off, the floor is seen alone.

Strips flag such cells by `layover_cells`. `candidates` and `settled` are for callers who combine looks themselves: no
stage of bathynav calls them, and a map weighs its looks by their sigma alone.
"""

from __future__ import annotations

import numpy as np

from perception.geometry import slant_range
from perception.records import BoolArray, FloatArray


def layover_cells(
    elevation_m: FloatArray, across_m: FloatArray, sonar_m: FloatArray, sample_m: float
) -> BoolArray:
    """Return the cells (n, m) whose slant range another visible cell of their line and side has too.

    Going outward over visible ground the slant range rises, but where it folds back: every cell that is nearer
    than one before it, or farther than one behind it, shares its range with another. Ground in shadow sends no
    echo and takes no part.

    Parameters
    ----------
    elevation_m : (n, m) surface; NaN no data, taken for not visible. across_m : (m,) rising, starboard positive.
    sonar_m : (n,) height of the sonar above the same datum. sample_m : slant range of a sample.
    """
    out = np.zeros(elevation_m.shape, bool)
    drop = np.asarray(sonar_m, float)[:, None] - elevation_m
    for columns in (np.flatnonzero(across_m > 0), np.flatnonzero(across_m < 0)[::-1]):
        if not len(columns):
            continue
        x, below = np.abs(across_m[columns]), drop[:, columns]
        # Angles from straight below rise outward; what lies under the greatest so far is hidden.
        angle = np.where(np.isfinite(below), np.arctan2(x, below), -np.inf)
        visible = np.isfinite(below) & (angle >= np.maximum.accumulate(angle, axis=1))
        slant = slant_range(x, np.nan_to_num(below))
        before = np.maximum.accumulate(np.where(visible, slant, -np.inf), axis=1)
        behind = np.minimum.accumulate(np.where(visible, slant, np.inf)[:, ::-1], axis=1)[:, ::-1]
        folded = (slant < before - sample_m) | (slant > behind + sample_m)
        out[:, columns] = visible & folded
    return out


def candidates(
    slant_m: float, profile_m: FloatArray, across_m: FloatArray, sonar_m: float
) -> FloatArray:
    """Return the places (k,) across one line where its visible surface has a slant range, nearest first.

    Parameters
    ----------
    slant_m : of the sample in question. profile_m, across_m : (m,) one side's surface, outward from the track.
    """
    x, drop = np.abs(across_m), sonar_m - profile_m
    angle = np.arctan2(x, drop)
    visible = angle >= np.maximum.accumulate(angle)
    miss = slant_range(x, drop) - slant_m
    crosses = (miss[:-1] * miss[1:] <= 0) & (miss[:-1] != miss[1:]) & visible[:-1] & visible[1:]
    k = np.flatnonzero(crosses)
    return np.asarray(x[k] + (x[k + 1] - x[k]) * miss[k] / (miss[k] - miss[k + 1]))


def settled(
    height_m: FloatArray, sigma_m: FloatArray, ambiguous: BoolArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return what several looks at the same places say, the ambiguous ones heard last.

    Where a look is clear, it alone counts, and an ambiguous one that agrees with the clear ones (within two
    combined sigmas) joins them: its echo was this surface's after all. Where every look is ambiguous the mean
    stands with the looks' disagreement in its sigma.

    Parameters
    ----------
    height_m, sigma_m, ambiguous : (looks, n); NaN a look that did not see the place.

    Returns
    -------
    height_m, sigma_m : (n,) NaN where no look saw.
    clear : (n,) whether a clear look settled the place.
    """
    seen = np.isfinite(height_m) & np.isfinite(sigma_m)
    surest = seen & ~ambiguous
    clear: BoolArray = np.any(surest, axis=0)
    mean, sigma = _weighted(height_m, sigma_m, np.where(clear, surest, seen))
    agrees = np.abs(height_m - mean) < 2 * np.hypot(sigma_m, sigma)
    taken = np.where(clear, surest | (seen & agrees), seen)
    mean, sigma = _weighted(height_m, sigma_m, taken)
    apart = np.where(taken, np.square(height_m - mean), 0.0).sum(axis=0)
    apart = np.sqrt(apart / np.maximum(taken.sum(axis=0), 1))
    return mean, np.asarray(np.where(clear, sigma, np.hypot(sigma, apart))), clear


def _weighted(
    height_m: FloatArray, sigma_m: FloatArray, taken: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return the mean (n,) of the looks taken, weighed by their sigma, and its sigma; NaN where none is."""
    weight = np.where(taken, 1 / np.square(np.maximum(sigma_m, 1e-6)), 0.0)
    total = weight.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.where(taken, weight * height_m, 0.0).sum(axis=0) / total
        sigma = 1 / np.sqrt(total)
    return mean, np.where(total > 0, sigma, np.nan)
