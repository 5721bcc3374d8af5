"""Currents from the command line: a constant, or a file of eastward and northward speeds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from scipy.interpolate import RegularGridInterpolator

from perception.files import existing_file
from perception.geodesy import GEOGRAPHIC, convergence
from perception.records import FloatArray, Grid, InputError
from planning.currents import Currents, steady

# Names of the speeds towards east and north: ROMS, HYCOM, Copernicus, and CF's standard names.
_EAST = ("u", "water_u", "uo", "eastward_sea_water_velocity", "u_east", "east", "current_east_m_s")
_NORTH = (
    "v",
    "water_v",
    "vo",
    "northward_sea_water_velocity",
    "v_north",
    "north",
    "current_north_m_s",
)
_X = ("easting", "easting_m", "x", "lon", "longitude")
_Y = ("northing", "northing_m", "y", "lat", "latitude")


def read_currents(text: str, grid: Grid) -> Currents:
    """Return currents from `EAST,NORTH` (m/s), a NetCDF, or a raster whose two bands are east and north.

    East and north are true ones, as in all files; they are turned by the map's convergence.

    A NetCDF has the speeds over one-dimensional coordinates, in the map's CRS or in degrees (from -180
    or from 0); of further dimensions (time, depth) the first is taken. A raster may have a CRS of its
    own. Unknown cells count as still water.

    Raises
    ------
    InputError
        Neither two numbers nor such a file, or one that does not reach the map.
    """
    parts = text.split(",")
    if len(parts) == 2:
        try:
            speeds = float(parts[0]), float(parts[1])
        except ValueError:
            pass
        else:
            if not np.isfinite(speeds).all():
                raise InputError(f"{text}: is no current; give two numbers in m/s, e.g. 0.2,-0.1")
            return _turned(steady(*speeds), grid)
    if not Path(text).exists():
        raise InputError(
            f"{text}: is neither EAST,NORTH in m/s nor a file; give e.g. --currents 0.2,-0.1"
        )
    path = existing_file(Path(text))
    x, y, east, north, own_crs = (
        _from_netcdf(path) if path.suffix.lower() in (".nc", ".nc4", ".cdf") else _from_raster(path)
    )
    currents = Currents(_sampler(path, x, y, (east, north), own_crs, grid.crs), str(path))
    middle = [
        np.array([0.5 * (grid.west_m + grid.east_m)]), np.array([0.5 * (grid.south_m + grid.north_m)])
    ]  # fmt: skip
    if not np.isfinite(currents.at(*middle)[0]).all():
        raise InputError(f"{path}: does not reach the map; give currents of the same area")
    return _turned(Currents(_still_where_unknown(currents), str(path)), grid)


def _turned(currents: Currents, grid: Grid) -> Currents:
    """Return currents along the grid's axes from ones along true east and north."""
    # One convergence for the map: it changes by thousandths of a degree over a survey.
    e, n = 0.5 * (grid.west_m + grid.east_m), 0.5 * (grid.south_m + grid.north_m)
    turn = float(np.nan_to_num(convergence(np.array([e]), np.array([n]), grid.crs))[0])
    cos, sin = np.cos(turn), np.sin(turn)

    def at(easting_m: FloatArray, northing_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        east, north = currents.at(easting_m, northing_m)
        return east * cos - north * sin, east * sin + north * cos

    return Currents(at, currents.source)


def _still_where_unknown(currents: Currents) -> Any:
    def at(easting_m: FloatArray, northing_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        east, north = currents.at(easting_m, northing_m)
        return np.nan_to_num(east), np.nan_to_num(north)

    return at


def _sampler(
    path: Path,
    x: FloatArray,
    y: FloatArray,
    speeds: tuple[FloatArray, FloatArray],
    own_crs: str,
    crs: str,
) -> Any:
    own = CRS.from_user_input(own_crs) if own_crs else None
    degrees = own is not None and own.is_geographic
    if degrees and not crs:
        raise InputError(
            f"{path}: is in degrees, and the map has no CRS; give currents in its metres"
        )
    transformer = _transformer(path, crs, own)
    if degrees and len(x) > 1 and 0 <= 360.0 - (x[-1] - x[0]) < 1.5 * (x[1] - x[0]):
        # All round the Earth: the last meridian's neighbour is the first.
        x, speeds = np.append(x, x[0] + 360.0), (_closed(speeds[0]), _closed(speeds[1]))
    flip = np.s_[::-1] if y[0] > y[-1] else np.s_[:]
    # Land is NaN in models of the sea: still water there, rather than none known beside the coast.
    fields = [
        RegularGridInterpolator((y[flip], x), np.nan_to_num(v)[flip], bounds_error=False)
        for v in speeds
    ]

    def at(easting_m: FloatArray, northing_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        if transformer is not None:
            easting_m, northing_m = transformer.transform(easting_m, northing_m)
        if degrees:
            # Files count longitudes from -180 or from 0.
            easting_m = x.min() + np.mod(easting_m - x.min(), 360.0)
        points = np.column_stack([northing_m, easting_m])
        return fields[0](points), fields[1](points)

    return at


def _closed(speeds: FloatArray) -> FloatArray:
    return np.concatenate([speeds, speeds[:, :1]], axis=1)


def _transformer(path: Path, crs: str, own: CRS | None) -> Transformer | None:
    """Return what takes the map's coordinates to a file's; None where they are the same."""
    if own is None or not crs:
        return None
    ours = CRS.from_user_input(crs)
    if ours.equals(own, ignore_axis_order=True):
        return None
    try:
        return Transformer.from_crs(ours, own, always_xy=True)
    except ProjError as error:
        raise InputError(
            f"{path}: its CRS ({own.name}) cannot be reached from the map's ({ours.name}); "
            "give currents in the map's metres"
        ) from error


def _from_raster(path: Path) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, str]:
    import rasterio

    try:
        with rasterio.open(path) as source:
            if source.count < 2:
                raise InputError(f"{path}: has one band; currents need two, towards east and north")
            east, north = (
                source.read(band, masked=True).astype(float).filled(np.nan) for band in (1, 2)
            )
            t = source.transform
            own_crs = source.crs.to_wkt() if source.crs else ""
            x = t.c + (np.arange(source.width) + 0.5) * t.a
            y = t.f + (np.arange(source.height) + 0.5) * t.e
    except rasterio.errors.RasterioError as error:
        raise InputError(
            f"{path}: is neither EAST,NORTH in m/s nor a file of currents ({error})"
        ) from error
    return x, y, east, north, own_crs


def _from_netcdf(path: Path) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, str]:
    import xarray

    try:
        data = xarray.open_dataset(path, decode_times=False)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as NetCDF ({error})") from error
    with data:
        fields = [_variable(path, data, names) for names in (_EAST, _NORTH)]
        x_name, y_name = (next((n for n in names if n in fields[0].dims), "") for names in (_X, _Y))
        if not x_name or not y_name:
            raise InputError(
                f"{path}: its currents lie over {', '.join(map(str, fields[0].dims))}; they need one "
                f"dimension of {', '.join(_X)} and one of {', '.join(_Y)}"
            )
        flat = []
        for field in fields:
            first = {d: 0 for d in field.dims if d not in (x_name, y_name)}
            flat.append(field.isel(first).transpose(y_name, x_name).to_numpy().astype(float))
        x, y = (data[n].to_numpy().astype(float) for n in (x_name, y_name))
    return x, y, flat[0], flat[1], GEOGRAPHIC if x_name.startswith("lon") else ""


def _variable(path: Path, data: Any, names: tuple[str, ...]) -> Any:
    for name in data.data_vars:
        standard = str(data[name].attrs.get("standard_name", ""))
        if str(name).lower() in names or standard in names:
            return data[name]
    raise InputError(
        f"{path}: has no current among {', '.join(map(str, data.data_vars)) or 'no variables'}; one of "
        f"{', '.join(names)} is needed"
    )
