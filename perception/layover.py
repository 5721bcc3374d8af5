"""Echoes of two surfaces at one range: where they are.

The founding paper: returns of different objects that arrive together are ambiguous, but only from one place; as the
vehicle moves the same two are told apart. A wall that faces the sonar is as near as the floor in front of it, so
its echo and the floor's share a range (layover); from the other side, or from farther off, the floor is seen alone.

Strips flag such cells; where passes meet, clear looks settle them (`mapping.looks`).
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
