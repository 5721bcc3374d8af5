"""Horizontal frames against closed formulas and against bearings on the ellipsoid."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from numpy.testing import assert_allclose

from perception.geodesy import (
    GEOGRAPHIC,
    LOCAL_CRS,
    convergence,
    is_local,
    metric_crs,
    scale_error,
    transform,
    utm_crs,
    wrap,
)
from perception.records import InputError


@pytest.mark.parametrize(
    ("lon", "lat", "crs"),
    [
        (-68.8, 48.4, "EPSG:32619"), (-59.64, 13.2, "EPSG:32621"), (151.2, -33.9, "EPSG:32756"),
        (179.99, 10.0, "EPSG:32660"), (180.0, 10.0, "EPSG:32601"), (-180.0, -1.0, "EPSG:32701"),
        (10.0, 88.0, "EPSG:32661"), (10.0, -85.0, "EPSG:32761"),
    ],
)  # fmt: skip
def test_the_utm_zone_of_a_position(lon, lat, crs):
    assert utm_crs(lon, lat) == crs


@pytest.mark.parametrize(
    "crs", ["EPSG:32619", "EPSG:32756", "EPSG:2154", "EPSG:32661", "EPSG:3035"]
)
def test_a_grid_bearing_is_the_true_bearing_less_the_convergence(crs):
    """Walk 10 m by a true bearing on the ellipsoid (Geod) and look at the bearing on the grid."""
    centre = {"EPSG:32619": (-71.5, 48.4), "EPSG:32756": (155.4, -33.9), "EPSG:2154": (7.5, 43.5),
              "EPSG:32661": (40.0, 86.0), "EPSG:3035": (25.0, 60.0)}[crs]  # fmt: skip
    geod = pyproj.Geod(ellps="GRS80" if crs in ("EPSG:2154", "EPSG:3035") else "WGS84")
    lon, lat = np.array([centre[0]]), np.array([centre[1]])
    east, north = transform(lon, lat, GEOGRAPHIC, crs)
    turn = convergence(east, north, crs)
    for bearing in (0.0, 77.0, 200.0):
        lon2, lat2, _ = geod.fwd(lon, lat, [bearing], [10.0])
        east2, north2 = transform(np.asarray(lon2), np.asarray(lat2), GEOGRAPHIC, crs)
        grid = np.arctan2(east2 - east, north2 - north)
        # EPSG:3035 is not conformal: bearings distort by up to the scale difference, 1 % here.
        tolerance = 2e-2 if crs == "EPSG:3035" else 2e-5
        assert abs(wrap(np.radians(bearing) - turn - grid)[0]) < tolerance


def test_convergence_of_utm_follows_the_first_order_formula():
    lon, lat = np.linspace(-71.9, -66.1, 9), np.full(9, 48.4)
    turn = convergence(*transform(lon, lat, GEOGRAPHIC, "EPSG:32619"), "EPSG:32619")
    assert_allclose(turn, np.radians(lon + 69.0) * np.sin(np.radians(48.4)), atol=2e-5)


def test_positions_go_there_and_back():
    lon, lat = np.array([-68.8, np.nan]), np.array([48.4, 48.4])
    east, north = transform(lon, lat, GEOGRAPHIC, "EPSG:32619")
    back = transform(east, north, "EPSG:32619", GEOGRAPHIC)
    assert_allclose(back[0], lon, atol=1e-9)
    assert np.isnan(east[1]) and np.isnan(back[1][1])


def test_a_local_grid_has_no_place_on_earth():
    assert is_local(LOCAL_CRS) and metric_crs(LOCAL_CRS) == LOCAL_CRS
    assert_allclose(convergence(np.array([5.0]), np.array([6.0]), LOCAL_CRS), 0.0)
    with pytest.raises(InputError, match="no place on Earth"):
        transform(np.array([5.0]), np.array([6.0]), LOCAL_CRS, "EPSG:32619")


def test_a_compound_crs_gives_its_horizontal_part():
    assert metric_crs("EPSG:32619+5703") == "EPSG:32619"


@pytest.mark.parametrize(
    ("text", "why"), [("EPSG:4326", "degrees"), ("EPSG:2263", "foot"), ("x", "x")]
)
def test_a_crs_that_is_not_metric_is_refused_by_name(text, why):
    with pytest.raises(InputError, match=why) as caught:
        metric_crs(text)
    assert text in str(caught.value)


@pytest.mark.parametrize(
    ("crs", "lon", "lat", "error"),
    [
        ("EPSG:32630", -3.0, 50.0, -0.0004),
        ("EPSG:3857", 0.0, 60.0, 1.0),  # 1 / cos 60 deg, but for the ellipsoid
        ("EPSG:32661", 20.0, 89.5, -0.006),
        (LOCAL_CRS, 1.0, 2.0, 0.0),
    ],
)
def test_the_scale_of_a_grid_against_its_definition(crs, lon, lat, error):
    at = (np.array([lon]), np.array([lat]))
    east, north = at if crs == LOCAL_CRS else transform(*at, GEOGRAPHIC, crs)
    assert abs(scale_error(east, north, crs)[0] - error) < 1e-4 + 5e-3 * abs(error)
