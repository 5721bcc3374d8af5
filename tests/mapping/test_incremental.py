"""A survey pass by pass ends where the batch on the same registrations ends, and near the whole batch."""

from __future__ import annotations

import numpy as np
import pytest

from mapping.incremental import IncrementalSurvey
from mapping.pose_graph import GraphConfig
from mapping.pose_graph_solve import solve
from mapping.survey import SurveyConfig
from perception.records import InputError
from tests.mapping.test_survey import error, fixes, flown  # noqa: F401
from tests.mapping.worlds import Flight

CONFIG = SurveyConfig(graph=GraphConfig(drift_m_per_sqrt_km=8.0), squares=(0.8, 0.4))


def test_each_pass_updates_the_track_and_the_end_is_the_batchs(
    flown: list[Flight],  # noqa: F811
) -> None:
    survey = IncrementalSurvey(CONFIG, fixes_to_come=True)
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
    kept = [x for x, ok in zip(so_far.links, so_far.solution.link_used, strict=True) if ok]
    batch = solve(
        so_far.keyframes, kept, so_far.ties, CONFIG.graph, robust=False, steps=so_far.steps
    )
    np.testing.assert_allclose(so_far.solution.correction_m, batch.correction_m, atol=1e-5)
    np.testing.assert_allclose(so_far.solution.covariance_m2, batch.covariance_m2, rtol=1e-4)


def test_a_pass_of_another_place_is_refused_and_the_survey_goes_on(
    flown: list[Flight],  # noqa: F811
) -> None:
    from dataclasses import replace

    survey = IncrementalSurvey(CONFIG)
    survey.add_pass(flown[0].strip)
    with pytest.raises(InputError, match="different coordinate systems"):
        survey.add_pass(replace(flown[1].strip, crs="EPSG:32631"))
