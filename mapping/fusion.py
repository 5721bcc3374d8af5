"""Fusion of strips into one grid of heights with the 1-sigma of each cell's mean."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mapping.flag_layer import rows_of
from mapping.gridding import Window
from mapping.looks import settle, with_ambiguity
from mapping.passes import add_spread, add_weighted, judge
from mapping.placed import PassRaster, PlacedStrip, boxes, extent, on_window, placed
from perception.quality import CellFlag
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
# Cells that a map in one piece may have: some 100 bytes each, passes included. Beyond it, `mapping.tiles`.
LARGEST_MAP = 400_000_000


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
    say, the sigma of the mean grows by the same factor (Birge's ratio). A look that is ambiguous by layover yields to
    clear ones (`mapping.looks`). The position's uncertainty adds
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
    sigma_m = np.zeros(len(strips)) if height_sigma_m is None else height_sigma_m
    there = [
        placed(strip, trajectory, float(one)) for strip, one in zip(strips, sigma_m, strict=True)
    ]
    window = map_window(there, cell)
    # Of passes that fold nowhere too, what lies in shadow settles nothing.
    folded = any(_folds(strip) for strip in strips)
    rasters = []
    for index, strip in enumerate(there):
        blocks = boxes(strip, cell)
        raster = on_window(strip, blocks, cell, window)
        if raster is not None and folded and strips[index].flags is not None:
            raster = with_ambiguity(raster, strip, rows_of(strips[index]), blocks, cell, window)
        rasters.append(raster)
        progress("fusing strips", index + 1, len(strips))
    shape = (window.rows, window.cols)
    mean, sigma, count = combine([r for r in rasters if r is not None], shape, cell)
    return Grid(
        elevation_m=mean[::-1],
        west_m=window.col * cell,
        north_m=(window.row + window.rows) * cell,
        cell_m=cell,
        crs=crs,
        sigma_m=sigma[::-1],
        count=count[::-1],
    )


def _folds(strip: ElevationStrip) -> bool:
    """Tell whether any sample of a strip is ambiguous."""
    return strip.flags is not None and bool(np.any(strip.flags & CellFlag.AMBIGUOUS.value))


def map_window(strips: Sequence[PlacedStrip], cell_m: float, most: int = LARGEST_MAP) -> Window:
    """Return the cells of the map, refusing sizes that make no sense.

    Raises
    ------
    InputError
        No strip holds a height, or the map would have more than `most` cells.
    """
    window = extent(strips, cell_m)
    if window is None:
        raise InputError("no strip holds a single height; was the bottom found in any ping?")
    if window.rows * window.cols > most:
        raise InputError(
            f"the map would have {window.rows} x {window.cols} cells of {cell_m} m; give a larger "
            "--cell, or --tiles to make it tile by tile"
        )
    return window


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


def combine(
    rasters: Sequence[PassRaster], shape: tuple[int, int], cell_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Combine passes into mean, sigma of the mean and count, each of `shape`, rows south to north."""
    keep = [np.isfinite(r.height_m) for r in rasters]
    settle(rasters, keep, shape)
    sums = _sums(rasters, keep, shape)
    # Three rounds find up to three wrong passes in a cell; more than that and there is no majority.
    for _ in range(3):
        if not _drop_worst(rasters, keep, sums):
            break
        sums = _sums(rasters, keep, shape)
    weight, total, number = sums
    filled = weight > 0
    safe = np.where(filled, weight, 1.0)
    mean = np.where(filled, total / safe, np.nan)
    chi2, position, count = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for r, k in zip(rasters, keep, strict=True):
        add_spread(r.height_m, r.variance_m2, r.position_m2, r.count, k, mean[r.window],
                   chi2[r.window], position[r.window], count[r.window])  # fmt: skip
    disagreement = np.maximum(chi2 / np.maximum(number - 1, 1), 1.0)
    variance = disagreement / safe + _slope_squared(mean, cell_m) * position / safe
    return mean, np.where(filled, np.sqrt(variance), np.nan), count


def _drop_worst(
    rasters: Sequence[PassRaster], keep: Sequence[BoolArray], sums: Sequence[FloatArray]
) -> bool:
    """Drop from each cell the pass farthest beyond four sigma of the others' mean; tell if any was.

    A wrong pass must not pull the mean that it is judged by, so each is judged by the rest; and it spoils
    the rest of every other, so only the worst goes at a time.
    """
    number = sums[2]
    if number.max(initial=0.0) < 3:
        return False
    worst = np.full(number.shape, _OUTLIER_SIGMA)
    for last in (False, True):
        for r, k in zip(rasters, keep, strict=True):
            judge(r.height_m, r.variance_m2, k, *(total[r.window] for total in sums),
                  worst[r.window], _OUTLIER_SIGMA, last)  # fmt: skip
    return bool((worst > _OUTLIER_SIGMA).any())


def _sums(
    rasters: Sequence[PassRaster], keep: Sequence[BoolArray], shape: tuple[int, int]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    weight, total, number = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for r, k in zip(rasters, keep, strict=True):
        add_weighted(r.height_m, r.variance_m2, k, weight[r.window], total[r.window],
                     number[r.window])  # fmt: skip
    return weight, total, number


def _slope_squared(height_m: FloatArray, cell_m: float) -> FloatArray:
    """Return the squared slope, 0 where a neighbour is missing."""
    if min(height_m.shape) < 2:
        return np.zeros_like(height_m)
    north, east = (np.gradient(height_m, cell_m, axis=axis) for axis in (0, 1))
    squared: FloatArray = np.nan_to_num(np.square(north) + np.square(east))
    return squared
