"""Gaps filled on request: local kriging from the data around a gap, with a sigma that grows into it.

How rough the floor is tells how far a datum reaches: its variogram is learned from the map itself as
`nugget + scale h^exponent`, the form of fractal ground (exponent towards 2 on smooth ground). A cell is
estimated from the nearest data in sixteen directions, so a gap's two sides always both speak, and nothing
outside the data's outline is made up. The choice of data depends on the cell's surroundings alone: a
tile fills its gaps as the whole map would.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numba
import numpy as np
from scipy import ndimage
from scipy.optimize import nnls

from perception.records import BoolArray, FloatArray, Grid, InputError, IntArray

# Data are looked for this many times as far as gaps are filled: the far side of a gap, and beyond.
SEARCH = 2.0
_RAYS = 16
# Cells solved at a time: 33 x 33 systems, some 30 MB.
_CHUNK = 2048
# What the map as a whole says of the roughness counts as so many data beside a gap's own.
_COMMON_DATA = 8.0
_EXPONENTS = np.arange(0.4, 1.96, 0.05)


@dataclass(frozen=True, slots=True)
class Variogram:
    """Half the mean squared difference of heights h metres apart: `nugget_m2 + scale h^exponent`."""

    nugget_m2: float
    scale: float
    exponent: float

    def relief_m2(self, distance_m: FloatArray) -> FloatArray:
        """Return the part that is the floor's, without the nugget (noise of single cells)."""
        power: FloatArray = self.scale * distance_m**self.exponent
        return power


def learn_variogram(windows: Iterable[FloatArray], cell_m: float, reach_m: float) -> Variogram:
    """Fit the variogram to windows of a map, over distances that filling bridges.

    Parameters
    ----------
    windows : (rows, cols) heights, NaN no data; several of a large map stand for all of it.
    reach_m : gaps are filled up to this far from data.

    Raises
    ------
    InputError
        No two cells of any window lie side by side with heights.
    """
    most = max(2, int(np.ceil(SEARCH * reach_m / cell_m)))
    lags = np.unique(np.round(np.geomspace(1, most, 12)).astype(int))
    square, number = np.zeros(len(lags)), np.zeros(len(lags))
    for height in windows:
        for k, lag in enumerate(lags):
            for apart in (height[lag:] - height[:-lag], height[:, lag:] - height[:, :-lag]):
                known = np.isfinite(apart)
                square[k] += float((apart[known].astype(float) ** 2).sum())
                number[k] += int(known.sum())
    seen = number > 0
    if not seen.any():
        raise InputError("the map has too few heights side by side to fill gaps from; drop --fill")
    return _fit(lags[seen] * cell_m, 0.5 * square[seen] / number[seen])


def _fit(distance_m: FloatArray, half_square_m2: FloatArray) -> Variogram:
    """Fit nugget and scale (not negative) for each exponent, by relative error; keep the best."""
    weight = 1.0 / np.maximum(half_square_m2, 1e-9)
    best, kept = np.inf, Variogram(0.0, 1e-9, 1.0)
    for exponent in _EXPONENTS:
        design = np.column_stack([np.ones_like(distance_m), distance_m**exponent])
        (nugget, scale), misfit = nnls(design * weight[:, None], half_square_m2 * weight)
        if misfit < best - 1e-9:
            best, kept = misfit, Variogram(float(nugget), max(float(scale), 1e-9), float(exponent))
    return kept


def fill_gaps(
    height_m: FloatArray,
    sigma_m: FloatArray,
    cell_m: float,
    reach_m: float,
    variogram: Variogram,
) -> tuple[FloatArray, FloatArray]:
    """Estimate the cells without data that lie within reach of it and inside its outline.

    Parameters
    ----------
    height_m, sigma_m : (rows, cols); NaN no data.

    Returns
    -------
    height_m, sigma_m : (rows, cols) of the filled cells; NaN elsewhere, where there are data too.
    """
    known = np.isfinite(height_m) & np.isfinite(sigma_m)
    filled, sigma = np.full(height_m.shape, np.nan), np.full(height_m.shape, np.nan)
    if not known.any():
        return filled, sigma
    near = ndimage.distance_transform_edt(~known) * cell_m <= reach_m
    # A height whose sigma nobody knows is no datum to fill from, and no gap either.
    rows, cols = np.nonzero(near & ~np.isfinite(height_m))
    steps = int(np.ceil(SEARCH * reach_m / cell_m))
    # Whole cells to each neighbour; rays of unequal angle are told apart by rounding alone.
    angle = 2 * np.pi * np.arange(_RAYS) / _RAYS
    for start in range(0, len(rows), _CHUNK):
        part = slice(start, start + _CHUNK)
        at, enclosed = neighbours(
            known, rows[part], cols[part], np.cos(angle), np.sin(angle), steps
        )
        r, c, at = rows[part][enclosed], cols[part][enclosed], at[enclosed]
        if len(r):
            filled[r, c], sigma[r, c] = _krige(height_m, sigma_m, r, c, at, cell_m, variogram)
    return filled, sigma


@numba.njit(cache=True)
def neighbours(
    known: BoolArray, rows: IntArray, cols: IntArray, up: FloatArray, right: FloatArray, steps: int
) -> tuple[IntArray, BoolArray]:
    """Find the first datum along each ray, and one half as far again behind it.

    Returns
    -------
    at : (n, 2 rays) flat index of the data; -1 none or one that is there already.
    enclosed : (n,) whether no half-plane beside the cell is without data.
    """
    height, width = known.shape
    rays = len(up)
    at = np.full((len(rows), 2 * rays), -1, np.int64)
    enclosed = np.zeros(len(rows), np.bool_)
    for i in range(len(rows)):
        gap, longest = 0, 0
        # Twice around, so that the gap across the first ray is counted whole.
        for turn in range(2 * rays):
            k = turn % rays
            hit = turn >= rays and at[i, k] != -1
            wanted = 1
            if turn < rays:
                for step in range(1, steps + 1):
                    r = rows[i] + int(np.round(up[k] * step))
                    c = cols[i] + int(np.round(right[k] * step))
                    if not (0 <= r < height and 0 <= c < width):
                        break
                    if step < wanted or not known[r, c]:
                        continue
                    at[i, k if not hit else rays + k] = r * width + c
                    if hit:
                        break
                    hit = True
                    wanted = step + max(2, step // 2)
            gap = 0 if hit else gap + 1
            longest = max(longest, gap)
        enclosed[i] = longest < rays // 2
        for k in range(2 * rays):
            for j in range(k):
                if at[i, k] == at[i, j]:
                    at[i, k] = -1
    return at, enclosed


def _krige(
    height_m: FloatArray,
    sigma_m: FloatArray,
    rows: IntArray,
    cols: IntArray,
    at: IntArray,
    cell_m: float,
    variogram: Variogram,
) -> tuple[FloatArray, FloatArray]:
    """Estimate cells from their neighbours by ordinary kriging; return heights and sigma, each (n,).

    Weights w that sum to one minimise `2 w.g0 - w'G w + nugget w'w`, with G the relief's variogram among the data
    and g0 to the cell. The roughness beside each gap scales the map's: `z'A z / (k - 1)` has mean one where the map's
    variogram holds. The data's own sigma is common to neighbours and is not averaged.
    """
    there = at >= 0
    r, c = np.divmod(np.where(there, at, 0), height_m.shape[1])
    apart = np.hypot(r[:, :, None] - r[:, None, :], c[:, :, None] - c[:, None, :]) * cell_m
    away = np.hypot(r - rows[:, None], c - cols[:, None]) * cell_m
    z = np.where(there, height_m[r, c], 0.0)
    n, k = at.shape
    among = variogram.relief_m2(apart)
    to_cell = np.where(there, variogram.relief_m2(away), 0.0)
    covariance = -among + (variogram.nugget_m2 + 1e-9) * np.eye(k)
    # What is not there gets a row of its own and no weight.
    both = there[:, :, None] & there[:, None, :]
    system = np.zeros((n, k + 1, k + 1))
    system[:, :k, :k] = np.where(both, covariance, np.eye(k))
    system[:, :k, k] = system[:, k, :k] = there
    right = np.zeros((n, k + 1, 2))
    right[:, :k, 0], right[:, k, 0] = -to_cell, 1.0
    right[:, :k, 1] = z
    solved = np.linalg.solve(system, right)
    weight, residual = solved[:, :k, 0], solved[:, :k, 1]
    estimate = (weight * z).sum(axis=1)
    spread = (np.where(both, covariance, 0.0) @ weight[:, :, None])[:, :, 0]
    quadratic = (weight * spread).sum(axis=1)
    variance = np.maximum(2 * (weight * to_cell).sum(axis=1) + quadratic, 0.0)
    number = there.sum(axis=1)
    local = (_COMMON_DATA + (z * residual).sum(axis=1)) / (_COMMON_DATA + number - 1)
    own = np.where(there, sigma_m[r, c] ** 2, 0.0).sum(axis=1) / number
    return estimate, np.sqrt(np.maximum(local, 0.1) * variance + own)


def fill_map(grid: Grid, reach_m: float) -> tuple[Grid, BoolArray]:
    """Fill a map's gaps up to `reach_m` from data; return it, and which cells were filled.

    Raises
    ------
    InputError
        The map has no sigma, or too few heights to learn its roughness.
    """
    if grid.sigma_m is None:
        raise InputError("a map without sigma cannot be filled: nothing says how sure its data are")
    variogram = learn_variogram([grid.elevation_m], grid.cell_m, reach_m)
    height, sigma = fill_gaps(grid.elevation_m, grid.sigma_m, grid.cell_m, reach_m, variogram)
    filled = np.isfinite(height)
    return (
        replace(
            grid,
            elevation_m=np.where(filled, height, grid.elevation_m),
            sigma_m=np.where(filled, sigma, grid.sigma_m),
            count=None if grid.count is None else np.where(filled, 0.0, grid.count),
        ),
        filled,
    )
