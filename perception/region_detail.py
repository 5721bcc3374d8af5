"""How coarse a surface the classes are read from: levels of detail, and the one taken without asking.

A coarser level is the map averaged over blocks of half the level's scale to all of it, and then treated as any
map: what is rough at one of *those* cells counts as noise. So a level tells the landforms of
its own size that stand out from smaller ones, at 2 sigma like the finest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit, prange
from scipy import ndimage

from perception.box_fit import box_derivatives
from perception.curvature import Curvature, Operator, curvature_of
from perception.noise import independent_noise
from perception.records import FloatArray, Grid
from perception.scale import smooth, upsample

# Regions are of use from about this many cells on: a dozen on a side. Rough terrain segmented at its own finest
# scale gives 20 to 60, hills and dunes that a map resolves give 400 and more (half the classed area each).
USEFUL_CELLS = 144
# With fewer regions than this nobody asks for fewer.
_FEW = 30
# Cells from one node of the noise map to the next.
_STEP = 8
# No level is taken unasked that leaves fewer blocks than this on the longer side, and none is thinned below ...
_LEAST_SIDE = 32
_LEAST_NODES = 16
# Above this many cells the level is chosen on tiles of so many cells a side, where most is known.
_WHOLE_CELLS = 300_000
_TILE = 256
_TILES = 4


def box_curvature(grid: Grid, window_m: float) -> Curvature:
    """Return H, K and their errors of the quadratic fitted over a box `window_m` wide about each cell."""
    # No box need be larger than the map, and none can be smaller than three cells.
    half = (
        min(max(round(0.5 * window_m / grid.cell_north_m - 0.5), 1), grid.shape[0]),
        min(max(round(0.5 * window_m / grid.cell_m - 0.5), 1), grid.shape[1]),
    )
    derivatives, gain = box_derivatives(grid.elevation_m, grid.cell_m, grid.cell_north_m, half)
    noise = upsample(independent_noise(grid.elevation_m, grid.sigma_m, _STEP), _STEP, grid.shape)
    mean, gauss, sigma_h, sigma_k = curvature_of(derivatives, gain, noise.astype(np.float64))
    # The Gaussian sigma that leaves the same noise in the second derivatives.
    with np.errstate(divide="ignore"):
        noise_gain = np.sqrt(np.maximum(gain.rr * gain.tt, 0.0))
        scale = (3 * grid.cell_m * grid.cell_north_m / (16 * np.pi * noise_gain)) ** (1 / 6)
    # A box of one row has no curvature across itself and no noise in it.
    scale[~np.isfinite(scale) & ~np.isnan(mean)] = 0.5 * window_m
    return Curvature(mean, gauss, sigma_h, sigma_k, scale, noise)


def curvature_at(
    grid: Grid, scale_m: float | None, least_m: float, operator: Operator
) -> Curvature:
    """Return H, K and their errors at the scale that the noise asks for, and no finer than `least_m`.

    Parameters
    ----------
    scale_m : one scale for the whole map instead of one chosen per cell; None chooses.
    least_m : least scale of a level of detail; 0 the finest.
    """
    if scale_m is not None:
        return _curvature(grid, max(scale_m, least_m), 0.0, operator)
    thinning = _thinning(grid, least_m)
    if thinning == 1:
        return _curvature(grid, None, least_m, operator)
    # A map too small to be thinned further is smoothed instead.
    rest_m = least_m if least_m >= 2 * thinning * np.sqrt(grid.cell_m * grid.cell_north_m) else 0.0
    coarse = _curvature(_thinned(grid, thinning), None, rest_m, operator)
    # Bare differences of means have the noise of a Gaussian of half a block, which is smoothing here.
    least_m = 0.5 * thinning * np.sqrt(grid.cell_m * grid.cell_north_m)
    coarse = replace(coarse, scale_m=np.fmax(coarse.scale_m, least_m))
    return _spread(coarse, thinning, grid)


def _curvature(grid: Grid, scale_m: float | None, least_m: float, operator: Operator) -> Curvature:
    smoothing = smooth(
        grid.elevation_m,
        grid.cell_m,
        grid.cell_north_m,
        grid.sigma_m,
        scale_m,
        operator,
        least_m,
    )
    mean, gauss, sigma_h, sigma_k = curvature_of(
        smoothing.derivatives, smoothing.gain, smoothing.noise_m, smoothing.step
    )
    scale = upsample(smoothing.scale_m, smoothing.step, grid.shape)
    scale[np.isnan(mean)] = np.nan
    noise = upsample(smoothing.noise_m, smoothing.step, grid.shape)
    return Curvature(mean, gauss, sigma_h, sigma_k, scale, noise)


def _thinning(grid: Grid, least_m: float) -> int:
    """Return the power of two by which a level's map is thinned: its scale is then one to two cells."""
    cell_m = np.sqrt(grid.cell_m * grid.cell_north_m)
    thinning = 1
    while 2 * thinning * cell_m <= least_m and max(grid.shape) >= 2 * thinning * _LEAST_NODES:
        thinning *= 2
    # One row or column cannot be thinned in one direction alone.
    return thinning if min(grid.shape) >= 4 * thinning else 1


def _thinned(grid: Grid, thinning: int) -> Grid:
    """Return the map's means over blocks, without a sigma: its own scatter tells more there.

    Means, not a smoother's values: what is rough at the size of a block must stay to be seen as noise.
    """
    rows, cols = grid.shape
    means = np.empty((-(-rows // thinning), -(-cols // thinning)))
    _block_means(grid.elevation_m, thinning, means)
    return Grid(
        means,
        grid.west_m,
        grid.north_m,
        grid.cell_m * thinning,
        cell_height_m=grid.cell_north_m * thinning,
    )


@njit(cache=True, parallel=True)
def _block_means(z: npt.NDArray[Any], thinning: int, means: npt.NDArray[np.float64]) -> None:
    rows, cols = z.shape
    for m in prange(means.shape[0]):
        for n in range(means.shape[1]):
            total, count = 0.0, 0
            for i in range(m * thinning, min((m + 1) * thinning, rows)):
                for j in range(n * thinning, min((n + 1) * thinning, cols)):
                    if not np.isnan(z[i, j]):
                        total += z[i, j]
                        count += 1
            means[m, n] = total / count if count > 0 else np.nan


def _spread(coarse: Curvature, thinning: int, grid: Grid) -> Curvature:
    """Interpolate a thinned map's curvature to the cells of the map; NaN where it has no height."""
    planes = (coarse.H, coarse.K, coarse.sigma_H, coarse.sigma_K, coarse.scale_m)
    nodes = np.stack([_filled(np.asarray(plane, np.float64)) for plane in planes])
    out = np.empty((5, *grid.shape), np.float32)
    _between_nodes(nodes, grid.elevation_m, thinning, out)
    # Nobody asks a level for its noise: one number stands for it.
    noise = np.broadcast_to(np.float32(np.nanmedian(coarse.noise_m)), grid.shape)
    return Curvature(out[0], out[1], out[2], out[3], out[4], noise)


def _filled(values: FloatArray) -> FloatArray:
    """Fill what is missing from the nearest that is known."""
    missing = np.isnan(values)
    if not missing.any() or missing.all():
        return values
    nearest = ndimage.distance_transform_edt(missing, return_distances=False, return_indices=True)
    filled: FloatArray = values[tuple(nearest)]
    return filled


@njit(cache=True, parallel=True)
def _between_nodes(
    nodes: npt.NDArray[np.float64],
    z: npt.NDArray[Any],
    thinning: int,
    out: npt.NDArray[np.float32],
) -> None:
    """Interpolate planes bilinearly between the centres of blocks; NaN where z is."""
    count, rows, cols = nodes.shape
    for i in prange(z.shape[0]):
        a = min(max((i + 0.5) / thinning - 0.5, 0.0), rows - 1.0)
        top = int(a)
        low = min(top + 1, rows - 1)
        a -= top
        for k in range(count):
            line = nodes[k, top] * (1 - a) + nodes[k, low] * a
            fine = out[k, i]
            for j in range(len(fine)):
                b = min(max((j + 0.5) / thinning - 0.5, 0.0), cols - 1.0)
                left = int(b)
                b -= left
                fine[j] = line[left] * (1 - b) + line[min(left + 1, cols - 1)] * b
                if np.isnan(z[i, j]):
                    fine[j] = np.nan


def tiles(grid: Grid) -> list[Grid]:
    """Return what the level is chosen on: the map, or some full tiles of a large one."""
    if grid.elevation_m.size <= _WHOLE_CELLS:
        return [grid]
    known = [(float(np.isfinite(t.elevation_m[::8, ::8]).mean()), t) for t in _lattice(grid)]
    best = max(share for share, _ in known)
    if best == 0:
        # The thinned look missed what little there is.
        known = [(float(np.isfinite(t.elevation_m).mean()), t) for _, t in known]
        best = max(share for share, _ in known)
        if best == 0:
            return [grid]
    full = [tile for share, tile in known if share >= 0.8 * best and share > 0]
    # Spread over the map: every so many of the full ones.
    return full[:: max(1, len(full) // _TILES)][:_TILES]


def _lattice(grid: Grid) -> Iterator[Grid]:
    rows, cols = grid.shape
    height, width = min(_TILE, rows), min(_TILE, cols)
    corners = [
        (i, j)
        for i in np.linspace(0, rows - height, min(8, -(-rows // height))).astype(int)
        for j in np.linspace(0, cols - width, min(8, -(-cols // width))).astype(int)
    ]
    for i, j in corners:
        window = np.s_[i : i + height, j : j + width]
        sigma_m = None if grid.sigma_m is None else grid.sigma_m[window]
        # A copy: kernels are compiled once, for whole arrays, and not again for windows.
        z = np.ascontiguousarray(grid.elevation_m[window])
        yield replace(grid, elevation_m=z, sigma_m=sigma_m, count=None)


def typical_cells(sizes: list[npt.NDArray[np.floating[Any]]]) -> float:
    """Return the size of region, in cells, that half of the classed area lies at or above.

    Parameters
    ----------
    sizes : for each tile the cells of its regions that are not flat. A few regions are no crowd: infinite.
    """
    cells = np.sort(np.concatenate(sizes))
    if len(cells) < _FEW:
        return float("inf")
    running = np.cumsum(cells)
    return float(cells[np.searchsorted(running, running[-1] / 2)])


def next_level(typical: float) -> int:
    """Return by how many doublings of the scale regions of a useful size are expected; 0 they are."""
    if typical >= USEFUL_CELLS:
        return 0
    # On rough ground a region's area goes with the square of the scale it is seen at.
    return int(np.ceil(0.5 * np.log2(USEFUL_CELLS / typical)))


def candidates(grid: Grid) -> list[float]:
    """Return the least scales to try, m, finest first: the map's own, then two cells, four, ..."""
    cell_m = float(np.sqrt(grid.cell_m * grid.cell_north_m))
    scales, thinning = [0.0], 2
    while max(grid.shape) >= thinning * _LEAST_SIDE and min(grid.shape) >= 4 * thinning:
        scales.append(thinning * cell_m)
        thinning *= 2
    return scales
