"""Currents: what a metre costs by direction, what the searches make of it, and the files they come in."""

from __future__ import annotations

import math

import numpy as np
import pytest
import xarray
from numpy.testing import assert_allclose

from perception.records import InputError
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
