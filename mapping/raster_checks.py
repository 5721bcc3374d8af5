"""What stands in a raster for no data without being declared, told from heights by how it stands apart."""

from __future__ import annotations

import numpy as np

from perception.records import BoolArray, FloatArray

# What makers write for "no data" and forget to declare; no sea floor stands at these to the digit.
_SENTINELS = (-9999.0, 9999.0, -99999.0, 99999.0, -32768.0, -32767.0)
# No height, whatever it stands for: makers fill with 1e20 or the largest float. (An odd datum may add millions.)
_IMPOSSIBLE_M = 1e9
# Hardly a height. Below it, as of a raster in centimetres, such a number may be one, and is none only where
# it lies so many robust spreads from the nearest of the others.
_HARDLY_M, _APART = 9_000.0, 10.0
# One value that fills so much of a raster and its rim, this many spreads from all the rest, is told of.
_LEAST_PART, _LEAST_CELLS, _FAR = 0.005, 10, 5.0


def no_heights(elevation_m: FloatArray, declared: bool, unit_m: float = 1.0) -> BoolArray:
    """Return where a raster holds what can be no height.

    Parameters
    ----------
    elevation_m : NaN where no data is declared as such.
    declared : whether the file declares a value for no data: then the usual ones count as heights.
    unit_m : metres in the file's unit.
    """
    wrong = np.abs(elevation_m) > _IMPOSSIBLE_M
    if declared:
        return np.asarray(wrong)
    usual = np.isin(elevation_m, np.array(_SENTINELS) * unit_m)
    rest = elevation_m[np.isfinite(elevation_m) & ~usual & ~wrong]
    for value in np.unique(elevation_m[usual & ~wrong]):
        if abs(value) > _HARDLY_M or _nearest(rest, value) > _APART * _spread(rest):
            wrong |= elevation_m == value
    return np.asarray(wrong)


def undeclared_rim(elevation_m: FloatArray) -> tuple[float, int] | None:
    """Return a value that fills the rim far from all other heights, and its cells; None if there is none.

    Ground does not stand at one value to the last digit and then fall tens of metres: that is no data stored as a number.
    """
    rim = np.concatenate(
        [elevation_m[0], elevation_m[-1], elevation_m[1:-1, 0], elevation_m[1:-1, -1]]
    )
    values, counts = np.unique(rim[np.isfinite(rim)], return_counts=True)
    if not len(values):
        return None
    value = float(values[np.argmax(counts)])
    there = elevation_m == value
    rest = elevation_m[np.isfinite(elevation_m) & ~there]
    cells = int(there.sum())
    enough = cells >= max(_LEAST_CELLS, _LEAST_PART * elevation_m.size)
    if not enough or not len(rest) or not _nearest(rest, value) > max(_FAR * _spread(rest), 1.0):
        return None
    return value, cells


def _nearest(rest: FloatArray, value: float) -> float:
    """Return how far a value lies from the nearest others, but for a hundredth of them; infinite without any."""
    return float(np.percentile(np.abs(rest - value), 1)) if len(rest) else float("inf")


def _spread(rest: FloatArray) -> float:
    """Return the robust standard deviation; 0 without values."""
    if not len(rest):
        return 0.0
    return 1.4826 * float(np.median(np.abs(rest - np.median(rest))))
