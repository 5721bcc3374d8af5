"""OMPL's planners and spaces: each runs, repeats to the bit, and keeps what its space promises."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from perception.records import InputError
from planning.cost import CostTerms
from planning.limits import VehicleLimits
from planning.ompl_planner import PLANNERS, SPACES, Found, plan_unguided
from planning.planner import PlanConfig, plan_route
from planning.surface import Surface, build_surface
from tests.planning.terrains import at, flat, grid_of

ENDS = np.array([[15.0, 60.0], [105.0, 62.0]])
EAST = (math.pi / 2, math.pi / 2)


def mound() -> np.ndarray:
    """Flat ground with a mound in the way, higher than the vehicle may fly over."""
    row, col = np.mgrid[:120, :120]
    return flat(depth_m=60.0) + 45.0 * np.exp(-(((col - 60) / 9.0) ** 2 + ((row - 60) / 25.0) ** 2))


def surface() -> Surface:
    return build_surface(grid_of(mound()), VehicleLimits(), CostTerms())


def unguided(space: str, planner: str = "bitstar", iterations: int = 3000, seed: int = 1) -> Found:
    found = plan_unguided(surface(), ENDS, EAST, space, planner, seed, iterations)
    assert found is not None
    return found


@pytest.mark.parametrize("planner", PLANNERS)
def test_every_planner_improves_on_the_guide_in_the_corridor(planner):
    grid = grid_of(mound())
    config = PlanConfig(planner, iterations=1500 if planner == "bitstar" else 60, layers=False)
    plan = plan_route(grid, at(grid, 60, 15), at(grid, 62, 105), config=config)
    assert plan.route is not None, plan.reason
    assert math.isfinite(plan.costs["ompl"])
    assert plan.route.cost < 1.1 * plan.grid_cost


@pytest.mark.parametrize("planner", [p for p in PLANNERS if p != "fmt"])
@pytest.mark.parametrize("space", SPACES)
def test_every_space_takes_every_planner_from_end_to_end(space, planner):
    fast = space in ("depth", "altitude")
    iterations = 1500 if planner == "bitstar" else 400 if fast else 50
    found = plan_unguided(surface(), ENDS, EAST, space, planner, 1, iterations)
    if found is None:
        # Blind sampling of depth and of helices need not find a way in half a second.
        assert space in ("depth", "owen") or planner != "bitstar"
        return
    assert_allclose(found.points[[0, -1]], ENDS, atol=1e-6)
    assert found.cost >= 89.0 and math.isfinite(found.cost)


def test_dubins_paths_keep_the_radius_and_the_headings_asked_for():
    found = unguided("dubins")
    legs = np.diff(found.points, axis=0)
    length = np.hypot(*legs.T)
    keep = length > 1e-9
    turn = np.diff(np.unwrap(np.arctan2(legs[keep, 1], legs[keep, 0])))
    radius = 0.5 * (length[keep][1:] + length[keep][:-1]) / np.maximum(np.abs(turn), 1e-12)
    # Traced two cells at a time: where two curves meet, a chord of one stands for both.
    assert np.percentile(radius, 5) >= 9.0
    assert abs(math.atan2(legs[0, 1], legs[0, 0])) < 0.2


@pytest.mark.parametrize("space", ["altitude", "dubins"])
def test_the_same_seed_gives_the_same_path_to_the_bit_in_every_space(space):
    one, two = unguided(space, iterations=800), unguided(space, iterations=800)
    assert_array_equal(one.states, two.states)


def test_a_route_planned_in_another_space_keeps_every_limit():
    grid = grid_of(mound())
    config = PlanConfig("bitstar", "dubins", iterations=800, layers=False)
    plan = plan_route(grid, at(grid, 60, 15), at(grid, 62, 105), config=config)
    assert plan.route is not None, plan.reason
    assert "ompl" in plan.costs and plan.route.min_clearance_margin_m >= 0


def test_an_unknown_space_and_fmt_without_a_guide_are_refused():
    with pytest.raises(InputError, match="no space 'polar'"):
        plan_unguided(surface(), ENDS, EAST, "polar", "bitstar", 0, 10)
    with pytest.raises(InputError, match="fmt plans in the corridor only"):
        plan_unguided(surface(), ENDS, EAST, "depth", "fmt", 0, 10)
