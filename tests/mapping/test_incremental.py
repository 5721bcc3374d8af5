"""A survey pass by pass ends where all at once ends, and compares only what has moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapping.comparison_memory import QUICK, ComparisonMemory
from mapping.incremental import IncrementalSurvey, pass_by_pass
from mapping.pose_graph import GraphConfig
from mapping.pose_graph_solve import solve, with_range_scale
from mapping.rounds import ends_of
from mapping.survey import correct_survey
from mapping.survey_records import SurveyConfig
from perception.records import InputError
from tests.mapping.test_survey import error, fixes, flown  # noqa: F401
from tests.mapping.worlds import Flight

CONFIG = SurveyConfig(graph=GraphConfig(drift_m_per_sqrt_km=8.0), squares=(0.8, 0.4))


def test_each_pass_updates_the_track_and_the_end_is_the_batchs(
    flown: list[Flight],  # noqa: F811
) -> None:
    survey = IncrementalSurvey(CONFIG)
    given = fixes(flown)
    for number, flight in enumerate(flown):
        own = [f for f in given if flight.strip.time_s[0] <= f.time_s <= flight.strip.time_s[-1]]
        so_far = survey.add_pass(flight.strip, own)
        assert len(so_far.strips) == number + 1
    before = error(
        flown,
        np.concatenate([f.strip.easting_m for f in flown]),
        np.concatenate([f.strip.northing_m for f in flown]),
    )
    track = so_far.trajectory
    assert error(flown, track.easting_m, track.northing_m) < 0.5 * before
    rounds = so_far.diagnostics.rounds
    arrivals = len(flown)
    assert {r.passes for r in rounds} == set(range(1, arrivals + 1))
    # Of what was compared before the last pass came some holds still.
    last = [r for r in rounds if r.passes == arrivals]
    assert 0 < sum(r.anew for r in last) < sum(r.compared for r in last)
    kept = [x for x, ok in zip(so_far.links, so_far.solution.link_used, strict=True) if ok]
    batch = solve(
        so_far.keyframes, kept, so_far.ties, so_far.solution.config, robust=False,
        steps=[s for s, ok in zip(so_far.steps, so_far.solution.step_used, strict=True) if ok],
    )  # fmt: skip
    batch = with_range_scale(batch, so_far.keyframes, kept, so_far.ties)
    np.testing.assert_allclose(so_far.solution.correction_m, batch.correction_m, atol=1e-5)
    np.testing.assert_allclose(so_far.solution.covariance_m2, batch.covariance_m2, rtol=1e-4)


def test_settled_it_ends_where_all_passes_at_once_end(flown: list[Flight]) -> None:  # noqa: F811
    """A tenth of the claimed sigma was asked for."""
    strips, given = [f.strip for f in flown], fixes(flown)
    grown, whole = pass_by_pass(strips, given, CONFIG), correct_survey(strips, given, CONFIG)
    apart = np.hypot(
        grown.trajectory.easting_m - whole.trajectory.easting_m,
        grown.trajectory.northing_m - whole.trajectory.northing_m,
    )
    sigma = np.hypot(whole.trajectory.sigma_easting_m, whole.trajectory.sigma_northing_m)
    assert np.sqrt(((apart / sigma) ** 2).mean()) < 0.1
    np.testing.assert_allclose(grown.height_m, whole.height_m, atol=0.01)


def test_the_same_passes_again_are_not_compared_again(flown: list[Flight]) -> None:  # noqa: F811
    strips, given = [f.strip for f in flown], fixes(flown)
    memory = ComparisonMemory()
    first = correct_survey(strips, given, CONFIG, memory=memory)
    compared = memory.compared
    assert compared == sum(r.compared for r in first.diagnostics.rounds)
    second = correct_survey(strips, given, CONFIG, memory=memory)
    assert memory.compared == compared
    np.testing.assert_array_equal(second.trajectory.easting_m, first.trajectory.easting_m)


def test_keyframes_chosen_anew_leave_no_constraint_on_the_old_ones(
    flown: list[Flight],  # noqa: F811
) -> None:
    """Squares stay, keyframes move closer together: what is remembered is tied to those of now."""
    strips, given = [f.strip for f in flown], fixes(flown)
    memory = ComparisonMemory(tolerance=QUICK)
    correct_survey(strips, given, CONFIG, memory=memory)
    closer = replace(CONFIG, keyframe_m=4.0)
    compared = memory.compared
    ours, plain = (correct_survey(strips, given, closer, memory=m) for m in (memory, None))
    assert memory.compared - compared < 0.5 * sum(r.compared for r in ours.diagnostics.rounds)
    for survey in (ours, plain):
        for window, link in zip(survey.squares, survey.links, strict=True):
            ends = ends_of(survey.keyframes, window)
            assert (link.first, link.second) == ends
    sigma = np.sqrt(np.trace(plain.solution.covariance_m2, axis1=1, axis2=2))
    apart = np.hypot(*(ours.solution.correction_m - plain.solution.correction_m).T)
    assert np.sqrt(((apart / sigma) ** 2).mean()) < 0.5


def test_a_match_is_carried_with_the_passes_and_compared_again_when_they_moved_too_far(
    flown: list[Flight],  # noqa: F811
) -> None:
    """Moved by a fiftieth of a metre all links stay the same; moved by metres they are made anew."""
    strips, given = [f.strip for f in flown], fixes(flown)
    memory = ComparisonMemory(tolerance=QUICK)
    correct_survey(strips, given, CONFIG, memory=memory)
    for shift_m, anew in ((0.02, False), (4.0, True)):
        before = memory.compared
        moved = [replace(f, easting_m=f.easting_m + shift_m) for f in given]
        again = correct_survey(strips, moved, CONFIG, memory=memory)
        compared = sum(r.compared for r in again.diagnostics.rounds)
        part = (memory.compared - before) / compared
        assert part > 0.9 if anew else part < 0.1


def test_a_pass_of_another_place_is_refused_and_the_survey_goes_on(
    flown: list[Flight],  # noqa: F811
) -> None:
    survey = IncrementalSurvey(CONFIG)
    survey.add_pass(flown[0].strip)
    with pytest.raises(InputError, match="different coordinate systems"):
        survey.add_pass(replace(flown[1].strip, crs="EPSG:32631"))
