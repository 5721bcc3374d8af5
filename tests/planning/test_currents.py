"""Currents: what a metre costs by direction, what the searches make of it, and the files they come in."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import xarray
from numpy.testing import assert_allclose
from pyproj import Transformer

from mapping.rasters import write_bands
from perception.records import Grid, InputError
from planning.bound import lower_bound
from planning.cost import CostTerms
from planning.current_files import read_currents
from planning.currents import Currents, steady, through_water
from planning.field import search
from planning.finish import exact_cost, finish
from planning.limits import VehicleLimits
from planning.planner import PlanConfig, plan_route
from planning.polish import evaluate
from planning.surface import Surface, build_surface
from tests.planning.terrains import NORTH, WEST, at, flat, grid_of

QUICK = PlanConfig(planner="none")


def surface(currents: Currents | None) -> Surface:
    grid = grid_of(flat())
    return build_surface(grid, VehicleLimits(), CostTerms(), currents=currents)


def test_water_per_ground_is_that_of_the_triangle_of_speeds():
    assert_allclose(through_water(1.0, 0.0, 0.25, 0.0), 1 / 1.25)
    assert_allclose(through_water(1.0, 0.0, -0.25, 0.0), 1 / 0.75)
    # Square to a current of 0.6 the vehicle makes good 0.8.
    assert_allclose(through_water(0.0, 7.0, 0.6, 0.0), 1.25)
    assert through_water(3.0, 4.0, 0.0, 0.0) == 1.0
    # No headway at all is dear, not infinite.
    assert_allclose(through_water(-1.0, 0.0, 2.0, 0.0), 20.0)


def test_the_grid_search_pays_for_a_steady_current_as_the_triangle_says():
    s = surface(steady(0.45, 0.0))
    field = search(s, (60, 20))
    # East with 0.3 of the speed, west against it.
    assert_allclose(field.cost[60, 100], 80 / 1.3, rtol=1e-5)
    back = search(s.reversed(), (60, 20))
    assert_allclose(back.cost[60, 100], 80 / 0.7, rtol=1e-5)


def test_polish_and_proof_agree_on_the_cost_in_a_current():
    def jet(e, n):
        return 0.5 * np.exp(-(((n - NORTH + 60) / 20) ** 2)), np.zeros(len(e))

    s = surface(Currents(jet))
    points = np.array([[10.0, 20.0], [60.0, 55.0], [100.0, 90.0]])
    w = finish(s, points)
    assert_allclose(exact_cost(s, w), evaluate(s, points).cost, rtol=0.01)


def test_a_route_bends_into_a_jet_that_carries_it_and_out_of_one_that_does_not():
    grid = grid_of(flat(160, 160))
    start, goal = at(grid, 80, 10), at(grid, 80, 150)
    middle = NORTH - 50.0
    for sign in (1.0, -1.0):

        def jet(e, n, sign=sign):
            return sign * 0.9 * np.exp(-(((n - middle) / 18.0) ** 2)), np.zeros(len(e))

        plan = plan_route(grid, start, goal, config=QUICK, currents=Currents(jet))
        assert plan.route is not None, plan.reason
        bend = plan.route.northing_m.max() - at(grid, 80, 0)[1]
        straight = math.dist(start, goal)
        if sign > 0:
            assert bend > 8.0 and plan.route.travel_time_s < straight / 1.5
        else:
            assert bend < 1.0
        assert plan.lower_bound <= plan.route.cost


def test_a_bound_in_a_current_stays_below_the_cost():
    s = surface(steady(0.6, 0.3))
    start, goal = (WEST + 20.5, NORTH - 60.5), (WEST + 100.5, NORTH - 20.5)
    field = search(s, (60, 20), (20, 100))
    assert lower_bound(s, start, goal) <= field.cost[20, 100]


def test_water_that_runs_as_fast_as_the_vehicle_is_barred():
    assert not surface(steady(1.2, 0.0)).barred.any()
    assert surface(steady(1.4, 0.0)).barred.all()
    with pytest.raises(InputError, match="current is as strong as the vehicle"):
        grid = grid_of(flat())
        plan_route(grid, at(grid, 10, 10), at(grid, 90, 90), config=QUICK, currents=steady(1.5, 0))


def test_currents_come_from_a_netcdf_of_a_sea_model_in_degrees(tmp_path):
    grid = grid_of(flat())
    lon, lat = np.linspace(8.9, 9.1, 21), np.linspace(36.9, 37.2, 31)
    u = np.broadcast_to(0.2, (2, 31, 21)).copy()
    v = np.broadcast_to(-0.1, (2, 31, 21)).copy()
    xarray.Dataset(
        {
            "uo": (("time", "latitude", "longitude"), u),
            "vo": (("time", "latitude", "longitude"), v),
        },
        coords={"time": [0, 1], "latitude": lat, "longitude": lon},
    ).to_netcdf(tmp_path / "c.nc")
    east, north = read_currents(str(tmp_path / "c.nc"), grid).on(grid)
    # At the zone's central meridian true north is grid north.
    assert_allclose(east, 0.2, atol=1e-3)
    assert_allclose(north, -0.1, atol=1e-3)


def test_a_file_that_holds_no_currents_says_what_is_missing(tmp_path):
    xarray.Dataset({"temp": (("x", "y"), np.zeros((3, 3)))}).to_netcdf(tmp_path / "t.nc")
    with pytest.raises(InputError, match="has no current among temp"):
        read_currents(str(tmp_path / "t.nc"), grid_of(flat()))
    with pytest.raises(InputError, match="neither EAST,NORTH in m/s nor a file"):
        read_currents("0.1;0.2", grid_of(flat()))


@pytest.mark.parametrize("text", ["nan,0", "0.1,inf"])
def test_a_current_that_is_no_number_is_refused(text):
    with pytest.raises(InputError, match="is no current"):
        read_currents(text, grid_of(flat()))


@pytest.mark.parametrize("first, last, step", [(0, 359, 1), (350, 358, 0.5), (-180, 179, 1)])
def test_longitudes_from_nought_reach_west_of_greenwich(tmp_path, first, last, step):
    # UTM zone 30: its central meridian is 3 degrees west; speeds are the longitude's own.
    grid = replace(grid_of(flat()), crs="EPSG:32630")
    lon, lat = np.arange(first, last + step / 2, step), np.linspace(36.0, 38.0, 5)
    west = np.broadcast_to(np.mod(lon + 180.0, 360.0) - 180.0, (5, len(lon)))
    xarray.Dataset(
        {"uo": (("lat", "lon"), 0.0 * west), "vo": (("lat", "lon"), 0.1 * west)},
        coords={"lat": lat, "lon": lon},
    ).to_netcdf(tmp_path / "c.nc")
    assert_allclose(read_currents(str(tmp_path / "c.nc"), grid).on(grid)[1], -0.3, atol=1e-3)


def test_longitudes_all_round_join_at_their_seam(tmp_path):
    # At 0.25 degrees west, between the last meridian of the file and the first.
    east, north = Transformer.from_crs(4326, 32630, always_xy=True).transform(-0.25, 37.0)
    grid = Grid(flat(), east - 60, north + 60, 1.0, crs="EPSG:32630")
    lon, lat = np.arange(0.0, 359.6, 0.5), np.linspace(36.0, 38.0, 5)
    still = np.zeros((5, len(lon)))
    still[:, -1] = 0.4
    xarray.Dataset(
        {"uo": (("lat", "lon"), still), "vo": (("lat", "lon"), 0 * still)},
        coords={"lat": lat, "lon": lon},
    ).to_netcdf(tmp_path / "c.nc")
    speed = np.hypot(*read_currents(str(tmp_path / "c.nc"), grid).on(grid))
    assert_allclose(speed, 0.2, atol=2e-3)


def test_a_raster_of_currents_is_read_in_its_own_crs(tmp_path):
    grid = grid_of(flat())
    east, north = Transformer.from_crs(32632, 32633, always_xy=True).transform(WEST, NORTH)
    field = Grid(np.zeros((40, 40)), east - 2000.0, north + 2000.0, 100.0, crs="EPSG:32633")
    # Speeds grow with the other zone's easting.
    ramp = np.broadcast_to(1e-4 * (field.centres()[0] - east), (40, 40))
    write_bands(tmp_path / "c.tif", {"east": ramp, "north": 0 * ramp}, field)
    speed = read_currents(str(tmp_path / "c.tif"), grid).on(grid)[0]
    assert abs(speed[0, 0]) < 1e-3 and speed[0, -1] == pytest.approx(0.012, abs=1e-3)
    write_bands(
        tmp_path / "far.tif", {"east": ramp, "north": 0 * ramp}, replace(field, west_m=WEST)
    )
    with pytest.raises(InputError, match="does not reach the map"):
        read_currents(str(tmp_path / "far.tif"), grid)
