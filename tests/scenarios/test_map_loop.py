"""The loop between map and track: a draft is a coarse map of the floor; a round is kept where the passes agree better."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapping.rasters import read_map
from mapping.survey import correct_survey, gain_in_likeness
from mapping.survey_records import CorrectedSurvey
from perception.readers import open_survey
from perception.records import Grid
from scenarios import map_loop
from scenarios.map_loop import draft_map, refine_on_map
from scenarios.schema import load_scenario
from scenarios.simulation import simulate
from scenarios.simulation_files import write_simulation
from scenarios.survey_map import build_passes, looks_of
from tests.mapping.test_survey import flown  # noqa: F401
from tests.mapping.worlds import ORIGIN, Flight
from tests.scenarios.tiny import write_tiny


@pytest.fixture(scope="module")
def corrected(flown: list[Flight]) -> CorrectedSurvey:  # noqa: F811
    return correct_survey([f.strip for f in flown])


def with_evidence(
    survey: CorrectedSurvey, factor: float, used: int | None = None
) -> CorrectedSurvey:
    *before, last = survey.diagnostics.rounds
    last = replace(last, evidence=factor * last.evidence, used=last.used if used is None else used)
    return replace(survey, diagnostics=replace(survey.diagnostics, rounds=(*before, last)))


def test_gain_in_likeness_is_the_part_by_which_evidence_grew(corrected: CorrectedSurvey) -> None:
    assert gain_in_likeness(corrected, corrected) == 0.0
    assert gain_in_likeness(corrected, with_evidence(corrected, 1.25)) == pytest.approx(0.25)
    # More evidence from fewer registrations that fit is no gain.
    fewer = with_evidence(corrected, 1.25, used=1)
    assert gain_in_likeness(corrected, fewer) == -1.0
    none = replace(corrected, diagnostics=replace(corrected.diagnostics, rounds=()))
    assert gain_in_likeness(none, corrected) == 0.0


@pytest.mark.parametrize(
    ("factors", "kept"), [((0.9,), 0), ((1.1,), 1), ((1.5, 1.01), 1), ((1.5, 1.1), 2)]
)
def test_refine_on_map_keeps_the_rounds_in_which_the_passes_agree_better(
    flown: list[Flight],  # noqa: F811
    corrected: CorrectedSurvey,
    monkeypatch: pytest.MonkeyPatch,
    factors: tuple[float, ...],
    kept: int,
) -> None:
    made: list[CorrectedSurvey] = []

    def again(*_: object, known: CorrectedSurvey, floor: Grid, **__: object) -> CorrectedSurvey:
        assert floor is draft
        made.append(with_evidence(known, factors[len(made)]))
        return made[-1]

    draft = Grid(np.full((4, 4), -40.0), ORIGIN[0], ORIGIN[1] + 4.0, 1.0)
    monkeypatch.setattr(map_loop, "draft_map", lambda *_, **__: draft)
    monkeypatch.setattr(map_loop, "correct_survey", again)
    result = refine_on_map([f.strip for f in flown], corrected, lambda _: [])
    assert len(made) == len(factors)
    assert result is (made[kept - 1] if kept else corrected)


def test_a_survey_without_registrations_is_not_refined(
    flown: list[Flight],  # noqa: F811
    corrected: CorrectedSurvey,
) -> None:
    few = with_evidence(corrected, 1.0, used=2)
    assert refine_on_map([f.strip for f in flown], few, lambda _: pytest.fail("no draft")) is few


def test_draft_map_is_a_coarse_map_of_the_floor(tmp_path: Path) -> None:
    """No worse than the soundings' own spread, on cells of a sixth of the altitude at least."""
    write_simulation(simulate(load_scenario(write_tiny(tmp_path))), tmp_path / "survey")
    survey = open_survey([tmp_path / "survey" / "survey.xtf"])
    passes = build_passes(survey)
    strips = [one.strip for one in passes]
    known = correct_survey(strips)
    draft = draft_map(strips, looks_of(survey, passes, known), survey.crs)
    altitude_m = np.nanmedian(np.concatenate([s.altitude_m for s in strips]))
    assert draft.cell_m >= altitude_m / 6.0
    truth = read_map(tmp_path / "survey" / "truth" / "elevation.tif")
    east, north = np.meshgrid(*draft.centres())
    off = truth.sample(east, north) - draft.elevation_m
    assert np.nanmedian(np.abs(off)) < np.nanstd(truth.elevation_m)
