"""Height steps where tracks cross: planted offsets come back, relief beside the tracks does not enter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapping.crossings import height_steps
from mapping.keyframes import choose_keyframes
from mapping.pose_graph import GraphConfig
from mapping.pose_graph_solve import solve
from perception.records import ElevationStrip
from tests.mapping.worlds import Drift, crossed_legs, fly, make_world


def sounded(offsets_m: list[float], seed: int = 1) -> list[ElevationStrip]:
    """Six crossed passes whose soundings follow the floor, each with a depth error of its own."""
    rng = np.random.default_rng(seed)
    world = make_world(rng, size=512)
    flown = fly(world, crossed_legs(), rng, Drift(0.0, 0.0, 0.0), step_m=1.0, across_step_m=25.0)
    strips = []
    for f, offset_m in zip(flown, offsets_m, strict=True):
        floor = world.sample(world.height_m, f.true_easting_m, f.true_northing_m)
        noise = 0.05 * rng.normal(size=len(floor))
        altitude = -f.strip.depth_m - floor - offset_m + noise
        # What the strip draws off its track must not matter.
        wild = f.strip.elevation_m + 5.0
        strips.append(replace(f.strip, altitude_m=altitude, elevation_m=wild))
    return strips


def test_planted_offsets_come_back_from_the_crossings() -> None:
    planted = np.array([0.0, 0.3, -0.2, 0.1, -0.4, 0.2])
    strips = sounded(list(-planted))
    keyframes = choose_keyframes(strips, 8.0)
    solution = solve(keyframes)
    steps = height_steps(strips, keyframes, solution)
    assert len(steps) == 9
    found = solve(keyframes, config=GraphConfig(height_m=0.3), steps=steps)
    left = found.height_m - planted
    assert np.ptp(left) < 0.3
    sigma = float(np.mean([s.sigma_m for s in steps]))
    misfit = [s.height_m - (planted[s.second] - planted[s.first]) for s in steps]
    assert np.std(misfit) < 2.0 * sigma


def test_parallel_passes_have_no_crossing_and_no_step() -> None:
    strips = sounded([0.0] * 6)[:3]
    keyframes = choose_keyframes(strips, 8.0)
    assert height_steps(strips, keyframes, solve(keyframes)) == []


def test_a_step_says_less_where_the_track_is_unknown_on_a_slope() -> None:
    strips = sounded([0.0] * 6)
    keyframes = choose_keyframes(strips, 8.0)
    sure = solve(keyframes)
    unsure = replace(sure, covariance_m2=sure.covariance_m2 + 25.0 * np.eye(2))
    near, far = (height_steps(strips, keyframes, s) for s in (sure, unsure))
    assert all(b.sigma_m > a.sigma_m for a, b in zip(near, far, strict=True))
    assert [s.height_m for s in near] == pytest.approx([s.height_m for s in far])
