"""Surveys, tours, replanning and exports: what is asked for is what comes out."""

from __future__ import annotations

import itertools
import json
import math
import xml.etree.ElementTree as ET

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose
from pyproj import Transformer

from perception.records import InputError
from planning.cost import CostTerms
from planning.coverage import SurveyConfig, plan_survey
from planning.dubins import dubins
from planning.exports import gpx, qgc_plan
from planning.finish import least_radius
from planning.limits import VehicleLimits
from planning.mission import solve_mission
from planning.nogo import forbidden_cells
from planning.planner import PlanConfig, plan_route
from planning.problem import Problem
from planning.replan import OldRoute, replan
from planning.surface import build_surface
from planning.tour import best_order
from tests.planning.terrains import NORTH, WEST, at, brute_force, canyon, flat, grid_of

QUICK = PlanConfig(planner="none", layers=False)


def gentle(n: int = 300) -> np.ndarray:
    row, col = np.mgrid[:n, :n]
    return -50.0 + 4.0 * np.sin(row / 25.0) + 3.0 * np.cos(col / 30.0)


@pytest.mark.parametrize("angle_deg", [0.0, 33.0])
def test_survey_lines_cover_the_area_and_keep_the_limits(angle_deg):
    grid = grid_of(gentle())
    box = shapely.box(-75, -45, 75, 45)
    turned = shapely.affinity.rotate(box, angle_deg, origin=(0, 0))
    area = shapely.affinity.translate(turned, WEST + 150, NORTH - 150)
    surface = build_surface(grid, VehicleLimits(), CostTerms())
    survey = plan_survey(surface, area, SurveyConfig(swath_m=30.0, overlap=0.25, crossings=2))
    assert survey.covered >= 0.999
    assert survey.path.problem == ""
    # Points of the area, each within half a swath of a line that passes abeam of it.
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (400, 2)) * [75, 45]
    points = shapely.get_coordinates(
        shapely.affinity.translate(
            shapely.affinity.rotate(shapely.multipoints(points), angle_deg, origin=(0, 0)),
            WEST + 150, NORTH - 150,
        )
    )  # fmt: skip
    lines = shapely.linestrings(survey.lines[:-2])
    distance = np.array(
        [[shapely.distance(line, shapely.Point(p)) for line in lines] for p in points]
    )
    assert (distance.min(axis=1) <= 15.0 + 1e-9).mean() >= 0.99
    radius, _ = least_radius(survey.path.easting_m, survey.path.northing_m)
    assert radius >= 10.0


def test_dubins_paths_are_shortest_among_known_cases_and_keep_the_radius():
    straight = dubins((0, 0, 0.0), (0, 50, 0.0), 10.0, 0.5)
    assert_allclose(straight[-1], [0, 50], atol=1e-9)
    assert_allclose(np.hypot(*np.diff(straight, axis=0).T).sum(), 50.0, rtol=1e-6)
    # Back on a parallel line two radii away: half a circle.
    back = dubins((0, 0, 0.0), (20, 0, math.pi), 10.0, 0.2)
    assert_allclose(np.hypot(*np.diff(back, axis=0).T).sum(), 10 * math.pi, rtol=1e-3)
    rng = np.random.default_rng(1)
    for _ in range(30):
        start, goal = (tuple([*rng.uniform(-40, 40, 2), rng.uniform(0, 6.28)]) for _ in range(2))
        path = dubins(start, goal, 10.0, 0.25)
        assert_allclose(path[[0, -1]], [start[:2], goal[:2]], atol=1e-6)
        legs = np.diff(path[-2:], axis=0)[0]
        gap = math.atan2(legs[0], legs[1]) - goal[2]
        assert abs(math.atan2(math.sin(gap), math.cos(gap))) < 0.02


@pytest.mark.parametrize("n", [5, 7])
def test_the_best_order_is_that_of_trying_all(n):
    rng = np.random.default_rng(n)
    points = rng.uniform(0, 100, (n, 2))
    cost = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
    order = best_order(cost)
    best = min(
        sum(cost[a, b] for a, b in itertools.pairwise((0, *middle, n - 1)))
        for middle in itertools.permutations(range(1, n - 1))
    )
    assert order[0] == 0 and order[-1] == n - 1 and sorted(order) == list(range(n))
    assert_allclose(sum(cost[a, b] for a, b in itertools.pairwise(order)), best)


def test_many_stops_on_a_circle_are_visited_round_it():
    angle = np.linspace(0, 2 * np.pi, 21)[:-1]
    points = np.column_stack([np.cos(angle), np.sin(angle)]) * 100
    shuffled = np.concatenate([[0], np.random.default_rng(0).permutation(np.arange(1, 19)), [19]])
    cost = np.hypot(*(points[shuffled][:, None] - points[shuffled][None]).transpose(2, 0, 1))
    assert_allclose(shuffled[best_order(cost)], np.arange(20))


def test_a_mission_passes_all_its_stops_without_a_kink():
    grid = grid_of(gentle(160))
    stops = [at(grid, *p) for p in ((15, 15), (120, 130), (30, 120), (140, 20))]
    plan, order = solve_mission(Problem(grid), stops, QUICK)
    assert plan.route is not None, plan.reason
    assert order == [0, 2, 1, 3]
    found = brute_force(grid, plan.route)
    assert found["radius_m"] >= 10.0 and found["least_m"] >= 5.0
    for e, n in stops:
        assert np.hypot(plan.route.easting_m - e, plan.route.northing_m - n).min() < 1e-4


def _old(route) -> OldRoute:
    return OldRoute(route.easting_m, route.northing_m, route.depth_m, route.distance_m)


def test_replanning_goes_round_what_the_new_map_shows_from_where_the_vehicle_is():
    z = flat(200, 200)
    grid = grid_of(z)
    old = _old(plan_route(grid, at(grid, 20, 100), at(grid, 180, 100), config=QUICK).route)
    z = z.copy()
    z[110:118, 60:140] = np.nan
    changed = grid_of(z)
    surface = build_surface(changed, VehicleLimits(), CostTerms())
    state = old.state_at(40.0)
    route, problem = replan(surface, state, old.rest(40.0))
    assert route is not None, problem
    found = brute_force(changed, route)
    assert found["radius_m"] >= 10.0 and found["least_m"] >= 5.0
    assert_allclose(
        [route.easting_m[0], route.northing_m[0]], [state.easting_m, state.northing_m], atol=1e-4
    )
    assert_allclose(route.depth_m[0], state.depth_m, atol=0.05)
    turn = route.heading_rad[0] - state.heading_rad
    assert abs(math.atan2(math.sin(turn), math.cos(turn))) < 0.06


def test_replanning_says_when_the_vehicle_is_too_deep_to_clear_what_lies_ahead():
    grid = grid_of(flat(200, 200))
    old = _old(plan_route(grid, at(grid, 20, 100), at(grid, 180, 100), config=QUICK).route)
    z = flat(200, 200)
    z[63:, :] = -28.0
    surface = build_surface(grid_of(z), VehicleLimits(), CostTerms())
    route, problem = replan(surface, old.state_at(40.0), old.rest(40.0))
    assert route is None and "too deep" in problem


def test_exports_agree_with_the_plan_within_a_millimetre():
    grid = grid_of(canyon(n=120, seed=1, wall_m=10.0))
    route = plan_route(grid, at(grid, 6, 60), at(grid, 110, 60), config=QUICK).route
    back = Transformer.from_crs(4326, grid.crs, always_xy=True)
    points = ET.fromstring(gpx(route)).iter("{http://www.topografix.com/GPX/1/1}rtept")
    rows = np.array([[float(p.get("lon")), float(p.get("lat")), float(p[0].text)] for p in points])
    items = json.loads(qgc_plan(route, 1.5))["mission"]["items"]
    params = np.array([item["params"][4:] for item in items])[:, [1, 0, 2]]
    for table in (rows, params):
        e, n = back.transform(table[:, 0], table[:, 1])
        assert_allclose(e, route.easting_m, atol=1e-3)
        assert_allclose(n, route.northing_m, atol=1e-3)
        assert_allclose(-table[:, 2], route.depth_m, atol=1e-4)


def test_no_go_areas_are_not_touched():
    grid = grid_of(flat())
    area = shapely.Polygon(
        [(WEST + 40, NORTH - 52), (WEST + 80, NORTH - 48), (WEST + 63, NORTH - 70)]
    )
    plan = plan_route(
        grid, at(grid, 20, 60), at(grid, 100, 60), config=QUICK,
        forbidden=forbidden_cells(grid, [area]),
    )  # fmt: skip
    assert plan.route is not None, plan.reason
    line = shapely.linestrings(np.column_stack([plan.route.easting_m, plan.route.northing_m]))
    assert not shapely.intersects(line, area)


def test_an_empty_survey_or_a_strange_overlap_is_refused():
    surface = build_surface(grid_of(flat()), VehicleLimits(), CostTerms())
    with pytest.raises(InputError, match="empty"):
        plan_survey(surface, shapely.Polygon())
    with pytest.raises(InputError, match=r"overlap must lie in \[0, 0.9\), got 0.95"):
        SurveyConfig(overlap=0.95)
