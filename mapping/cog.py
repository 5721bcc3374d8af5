"""Cloud-optimised GeoTIFFs written window by window: rasters larger than memory, with overviews."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import psutil
import rasterio
import rasterio.shutil
from rasterio._err import CPLE_BaseError
from rasterio.enums import Resampling
from rasterio.errors import RasterioError
from rasterio.transform import Affine
from rasterio.windows import Window

from perception.files import whole_file
from perception.records import Grid, InputError, Progress, silent

# What GDAL may keep of rasters in memory, MB; its own default is a twentieth of the machine's.
_CACHE_MB = 256
# Cells on a side of a block of the file.
_BLOCK = 512

Slices = tuple[slice, slice]
# A disk that fills up is told by GDAL's own exception where rasterio does not turn it into one of its own.
RASTER_ERRORS = (RasterioError, CPLE_BaseError)


@dataclass(frozen=True, slots=True)
class Frame:
    """Where a raster lies: outer edges, cell, size; rows run north to south."""

    west_m: float
    north_m: float
    cell_m: float
    shape: tuple[int, int]
    crs: str = ""
    datum: str = ""
    cell_north_m: float | None = None

    @classmethod
    def of(cls, grid: Grid) -> Frame:
        """Return a grid's frame."""
        return cls(grid.west_m, grid.north_m, grid.cell_m, grid.shape, grid.crs, grid.datum,
                   grid.cell_north_m)  # fmt: skip

    @property
    def transform(self) -> Affine:
        north = self.cell_m if self.cell_north_m is None else self.cell_north_m
        return Affine(self.cell_m, 0, self.west_m, 0, -north, self.north_m)


@dataclass(frozen=True, slots=True)
class Kind:
    """What a raster's values are: GDAL's type, no data, and how overviews are made of them."""

    dtype: str = "float32"
    nodata: float = float("nan")
    overviews: str = "average"


class Statistics:
    """Running statistics of one band, NaN left out, in the tags by which GDAL keeps them."""

    def __init__(self) -> None:
        self.number, self.mean, self.square = 0, 0.0, 0.0
        self.low, self.high = np.inf, -np.inf

    def add(self, values: npt.NDArray[Any]) -> None:
        """Take in the values of a window (Chan's parallel update of mean and variance)."""
        known = np.asarray(values[np.isfinite(values)], float)
        if not known.size:
            return
        mean, square = float(known.mean()), float(((known - known.mean()) ** 2).sum())
        total = self.number + known.size
        apart = mean - self.mean
        self.square += square + apart**2 * self.number * known.size / total
        self.mean += apart * known.size / total
        self.number = total
        self.low, self.high = min(self.low, float(known.min())), max(self.high, float(known.max()))

    def tags(self, cells: int) -> dict[str, str]:
        """Return GDAL's tags; none where no value was seen."""
        if not self.number:
            return {}
        return {
            "STATISTICS_MINIMUM": repr(self.low),
            "STATISTICS_MAXIMUM": repr(self.high),
            "STATISTICS_MEAN": repr(self.mean),
            "STATISTICS_STDDEV": repr(float(np.sqrt(self.square / self.number))),
            "STATISTICS_VALID_PERCENT": f"{100 * self.number / cells:.4g}",
        }


def write_cog(
    path: Path,
    frame: Frame,
    bands: Sequence[str],
    windows: Iterable[tuple[Slices, Mapping[str, npt.NDArray[Any]]]],
    tags: Mapping[str, str] | None = None,
    progress: Progress = silent,
    kind: Kind | None = None,
) -> None:
    """Write described bands with overviews and statistics.

    A plain tiled GeoTIFF beside it takes the windows in any order and its overviews; GDAL then orders both as
    a COG wants them, block by block. Memory stays at a window and GDAL's cache, whatever the size.

    Parameters
    ----------
    windows : slices of the raster (rows from the north) with the values of every band; what no window covers is
        no data.
    kind : of the values; None is float32, NaN no data, with averaged overviews.

    Raises
    ------
    InputError
        The file cannot be written; nothing is left behind.
    """
    rows, cols = frame.shape
    kind = kind or Kind()
    profile = {
        "driver": "GTiff", "dtype": kind.dtype, "count": len(bands), "height": rows, "width": cols,
        "crs": frame.crs or None, "transform": frame.transform, "nodata": kind.nodata,
        "tiled": True, "blockxsize": _BLOCK, "blockysize": _BLOCK, "interleave": "band",
        "sparse_ok": True, "bigtiff": "if_safer",
    }  # fmt: skip
    _remove_drafts_of_the_dead(path)
    draft = path.with_name(f".{path.stem}.{os.getpid()}.draft.tif")
    try:
        with whole_file(path) as temporary, rasterio.Env(GDAL_CACHEMAX=_CACHE_MB):
            with rasterio.open(draft, "w", **profile) as target:
                said = _fill(target, bands, windows, kind)
                for index, (name, statistics) in enumerate(said.items(), start=1):
                    target.set_band_description(index, name)
                    target.update_tags(index, **statistics.tags(rows * cols))
                datum = {"VERTICAL_DATUM": frame.datum} if frame.datum else {}
                target.update_tags(**datum, **dict(tags or {}))
            progress("writing the raster", 0, 2)
            levels = _overview_levels(frame.shape)
            # Left to the COG driver, overviews take four times as long as all the rest.
            with rasterio.open(draft, "r+") as target:
                target.build_overviews(levels, Resampling[kind.overviews])
            progress("writing the raster", 1, 2)
            rasterio.shutil.copy(
                draft, temporary, driver="COG", compress="deflate", predictor="yes", level="2",
                overviews="FORCE_USE_EXISTING" if levels else "NONE", blocksize=str(_BLOCK),
                bigtiff="if_safer", num_threads="2",
            )  # fmt: skip
            progress("writing the raster", 2, 2)
    except RASTER_ERRORS as error:
        raise InputError(f"{path}: cannot be written ({error}); is the disk full?") from error
    finally:
        draft.unlink(missing_ok=True)


def _overview_levels(shape: tuple[int, int]) -> list[int]:
    """Return the factors of the overviews: halves, until one block holds the whole."""
    levels, factor = [], 1
    while max(shape) > _BLOCK * factor:
        factor *= 2
        levels.append(factor)
    return levels


def _remove_drafts_of_the_dead(path: Path) -> None:
    """Remove what killed runs left of this raster, as large as the map; a running one's is its own."""
    for left in path.parent.glob(f".{path.stem}.*.draft.tif"):
        owner = left.name.removesuffix(".draft.tif").rpartition(".")[2]
        if owner.isdigit() and not psutil.pid_exists(int(owner)):
            left.unlink(missing_ok=True)


def _fill(
    target: Any,
    bands: Sequence[str],
    windows: Iterable[tuple[Slices, Mapping[str, npt.NDArray[Any]]]],
    kind: Kind,
) -> dict[str, Statistics]:
    said = {name: Statistics() for name in bands}
    for (rows, cols), values in windows:
        window = Window(cols.start, rows.start, cols.stop - cols.start, rows.stop - rows.start)
        for index, name in enumerate(bands, start=1):
            band = np.asarray(values[name], kind.dtype)
            target.write(band, index, window=window)
            if kind.dtype == "float32":  # bits have no mean
                said[name].add(band)
    return said
