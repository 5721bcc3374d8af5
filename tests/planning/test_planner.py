"""Whole routes: limits kept, costs near the bound, symmetry, repeatability, refusals with reasons."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

from perception.records import InputError
from planning.limits import VehicleLimits
from planning.planner import Plan, PlanConfig, plan_route
from tests.planning.terrains import at, brute_force, canyon, flat, grid_of

QUICK = PlanConfig(planner="none")


def assert_within_limits(grid, plan: Plan, limits: VehicleLimits | None = None) -> None:
    limits = limits or VehicleLimits()
    assert plan.route is not None, plan.reason
    found = brute_force(grid, plan.route)
    assert found["least_m"] >= limits.floor_m
    assert found["greatest_m"] <= limits.ceiling_m
    assert found["radius_m"] >= limits.turn_radius_m
    assert found["up_deg"] <= limits.pitch_up_deg and found["down_deg"] <= limits.pitch_down_deg
    # The proof is exact: dense samples lie above it, and come near it.
    assert plan.route.min_altitude_m <= found["least_m"] + 1e-9
    assert_allclose(plan.route.min_altitude_m, found["least_m"], atol=0.01)


def test_on_flat_ground_the_route_is_the_straight_line_at_the_floor():
    grid = grid_of(flat())
    start, goal = at(grid, 10, 15), at(grid, 100, 80)
    plan = plan_route(grid, start, goal, config=QUICK)
    assert_within_limits(grid, plan)
    assert_allclose(plan.route.cost, math.hypot(90, 65), rtol=1e-4)
    assert_allclose(plan.lower_bound, math.hypot(90, 65), rtol=1e-2)
    assert plan.lower_bound <= plan.route.cost
    assert_allclose(
        [plan.route.easting_m[[0, -1]], plan.route.northing_m[[0, -1]]],
        np.transpose([start, goal]),
        atol=1e-5,
    )


def test_a_straight_valley_is_followed_and_its_cost_is_its_length():
    col = np.arange(160.0)
    z = np.tile(-60.0 + 0.02 * (col - 80) ** 2, (160, 1))
    grid = grid_of(z)
    plan = plan_route(grid, at(grid, 8, 80), at(grid, 150, 80), config=QUICK)
    assert_within_limits(grid, plan)
    assert_allclose(plan.route.cost, 142.0, rtol=1e-3)
    assert np.abs(plan.route.easting_m - at(grid, 0, 80)[0]).max() < 0.5


@pytest.mark.parametrize(
    "seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)]
)
def test_rough_canyons_keep_every_limit_by_an_independent_check(seed):
    grid = grid_of(canyon(seed=seed))
    plan = plan_route(grid, at(grid, 6, 118), at(grid, 233, 121))
    assert_within_limits(grid, plan)
    assert plan.lower_bound <= plan.route.cost
    assert plan.route.cost <= 1.06 * plan.grid_cost


def test_without_a_turning_limit_the_route_comes_within_three_per_cent_of_the_grid():
    limits = VehicleLimits(turn_radius_m=0.0)
    grid = grid_of(canyon(seed=5, wall_m=15.0))
    plan = plan_route(grid, at(grid, 6, 118), at(grid, 233, 121), limits, config=QUICK)
    assert_within_limits(grid, plan, limits)
    assert plan.route.cost <= 1.03 * plan.grid_cost


def test_asymmetric_pitch_limits_are_kept_each():
    limits = VehicleLimits(pitch_up_deg=15.0, pitch_down_deg=40.0, ceiling_m=60.0)
    row = np.arange(200.0)
    z = np.tile((-60.0 + 25.0 * np.exp(-(((row - 100) / 12) ** 2)))[:, None], (1, 60))
    grid = grid_of(z)
    plan = plan_route(grid, at(grid, 5, 30), at(grid, 195, 30), limits, config=QUICK)
    assert_within_limits(grid, plan, limits)


def test_a_mirrored_world_gives_a_route_of_the_same_cost():
    z = canyon(n=160, seed=1)
    one = plan_route(grid_of(z), at(grid_of(z), 6, 78), at(grid_of(z), 153, 81), config=QUICK)
    grid = grid_of(z[:, ::-1])
    two = plan_route(grid, at(grid, 6, 159 - 78), at(grid, 153, 159 - 81), config=QUICK)
    assert_allclose(two.grid_cost, one.grid_cost, rtol=1e-6)
    # Pattern search tries one side before the other, so a mirror may end in a neighbouring minimum.
    assert_allclose(two.route.cost, one.route.cost, rtol=0.01)


def test_the_same_seed_gives_the_same_route_to_the_bit():
    grid = grid_of(canyon(n=120, seed=2))
    runs = [
        plan_route(grid, at(grid, 6, 60), at(grid, 112, 60), config=PlanConfig(seed=3)).route
        for _ in range(2)
    ]
    for name in ("easting_m", "northing_m", "depth_m"):
        np.testing.assert_array_equal(getattr(runs[0], name), getattr(runs[1], name))


def test_sigma_lifts_the_route_by_k_sigma_and_a_safer_risk_lifts_it_more():
    sigma = np.full((120, 120), 0.3)
    grid = grid_of(flat(), sigma_m=sigma)
    plans = [
        plan_route(grid, at(grid, 10, 15), at(grid, 100, 80), config=PlanConfig("none", risk=risk))
        for risk in (0.1, 0.001)
    ]
    for plan in plans:
        assert_allclose(plan.route.min_altitude_m, 5.0 + 0.3 * plan.k, atol=1e-3)
        assert plan.route.min_clearance_margin_m >= 0
    assert plans[1].k > plans[0].k > 2.0


def test_the_grid_and_the_bound_pay_for_k_sigma_and_uncertain_ground_is_gone_around():
    sigma = np.full((120, 120), 0.3)
    grid = grid_of(flat(), sigma_m=sigma)
    plan = plan_route(grid, at(grid, 60, 15), at(grid, 60, 105), config=QUICK)
    # Level flight at k sigma above the floor, priced at 0.1 per metre.
    expected = 90.0 * (1.0 + 0.1 * 0.3 * plan.k)
    assert_allclose([plan.route.cost, plan.grid_cost], expected, rtol=1e-3)
    assert 0.98 * expected <= plan.lower_bound <= plan.route.cost
    sigma[40:80, 45:75] = 3.0
    unsure = grid_of(flat(), sigma_m=sigma)
    plan = plan_route(unsure, at(grid, 60, 15), at(grid, 60, 105), config=QUICK)
    assert_within_limits(unsure, plan)
    assert np.abs(plan.route.northing_m - at(grid, 60, 0)[1]).max() > 18.0
    assert plan.lower_bound <= plan.route.cost <= 1.05 * plan.grid_cost


def test_heavier_ground_is_gone_around():
    weight = np.ones((120, 120))
    weight[:, 50:70] = 6.0
    weight[100:, 50:70] = 1.0
    grid = grid_of(flat())
    plan = plan_route(grid, at(grid, 60, 20), at(grid, 60, 100), weight=weight, config=QUICK)
    assert_within_limits(grid, plan)
    assert plan.route.northing_m.min() < at(grid, 100, 0)[1]
    assert plan.route.cost < 1.05 * plan.grid_cost


def test_end_headings_are_kept():
    limits = VehicleLimits(start_heading_deg=270.0, goal_heading_deg=0.0)
    grid = grid_of(flat(200, 200))
    plan = plan_route(grid, at(grid, 100, 60), at(grid, 100, 140), limits, config=QUICK)
    assert_within_limits(grid, plan)
    headings = np.degrees(plan.route.heading_rad)
    # A turn may begin at the very end: the first chord of an arc of 10 m differs by up to 2.9 deg.
    assert_allclose(headings[0], 270.0, atol=3.0)
    assert_allclose(np.mod(headings[-1] + 180, 360) - 180, 0.0, atol=3.0)


# ---- refusals -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("place", "text"),
    [
        ((500_000.0 - 50, 4_099_950.0), "start .* lies off the map"),
        ((500_030.5, 4_099_969.5), "start .* beside a cell without data"),
        ((500_090.5, 4_099_909.5), "start .* in rock or too shallow"),
    ],
)
def test_a_start_that_cannot_be_used_is_refused_with_the_reason(place, text):
    z = flat()
    z[30, 30] = np.nan
    z[90, 90] = -2.0
    with pytest.raises(InputError, match=text):
        plan_route(grid_of(z), place, at(grid_of(z), 5, 5), config=QUICK)


def test_a_wall_of_no_data_is_named_within_a_cell_at_its_thinnest():
    z = flat()
    z[55:65, :] = np.nan
    z[61:65, 70] = -40.0
    plan = plan_route(grid_of(z), at(grid_of(z), 10, 60), at(grid_of(z), 110, 60), config=QUICK)
    assert plan.route is None and "no data" in plan.reason
    place = plan.blockage.place
    row, col = grid_of(z).fractional_index(np.array(place[0]), np.array(place[1]))
    assert 54 <= row <= 61 and abs(col - 70) <= 1


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["land", "no data", "too deep", "no-go"])
def test_the_thinnest_place_of_a_planted_wall_is_named_within_a_cell(seed, kind):
    rng = np.random.default_rng(seed)
    row = np.arange(100)[:, None]
    first = 45 + np.cumsum(rng.integers(-1, 2, 100))
    place = int(rng.integers(15, 85))
    last = first + 9 + np.minimum(np.abs(np.arange(100) - place), 4)
    wall = (row >= first) & (row <= last)
    # One thin place, a cell wide: a notch in the wall's far side.
    wall[first[place] + 3 :, place] = False
    z = flat(100, 100)
    limits, more = VehicleLimits(depth_max_m=90.0), {}
    if kind == "no-go":
        more["forbidden"] = wall
    else:
        z[wall] = {"land": 3.0, "no data": np.nan, "too deep": -200.0}[kind]
    grid = grid_of(z)
    plan = plan_route(
        grid, at(grid, 5, 50), at(grid, 95, 50), limits, config=QUICK, **more
    )  # fmt: skip
    assert plan.route is None
    word = {
        "land": "above the water",
        "no data": "no data",
        "too deep": "depth_max_m",
        "no-go": "no-go",
    }
    assert word[kind] in plan.reason
    found_row, found_col = grid.fractional_index(*(np.array(v) for v in plan.blockage.place))
    assert abs(found_col - place) <= 1
    assert first[place] - 1 <= found_row <= first[place] + 3


@pytest.mark.parametrize(
    ("wall_m", "key", "more"),
    [(-3.2, "floor_m", {}), (-130.0, "depth_max_m", {"depth_max_m": 90.0})],
)
def test_the_limit_that_a_wall_of_water_names_opens_it(wall_m, key, more):
    # Slopes gentle enough for pitch, a wall too shallow to pass or too deep to go.
    row = np.arange(240.0)
    z = np.tile((-40.0 + (wall_m + 40.0) * np.exp(-(((row - 120) / 45) ** 2)))[:, None], (1, 60))
    z = np.round(z, 2)
    grid = grid_of(z)
    start, goal = at(grid, 5, 30), at(grid, 235, 30)
    plan = plan_route(grid, start, goal, VehicleLimits(**more), config=QUICK)
    assert plan.route is None
    value = float(re.search(rf"a {key} of ([0-9.]+) opens it", plan.reason)[1])
    eased = VehicleLimits(**{**more, key: value})
    assert_within_limits(grid, plan_route(grid, start, goal, eased, config=QUICK), eased)


def test_a_wall_too_steep_for_pitch_and_ceiling_is_named_with_a_way_out():
    # The channel is too narrow to climb the wall's face by skimming along it.
    z = flat(200, 60, 60.0)
    z[98:102, :] = -20.0
    z[98:102, 30:36] = -30.0
    z[:, :12] = z[:, 48:] = np.nan
    grid = grid_of(z)
    start, goal = at(grid, 20, 20), at(grid, 180, 20)
    plan = plan_route(grid, start, goal, config=QUICK)
    assert plan.route is None
    row, _ = grid.fractional_index(*(np.array(v) for v in plan.blockage.place))
    assert 97 <= row <= 102
    # What the refusal names as the way out is one.
    eased = VehicleLimits(ceiling_m=plan.blockage.opens["ceiling_m"])
    assert f"a ceiling_m of {eased.ceiling_m:g} " in plan.reason
    assert 20.0 < eased.ceiling_m < 40.0
    assert_within_limits(grid, plan_route(grid, start, goal, eased, config=QUICK), eased)


def test_a_gate_in_a_wall_is_found():
    z = flat(160, 160, 60.0)
    z[78:82, :] = -10.0
    z[76:84, 100:112] = -60.0
    grid = grid_of(z)
    plan = plan_route(grid, at(grid, 20, 40), at(grid, 140, 40), config=QUICK)
    assert_within_limits(grid, plan)
    through = np.abs(plan.route.northing_m - at(grid, 80, 0)[1]) < 2
    assert (np.abs(plan.route.easting_m[through] - at(grid, 0, 105.5)[0]) < 7).all()


def test_a_hairpin_tighter_than_the_turning_circle_is_blamed_on_it():
    z = np.full((120, 120), np.nan)
    z[20:24, 10:100] = -40.0
    z[20:34, 96:100] = -40.0
    z[30:34, 10:100] = -40.0
    limits = VehicleLimits(turn_radius_m=30.0)
    grid = grid_of(z)
    plan = plan_route(grid, at(grid, 21.5, 15), at(grid, 31.5, 15), limits, config=QUICK)
    assert plan.route is None
    assert plan.blockage.limit == "turn_radius_m"
    row, col = grid.fractional_index(*(np.array(v) for v in plan.blockage.place))
    assert 18 <= row <= 36 and 90 <= col <= 101


def test_islands_of_no_data_are_gone_around():
    z = flat()
    z[50:70, 30:90] = np.nan
    grid = grid_of(z)
    plan = plan_route(grid, at(grid, 20, 60), at(grid, 100, 60), config=QUICK)
    assert_within_limits(grid, plan)


def test_a_floor_above_the_ceiling_is_refused():
    with pytest.raises(InputError, match=r"ceiling_m \(4\) must lie above floor_m \(5\)"):
        VehicleLimits(ceiling_m=4.0)


def test_ends_in_one_place_are_refused_and_ends_in_one_cell_are_joined():
    grid = grid_of(flat(40, 40))
    with pytest.raises(InputError, match="same place"):
        plan_route(grid, at(grid, 20, 20), at(grid, 20, 20), config=QUICK)
    for config in (QUICK, PlanConfig()):
        plan = plan_route(grid, at(grid, 20.1, 20), at(grid, 20.4, 20.2), config=config)
        assert plan.route is not None, plan.reason
        assert_allclose(plan.route.length_m, math.hypot(0.3, 0.2), rtol=1e-3)
