"""Where echoes truly come from: a strip draws them as if the floor were level beneath each line."""

from __future__ import annotations

import numba
import numpy as np

from perception.interpolation import cell_height
from perception.records import ElevationStrip, FloatArray, Grid, IntArray


def placed_across(strip: ElevationStrip, floor: Grid | None) -> FloatArray:
    """Return (n, m) the signed ground range at which each cell's slant range meets the floor.

    With altitude a, flat ground range x and the floor h above that beneath the line, the slant range is
    sqrt(x^2 + a^2) and the true ground range sqrt(x^2 + a^2 - (a - h)^2): a hill is drawn towards the track
    by h a / x, from every side towards another place. Unknown floor counts as level.
    """
    flat = np.asarray(strip.across_m, float)
    if floor is None:
        shape = strip.echo.shape
        return np.ascontiguousarray(np.broadcast_to(flat.astype(np.float32), shape))
    frame = np.array([floor.west_m, floor.north_m, floor.cell_m, floor.cell_north_m])
    poses = np.column_stack(
        [strip.easting_m, strip.northing_m, strip.heading_rad, np.nan_to_num(strip.altitude_m)]
    )
    knots = _knots(strip, min(floor.cell_m, floor.cell_north_m))
    return _places(flat, poses, np.asarray(floor.elevation_m, float), frame, knots)


def _knots(strip: ElevationStrip, cell_m: float) -> IntArray:
    """Return the lines at which the floor is read: one a cell of it, and the last."""
    last = len(strip.time_s) - 1
    return np.unique(np.append(np.arange(0, last, max(1, int(cell_m / strip.step_m))), last))


@numba.njit(cache=True, nogil=True)
def _places(
    flat: FloatArray, poses: FloatArray, floor: FloatArray, frame: FloatArray, knots: IntArray
) -> FloatArray:
    """Return (n, m) places of (m,) flat ranges; `poses` (n, 4) east, north, heading, altitude.

    Between the lines `knots` places are interpolated: the floor has nothing finer than its cells to say.
    """
    n, m = len(poses), len(flat)
    placed = np.empty((n, m), np.float32)
    for i in knots:
        east, north, heading, altitude = poses[i]
        c, s = np.cos(heading), np.sin(heading)
        beneath = _height(floor, frame, east, north)
        for j in range(m):
            x = flat[j]
            # The floor is first read at the flat place, then where that puts the cell: twice is within a cell.
            for _ in range(2):
                rise = _height(floor, frame, east + c * x, north - s * x) - beneath
                if np.isnan(rise):
                    rise = 0.0
                rise = min(max(rise, -2.0 * altitude), 0.8 * altitude)
                squared = flat[j] ** 2 + 2.0 * altitude * rise - rise * rise
                x = np.sign(flat[j]) * np.sqrt(max(squared, 0.0))
            placed[i, j] = x
    for k in range(1, len(knots)):
        low, high = knots[k - 1], knots[k]
        for i in range(low + 1, high):
            part = np.float32((i - low) / (high - low))
            for j in range(m):
                placed[i, j] = placed[low, j] + part * (placed[high, j] - placed[low, j])
    return placed


@numba.njit(cache=True, nogil=True)
def _height(floor: FloatArray, frame: FloatArray, east: float, north: float) -> float:
    """Return `Grid.sample` of one place: bilinear, NaN outside the outermost centres or beside a NaN."""
    rows, cols = floor.shape
    row = (frame[1] - north) / frame[3] - 0.5
    col = (east - frame[0]) / frame[2] - 0.5
    if not (0.0 <= row <= rows - 1 and 0.0 <= col <= cols - 1):
        return np.nan
    r, c = min(int(row), max(rows - 2, 0)), min(int(col), max(cols - 2, 0))
    return cell_height(floor, r, c, row, col)
