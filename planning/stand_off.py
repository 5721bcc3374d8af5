"""The least slant distance from a route to the ground: over a slope it is less than the altitude."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from perception.records import FloatArray, bilinear
from planning.finish import Waypoints
from planning.surface import Surface

# The closer look around the nearest cell: half its width in cells and in segments, and into how many
# parts that half is divided.
_LOOK, _FINE = 2.0, 24


def least_stand_off(
    surface: FloatArray,
    cell_m: tuple[float, float],
    row: FloatArray,
    col: FloatArray,
    height_m: FloatArray,
    reach_m: float,
) -> tuple[float, int]:
    """Return the least slant distance from a polyline to the bilinear surface, and its nearest vertex.

    The nearest pair of vertex and cell centre is looked for first, then the least distance between
    points of path and surface around it, down to a hundredth of a cell and of a segment.

    Parameters
    ----------
    surface : (rows, cols) heights at cell centres, NaN no data.
    cell_m : width and height of a cell.
    row, col, height_m : (n,) vertices, fractional indices and heights.
    reach_m : how far to look; infinite is returned where nothing lies nearer.
    """
    heights = np.asarray(surface, np.float64)
    r, c, z = (np.asarray(v, np.float64) for v in (row, col, height_m))
    best, at, i, j = _nearest(heights, cell_m[0], cell_m[1], r, c, z, reach_m)
    if not math.isfinite(best):
        return math.inf, 0
    return min(float(best), _closer(heights, cell_m, (r, c, z), int(at), int(i), int(j))), int(at)


def stand_off(surface: Surface, w: Waypoints) -> float:
    """Return the least slant distance of proved waypoints to a surface's bottom."""
    x, y = surface.local(w.easting_m, w.northing_m)
    # Nothing is nearer than the ground below, and that is known.
    reach = w.least_altitude_m + 2.0 * max(surface.cell_m)
    distance, _ = least_stand_off(
        surface.bottom_m, surface.cell_m, y / surface.cell_m[1], x / surface.cell_m[0], -w.depth_m,
        reach,
    )  # fmt: skip
    return min(distance, w.least_altitude_m)


def _closer(
    surface: FloatArray,
    cell_m: tuple[float, float],
    path: tuple[FloatArray, FloatArray, FloatArray],
    at: int,
    i: int,
    j: int,
) -> float:
    """Look twice around a vertex and a cell, the second time around the first's best, more closely."""
    stations = np.arange(len(path[0]))
    s, row, col, half, best = float(at), float(i), float(j), float(_LOOK), math.inf
    for _ in range(2):
        offset = half * np.linspace(-1.0, 1.0, 2 * _FINE + 1)
        v = np.clip(s + offset, 0, len(stations) - 1)
        r, c, z = (np.interp(v, stations, p) for p in path)
        rows, cols = (g.ravel() for g in np.meshgrid(row + offset, col + offset, indexing="ij"))
        ground = bilinear(surface, rows, cols)
        dy = (r[:, None] - rows) * cell_m[1]
        dx = (c[:, None] - cols) * cell_m[0]
        d2 = dx * dx + dy * dy + (z[:, None] - ground) ** 2
        if not np.isfinite(d2).any():
            break
        k, m = np.unravel_index(int(np.nanargmin(d2)), d2.shape)
        best = min(best, math.sqrt(float(d2[k, m])))
        s, row, col, half = float(v[k]), float(rows[m]), float(cols[m]), 2.0 * half / _FINE
    return best


@njit(cache=True)
def _nearest(surface, width, height, row, col, z, reach):  # type: ignore[no-untyped-def]
    """Return (distance, vertex, row, col) of the nearest pair of vertex and cell centre."""
    best, at, best_r, best_c = reach, -1, 0, 0
    for i in range(len(row)):
        # Only cells nearer than the best so far can matter.
        n_r, n_c = int(best / height) + 1, int(best / width) + 1
        r0, c0 = round(row[i]), round(col[i])
        for r in range(max(0, r0 - n_r), min(surface.shape[0], r0 + n_r + 1)):
            for c in range(max(0, c0 - n_c), min(surface.shape[1], c0 + n_c + 1)):
                dy, dx, dz = (r - row[i]) * height, (c - col[i]) * width, z[i] - surface[r, c]
                d = math.sqrt(dx * dx + dy * dy + dz * dz)
                if d < best:
                    best, at, best_r, best_c = d, i, r, c
    return (best if at >= 0 else np.inf), at, best_r, best_c
