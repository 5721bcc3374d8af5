"""Horizontal frames: from what a file holds to a projected CRS in metres, and back to true north."""

from __future__ import annotations

import numpy as np
import pyproj
from pyproj.exceptions import CRSError, ProjError

from perception.records import FloatArray, InputError

# Metric navigation without a zone has no place on Earth: an engineering CRS says so. GDAL, PROJ and
# QGIS read this older spelling of one, and GDAL gives it back letter by letter from a map file.
LOCAL_CRS = (
    'LOCAL_CS["local metric grid",UNIT["metre",1,AUTHORITY["EPSG","9001"]],'
    'AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
)
GEOGRAPHIC = "EPSG:4326"


def utm_crs(longitude_deg: float, latitude_deg: float) -> str:
    """Return the WGS 84 UTM zone of a position, or the polar stereographic grid beyond it.

    Zones are the plain six degrees: the exceptions off Norway and Svalbard are a mapping custom, and
    a plain zone serves as well for one survey.
    """
    if latitude_deg > 84.0:
        return "EPSG:32661"
    if latitude_deg < -80.0:
        return "EPSG:32761"
    zone = int((longitude_deg + 180.0) % 360.0 // 6.0) + 1
    return f"EPSG:{(32600 if latitude_deg >= 0 else 32700) + zone}"


def metric_crs(text: str) -> str:
    """Check that `text` names a projected (or engineering) CRS in metres; return its short name.

    Raises
    ------
    InputError
        Unknown to PROJ, in degrees, or in another unit than the metre.
    """
    try:
        crs = pyproj.CRS.from_user_input(text)
    except CRSError as error:
        raise InputError(
            f"--crs {text!r}: PROJ does not know it; give a projected CRS such as EPSG:32619"
        ) from error
    if crs.is_compound:
        crs = crs.sub_crs_list[0]
    if not (crs.is_projected or crs.is_engineering):
        raise InputError(
            f"--crs {text!r}: is in degrees; give a projected CRS in metres such as EPSG:32619"
        )
    unit = crs.axis_info[0].unit_name if crs.axis_info else "metre"
    if unit not in ("metre", "meter", "m"):
        raise InputError(
            f"--crs {text!r}: its unit is {unit}; give a projected CRS in metres such as EPSG:32619"
        )
    return short_name(crs)


def short_name(crs: pyproj.CRS) -> str:
    """Return `EPSG:n` where the CRS has a code, else the text that loses nothing."""
    authority = crs.to_authority(min_confidence=100)
    if authority is not None:
        return ":".join(authority)
    return LOCAL_CRS if crs.is_engineering else str(crs.to_wkt())


def is_local(crs: str) -> bool:
    """Return whether `crs` has no place on Earth."""
    return bool(pyproj.CRS.from_user_input(crs).is_engineering) if crs else True


def transform(
    x: FloatArray, y: FloatArray, source_crs: str, target_crs: str
) -> tuple[FloatArray, FloatArray]:
    """Carry positions (n,) from one CRS to another, x east and y north in both.

    NaN stays NaN, and what the projection cannot hold becomes NaN.

    Raises
    ------
    InputError
        No transformation leads from one to the other (a local grid has no place on Earth).
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    if source_crs == target_crs:
        return x, y
    if is_local(source_crs) or is_local(target_crs):
        raise InputError(
            f"positions in {_plain(source_crs)} cannot be brought to {_plain(target_crs)}: a local "
            "grid has no place on Earth; give the survey's own projected CRS with --crs"
        )
    try:
        carry = pyproj.Transformer.from_crs(source_crs, target_crs, always_xy=True)
        east, north = carry.transform(x, y)
    except ProjError as error:
        raise InputError(
            f"positions cannot be brought from {source_crs} to {target_crs} ({error}); "
            "give another --crs"
        ) from error
    east, north = np.asarray(east, float), np.asarray(north, float)
    bad = ~(np.isfinite(east) & np.isfinite(north))
    return np.where(bad, np.nan, east), np.where(bad, np.nan, north)


def _plain(crs: str) -> str:
    return "a local grid" if is_local(crs) else crs


def convergence(easting_m: FloatArray, northing_m: FloatArray, crs: str) -> FloatArray:
    """Return the grid convergence (n,) in radians: grid bearing = true bearing - convergence.

    Positive where grid north lies clockwise (east) of true north, as east of the central meridian in
    the northern hemisphere. Zero on a local grid, whose north is taken for true; NaN where the
    position is NaN.
    """
    easting_m, northing_m = np.asarray(easting_m, float), np.asarray(northing_m, float)
    if is_local(crs):
        return np.zeros(easting_m.shape)
    # By a step of the projection itself along the meridian: right for every projected CRS, while
    # PROJ's own factors are defined for a Proj of the CRS's ellipsoid only. 1e-5 deg is 1 m.
    lon, lat = transform(easting_m, northing_m, crs, GEOGRAPHIC)
    step_deg = np.where(lat < 89.0, 1e-5, -1e-5)
    east, north = transform(lon, lat + step_deg, GEOGRAPHIC, crs)
    base_east, base_north = transform(lon, lat, GEOGRAPHIC, crs)
    sign = np.sign(step_deg)
    true_north_in_grid = np.arctan2(sign * (east - base_east), sign * (north - base_north))
    # The grid bearing of true north is minus the convergence.
    return np.asarray(-true_north_in_grid)


def scale_error(easting_m: FloatArray, northing_m: FloatArray, crs: str) -> FloatArray:
    """Return by what part (n,) a grid's metres differ from true ones: +0.5 where 10 m of ground measure 15.

    Of the steps along meridian and parallel the one that is further off. A UTM zone keeps within 0.001, and
    Web Mercator is off by 1 / cos(latitude). Zero on a local grid; NaN where the position is NaN.
    """
    easting_m, northing_m = np.asarray(easting_m, float), np.asarray(northing_m, float)
    if is_local(crs):
        return np.zeros(easting_m.shape)
    lon, lat = transform(easting_m, northing_m, crs, GEOGRAPHIC)
    step_deg = np.where(lat < 89.0, 1e-4, -1e-4)
    geod, base = pyproj.Geod(ellps="WGS84"), transform(lon, lat, GEOGRAPHIC, crs)
    errors = []
    for step_lon, step_lat in ((0.0, step_deg), (step_deg, 0.0)):
        there = lon + step_lon, lat + step_lat
        east, north = transform(*there, GEOGRAPHIC, crs)
        _, _, true_m = geod.inv(lon, lat, *there)
        with np.errstate(invalid="ignore", divide="ignore"):
            errors.append(np.hypot(east - base[0], north - base[1]) / np.asarray(true_m) - 1.0)
    return np.asarray(np.where(np.abs(errors[0]) > np.abs(errors[1]), *errors))


def wrap(angle_rad: FloatArray) -> FloatArray:
    """Wrap angles into [-pi, pi)."""
    return np.asarray((np.asarray(angle_rad) + np.pi) % (2 * np.pi) - np.pi)
