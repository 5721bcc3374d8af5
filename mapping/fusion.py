"""Fusion of strips into one grid of heights with the 1-sigma of each cell's mean."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np

from perception.records import (
    BoolArray,
    ElevationStrip,
    FloatArray,
    Grid,
    InputError,
    Progress,
    Trajectory,
    silent,
)

# A cell's height from one pass this many sigma from the other passes' mean is an outlier.
_OUTLIER_SIGMA = 4.0
# Lines farther apart than this many usual steps have a gap between them, which is not bridged.
_GAP_STEPS = 4.0


@dataclass(frozen=True, slots=True)
class PassRaster:
    """One strip on the common lattice: cell (row, col) of it is lattice cell (row0 + row, col0 + col).

    `height_m`, `variance_m2`, `count` (rows, cols); NaN and 0 no data. Rows run south to north.
    """

    row0: int
    col0: int
    height_m: FloatArray
    variance_m2: FloatArray
    position_m2: FloatArray
    count: FloatArray

    @property
    def window(self) -> tuple[slice, slice]:
        rows, cols = self.height_m.shape
        return slice(self.row0, self.row0 + rows), slice(self.col0, self.col0 + cols)


def default_cell(strips: Sequence[ElevationStrip]) -> float:
    """Return the finest cell of the series 1, 2, 5 that the strips' lines and columns fill."""
    spacings = []
    for strip in strips:
        if len(strip.time_s) > 1:
            step = np.hypot(np.diff(strip.easting_m), np.diff(strip.northing_m))
            across = np.median(np.diff(strip.across_m)) if len(strip.across_m) > 1 else 0.0
            spacings.append(max(float(np.nanmedian(step)), float(across)))
    wanted = max(float(np.median(spacings)), 0.01) if spacings else 1.0
    decade = 10.0 ** math.floor(math.log10(wanted))
    # A tenth of tolerance: lines 0.52 m apart fill cells of 0.5 m well enough.
    for factor in (1.0, 2.0, 5.0, 10.0):
        if factor * decade >= 0.9 * wanted:
            return round(factor * decade, 6)
    return 10.0 * decade


def fuse(
    strips: Sequence[ElevationStrip],
    cell_m: float | None = None,
    crs: str | None = None,
    trajectory: Trajectory | None = None,
    height_sigma_m: FloatArray | None = None,
    progress: Progress = silent,
) -> Grid:
    """Fuse strips into one map.

    A pass gives a cell one height: its data there share altitude, attitude and sound speed, so their
    number does not make the mean better. Passes are averaged by inverse variance; one that lies beyond
    four sigma of at least two others is left out there, and where passes disagree more than their sigmas
    say, the sigma of the mean grows by the same factor (Birge's ratio). The position's uncertainty adds
    the slope times it.

    Parameters
    ----------
    cell_m : cell of the map; None takes `default_cell`.
    crs : expected coordinate system; None that of the strips.
    trajectory : corrected poses, for their position sigma; rows are matched by ping.
    height_sigma_m : (passes,) 1-sigma of each strip's height offset, common to all its cells.

    Raises
    ------
    InputError
        No strip holds a height, or strips of different coordinate systems.
    """
    crs = _common_crs(strips, crs)
    cell = default_cell(strips) if cell_m is None else float(cell_m)
    lattice = _lattice(strips, cell)
    rasters = []
    for index, strip in enumerate(strips):
        offset = 0.0 if height_sigma_m is None else float(height_sigma_m[index])
        rasters.append(
            _rasterise(strip, cell, lattice, _position_variance(strip, trajectory), offset)
        )
        progress("fusing strips", index + 1, len(strips))
    west, south, cols, rows = lattice
    mean, sigma, count = combine([r for r in rasters if r is not None], (rows, cols), cell)
    return Grid(
        elevation_m=mean[::-1],
        west_m=west * cell,
        north_m=(south + rows) * cell,
        cell_m=cell,
        crs=crs,
        sigma_m=sigma[::-1],
        count=count[::-1],
    )


def _common_crs(strips: Sequence[ElevationStrip], crs: str | None) -> str:
    names = sorted({strip.crs for strip in strips})
    if len(names) > 1:
        raise InputError(
            f"the strips lie in different coordinate systems ({', '.join(names)}); "
            "give one for all with --crs EPSG:N"
        )
    if not any(np.isfinite(strip.elevation_m).any() for strip in strips):
        raise InputError("no strip holds a single height; was the bottom found in any ping?")
    if crs and names and names[0] and crs != names[0]:
        raise InputError(
            f"the strips lie in {names[0]}, not in {crs}; read the survey with --crs {crs}"
        )
    return crs or names[0]


def _lattice(strips: Sequence[ElevationStrip], cell: float) -> tuple[int, int, int, int]:
    """Return west and south in whole cells and the number of columns and rows."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for strip in strips:
        seen = np.isfinite(strip.elevation_m)
        if not seen.any():
            continue
        for axis, values in enumerate(strip.positions()):
            low[axis] = min(low[axis], float(values[seen].min()))
            high[axis] = max(high[axis], float(values[seen].max()))
    first = np.floor(low / cell).astype(int)
    last = np.floor(high / cell).astype(int)
    cols, rows = (last - first + 1).tolist()
    if cols * rows > 4e8:
        raise InputError(
            f"the map would have {rows} x {cols} cells of {cell} m; give a larger --cell"
        )
    return int(first[0]), int(first[1]), cols, rows


def _position_variance(strip: ElevationStrip, trajectory: Trajectory | None) -> FloatArray:
    """Return (n,) mean variance of the horizontal position per axis at each line; 0 unknown."""
    if trajectory is None or trajectory.ping is None:
        return np.zeros(len(strip.ping))
    order = np.argsort(trajectory.ping)
    variance = 0.5 * (trajectory.sigma_easting_m**2 + trajectory.sigma_northing_m**2)
    return np.interp(strip.ping, trajectory.ping[order], np.nan_to_num(variance[order]))


def _rasterise(
    strip: ElevationStrip,
    cell: float,
    lattice: tuple[int, int, int, int],
    position_m2: FloatArray,
    offset_sigma_m: float,
) -> PassRaster | None:
    seen = np.isfinite(strip.elevation_m) & (strip.sigma_m > 0)
    if not seen.any():
        return None
    east, north = (values[seen] for values in strip.positions())
    col0, row0 = int(np.floor(east.min() / cell)), int(np.floor(north.min() / cell))
    cols = int(np.floor(east.max() / cell)) - col0 + 1
    rows = int(np.floor(north.max() / cell)) - row0 + 1
    step = np.hypot(np.diff(strip.easting_m), np.diff(strip.northing_m))
    usual = float(np.median(step)) if len(step) else cell
    across = float(np.median(np.diff(strip.across_m))) if len(strip.across_m) > 1 else cell
    # At 0.6 of a cell a slanting lattice of samples leaves no cell empty.
    weight, height, variance, position, count = bin_strip(
        np.where(seen, strip.elevation_m, np.nan), strip.sigma_m, strip.easting_m - col0 * cell,
        strip.northing_m - row0 * cell, strip.heading_rad, strip.across_m, position_m2, cell, rows, cols,
        max(1, math.ceil(usual / (0.6 * cell))), max(1, math.ceil(across / (0.6 * cell))),
        max(_GAP_STEPS * usual, 1e-6),
    )  # fmt: skip
    filled = weight > 0
    safe = np.where(filled, weight, 1.0)
    return PassRaster(
        row0=row0 - lattice[1],
        col0=col0 - lattice[0],
        height_m=np.where(filled, height / safe, np.nan),
        variance_m2=np.where(filled, variance / safe + offset_sigma_m**2, np.nan),
        position_m2=np.where(filled, position / safe, 0.0),
        count=count,
    )


@numba.njit(cache=True)
def bin_strip(
    height: FloatArray,
    sigma: FloatArray,
    east: FloatArray,
    north: FloatArray,
    heading: FloatArray,
    across: FloatArray,
    position_m2: FloatArray,
    cell: float,
    rows: int,
    cols: int,
    along_parts: int,
    across_parts: int,
    gap_m: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Sum weights 1/sigma^2 and weighted height, sigma^2, position variance; count the data.

    Between neighbouring samples `along_parts` x `across_parts` points are interpolated so that no cell
    inside the strip stays empty; the count holds the samples alone.
    """
    weight = np.zeros((rows, cols))
    w_height = np.zeros((rows, cols))
    w_variance = np.zeros((rows, cols))
    w_position = np.zeros((rows, cols))
    count = np.zeros((rows, cols))
    n, m = height.shape
    for i in range(n):
        i1 = min(i + 1, n - 1)
        parts = along_parts
        if i1 == i or np.hypot(east[i1] - east[i], north[i1] - north[i]) > gap_m:
            parts = 1
        for a in range(parts):
            fa = a / parts
            h = heading[i] + fa * np.arctan2(
                np.sin(heading[i1] - heading[i]), np.cos(heading[i1] - heading[i])
            )
            c, s = np.cos(h), np.sin(h)
            e0 = east[i] + fa * (east[i1] - east[i])
            n0 = north[i] + fa * (north[i1] - north[i])
            for j in range(m):
                for b in range(across_parts):
                    fb = b / across_parts
                    j1 = min(j + 1, m - 1)
                    z, var = 0.0, 0.0
                    z += (1 - fa) * (1 - fb) * height[i, j]
                    var += (1 - fa) * (1 - fb) * sigma[i, j] ** 2
                    if fa > 0:
                        z += fa * (1 - fb) * height[i1, j]
                        var += fa * (1 - fb) * sigma[i1, j] ** 2
                    if fb > 0:
                        z += (1 - fa) * fb * height[i, j1]
                        var += (1 - fa) * fb * sigma[i, j1] ** 2
                    if fa > 0 and fb > 0:
                        z += fa * fb * height[i1, j1]
                        var += fa * fb * sigma[i1, j1] ** 2
                    if not (var > 0 and z == z):
                        continue
                    x = across[j] + fb * (across[j1] - across[j])
                    col = int(np.floor((e0 + c * x) / cell))
                    row = int(np.floor((n0 - s * x) / cell))
                    if 0 <= row < rows and 0 <= col < cols:
                        w = 1.0 / var
                        weight[row, col] += w
                        w_height[row, col] += w * z
                        w_variance[row, col] += 1.0
                        w_position[row, col] += w * position_m2[i]
                        if a == 0 and b == 0:
                            count[row, col] += 1.0
    return weight, w_height, w_variance, w_position, count


def combine(
    rasters: Sequence[PassRaster], shape: tuple[int, int], cell_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Combine passes into mean, sigma of the mean and count, each of `shape`, rows south to north."""
    keep = [np.isfinite(r.height_m) for r in rasters]
    # Three rounds find up to three wrong passes in a cell; more than that and there is no majority.
    for _ in range(3):
        if not _drop_worst(rasters, keep, shape):
            break
    weight, total, number = _sums(rasters, keep, shape)
    filled = weight > 0
    safe = np.where(filled, weight, 1.0)
    mean = np.where(filled, total / safe, np.nan)
    chi2, position, count = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for r, k in zip(rasters, keep, strict=True):
        w = np.where(k, 1.0 / r.variance_m2, 0.0)
        residual = np.where(k, r.height_m - mean[r.window], 0.0)
        chi2[r.window] += w * residual**2
        position[r.window] += w * r.position_m2
        count[r.window] += np.where(k, r.count, 0.0)
    disagreement = np.maximum(chi2 / np.maximum(number - 1, 1), 1.0)
    variance = disagreement / safe + _slope_squared(mean, cell_m) * position / safe
    return mean, np.where(filled, np.sqrt(variance), np.nan), count


def _drop_worst(
    rasters: Sequence[PassRaster], keep: list[BoolArray], shape: tuple[int, int]
) -> bool:
    """Drop from each cell the pass farthest beyond four sigma of the others' mean; tell if any was.

    A wrong pass must not pull the mean that it is judged by, so each is judged by the rest; and it spoils
    the rest of every other, so only the worst goes at a time.
    """
    weight, total, number = _sums(rasters, keep, shape)
    worst = np.full(shape, _OUTLIER_SIGMA)
    ratios = []
    for r, k in zip(rasters, keep, strict=True):
        w = np.where(k, 1.0 / r.variance_m2, 0.0)
        others = weight[r.window] - w
        several = k & (number[r.window] >= 3) & (others > 1e-12)
        safe = np.where(several, others, 1.0)
        rest = (total[r.window] - w * np.where(k, r.height_m, 0.0)) / safe
        expected = np.sqrt(np.where(k, r.variance_m2, 0.0) + 1.0 / safe)
        ratio = np.where(several, np.abs(np.where(k, r.height_m, 0.0) - rest) / expected, 0.0)
        worst[r.window] = np.maximum(worst[r.window], ratio)
        ratios.append(ratio)
    dropped = False
    for index, (r, ratio) in enumerate(zip(rasters, ratios, strict=True)):
        drop = (ratio > _OUTLIER_SIGMA) & (ratio >= worst[r.window])
        dropped = dropped or bool(drop.any())
        keep[index] = keep[index] & ~drop
    return dropped


def _sums(
    rasters: Sequence[PassRaster], keep: Sequence[BoolArray], shape: tuple[int, int]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    weight, total, number = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for r, k in zip(rasters, keep, strict=True):
        w = np.where(k, 1.0 / r.variance_m2, 0.0)
        weight[r.window] += w
        total[r.window] += w * np.where(k, r.height_m, 0.0)
        number[r.window] += k
    return weight, total, number


def _slope_squared(height_m: FloatArray, cell_m: float) -> FloatArray:
    """Return the squared slope, 0 where a neighbour is missing."""
    if min(height_m.shape) < 2:
        return np.zeros_like(height_m)
    north, east = (np.gradient(height_m, cell_m, axis=axis) for axis in (0, 1))
    squared: FloatArray = np.nan_to_num(np.square(north) + np.square(east))
    return squared
