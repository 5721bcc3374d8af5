"""The survey's loop on a small world: drift goes, bad input has a clear outcome."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from mapping import survey, survey_check, survey_loop
from mapping.fixes import PositionFix
from mapping.pose_graph import GraphConfig, Solution
from mapping.pose_graph_files import write_graph
from mapping.rounds import Registration
from mapping.survey import correct_survey
from mapping.survey_loop import Given, State
from mapping.survey_records import CorrectedSurvey, Round, SurveyConfig
from mapping.textures import MatchConfig
from perception.records import InputError
from tests.mapping.worlds import Drift, Flight, fly, make_world

# A hash: two parallel passes the same way, two crossing them.
LEGS = [
    (100.0, 20.0, 0.0, 200.0),
    (150.0, 20.0, 0.0, 200.0),
    (25.0, 100.0, 90.0, 200.0),
    (225.0, 150.0, 270.0, 200.0),
]


@pytest.fixture(scope="module")
def flown() -> list[Flight]:
    rng = np.random.default_rng(2)
    return fly(make_world(rng, size=256), LEGS, rng, Drift(8.0, 0.4, 0.004), turn_m=200.0)


def fixes(flown: list[Flight]) -> list[PositionFix]:
    return [
        PositionFix(
            f.strip.time_s[k], f.true_easting_m[k], f.true_northing_m[k], 0.16, 0.0, 0.16, "gps"
        )
        for f, k in ((flown[0], 0), (flown[-1], -1))
    ]


def error(flown: list[Flight], easting_m: np.ndarray, northing_m: np.ndarray) -> float:
    east = easting_m - np.concatenate([f.true_easting_m for f in flown])
    north = northing_m - np.concatenate([f.true_northing_m for f in flown])
    return float(np.sqrt((east**2 + north**2).mean()))


def test_drift_goes_and_what_is_left_is_said(flown: list[Flight]) -> None:
    strips = [f.strip for f in flown]
    corrected = correct_survey(
        strips, fixes(flown), SurveyConfig(graph=GraphConfig(drift_m_per_sqrt_km=8.0))
    )
    before = error(
        flown,
        np.concatenate([s.easting_m for s in strips]),
        np.concatenate([s.northing_m for s in strips]),
    )
    track = corrected.trajectory
    after = error(flown, track.easting_m, track.northing_m)
    assert after < 0.4 * before
    said = float(np.sqrt((track.sigma_easting_m**2 + track.sigma_northing_m**2).mean()))
    assert after < 2.0 * said
    assert corrected.diagnostics.rounds[-1].used >= 3
    assert not corrected.diagnostics.worsened and not corrected.diagnostics.indeterminate
    assert len(track.time_s) == sum(len(s.time_s) for s in strips)
    for strip, moved in zip(strips, corrected.strips, strict=True):
        assert moved.echo is strip.echo


def test_passes_that_never_meet_stay_on_their_navigation() -> None:
    rng = np.random.default_rng(5)
    legs = [(60.0, 20.0, 0.0, 80.0), (400.0, 20.0, 0.0, 80.0)]
    flown = fly(make_world(rng, size=512), legs, rng, Drift(0.0, 0.0, 0.0))
    corrected = correct_survey([f.strip for f in flown])
    assert corrected.registrations == ()
    for f, strip in zip(flown, corrected.strips, strict=True):
        np.testing.assert_allclose(strip.easting_m, f.strip.easting_m, atol=1e-6)


def test_a_survey_whose_every_match_is_refused_is_whole_and_can_be_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Each round one chance match, sixty metres off: the graph refuses it, and no link is left."""
    plain = survey_loop.register

    def spoilt(*given: object, **more: object) -> object:
        results, links = plain(*given, **more)  # type: ignore[arg-type]
        results = [(w, replace(m, accepted=i == 0)) for i, (w, m) in enumerate(results)]
        wrong = [
            replace(x, shift_m=x.shift_m + 60.0, covariance_m2=0.01 * np.eye(2)) for x in links[:1]
        ]
        return (
            (results, wrong)
            if wrong
            else ([(w, replace(m, accepted=False)) for w, m in results], [])
        )

    monkeypatch.setattr(survey_loop, "register", spoilt)
    rng = np.random.default_rng(2)
    legs = [(60.0, 20.0, 0.0, 120.0), (20.0, 80.0, 90.0, 120.0)]
    flown = fly(make_world(rng, size=200), legs, rng, Drift(0.0, 0.0, 0.0), turn_m=200.0)
    config = SurveyConfig(graph=GraphConfig(drift_m_per_sqrt_km=2.0))
    corrected = correct_survey([f.strip for f in flown], config=config)
    assert sum(r.accepted for r in corrected.diagnostics.rounds) > 0
    assert len(corrected.links) == len(corrected.solution.link_used) == 0
    write_graph(tmp_path, corrected)


def test_a_strip_wholly_nan_harms_no_other(flown: list[Flight]) -> None:
    strips = [f.strip for f in flown]
    nothing = np.full_like(strips[1].echo, np.nan)
    strips[1] = replace(strips[1], echo=nothing, elevation_m=nothing)
    corrected = correct_survey(strips, config=SurveyConfig(rounds=1))
    assert np.isfinite(corrected.trajectory.easting_m).all()
    assert all(1 not in (r.window.first, r.window.second) for r in corrected.registrations)


def test_a_clock_that_jumps_back_parts_the_passes_without_harm(flown: list[Flight]) -> None:
    strips = [f.strip for f in flown]
    strips[2] = replace(strips[2], time_s=strips[2].time_s - 86_400.0)
    corrected = correct_survey(strips, config=SurveyConfig(rounds=1))
    assert np.isnan(corrected.keyframes.way_m[corrected.keyframes.starts[2]])
    assert np.isfinite(corrected.trajectory.easting_m).all()


def test_a_pass_of_one_line_is_kept(flown: list[Flight]) -> None:
    strip = flown[0].strip
    one = {
        name: getattr(strip, name)[:1]
        for name in (
            "elevation_m", "sigma_m", "echo", "shadow", "time_s", "ping", "easting_m", "northing_m",
            "depth_m", "heading_rad", "altitude_m", "altitude_sigma_m",
        )
    }  # fmt: skip
    corrected = correct_survey([strip, replace(strip, **one)], config=SurveyConfig(rounds=1))
    assert len(corrected.strips[1].time_s) == 1


def test_nothing_and_two_zones_are_refused(flown: list[Flight]) -> None:
    with pytest.raises(InputError, match="holds no strip"):
        correct_survey([])
    other = replace(flown[1].strip, crs="EPSG:32631")
    with pytest.raises(InputError, match="different coordinate systems"):
        correct_survey([flown[0].strip, other])


def test_passes_in_two_places_are_refused_and_a_long_line_of_them_is_not(
    flown: list[Flight],
) -> None:
    strip = replace(flown[0].strip, source="a.xtf")
    far = replace(strip, easting_m=strip.easting_m + 400_000.0, source="b.xtf")
    with pytest.raises(InputError, match=r"b\.xtf lies 400 km from a\.xtf"):
        correct_survey([strip, far])
    between = [replace(strip, easting_m=strip.easting_m + 45_000.0 * n) for n in range(10)]
    assert len(correct_survey([*between, far], config=SurveyConfig(rounds=1)).strips) == 11


def test_a_cell_that_is_asked_for_is_not_rounded(
    flown: list[Flight], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[float] = []
    plain = survey_loop.compare_rounds

    def told(given: Given, known: CorrectedSurvey | None) -> State:
        seen.append(given.cell_m)
        return plain(given, known)

    monkeypatch.setattr(survey, "compare_rounds", told)
    strips = [flown[0].strip]
    correct_survey(strips, config=SurveyConfig(match=MatchConfig(cell_m=0.4567)))
    correct_survey(strips)
    assert seen[0] == 0.4567 and seen[1] == survey_check.steady(seen[1])


ROUND = Round("soundings", 1.0, 1, 1, 1, 0, 1.0, 1.0, 1.0, 1.0, 1, 1)
FOUND = cast(Registration, None)


@pytest.mark.parametrize(("rounds", "expected"), [(None, [0.8, 0.3, 0.2]), (2, [0.8, 0.5])])
def test_of_the_rounds_that_are_to_be_the_last_two_are_never_left_out(
    rounds: int | None, expected: list[float], flown: list[Flight], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second of two was left out, for it was the second of four widths."""
    made: list[float] = []

    def noted(given: Given, state: State, part: float, *rest: object, **more: object) -> State:
        made.append(part)
        return replace(state, rounds=(ROUND,), found=(FOUND,))

    monkeypatch.setattr(survey_loop, "_round", noted)
    monkeypatch.setattr(survey_loop, "_needless", lambda *given: True)
    monkeypatch.setattr(survey_loop, "_begun", lambda *given: State(cast(Solution, None)))
    given = cast(Given, SimpleNamespace(config=SurveyConfig(rounds=rounds), cell_m=1.0))
    survey_loop.compare_rounds(given, None)
    assert made == expected
