"""How much of a map's heights is noise that is independent from cell to cell.

The fourth difference along both axes has the response (2 sin f/2)^4 on each: relief of more than some ten
cells leaves nothing in it, noise of one cell all of its power. Its median absolute value over blocks is
not led by the few cells where relief is sharp.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit, prange
from scipy import ndimage

from perception.records import FloatArray

Array = npt.NDArray[Any]

_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
# Root of the sum of squares of the difference's weights along one axis.
_NORM = np.sqrt(70.0)
_BLOCK = 64
# With fewer differences a block's median says little.
_LEAST = 50
# A stated sigma above 1 / 0.8 of the scatter seen is not noise of single cells: such noise would show.
_SEEN = 0.8


def independent_noise(z: FloatArray, sigma_m: FloatArray | None, step: int) -> FloatArray:
    """Estimate the 1-sigma of the independent noise on every `step`-th row and column, (m, n).

    Parameters
    ----------
    z : (rows, cols) heights; NaN no data.
    sigma_m : (rows, cols) stated 1-sigma of the heights, all causes together. Where the scatter seen
        supports it, it is taken; where less is seen, its remainder is correlated over many cells and
        hardly bends the surface, so what is seen is taken. Cells where it is not a positive number
        are passed over.
    """
    # The last node lies at or beyond the last cell, so that none is extrapolated.
    nodes = ((z.shape[0] + step - 2) // step + 1, (z.shape[1] + step - 2) // step + 1)
    seen = _to_nodes(_block_scatter(z), nodes, step)
    if sigma_m is None:
        return np.where(np.isfinite(seen), seen, 0.0)
    stated = np.sqrt(_node_mean_square(np.ascontiguousarray(sigma_m, np.float64), step, nodes))
    known = np.isfinite(stated)
    if not known.any():
        return np.where(np.isfinite(seen), seen, 0.0)
    trusted = known & (~np.isfinite(seen) | (seen >= _SEEN * stated))
    return np.where(trusted, stated, np.where(np.isfinite(seen), seen, 0.0))


def _block_scatter(z: FloatArray) -> FloatArray:
    """Return the robust 1-sigma of independent noise per block, medians of 3 x 3 blocks; NaN unknown."""
    values = np.ascontiguousarray(z)
    rows, cols = values.shape
    down = _DIFFERENCE / _NORM if rows >= 5 else np.array([1.0])
    across = _DIFFERENCE / _NORM if cols >= 5 else np.array([1.0])
    blocks = (-(-rows // _BLOCK), -(-cols // _BLOCK))
    if rows < 5 and cols < 5:
        return np.full(blocks, np.nan)
    # A million differences tell as much as sixteen.
    stride = max(1, int(np.sqrt(values.size / 1e6)))
    scatter, count = np.empty(blocks), np.empty(blocks)
    _scatter(values, down, across, stride, scatter, count)
    scatter[count < min(_LEAST, 0.25 * values.size)] = np.nan
    return _median_of_neighbours(scatter)


@njit(cache=True, parallel=True)
def _scatter(
    z: Array, down: Array, across: Array, stride: int, scatter: Array, count: Array
) -> None:
    rows, cols = z.shape
    ny, nx = len(down) // 2, len(across) // 2
    for bi in prange(scatter.shape[0]):
        found = np.empty(64 * 64)
        for bj in range(scatter.shape[1]):
            n = 0
            for i in range(max(64 * bi, ny), min(64 * bi + 64, rows - ny), stride):
                for j in range(max(64 * bj, nx), min(64 * bj + 64, cols - nx), stride):
                    total = 0.0
                    for k in range(-ny, ny + 1):
                        line = 0.0
                        for m in range(-nx, nx + 1):
                            line += across[m + nx] * z[i + k, j + m]
                        total += down[k + ny] * line
                    if not np.isnan(total):
                        found[n] = abs(total)
                        n += 1
            count[bi, bj] = n
            # 0.6745 is the median absolute value of a standard Gaussian.
            scatter[bi, bj] = np.median(found[:n]) / 0.6745 if n > 0 else np.nan


def _median_of_neighbours(values: FloatArray) -> FloatArray:
    padded = np.pad(values, 1, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).reshape(*values.shape, 9)
    known = np.isfinite(windows).any(axis=-1)
    out = np.full(values.shape, np.nan)
    out[known] = np.nanmedian(windows[known], axis=-1)
    if known.any() and not known.all():
        nearest = ndimage.distance_transform_edt(
            ~known, return_distances=False, return_indices=True
        )
        out = out[tuple(nearest)]
    return out


def _to_nodes(blocks: FloatArray, nodes: tuple[int, int], step: int) -> FloatArray:
    """Interpolate from the blocks' centres to the nodes, held constant outside."""
    rows = np.arange(nodes[0]) * step / _BLOCK - 0.5
    cols = np.arange(nodes[1]) * step / _BLOCK - 0.5
    grid = np.meshgrid(rows, cols, indexing="ij")
    return ndimage.map_coordinates(blocks, grid, order=1, mode="nearest")


@njit(cache=True)
def _node_mean_square(values: Array, step: int, nodes: tuple[int, int]) -> Array:
    """Return the mean square of the positive values about each node; NaN where there is none."""
    out = np.empty(nodes)
    half = step // 2
    for i in range(nodes[0]):
        for j in range(nodes[1]):
            total, n = 0.0, 0
            for a in range(max(i * step - half, 0), min(i * step + half, values.shape[0])):
                for b in range(max(j * step - half, 0), min(j * step + half, values.shape[1])):
                    if values[a, b] > 0 and np.isfinite(values[a, b]):
                        total += values[a, b] ** 2
                        n += 1
            out[i, j] = total / n if n > 0 else np.nan
    return out
