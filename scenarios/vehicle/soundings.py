"""Beams of a Doppler log and the altimeter: rays cast on the true floor."""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.records import FloatArray, Grid
from scenarios.vehicle.motion import Motion

# The contract's default: four beams 30 degrees off nadir, azimuths clockwise from the bow.
BEAM_AZIMUTHS_DEG = (45.0, 135.0, 225.0, 315.0)
BEAM_OFF_NADIR_DEG = 30.0


def beam_ranges(motion: Motion, floor: Grid, longest_m: float = 200.0) -> FloatArray:
    """Return the true range (n, 4) along each beam to the floor; NaN beyond `longest_m`."""
    azimuth = np.deg2rad(np.array(BEAM_AZIMUTHS_DEG))
    tilt = np.deg2rad(BEAM_OFF_NADIR_DEG)
    body = np.stack(
        [
            np.sin(tilt) * np.cos(azimuth),
            np.sin(tilt) * np.sin(azimuth),
            np.full(azimuth.shape, np.cos(tilt)),
        ],
        axis=1,
    )
    directions = np.einsum("nij,bj->nbi", rotation_to_map(motion), body)
    origins = np.column_stack([motion.easting_m, motion.northing_m, motion.elevation_m])
    return _cast(
        np.ascontiguousarray(floor.elevation_m, np.float64),
        floor.west_m, floor.north_m, floor.cell_m, origins, directions, longest_m,
    )  # fmt: skip


def rotation_to_map(motion: Motion) -> FloatArray:
    """Return (n, 3, 3) matrices from the body (forward, starboard, down) to (east, north, up)."""
    h, p, r = motion.heading_rad, motion.pitch_rad, motion.roll_rad
    ch, sh, cp, sp, cr, sr = np.cos(h), np.sin(h), np.cos(p), np.sin(p), np.cos(r), np.sin(r)
    forward = np.stack([sh * cp, ch * cp, sp], axis=-1)
    starboard = np.stack([ch * cr + sh * sp * sr, -sh * cr + ch * sp * sr, -cp * sr], axis=-1)
    down = np.stack([-ch * sr + sh * sp * cr, sh * sr + ch * sp * cr, -cp * cr], axis=-1)
    return np.stack([forward, starboard, down], axis=-1)


@njit(cache=True)
def _cast(heights, west_m, north_m, cell_m, origins, directions, longest_m):  # type: ignore[no-untyped-def]
    """March each ray by half cells to the first point below the floor, then bisect."""
    n, beams = directions.shape[0], directions.shape[1]
    out = np.full((n, beams), np.nan)
    step = 0.5 * cell_m
    for i in range(n):
        for b in range(beams):
            t = 0.0
            while t < longest_m:
                t += step
                if _above(heights, west_m, north_m, cell_m, origins[i], directions[i, b], t) <= 0.0:
                    near, far = t - step, t
                    for _ in range(20):
                        middle = 0.5 * (near + far)
                        gap = _above(
                            heights, west_m, north_m, cell_m, origins[i], directions[i, b], middle
                        )
                        if gap > 0.0:
                            near = middle
                        else:
                            far = middle
                    out[i, b] = 0.5 * (near + far)
                    break
    return out


@njit(cache=True)
def _above(heights, west_m, north_m, cell_m, origin, direction, t):  # type: ignore[no-untyped-def]
    """Height of the ray above the floor at range `t`; edges extend outward."""
    rows, cols = heights.shape
    row = (north_m - origin[1] - t * direction[1]) / cell_m - 0.5
    col = (origin[0] + t * direction[0] - west_m) / cell_m - 0.5
    row = min(max(row, 0.0), rows - 1.001)
    col = min(max(col, 0.0), cols - 1.001)
    i, j = int(row), int(col)
    fr, fc = row - i, col - j
    floor = (heights[i, j] * (1 - fc) + heights[i, j + 1] * fc) * (1 - fr) + (
        heights[i + 1, j] * (1 - fc) + heights[i + 1, j + 1] * fc
    ) * fr
    return origin[2] + t * direction[2] - floor
