"""The table of regions and the graph of their neighbourhoods."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from perception.records import Grid
from perception.region_labels import (
    COUNT,
    HIGH,
    LOW,
    MAX_P,
    SUM_H,
    SUM_K,
    SUM_P,
    SUM_SCALE,
    SUM_X,
    SUM_XX,
    SUM_XY,
    SUM_Y,
    SUM_YY,
)  # fmt: skip


def region_table(
    sums: npt.NDArray[np.float64], class_of: npt.NDArray[Any], frame: Grid
) -> dict[str, npt.NDArray[Any]]:
    """Turn the sums over cells into the attributes of the regions, one row each.

    Parameters
    ----------
    sums : (n + 1, 13) from `region_sums`; row 0 is no data.
    class_of : (n + 1,) class by region number.

    Returns
    -------
    dict
        `class_code`, `class_probability` (mean over the cells), `area_m2`, `relief_m` (highest minus
        lowest), `easting_m`, `northing_m` (centroid), `axis_rad` (direction of the longest spread,
        clockwise from grid north, 0 to pi), `elongation` (ratio of the longest to the shortest
        spread, from 1), `mean_H`, `mean_K`, `peak_probability`, `scale_m`.
    """
    rows = sums[1:]
    count = rows[:, COUNT]
    x, y = rows[:, SUM_X] / count, rows[:, SUM_Y] / count
    dx, dy = frame.cell_m, frame.cell_north_m
    # A cell is an area, not a point: its own spread (1/12) keeps one-cell regions round.
    xx = (rows[:, SUM_XX] / count - x**2 + 1 / 12) * dx**2
    yy = (rows[:, SUM_YY] / count - y**2 + 1 / 12) * dy**2
    xy = -(rows[:, SUM_XY] / count - x * y) * dx * dy  # rows run south
    half = np.hypot(0.5 * (xx - yy), xy)
    mid = 0.5 * (xx + yy)
    axis_from_east = 0.5 * np.arctan2(2 * xy, xx - yy)
    return {
        "class_code": np.asarray(class_of[1:], np.int32),
        "class_probability": rows[:, SUM_P] / count,
        "area_m2": count * dx * dy,
        "relief_m": rows[:, HIGH] - rows[:, LOW],
        "easting_m": frame.west_m + (x + 0.5) * dx,
        "northing_m": frame.north_m - (y + 0.5) * dy,
        "axis_rad": np.mod(np.pi / 2 - axis_from_east, np.pi),
        "elongation": np.sqrt((mid + half) / np.maximum(mid - half, 1e-12)),
        "mean_H": rows[:, SUM_H] / count,
        "mean_K": rows[:, SUM_K] / count,
        "peak_probability": rows[:, MAX_P],
        "scale_m": rows[:, SUM_SCALE] / count,
    }


def neighbours(edges: npt.NDArray[Any], count: int) -> list[list[int]]:
    """Return the numbers of each region's neighbours, ascending; entry r is region r + 1."""
    both = np.concatenate([edges, edges[:, ::-1]])
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    starts = np.searchsorted(both[:, 0], np.arange(1, count + 2))
    return [both[starts[r] : starts[r + 1], 1].tolist() for r in range(count)]
