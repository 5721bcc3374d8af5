"""Ground seen from one side only: there the mean profile stays what the soundings say.

An unknown gain by angle and an unknown mean slope by angle explain the same echoes. Looks from the
other side or across tell them apart; where there are none, echoes tell how the floor departs from its
mean profile along the track, not the profile itself. Each pass, side and stretch of ground range
therefore keeps its mean height, unless seen from elsewhere too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from perception.rays import Rays
from perception.records import BoolArray, FloatArray, IntArray
from perception.shading import Rows
from perception.soundings import Equations, bilinear_rows

# Looks whose mean direction has at least this length come from one side (1 = all from one direction).
_ONE_SIDED = 0.8
# The same of their doubled directions: looks from opposite sides count as one axis, at right angles as none.
_ONE_AXIS = 0.7
_STRETCH_CELLS = 4
# The mean of so few points is no profile.
_FEW = 3


def one_sided(rows: Rows, shape: tuple[int, int]) -> BoolArray:
    """Return (rows - 1, cols - 1), True where all looks at a cell have about one direction."""
    duals = (shape[0] - 1) * (shape[1] - 1)
    length = np.maximum(np.hypot(rows.c_east, rows.c_north), 1e-9)
    count = np.bincount(rows.cell, minlength=duals)
    east = np.bincount(rows.cell, rows.c_east / length, minlength=duals)
    north = np.bincount(rows.cell, rows.c_north / length, minlength=duals)
    mean = np.hypot(east, north) / np.maximum(count, 1)
    return ((count > 0) & (mean > _ONE_SIDED)).reshape(shape[0] - 1, shape[1] - 1)


def uncrossed(rows: Rows, shape: tuple[int, int]) -> BoolArray:
    """Return (rows - 1, cols - 1), True where all looks at a cell lie along one axis, from one side or both."""
    duals = (shape[0] - 1) * (shape[1] - 1)
    angle = 2 * np.arctan2(rows.c_east, rows.c_north)
    count = np.bincount(rows.cell, minlength=duals)
    along = np.bincount(rows.cell, np.cos(angle), minlength=duals)
    aside = np.bincount(rows.cell, np.sin(angle), minlength=duals)
    mean = np.hypot(along, aside) / np.maximum(count, 1)
    return ((count > 0) & (mean > _ONE_AXIS)).reshape(shape[0] - 1, shape[1] - 1)


def mean_profiles(
    base: FloatArray,
    west_m: float,
    south_m: float,
    cell_m: float,
    rays: Sequence[Rays],
    single: BoolArray,
    sigma_m: float,
    relative: bool = False,
) -> Equations:
    """Return equations that hold mean heights by pass, side and ground range to those of `base`.

    Parameters
    ----------
    base : (rows, cols) surface of the soundings alone.
    single : (rows - 1, cols - 1) ground whose mean is held.
    sigma_m : 1-sigma of a mean.
    relative : hold the rise of the mean from below the track, not the mean itself.
    """
    stretch = _STRETCH_CELLS * cell_m
    value: list[FloatArray] = []
    line: list[IntArray] = []
    node: list[IntArray] = []
    lines = 0
    for ray in rays:
        ground = np.arange(1, int(ray.reach_m / stretch)) * stretch
        every = slice(None, None, 2)
        east = ray.easting_m[every, None] + np.sin(ray.azimuth_rad)[every, None] * ground
        north = ray.northing_m[every, None] + np.cos(ray.azimuth_rad)[every, None] * ground
        col, row = (east - west_m) / cell_m, (north - south_m) / cell_m
        inside = (col >= 0) & (row >= 0) & (col < single.shape[1]) & (row < single.shape[0])
        c = np.where(inside, col, 0).astype(np.int64)
        r = np.where(inside, row, 0).astype(np.int64)
        inside &= single[r, c]
        number = inside.sum(axis=0)
        inside &= number > _FEW
        held = np.flatnonzero(number > _FEW)
        group = np.broadcast_to(np.arange(len(ground)), inside.shape)[inside]
        points = bilinear_rows(row[inside], col[inside], 1.0 / number[group], base.shape).tocoo()
        value.append(points.data)
        line.append(lines + np.searchsorted(held, group[points.row]))
        node.append(points.col)
        if relative:
            below, share = _mean_below(ray, west_m, south_m, cell_m, base.shape)
            value.append(np.tile(-share, len(held)))
            line.append(lines + np.repeat(np.arange(len(held)), len(below)))
            node.append(np.tile(below, len(held)))
        lines += len(held)
    matrix = sparse.csr_matrix(
        (np.concatenate(value), (np.concatenate(line), np.concatenate(node))),
        shape=(lines, base.size),
    )
    return Equations(matrix, np.full(lines, sigma_m**-2.0), matrix @ base.ravel())


def _mean_below(
    ray: Rays, west_m: float, south_m: float, cell_m: float, shape: tuple[int, ...]
) -> tuple[IntArray, FloatArray]:
    """Return the nodes below a track and their shares in the mean height there."""
    points = bilinear_rows(
        np.clip((ray.northing_m - south_m) / cell_m, 0, shape[0] - 1.001),
        np.clip((ray.easting_m - west_m) / cell_m, 0, shape[1] - 1.001),
        np.full(len(ray.easting_m), 1.0 / len(ray.easting_m)),
        (shape[0], shape[1]),
    )
    nodes, place = np.unique(points.indices, return_inverse=True)
    share: FloatArray = np.bincount(place, points.data).astype(float)
    return nodes, share
