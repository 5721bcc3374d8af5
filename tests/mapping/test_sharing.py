"""One compass error for all passes or one each: the survey says which."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapping.keyframes import KeyframeFix, Keyframes, choose_keyframes
from mapping.pose_graph import GraphConfig, log_evidence, solve
from mapping.sharing import solve_shared
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
