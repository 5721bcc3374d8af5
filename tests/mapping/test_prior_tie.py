"""A survey that lies off a prior map is moved onto it, by relief; featureless ground ties nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapping.keyframes import choose_keyframes
from mapping.pose_graph import GraphConfig
from mapping.pose_graph_solve import solve
from mapping.prior_tie import ties_to_prior
from perception.records import Grid
from tests.mapping.worlds import CRS, ORIGIN, Drift, World, crossed_legs, fly, make_world


def mapped(world: World, shift_m: tuple[float, float], rng: np.random.Generator) -> Grid:
    """Return a map of the world, 300 m a side, that lies `shift_m` east and north of the truth."""
    size, cell_m = 150, 2.0
    east = ORIGIN[0] + (np.arange(size) + 0.5) * cell_m
    north = ORIGIN[1] + 300.0 - (np.arange(size) + 0.5) * cell_m
    x, y = np.meshgrid(east - shift_m[0], north - shift_m[1])
    height = world.sample(world.height_m, x, y) + 0.05 * rng.normal(size=(size, size))
    sigma = np.full((size, size), 0.05)
    return Grid(height, ORIGIN[0], ORIGIN[1] + 300.0, cell_m, CRS, sigma)


def test_a_planted_offset_of_the_survey_is_found() -> None:
    rng = np.random.default_rng(4)
    world = make_world(rng)
    strips = [
        f.strip for f in fly(world, crossed_legs(), rng, Drift(0.0, 0.0, 0.0), 2.0, 50.0, 25.0)
    ]
    keyframes = choose_keyframes(strips, 12.0)
    config = GraphConfig()
    solution = solve(keyframes, config=config)
    draft, prior = mapped(world, (3.0, -2.0), rng), mapped(world, (0.0, 0.0), rng)
    ties = ties_to_prior(draft, prior, keyframes, solution, config, 60.0)
    assert ties.compared >= 16
    assert len(ties.fixes) >= 0.7 * ties.compared
    found = np.array([fix.correction_m for fix in ties.fixes])
    np.testing.assert_allclose(np.median(found, axis=0), [-3.0, 2.0], atol=0.25)
    tied = solve(keyframes, (), ties.fixes, config)
    left = tied.correction_m - np.array([-3.0, 2.0])
    sigma = np.sqrt(np.trace(tied.covariance_m2, axis1=1, axis2=2))
    assert np.mean(np.hypot(*left.T) < 2.0 * sigma) > 0.9


def test_flat_ground_and_ground_elsewhere_tie_nothing() -> None:
    rng = np.random.default_rng(5)
    world = make_world(rng)
    strips = [
        f.strip for f in fly(world, crossed_legs(), rng, Drift(0.0, 0.0, 0.0), 2.0, 50.0, 25.0)
    ]
    keyframes = choose_keyframes(strips, 12.0)
    solution = solve(keyframes)
    flat = make_world(rng, relief_m=0.0)
    nothing = ties_to_prior(
        mapped(flat, (0, 0), rng),
        mapped(flat, (0, 0), rng),
        keyframes,
        solution,
        GraphConfig(),
        60.0,
    )
    assert nothing.compared > 0 and not nothing.fixes
    elsewhere = replace(mapped(world, (0, 0), rng), west_m=ORIGIN[0] + 5000.0)
    away = ties_to_prior(
        mapped(world, (0, 0), rng), elsewhere, keyframes, solution, GraphConfig(), 60.0
    )
    assert away.compared == 0 and not away.fixes


def test_another_grounds_map_is_refused() -> None:
    """Two fields of relief that have nothing in common: chance fits must not tie."""
    rng = np.random.default_rng(6)
    mine, other = make_world(rng), make_world(rng)
    strips = [
        f.strip for f in fly(mine, crossed_legs(), rng, Drift(0.0, 0.0, 0.0), 2.0, 50.0, 25.0)
    ]
    keyframes = choose_keyframes(strips, 12.0)
    solution = solve(keyframes)
    ties = ties_to_prior(
        mapped(mine, (0, 0), rng),
        mapped(other, (0, 0), rng),
        keyframes,
        solution,
        GraphConfig(),
        60.0,
    )
    assert len(ties.fixes) <= 0.1 * ties.compared
