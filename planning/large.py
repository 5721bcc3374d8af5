"""Maps too large to hold: block means to plan on, windows to prove in.

What that gives up is said in docs/planning.md: a gap narrower than a block is found only where the
repair of a stretch (`planning.full_resolution`) comes by it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio

from mapping.rasters import OpenMap, open_map
from perception.files import existing_file
from perception.records import (
    REGION_CLASSES,
    BoolArray,
    FloatArray,
    Grid,
    InputError,
    NoOverlapError,
    Progress,
    silent,
)

# Cells that planning holds at once: 70 bytes each in the surfaces and searches.
MOST_CELLS = 30_000_000
# Cells of the reduced map, for a search of seconds.
REDUCED_CELLS = 2_500_000
# Share of a block that must hold heights for it to count in the second try.
_LOOSE_SHARE = 0.5
# Cells read at once, and cells read in a second from a compressed file on one core: for the estimate.
_BAND_CELLS, _CELLS_PER_S = 8_000_000, 12e6


def raster_cells(path: Path) -> int:
    """Return the number of cells of a raster without reading it; 0 where GDAL cannot open it."""
    try:
        with rasterio.open(existing_file(path)) as source:
            return int(source.width) * int(source.height)
    except rasterio.errors.RasterioError:
        return 0


def map_crs(path: Path) -> str:
    """Return a map's CRS without reading it; refusals of `read_map`."""
    with open_map(path) as opened:
        return opened.source.crs.to_string() if opened.source.crs else ""


def is_dry(path: Path) -> bool:
    """Tell whether all heights of a map lie above its zero, row band by row band up to the first below."""
    with open_map(path) as opened:
        height, width = opened.shape
        step = max(1, _BAND_CELLS // width)
        for first in range(0, height, step):
            part = opened.read(slice(first, min(height, first + step)), slice(0, width))
            if (part.elevation_m <= 0).any():
                return False
    return True


def map_bounds(path: Path) -> tuple[float, float, float, float]:
    """Return west, south, east and north of a map without reading it; refusals of `read_map`."""
    with open_map(path) as opened:
        west, south, east, north = (float(v) for v in opened.source.bounds)
        return west, south, east, north


def reading_seconds(cells: int) -> float:
    """Return about how long one reading of so many cells takes."""
    return cells / _CELLS_PER_S


@dataclass(frozen=True, slots=True)
class Reduced:
    """A large map as blocks.

    Attributes
    ----------
    grid : means of the blocks' heights, worst sigma; a block with any cell of no data is no data.
    loose : the same where a block may lack up to half of its cells, and any of its sigmas.
    block : cells along a block's side.
    cell_m : width and height of a cell as stored.
    lowest_m : height of the lowest cell.
    """

    grid: Grid
    loose: Grid
    block: int
    cell_m: tuple[float, float]
    lowest_m: float

    @property
    def loose_has_more(self) -> bool:
        """Whether half-filled blocks open ground that full ones do not."""
        return bool(_usable(self.loose).sum() > _usable(self.grid).sum())


def _usable(grid: Grid) -> BoolArray:
    known = np.isfinite(grid.elevation_m)
    return known if grid.sigma_m is None else known & np.isfinite(grid.sigma_m)


def read_reduced(path: Path, sigma_m: float | None = None, progress: Progress = silent) -> Reduced:
    """Read a large map as blocks, row band by row band; arguments and refusals of `read_map`."""
    with open_map(path, sigma_m) as opened:
        height, width = opened.shape
        block = max(1, math.ceil(math.sqrt(height * width / REDUCED_CELLS)))
        rows, cols = height // block, width // block
        mean, loose, sigma, loose_sigma = (np.full((rows, cols), np.nan) for _ in range(4))
        lowest = math.inf
        step = max(1, _BAND_CELLS // (width * block))
        for first in range(0, rows, step):
            last = min(rows, first + step)
            part = opened.read(slice(first * block, last * block), slice(0, cols * block))
            mean[first:last], loose[first:last] = _means(part.elevation_m, block)
            lowest = float(np.fmin.reduce(part.elevation_m, axis=None, initial=lowest))
            if part.sigma_m is not None:
                # The worst of a block stands for it; one without a sigma leaves it without.
                sigma[first:last] = _blocks(part.sigma_m, block).max(axis=(1, 3))
                of_heights = np.where(np.isfinite(part.elevation_m), part.sigma_m, np.nan)
                loose_sigma[first:last] = np.fmax.reduce(_blocks(of_heights, block), axis=(1, 3))
            progress("reading the map", last, rows)
        corner = opened.read(slice(0, 1), slice(0, 1))
    if not np.isfinite(loose).any():
        raise InputError(f"{path}: holds no block of {block} x {block} cells with heights")
    grid = replace(
        corner,
        elevation_m=mean,
        sigma_m=sigma,
        count=None,
        cell_m=block * corner.cell_m,
        cell_height_m=block * corner.cell_north_m,
    )
    looser = replace(grid, elevation_m=loose, sigma_m=loose_sigma)
    if not np.isfinite(loose_sigma).any():
        grid, looser = replace(grid, sigma_m=None), replace(looser, sigma_m=None)
    elif not np.isfinite(sigma).any():
        # Sigma lacks somewhere in every block: what the file does tell of it must not be left out.
        grid = looser
    return Reduced(grid, looser, block, (corner.cell_m, corner.cell_north_m), lowest)


def _blocks(values: FloatArray, block: int) -> FloatArray:
    rows, cols = values.shape
    return values.reshape(rows // block, block, cols // block, block)


def _means(values: FloatArray, block: int) -> tuple[FloatArray, FloatArray]:
    """Return the blocks' means, NaN where any cell is, and NaN where half of the cells are."""
    known = np.isfinite(values)
    share = _blocks(known, block).mean(axis=(1, 3))
    total = _blocks(np.where(known, values, 0.0), block).mean(axis=(1, 3))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = total / share
    return np.where(share == 1.0, mean, np.nan), np.where(share >= _LOOSE_SHARE, mean, np.nan)


def read_window(
    path: Path,
    box: tuple[float, float, float, float],
    margin_m: float = 0.0,
    sigma_m: float | None = None,
) -> Grid:
    """Read, at full resolution, the cells in and around a box (west, south, east, north)."""
    with open_map(path, sigma_m) as opened:
        return window_of(opened, box, margin_m)


def window_of(
    opened: OpenMap, box: tuple[float, float, float, float], margin_m: float = 0.0
) -> Grid:
    """Read the cells in and around a box of an open map.

    Raises
    ------
    NoOverlapError
        The box lies off the map.
    """
    t = opened.source.transform
    rows, cols = opened.shape
    c0 = max(0, math.floor((box[0] - margin_m - t.c) / t.a) - 3)
    c1 = min(cols, math.ceil((box[2] + margin_m - t.c) / t.a) + 3)
    r0 = max(0, math.floor((t.f - box[3] - margin_m) / -t.e) - 3)
    r1 = min(rows, math.ceil((t.f - box[1] + margin_m) / -t.e) + 3)
    if r0 >= r1 or c0 >= c1:
        raise NoOverlapError(
            f"{opened.path}: does not reach easting {box[0]:.1f} to {box[2]:.1f}, northing "
            f"{box[1]:.1f} to {box[3]:.1f}; give positions on the map"
        )
    return opened.read(slice(r0, r1), slice(c0, c1))


def reduced_weights(path: Path, reduced: Reduced, weights: Mapping[str, float]) -> FloatArray:
    """Return the blocks' mean weight from a region map of the full resolution, band by band.

    Raises
    ------
    InputError
        No region map, or one of another grid than the map.
    """
    by_code = np.array([weights.get(name, 1.0) for name in REGION_CLASSES])
    rows, cols = reduced.grid.shape
    out = np.empty((rows, cols))
    with rasterio.open(existing_file(path)) as source:
        names = [(d or "").lower() for d in source.descriptions]
        if "class" not in names:
            raise InputError(
                f"{path}: lacks the band class; make it from this map: bathynav regions MAP.tif"
            )
        refuse_other_frame(path, source.transform, (source.height, source.width), reduced)
        step = max(1, _BAND_CELLS // (source.width * reduced.block))
        for first in range(0, rows, step):
            last = min(rows, first + step)
            window: Any = rasterio.windows.Window(
                0, first * reduced.block, cols * reduced.block, (last - first) * reduced.block
            )
            code = source.read(names.index("class") + 1, window=window)
            by_cell = by_code[np.clip(code, 0, len(by_code) - 1)]
            out[first:last] = _blocks(by_cell, reduced.block).mean(axis=(1, 3))
    return out


def refuse_other_frame(
    path: Path, transform: Any, shape: tuple[int, int], reduced: Reduced
) -> None:
    """Refuse a raster that is not on the grid of the large map."""
    grid, (width, height) = reduced.grid, reduced.cell_m
    near = 0.01 * width
    same = (
        abs(transform.c - grid.west_m) < near
        and abs(transform.f - grid.north_m) < near
        and abs(transform.a - width) * shape[1] < near
        and abs(-transform.e - height) * shape[0] < near
        and (shape[0] // reduced.block, shape[1] // reduced.block) == grid.shape
    )
    if not same:
        raise InputError(
            f"{path}: {shape[0]} x {shape[1]} cells of {transform.a:g} m from "
            f"{transform.c:.2f},{transform.f:.2f} are not the map's; make it from this map: "
            "bathynav regions MAP.tif"
        )
