"""A survey's graph written for others: GTSAM reads it back whole, and g2o's optimum is the survey's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam as typed_gtsam
import numpy as np
import pytest

from mapping.graph_files import read_g2o
from mapping.keyframes import choose_keyframes, tie_fixes
from mapping.pose_graph import Blend, GraphConfig, HeightStep, Solution
from mapping.pose_graph_files import survey_poses, write_graph
from mapping.pose_graph_sets import gtsam_factors, gtsam_values
from mapping.pose_graph_solve import solve
from mapping.survey_records import CorrectedSurvey, Diagnostics
from perception.records import FloatArray, Trajectory
from tests.mapping.gtsam_text import read_graph
from tests.mapping.test_pose_graph import end_fixes, flights, true_links

gtsam: Any = typed_gtsam


@pytest.fixture(scope="module")
def survey() -> CorrectedSurvey:
    rng = np.random.default_rng(11)
    flown = flights(rng)
    strips = tuple(f.strip for f in flown)
    keyframes = choose_keyframes(strips, 20.0)
    links = true_links(flown, keyframes, rng)
    # As registrations have it: the ground hangs on two keyframes.
    links[::2] = [
        replace(x, second_blend=Blend(x.second, x.second + 1, 0.3))
        if keyframes.strip[x.second] == keyframes.strip[min(x.second + 1, len(keyframes) - 1)]
        else x
        for x in links[::2]
    ]
    # One that is wrong, and must not be handed on.
    links.append(replace(links[3], shift_m=links[3].shift_m + 30.0))
    ties = tie_fixes(end_fixes(flown, rng), strips, keyframes, 4.0)
    steps = [HeightStep(0, 3, 0.1, 0.05)]
    config = GraphConfig(shared=0.8)
    solution = solve(keyframes, links, ties, config, steps=steps)
    assert not solution.link_used[-1]
    return corrected(strips, keyframes, solution, links, ties, steps)


def corrected(
    strips: Any, keyframes: Any, solution: Solution, links: Any, ties: Any, steps: Any
) -> CorrectedSurvey:
    nothing: FloatArray = np.zeros(0)
    track = Trajectory(*([nothing] * 8))
    return CorrectedSurvey(
        strips, track, (), Diagnostics((), False, False, 2, 0, 0.0), solution.height_m,
        solution.height_sigma_m, keyframes, solution, tuple(links), tuple(ties), tuple(steps),
    )  # fmt: skip


def test_gtsam_reads_back_the_factors_and_the_solution(
    survey: CorrectedSurvey, tmp_path: Path
) -> None:
    write_graph(tmp_path, survey)
    graph, values = read_graph(tmp_path)
    assert graph.error(values) == pytest.approx(survey.solution.error_after, rel=1e-9)
    found = np.array([values.atVector(gtsam.symbol("e", k)) for k in range(len(survey.keyframes))])
    np.testing.assert_allclose(found, survey.solution.correction_m, atol=1e-9)


def test_g2o_comes_back_as_it_was_written(survey: CorrectedSurvey, tmp_path: Path) -> None:
    write_graph(tmp_path, survey)
    written, read = survey_poses(survey), read_g2o(tmp_path / "graph.g2o")
    for name in ("key", "pose", "edge", "measured", "information", "fixed"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))


def test_the_optimum_of_the_g2o_graph_is_the_surveys_own(survey: CorrectedSurvey) -> None:
    """Another solver, other unknowns (poses, not corrections), the same track."""
    poses = survey_poses(survey)
    graph, values = gtsam_factors(poses), gtsam_values(poses)
    origin = int(poses.fixed[0])
    graph.add(
        gtsam.PriorFactorPose2(origin, gtsam.Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, 1e-4))
    )
    # From elsewhere, or the optimum would be where it was put.
    rng = np.random.default_rng(0)
    for k in range(origin):
        p = values.atPose2(k)
        values.update(k, gtsam.Pose2(*(np.array([p.x(), p.y()]) + rng.normal(size=2)), p.theta()))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    found = np.array([[result.atPose2(k).x(), result.atPose2(k).y()] for k in range(origin)])
    np.testing.assert_allclose(found, poses.pose[:origin, :2], atol=0.02)
