"""The independent check itself: closed forms, the proof's own figures, and routes that it must refuse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose

from mapping.rasters import write_map
from planning.clearance import polyline_extremes
from planning.planner import PlanConfig, plan_route
from planning.route import write_route
from scenarios.benchmarks.route_check import check_route, extremes
from tests.planning.terrains import at, canyon, grid_of


def test_a_saddle_has_its_extremes_where_analysis_says():
    surface = np.array([[0.0, 0.0], [0.0, 1.0]])
    # Along the diagonal u v is t^2: 1 - t / 2 - t^2 falls from 1 to -1/2.
    low, high = extremes(surface, np.array([0.0, 1.0]), np.array([0.0, 1.0]), np.array([1.0, 0.5]))
    assert_allclose([low, high], [-0.5, 1.0])
    # Along the other it is t (1 - t): a level line at 0 dips to -1/4 in the middle.
    low, _ = extremes(surface, np.array([1.0, 0.0]), np.array([0.0, 1.0]), np.zeros(2))
    assert_allclose(low, -0.25)


def test_it_agrees_with_the_proof_on_random_ground_though_it_shares_no_code():
    rng = np.random.default_rng(0)
    surface = rng.normal(size=(20, 30))
    row, col = rng.uniform(0, 19, 40), rng.uniform(0, 29, 40)
    row[::5], col[::7] = np.round(row[::5]), np.round(col[::7])
    z = rng.normal(size=40) + 4
    proof = polyline_extremes(surface, row, col, z)
    low, high = extremes(surface, row, col, z)
    assert_allclose([low, high], [proof.least_m.min(), proof.greatest_m.max()], atol=1e-12)


def test_a_hole_is_met_and_one_beside_a_grid_line_is_not():
    surface = np.zeros((4, 4))
    surface[1, 1] = np.nan
    low, _ = extremes(surface, np.array([0.5, 0.5]), np.array([0.0, 3.0]), np.ones(2))
    assert np.isnan(low)
    low, _ = extremes(surface, np.array([2.0, 2.0]), np.array([0.0, 3.0]), np.ones(2))
    assert low == 1.0


def test_a_written_route_passes_and_one_ten_centimetres_deeper_does_not(tmp_path):
    grid = grid_of(np.float32(canyon(n=120, seed=2)).astype(float))
    write_map(tmp_path / "map.tif", grid)
    plan = plan_route(
        grid, at(grid, 6, 60), at(grid, 112, 60), config=PlanConfig("none", layers=False)
    )
    write_route(tmp_path, plan.route)
    found = check_route(tmp_path / "route.csv", tmp_path / "map.tif")
    assert found.least_margin_m >= 0
    assert_allclose(found.least_margin_m, plan.route.min_clearance_margin_m, atol=1e-9)
    assert found.least_radius_m >= 10.0
    assert found.steepest_up_deg <= 30.0 and found.steepest_down_deg <= 30.0
    write_route(tmp_path, replace(plan.route, depth_m=plan.route.depth_m + 0.1))
    assert check_route(tmp_path / "route.csv", tmp_path / "map.tif").least_margin_m < -0.099
