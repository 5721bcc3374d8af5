"""Proof of clearance: exact extremes of altitude over the bilinear surface along straight segments.

Between cell centres the surface is bilinear; along a straight 3-D segment its height is a quadratic
in the segment's parameter within each cell, so least and greatest altitude have closed forms. Nothing
is sampled. Derivation in docs/clearance.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.interpolation import cell_height
from perception.records import FloatArray


@dataclass(frozen=True, slots=True)
class Extremes:
    """Exact extremes of ``height - surface`` along a polyline, segment by segment.

    Attributes
    ----------
    least_m, greatest_m : (n - 1,) per segment; NaN where the segment touches no data.
    least_at, greatest_at : (n - 1,) parameter in [0, 1] along the segment.
    """

    least_m: FloatArray
    greatest_m: FloatArray
    least_at: FloatArray
    greatest_at: FloatArray

    def worst(self) -> tuple[int, float]:
        """Return segment and parameter of the least value; a NaN segment is the worst of all."""
        if len(self.least_m) == 0:
            return 0, 0.0
        bad = np.flatnonzero(np.isnan(self.least_m))
        index = int(bad[0]) if len(bad) else int(np.argmin(self.least_m))
        return index, float(self.least_at[index])


@njit(cache=True)
def segment_extremes(surface, row_a, col_a, z_a, row_b, col_b, z_b):  # type: ignore[no-untyped-def]
    """Return (least, at, greatest, at) of height minus surface along one segment, exactly.

    NaN throughout where the segment leaves the raster or touches a NaN corner with weight.
    """
    rows, cols = surface.shape
    nan = np.nan
    if not (
        min(row_a, row_b) >= 0
        and min(col_a, col_b) >= 0
        and max(row_a, row_b) <= rows - 1
        and max(col_a, col_b) <= cols - 1
    ):
        return nan, 0.0, nan, 0.0
    d_row, d_col, d_z = row_b - row_a, col_b - col_a, z_b - z_a
    least, greatest = np.inf, -np.inf
    least_at = greatest_at = 0.0
    t = 0.0
    while True:
        # The next crossing of a grid line, in parameter; the piece [t, t1] lies in one cell.
        t1 = 1.0
        if d_row != 0.0:
            here = row_a + t * d_row
            line = math.floor(here) + 1.0 if d_row > 0 else math.ceil(here) - 1.0
            t1 = min(t1, (line - row_a) / d_row)
        if d_col != 0.0:
            here = col_a + t * d_col
            line = math.floor(here) + 1.0 if d_col > 0 else math.ceil(here) - 1.0
            t1 = min(t1, (line - col_a) / d_col)
        if t1 <= t:
            # Rounding put the point a hair before the line it stands on; step over the line.
            t1 = min(1.0, t + 1e-12)
        middle = 0.5 * (t + t1)
        row0 = min(math.floor(row_a + middle * d_row), max(rows - 2, 0))
        col0 = min(math.floor(col_a + middle * d_col), max(cols - 2, 0))
        g = np.empty(3)
        for i in range(3):
            u = t + 0.5 * i * (t1 - t)
            # Crossings are clamped into the cell: rounding must not fetch a corner across a line.
            row = min(max(row_a + u * d_row, row0), row0 + 1.0)
            col = min(max(col_a + u * d_col, col0), col0 + 1.0)
            g[i] = z_a + u * d_z - cell_height(surface, row0, col0, row, col)
        if math.isnan(g[0]) or math.isnan(g[1]) or math.isnan(g[2]):
            return nan, t, nan, t
        for i in (0, 2):
            u = t if i == 0 else t1
            if g[i] < least:
                least, least_at = g[i], u
            if g[i] > greatest:
                greatest, greatest_at = g[i], u
        # g(v) = g0 + b v + c v^2 on v in [0, 1], from its ends and middle.
        c = 2.0 * (g[0] + g[2] - 2.0 * g[1])
        b = g[2] - g[0] - c
        if c != 0.0:
            v = -b / (2.0 * c)
            if 0.0 < v < 1.0:
                value = g[0] + v * (b + c * v)
                u = t + v * (t1 - t)
                if value < least:
                    least, least_at = value, u
                if value > greatest:
                    greatest, greatest_at = value, u
        if t1 >= 1.0:
            break
        t = t1
    return least, least_at, greatest, greatest_at


@njit(cache=True)
def _polyline_extremes(surface, row, col, z, out):  # type: ignore[no-untyped-def]
    for i in range(len(row) - 1):
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = segment_extremes(
            surface, row[i], col[i], z[i], row[i + 1], col[i + 1], z[i + 1]
        )


def polyline_extremes(
    surface: FloatArray, row: FloatArray, col: FloatArray, height_m: FloatArray
) -> Extremes:
    """Return the exact extremes of ``height - surface`` along a polyline.

    Parameters
    ----------
    surface : (rows, cols) heights at cell centres, NaN no data.
    row, col : (n,) fractional indices of the vertices, whole at cell centres.
    height_m : (n,) heights of the vertices, up.

    Notes
    -----
    Within a cell the surface is ``s + p u + q v + r u v``; with u, v and the height linear in the
    segment's parameter, their difference is a quadratic, known from three points of it.
    """
    out = np.empty((max(len(row) - 1, 0), 4))
    _polyline_extremes(
        np.ascontiguousarray(surface, dtype=np.float64),
        np.asarray(row, np.float64),
        np.asarray(col, np.float64),
        np.asarray(height_m, np.float64),
        out,
    )
    return Extremes(out[:, 0], out[:, 2], out[:, 1], out[:, 3])
