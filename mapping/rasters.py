"""Map files: any elevation raster GDAL reads comes in, cloud-optimised GeoTIFF goes out."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rasterio
from pyproj import CRS
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.transform import Affine
from rasterio.windows import Window

from mapping.cog import RASTER_ERRORS, Statistics
from mapping.raster_checks import no_heights, undeclared_rim
from perception.files import existing_file, whole_file
from perception.records import FloatArray, Grid, InputError

logger = logging.getLogger(__name__)

_SIGMA_NAMES = ("sigma", "uncertainty", "std", "stddev", "standard deviation")
_ELEVATION_NAMES = ("elevation", "bathymetry", "height", "z", "topo", "depth")
# Metres in a unit of height; the survey foot differs from the foot by two parts in a million.
_UNITS_M = {
    "ft": 0.3048, "feet": 0.3048, "foot": 0.3048, "us-ft": 1200 / 3937, "us survey foot": 1200 / 3937, "ftus": 1200 / 3937,
    "fathom": 1.8288, "fathoms": 1.8288, "cm": 0.01, "centimetre": 0.01, "centimeter": 0.01, "mm": 0.001, "dm": 0.1,
    "km": 1000.0, "yd": 0.9144, "yard": 0.9144, "yards": 0.9144,
    "m": 1.0, "metre": 1.0, "metres": 1.0, "meter": 1.0, "meters": 1.0,
}  # fmt: skip


def read_map(path: Path, sigma_m: float | None = None) -> Grid:
    """Read an elevation raster as a `Grid`, heights up.

    Parameters
    ----------
    path : any raster GDAL opens (GeoTIFF, BAG, NetCDF, ASC, GMT grid).
    sigma_m : 1-sigma for the whole map, used instead of a band of that meaning.

    Returns
    -------
    Grid
        Nodata and non-finite cells are NaN. A band described as depth is turned to elevation.

    Raises
    ------
    InputError
        Not a raster, no georeference, rotated, geographic (degrees), or without a single height.
    """
    with open_map(path, sigma_m) as opened:
        return opened.read_whole()


@contextmanager
def open_map(path: Path, sigma_m: float | None = None) -> Iterator[OpenMap]:
    """Open a map too large to hold, to be read by windows; arguments and refusals of `read_map`."""
    path = existing_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(_main_subdataset(path)) as source:
                yield _opened(source, path, sigma_m)
    except RasterioError as error:
        if str(error).startswith("Read failed"):
            raise InputError(
                f"{path}: is cut short or damaged: its head is a raster's, but cells cannot be read "
                f"({error.__cause__ or error}); fetch or make it again"
            ) from error
        raise InputError(
            f"{path}: GDAL cannot read it as a raster ({error}); "
            "give a GeoTIFF, BAG, NetCDF or ASC grid"
        ) from error


@dataclass(frozen=True, slots=True)
class OpenMap:
    """An open map file: which band means what, and the georeference.

    Attributes
    ----------
    elevation_band, sigma_band, count_band : numbers from 1; None where the file has none.
    down : whether the band of heights holds depths.
    sigma_m : 1-sigma that the caller gave for the whole map; None takes the file's.
    sigma_beside : name of another variable of the same NetCDF that holds the sigma; empty none.
    unit_m : metres in the file's unit of height, and of sigma.
    told : kinds of defects already told of, so that a map read by windows tells of each once.
    """

    path: Path
    source: Any
    elevation_band: int
    down: bool
    sigma_band: int | None
    count_band: int | None
    sigma_m: float | None
    sigma_beside: str
    unit_m: float = 1.0
    told: set[str] = field(default_factory=set)

    @property
    def shape(self) -> tuple[int, int]:
        return int(self.source.height), int(self.source.width)

    def read_whole(self) -> Grid:
        """Read all of the map.

        Raises
        ------
        InputError
            It holds no height at all.
        """
        grid = self.read()
        if not np.isfinite(grid.elevation_m).any():
            raise InputError(
                f"{self.path}: band {self.elevation_band} holds no height at all "
                "(every cell is nodata or NaN)"
            )
        rim = undeclared_rim(grid.elevation_m)
        if rim is not None:
            value = (-rim[0] if self.down else rim[0]) / self.unit_m + 0.0
            self._tell_once(
                "rim",
                f"{rim[1]:,} cells hold exactly {value:g}, far from all the others, and fill its rim: is that "
                f"no data? Declare it: gdal_edit.py -a_nodata {value:g} {self.path.name}",
            )
        return replace(grid, sigma_m=_known(grid.sigma_m), count=_known(grid.count))

    def read(self, rows: slice | None = None, cols: slice | None = None) -> Grid:
        """Read a window of whole cells; a band of sigma stays even where it is empty."""
        window = None
        west, north, transform = (
            self.source.transform.c,
            self.source.transform.f,
            self.source.transform,
        )
        if rows is not None and cols is not None:
            window = Window(cols.start, rows.start, cols.stop - cols.start, rows.stop - rows.start)
            west, north = west + cols.start * transform.a, north + rows.start * transform.e
        elevation_m = self._without_sentinels(
            _read_band(self.source, self.elevation_band, window) * self.unit_m
        )
        if self.down:
            elevation_m = -elevation_m
        sigma: npt.NDArray[np.float64] | None = None
        if self.sigma_m is not None:
            sigma = np.where(np.isfinite(elevation_m), float(self.sigma_m), np.nan)
        elif self.sigma_band is not None:
            sigma = _read_band(self.source, self.sigma_band, window) * self.unit_m
        elif self.sigma_beside:
            with rasterio.open(self.sigma_beside) as beside:
                sigma = _read_band(beside, 1, window) * self.unit_m
        if sigma is not None and (sigma < 0).any():
            self._tell_once(
                "sigma", f"holds negative sigmas ({np.nanmin(sigma):g}): taken for unknown"
            )
            sigma = np.where(sigma < 0, np.nan, sigma)
        square = np.isclose(transform.a, -transform.e, rtol=1e-9)
        return Grid(
            elevation_m=elevation_m,
            west_m=west,
            north_m=north,
            cell_m=transform.a,
            cell_height_m=None if square else -transform.e,
            crs=_horizontal(self.source.crs),
            sigma_m=sigma,
            count=None
            if self.count_band is None
            else _read_band(self.source, self.count_band, window),
            datum=self.source.tags().get("VERTICAL_DATUM", ""),
        )

    def _without_sentinels(self, elevation_m: FloatArray) -> FloatArray:
        """Return heights with NaN for what stands for no data without being declared as such."""
        declared = self.source.nodatavals[self.elevation_band - 1] is not None
        wrong = no_heights(elevation_m, declared, self.unit_m)
        if not wrong.any():
            return elevation_m
        values = ", ".join(f"{v / self.unit_m:g}" for v in np.unique(elevation_m[wrong])[:3])
        self._tell_once("no data", f"cells of {values} are no heights: taken for no data")
        return np.where(wrong, np.nan, elevation_m)

    def _tell_once(self, kind: str, defect: str) -> None:
        if kind not in self.told:
            self.told.add(kind)
            logger.warning("%s: %s", self.path, defect)


def _horizontal(crs: Any) -> str:
    """Return a raster's CRS without the vertical part that BAG files carry: frames are compared by it."""
    if not crs:
        return ""
    # Compound names are rare, and asking pyproj costs milliseconds.
    if not crs.to_wkt().startswith("COMPD"):
        return str(crs.to_string())
    part = CRS.from_wkt(crs.to_wkt()).sub_crs_list[0]
    return str(part.to_string())


def _main_subdataset(path: Path) -> str:
    """Return the dataset to open: a NetCDF of several variables hides them as subdatasets."""
    with rasterio.open(path) as source:
        if source.count or not source.subdatasets:
            return str(path)
        names = list(source.subdatasets)
    for wanted in _ELEVATION_NAMES:
        for name in names:
            if name.rsplit(":", 1)[-1].strip("/").lower() == wanted:
                return str(name)
    return str(names[0])


def _opened(source: Any, path: Path, sigma_m: float | None) -> OpenMap:
    _refuse_unusable_frame(source, path)
    descriptions = _descriptions(source)
    elevation_band = _band_named(descriptions, _ELEVATION_NAMES) or 1
    sigma_band = _band_named(descriptions, _SIGMA_NAMES)
    return OpenMap(
        path=path,
        source=source,
        elevation_band=elevation_band,
        down=_points_down(source, elevation_band, descriptions[elevation_band - 1]),
        sigma_band=sigma_band,
        count_band=_band_named(descriptions, ("count",)),
        sigma_m=sigma_m,
        sigma_beside="" if sigma_band is not None else _sibling_sigma(source, path),
        unit_m=_unit_of_height(source, elevation_band, path),
    )


def _unit_of_height(source: Any, band: int, path: Path) -> float:
    """Return the metres in a file's unit of height: by its band, its tags or its vertical CRS."""
    tags = {k.rsplit("#", 1)[-1].lower(): v for k, v in source.tags(band).items()}
    name = str(source.units[band - 1] or tags.get("units", "") or tags.get("unittype", "")).strip()
    unit_m = _UNITS_M.get(name.lower().replace("_", " "), 1.0)
    if name and name.lower().replace("_", " ") not in _UNITS_M:
        logger.warning("%s: its unit of height, %r, is not known: read as metres", path, name)
    if not name and source.crs and source.crs.to_wkt().startswith("COMPD"):
        axis = CRS.from_wkt(source.crs.to_wkt()).sub_crs_list[-1].axis_info[0]
        name, unit_m = axis.unit_name, axis.unit_conversion_factor
    if unit_m != 1.0:
        logger.warning("%s: its heights are in %s: turned to metres", path, name)
    return unit_m


def _descriptions(source: Any) -> list[str]:
    """Return the bands' names in lower case; a NetCDF keeps its variable's name in a tag."""
    return [
        (name or source.tags(band).get("NETCDF_VARNAME", "")).lower()
        for band, name in enumerate(source.descriptions, start=1)
    ]


def _points_down(source: Any, band: int, name: str) -> bool:
    """Return whether a band holds depths: by CF's `positive`, or else by its name."""
    tags = {**source.tags(), **source.tags(band)}
    for key, value in tags.items():
        if key.rsplit("#", 1)[-1] == "positive" and key.split("#")[0].lower() in ("positive", name):
            return str(value).lower() == "down"
    return name.startswith("depth")


def _sibling_sigma(source: Any, path: Path) -> str:
    """Return the name of the sigma that stands beside the heights in a NetCDF; empty none."""
    if not str(source.name).lower().startswith("netcdf:"):
        return ""
    with rasterio.open(path) as whole:
        names = list(whole.subdatasets)
    for wanted in _SIGMA_NAMES:
        for name in names:
            if name.rsplit(":", 1)[-1].strip("/").lower() == wanted:
                with rasterio.open(name) as beside:
                    if beside.shape == source.shape:
                        return str(name)
    return ""


def _known(values: FloatArray | None) -> FloatArray | None:
    """Return a band, or None where it is there in name only: some makers leave uncertainty empty."""
    return None if values is None or not np.isfinite(values).any() else values


def _refuse_unusable_frame(source: Any, path: Path) -> None:
    transform = source.transform
    if transform.b or transform.d or transform.a <= 0 or transform.e >= 0:
        if transform == Affine.identity():
            raise InputError(
                f"{path}: has no georeference; give a raster with a projected CRS in metres"
            )
        raise InputError(
            f"{path}: its rows do not run north to south (transform {tuple(transform)[:6]}); "
            "warp it to a north-up grid: gdalwarp -t_srs EPSG:<UTM zone> in.tif out.tif"
        )
    degrees = any(
        key.endswith("#units") and str(value).lower().startswith("degree")
        for key, value in source.tags().items()
    )
    # A NetCDF of the COARDS kind names no CRS; its axes' units tell.
    if degrees or (source.crs is not None and source.crs.is_geographic):
        name = source.crs.to_string() if source.crs is not None else "longitude and latitude"
        raise InputError(
            f"{path}: its cells are in degrees ({name}); "
            "warp it to metres: gdalwarp -t_srs EPSG:<UTM zone> in.tif out.tif"
        )
    # A local (engineering) CRS is neither geographic nor projected: GDAL knows no unit of it.
    projected = source.crs is not None and source.crs.is_projected
    if projected and source.crs.linear_units_factor[1] != 1.0:
        raise InputError(
            f"{path}: its cells are in {source.crs.linear_units_factor[0]}; "
            "warp it to metres: gdalwarp -t_srs EPSG:<UTM zone> in.tif out.tif"
        )


def _band_named(descriptions: Sequence[str], names: Sequence[str]) -> int | None:
    for name in names:
        for band, description in enumerate(descriptions, start=1):
            if description.split(" ")[0] == name:
                return band
    return None


def _read_band(source: Any, band: int, window: Window | None = None) -> npt.NDArray[np.float64]:
    values = source.read(band, window=window, masked=True).astype(np.float64)
    scale, offset = source.scales[band - 1], source.offsets[band - 1]
    filled: npt.NDArray[np.float64] = values.filled(np.nan) * scale + offset
    filled[~np.isfinite(filled)] = np.nan
    return filled


def write_map(
    path: Path,
    grid: Grid,
    tags: Mapping[str, str] | None = None,
    filled: npt.NDArray[np.bool_] | None = None,
) -> None:
    """Write `map.tif` as the contract has it: float32 bands elevation, sigma, count; NaN nodata.

    A grid without sigma or count gets bands of NaN, so that the bands' order never varies.

    Parameters
    ----------
    filled : (rows, cols) where gaps were filled: a fourth band `filled`, 1 there.
    """
    nothing = np.full(grid.shape, np.nan)
    bands = {
        "elevation": grid.elevation_m,
        "sigma": nothing if grid.sigma_m is None else grid.sigma_m,
        "count": nothing if grid.count is None else grid.count,
    }
    if filled is not None:
        bands["filled"] = filled.astype(float)
    extra = {"VERTICAL_DATUM": grid.datum} if grid.datum else {}
    write_bands(path, bands, grid, tags={**extra, **(tags or {})})


def write_bands(
    path: Path,
    bands: Mapping[str, npt.NDArray[Any]],
    frame: Grid,
    dtype: str = "float32",
    nodata: float | None = float("nan"),
    tags: Mapping[str, str] | None = None,
) -> None:
    """Write described bands on the frame (origin, cell, CRS) of a grid as a COG.

    Parameters
    ----------
    bands : description to (rows, cols) array, in the order of the file.
    frame : the grid whose georeference is taken.
    """
    rows, cols = frame.shape
    transform = Affine(frame.cell_m, 0, frame.west_m, 0, -frame.cell_north_m, frame.north_m)
    profile = {
        "driver": "COG",
        "dtype": dtype,
        "count": len(bands),
        "height": rows,
        "width": cols,
        "crs": frame.crs or None,
        "transform": transform,
        "nodata": nodata,
        "compress": "deflate",
        "predictor": "yes",
        # Averaged overviews of labels would invent classes.
        "overview_resampling": "nearest"
        if np.issubdtype(np.dtype(dtype), np.integer)
        else "average",
    }
    with whole_file(path) as temporary:
        try:
            with rasterio.open(temporary, "w", **profile) as target:
                for index, (name, values) in enumerate(bands.items(), start=1):
                    band = np.asarray(values).astype(dtype)
                    target.write(band, index)
                    target.set_band_description(index, name)
                    if np.issubdtype(band.dtype, np.floating):
                        statistics = Statistics()
                        statistics.add(band)
                        target.update_tags(index, **statistics.tags(rows * cols))
                target.update_tags(**dict(tags or {}))
        except RASTER_ERRORS as error:
            raise InputError(f"{path}: cannot be written ({error}); is the disk full?") from error
