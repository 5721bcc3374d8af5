"""One compass error for all passes or one each: the survey says which."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapping.keyframes import KeyframeFix, Keyframes, choose_keyframes
from mapping.pose_graph import GraphConfig, HeightStep
from mapping.pose_graph_solve import log_evidence, solve
from mapping.sharing import height_size, solve_shared
from perception.records import FloatArray
from tests.mapping.test_pose_graph import flights, rms


def steered(course_rad: FloatArray) -> tuple[list[KeyframeFix], FloatArray, Keyframes]:
    """Passes without a walk, each with a course error, fixed at both ends of every pass."""
    rng = np.random.default_rng(8)
    strips = [f.strip for f in flights(rng)]
    keyframes = choose_keyframes(strips, 30.0)
    truth = np.zeros((len(keyframes), 2))
    for k in range(1, len(keyframes)):
        d = [
            keyframes.easting_m[k] - keyframes.easting_m[k - 1],
            keyframes.northing_m[k] - keyframes.northing_m[k - 1],
        ]
        turn = course_rad[keyframes.strip[k - 1]]
        truth[k] = truth[k - 1] + turn * np.array([d[1], -d[0]])
    ends = np.sort(np.concatenate([keyframes.starts[:-1], keyframes.starts[1:] - 1]))
    ties = [
        KeyframeFix(int(k), truth[k] + 0.1 * rng.normal(size=2), 0.01 * np.eye(2)) for k in ends
    ]
    return ties, truth, keyframes


def test_one_error_for_all_is_found_and_serves_the_track() -> None:
    ties, truth, keyframes = steered(np.full(6, 0.006))
    config = GraphConfig(drift_m_per_sqrt_km=0.5)
    alone = solve(keyframes, (), ties, config)
    shared = solve_shared(keyframes, (), ties, config)
    assert rms(shared.correction_m - truth) <= rms(alone.correction_m - truth)
    assert shared.pass_sigma[:, 1].max() < 0.8 * alone.pass_sigma[:, 1].max()


def test_errors_that_differ_are_left_to_differ() -> None:
    course = np.array([0.01, -0.01, 0.008, -0.012, 0.01, -0.009])
    ties, _, keyframes = steered(course)
    config = GraphConfig(drift_m_per_sqrt_km=0.5)
    shared = solve_shared(keyframes, (), ties, config)
    np.testing.assert_allclose(shared.pass_errors[:, 1], course, atol=0.004)
    alone, forced = (
        log_evidence(keyframes, (), ties, replace(config, shared=kept)) for kept in (0.0, 0.995)
    )
    assert alone > forced + 5.0


@pytest.mark.parametrize(("true_m", "low", "high"), [(0.01, 0.0, 0.11), (0.5, 0.25, 1.0)])
def test_the_size_of_height_offsets_is_that_of_the_crossings(
    true_m: float, low: float, high: float
) -> None:
    rng = np.random.default_rng(9)
    offset = true_m * rng.normal(size=12)
    steps = [
        HeightStep(i, j, float(offset[j] - offset[i] + 0.1 * rng.normal()), 0.1)
        for i in range(6)
        for j in range(6, 12)
    ]
    assert low < height_size(steps, 12, GraphConfig()) < high


def test_without_crossings_the_configured_size_stands() -> None:
    assert height_size([], 3, GraphConfig(height_m=0.2)) == 0.2


def test_a_step_that_only_large_offsets_explain_is_doubted_when_small_ones_are_found() -> None:
    """Five passes agree to a centimetre; what one crossing says of the sixth is then no offset of its own."""
    rng = np.random.default_rng(8)
    keyframes = choose_keyframes([f.strip for f in flights(rng)], 30.0)
    ties = [KeyframeFix(k, np.zeros(2), 0.01 * np.eye(2)) for k in (0, len(keyframes) - 1)]
    steps = [HeightStep(i, j, 0.0, 0.02) for i in range(5) for j in range(i + 1, 5)]
    steps.append(HeightStep(0, 5, 0.17, 0.05))
    config = GraphConfig(drift_m_per_sqrt_km=0.5, shared=0.995)
    first = solve(keyframes, (), ties, config, steps=steps)
    assert first.step_used.all() and height_size(steps, 6, config) < config.height_m
    shared = solve_shared(keyframes, (), ties, config, steps)
    assert shared.config.height_m < config.height_m
    alone = solve(keyframes, (), ties, shared.config, steps=steps)
    np.testing.assert_array_equal(shared.step_used, alone.step_used)
    assert shared.step_used[:-1].all() and not shared.step_used[-1]
    assert abs(shared.height_m[5]) < 0.01
