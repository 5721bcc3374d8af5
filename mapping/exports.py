"""A map in other people's formats: NetCDF with CF attributes, GMT grid, BAG, ESRI ASCII.

Each is written from `map.tif` window by window, so its size does not matter.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import numpy.typing as npt
import rasterio
import rasterio.shutil
from pyproj import CRS
from rasterio.windows import Window

from mapping.cog import RASTER_ERRORS
from perception.files import existing_file, whole_file
from perception.records import InputError

# Rows read and written at a time; chunks of the files are as high.
_ROWS = 256
_CHUNK_COLS = 512

# variable: (units, long name)
_VARIABLES = {
    "elevation": ("m", "height of the sea floor above the vertical datum"),
    "sigma": ("m", "1-sigma of the cell's mean height"),
    "count": ("1", "number of data in the cell"),
    "filled": ("1", "1 where the cell is filled in, not measured"),
}
FORMATS = (".nc", ".grd", ".bag", ".asc")


def check_frame(names: Sequence[str], crs: str) -> None:
    """Refuse files whose format needs a coordinate system that the map will not have.

    Parameters
    ----------
    names : the files' names.
    crs : the map's; empty none.

    Raises
    ------
    InputError
        A BAG, of which the system is a part, of a map without one.
    """
    for name in names:
        if Path(name).suffix == ".bag" and not crs:
            raise InputError(
                f"{name}: a BAG needs a coordinate system and the survey tells none; give the one its "
                "positions lie in with --crs EPSG:N, or another format (.nc, .grd, .asc)"
            )


def export_map(source: Path, target: Path) -> None:
    """Write a map of ours in the format that the target's suffix names.

    Parameters
    ----------
    source : a GeoTIFF with bands described `elevation`, `sigma`, `count`.
    target : `.nc` NetCDF with CF-1.11 attributes, all bands; `.grd` GMT grid of the heights; `.bag` heights and
        uncertainty; `.asc` heights.

    Raises
    ------
    InputError
        A suffix of none of these, or a file that cannot be written.
    """
    if target.suffix not in FORMATS:
        raise InputError(
            f"{target}: {target.suffix or 'a name without suffix'} is no format of a map; "
            f"give one of {', '.join(FORMATS)}"
        )
    try:
        with rasterio.open(existing_file(source)) as raster, whole_file(target) as temporary:
            check_frame([str(target)], raster.crs.to_wkt() if raster.crs else "")
            if target.suffix in (".nc", ".grd"):
                _write_netcdf(temporary, raster, gmt=target.suffix == ".grd")
            else:
                _write_by_gdal(temporary, raster, target.suffix)
                if temporary.with_suffix(".prj").exists():
                    temporary.with_suffix(".prj").replace(target.with_suffix(".prj"))
    except (*RASTER_ERRORS, RuntimeError) as error:
        # netCDF4 tells a full disk as a RuntimeError of its library.
        raise InputError(f"{target}: cannot be written ({error}); is the disk full?") from error


def _write_netcdf(path: Path, raster: Any, gmt: bool) -> None:
    """Write heights (as `z`, alone, for GMT) or every band, rows from the south as both customs have it."""
    rows, cols = raster.shape
    names = ["elevation"] if gmt else [name for name in raster.descriptions if name in _VARIABLES]
    with netCDF4.Dataset(path, "w") as data:
        data.setncatts({"Conventions": "CF-1.11", "title": "sea floor map",
                        "vertical_datum": raster.tags().get("VERTICAL_DATUM", "")})  # fmt: skip
        if gmt:
            data.node_offset = np.int32(1)  # values are of cells, not of nodes
        _write_axes(data, raster)
        for name in names:
            units, long_name = _VARIABLES[name]
            variable = data.createVariable(
                "z" if gmt else name, "f4", ("y", "x"), zlib=True, complevel=2, fill_value=np.nan,
                chunksizes=(min(_ROWS, rows), min(_CHUNK_COLS, cols)),
            )  # fmt: skip
            variable.setncatts({"units": units, "long_name": long_name, "grid_mapping": "crs"})
            if name == "elevation":
                variable.positive = "up"
            low, high = np.inf, -np.inf
            for top, values in _bands_of_rows(raster, raster.descriptions.index(name) + 1):
                variable[rows - top - len(values) : rows - top] = values[::-1]
                if np.isfinite(values).any():
                    low, high = (
                        min(low, float(np.nanmin(values))),
                        max(high, float(np.nanmax(values))),
                    )
            if low <= high:
                variable.actual_range = np.array([low, high], np.float32)


def _write_axes(data: Any, raster: Any) -> None:
    """Write the axes' cell centres and the coordinate system, in CF's words and in GDAL's."""
    (rows, cols), transform = raster.shape, raster.transform
    axes = {
        "x": (transform.c, transform.a, cols, "easting"),
        "y": (transform.f + rows * transform.e, -transform.e, rows, "northing"),
    }
    for name, (start, step, size, long_name) in axes.items():
        data.createDimension(name, size)
        axis = data.createVariable(name, "f8", (name,))
        axis.setncatts(
            {"units": "m", "long_name": long_name, "axis": name.upper(),
             "standard_name": f"projection_{name}_coordinate"}
        )  # fmt: skip
        if "node_offset" in data.ncattrs():
            # GMT's range is of the outer edges; CF's, which GDAL goes by without GMT's mark, of the values.
            axis.actual_range = np.array([start, start + size * step])
        axis[:] = start + (np.arange(size) + 0.5) * step
    crs = data.createVariable("crs", "i4")
    if raster.crs:
        wkt = raster.crs.to_wkt()
        crs.setncatts({k: v for k, v in CRS.from_wkt(wkt).to_cf().items() if k != "crs_wkt"})
        crs.setncatts({"crs_wkt": wkt, "spatial_ref": wkt})


def _bands_of_rows(raster: Any, band: int) -> Iterator[tuple[int, npt.NDArray[np.float32]]]:
    rows, cols = raster.shape
    for top in range(0, rows, _ROWS):
        window = Window(0, top, cols, min(_ROWS, rows - top))
        yield top, raster.read(band, window=window)


def _write_by_gdal(path: Path, raster: Any, suffix: str) -> None:
    """Let GDAL write a format that it writes from another raster only, by way of a plain GeoTIFF."""
    driver, bands, nodata = {
        ".bag": ("BAG", ("elevation", "sigma"), 1_000_000.0),  # the format's own
        ".asc": ("AAIGrid", ("elevation",), -9999.0),
    }[suffix]
    profile = {**raster.profile, "driver": "GTiff", "count": len(bands), "nodata": nodata}
    for key in ("interleave", "compress", "predictor"):
        profile.pop(key, None)
    with whole_file(path.with_suffix(".draft.tif")) as draft:
        with rasterio.open(draft, "w", **profile) as plain:
            for index, name in enumerate(bands, start=1):
                for top, values in _bands_of_rows(raster, raster.descriptions.index(name) + 1):
                    window = Window(0, top, values.shape[1], values.shape[0])
                    filled = np.where(np.isfinite(values), values, np.float32(nodata))
                    plain.write(filled, index, window=window)
        rasterio.shutil.copy(draft, path, driver=driver)
    path.with_suffix(".draft.tif").unlink(missing_ok=True)
    Path(f"{path}.aux.xml").unlink(missing_ok=True)
