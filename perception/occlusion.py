"""Shadows as equations: a shadow's end lies on the ray that grazes its start.

Where the echo is far below what a level floor would send, the floor is hidden. Such samples tell
nothing of slope and are left out of the shading; instead start and end of each shadow are put on one
ray, and ground between them that the present surface lifts above the ray is put down onto it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numba import njit
from scipy import sparse

from perception.gain_basis import GainBasis
from perception.rays import Rays
from perception.records import BoolArray, FloatArray
from perception.soundings import Equations, bilinear_rows

# Power below this part of a level floor's is shadow: a slope must come within a fifth of grazing to
# echo as little, and four decibels of albedo do not bridge it.
_DARK = 0.04
# 1-sigma of an end's height above the ray of the start: edges are known to a sample or two, and the
# grazing crest is sharper than a cell.
_END_SIGMA_M = 0.15
# Beyond this misfit an end is more likely something else (a dark patch, a ghost).
_END_DOUBT_M = 0.6


def dark_samples(
    rays: Rays, level_m: FloatArray, basis: GainBasis, gain: FloatArray, cell_m: float
) -> BoolArray:
    """Return (n, m) True where a ray's echo is that of a shadow.

    Parameters
    ----------
    level_m : (n,) height of the floor about the ray.
    """
    m = rays.power.shape[1]
    slant = (np.arange(m) + 0.5) * rays.sample_m[:, None]
    drop = (rays.up_m - level_m)[:, None]
    angle = np.arccos(np.clip(drop / slant, 1e-3, 0.999))
    side = np.full(angle.shape, rays.side, np.int64)
    knot, share = basis.place((angle + rays.tilt_rad[:, None]).ravel(), slant.ravel(), side.ravel())
    level_gain = np.einsum("ij,ij->i", share, gain[knot]).reshape(angle.shape)
    tangent = 1 / np.tan(angle)
    reference = np.exp(level_gain) * tangent**2 / np.sqrt(1 + tangent**2)
    size = max(3, round(0.4 * cell_m / float(rays.sample_m[0]))) | 1
    shortest = max(size, round(cell_m / float(rays.sample_m[0])))
    dark = np.zeros(rays.power.shape, np.bool_)
    find_dark(rays.power.astype(np.float64), reference, size, shortest, _DARK, dark)
    dark[slant < 1.15 * drop] = False
    return dark


@njit(cache=True)
def find_dark(power, reference, size, shortest, limit, dark):  # type: ignore[no-untyped-def]
    """Mark runs of at least `shortest` samples whose running mean stays below `limit`."""
    n, m = power.shape
    for i in range(n):
        total = 0.0
        run = 0
        for k in range(m):
            v = power[i, k] / reference[i, k] if power[i, k] >= 0 else 1.0
            total += min(v, 1.0)
            if k >= size:
                w = power[i, k - size] / reference[i, k - size] if power[i, k - size] >= 0 else 1.0
                total -= min(w, 1.0)
            below = k >= size - 1 and total < limit * size
            if below:
                run += 1
            if (not below or k == m - 1) and run > 0:
                # A window that is all dark covers `size` samples: the run is longer by that much.
                first = k - run - size + 1
                last = k - 1
                if last - first + 1 >= shortest and not below:
                    for q in range(max(first, 0), last + 1):
                        dark[i, q] = True
                run = 0
    return


@njit(cache=True)
def shadow_ends(z, west, south, cell, east, north, up, azimuth, sample_m, dark, step, out):  # type: ignore[no-untyped-def]
    """Write (ray, ground range of start, middle and end) of every shadow; return their number."""
    n, m = dark.shape
    rows, cols = z.shape
    count = 0
    for i in range(n):
        ds = sample_m[i]
        ux, uy = np.sin(azimuth[i]), np.cos(azimuth[i])
        k = 0
        g = step
        slant = 0.0
        while k < m:
            if not dark[i, k]:
                k += 1
                continue
            first = k
            while k < m and dark[i, k]:
                k += 1
            if k >= m - 1 or first == 0:
                break
            start = -1.0
            end = -1.0
            while g < m * ds:
                x = (east[i] + ux * g - west) / cell
                y = (north[i] + uy * g - south) / cell
                c, r = int(np.floor(x)), int(np.floor(y))
                if c < 0 or r < 0 or c >= cols - 1 or r >= rows - 1:
                    break
                fx, fy = x - c, y - r
                h = (1 - fy) * ((1 - fx) * z[r, c] + fx * z[r, c + 1]) + fy * (
                    (1 - fx) * z[r + 1, c] + fx * z[r + 1, c + 1]
                )
                slant = np.sqrt(g * g + (up[i] - h) ** 2)
                if start < 0 and slant >= first * ds:
                    start = g
                if slant >= k * ds:
                    end = g
                    break
                g += step
            if start > 0 and end > start and count < len(out):
                out[count, 0] = i
                out[count, 1] = start
                out[count, 2] = 0.5 * (start + end)
                out[count, 3] = end
                count += 1
    return count


def shadow_equations(
    surface: FloatArray,
    west_m: float,
    south_m: float,
    cell_m: float,
    rays: Sequence[Rays],
    dark: Sequence[BoolArray],
) -> Equations:
    """Return the shadows of all rays as equations on the surface, linearised about it."""
    parts, weights, values = [], [], []
    for ray, hidden in zip(rays, dark, strict=True):
        found = np.empty((int(hidden.any(axis=1).sum()) * 12 + 1, 4))
        count = shadow_ends(
            surface, west_m, south_m, cell_m, ray.easting_m, ray.northing_m, ray.up_m,
            ray.azimuth_rad, ray.sample_m, hidden, 0.25 * cell_m, found,
        )  # fmt: skip
        index = found[:count, 0].astype(np.int64)
        one = replace(
            ray, easting_m=ray.easting_m[index], northing_m=ray.northing_m[index],
            up_m=ray.up_m[index], azimuth_rad=ray.azimuth_rad[index],
        )  # fmt: skip
        start = _points(surface, west_m, south_m, cell_m, one, found[:count, 1])
        for column, only_above in ((3, False), (2, True)):
            point = _points(surface, west_m, south_m, cell_m, one, found[:count, column])
            # Height of the point above the ray that grazes the start.
            above = (point[3] - start[3]) * point[4]
            used = np.flatnonzero(above > 0) if only_above else np.arange(count)
            share = point[4] / start[4]
            a = bilinear_rows(point[0][used], point[1][used], np.ones(len(used)), surface.shape)
            b = bilinear_rows(start[0][used], start[1][used], share[used], surface.shape)
            matrix = sparse.csr_matrix(a - b)
            parts.append(matrix)
            doubt = 1 / (1 + (above[used] / _END_DOUBT_M) ** 2)
            weights.append(doubt / _END_SIGMA_M**2)
            values.append((point[2] - share * start[2] - above)[used])
    return Equations(
        sparse.csr_matrix(sparse.vstack(parts)), np.concatenate(weights), np.concatenate(values)
    )


def _points(
    surface: FloatArray,
    west_m: float,
    south_m: float,
    cell_m: float,
    ray: Rays,
    ground_m: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return (row, col, height, angle from the vertical, lever g - d p) of points along rays."""
    from perception.records import bilinear

    heights = []
    for g in (ground_m - 0.5 * cell_m, ground_m, ground_m + 0.5 * cell_m):
        col = (ray.easting_m + np.sin(ray.azimuth_rad) * g - west_m) / cell_m
        row = (ray.northing_m + np.cos(ray.azimuth_rad) * g - south_m) / cell_m
        col = np.clip(col, 0, surface.shape[1] - 1.001)
        row = np.clip(row, 0, surface.shape[0] - 1.001)
        heights.append((row, col, bilinear(surface, row, col)))
    row, col, height = heights[1]
    slope = (heights[2][2] - heights[0][2]) / cell_m
    drop = ray.up_m - height
    lever = np.clip(ground_m - drop * slope, 0.7 * ground_m, 1.5 * ground_m)
    return row, col, height, np.arctan2(ground_m, drop), lever
