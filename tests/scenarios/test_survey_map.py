"""Sonar files to a map, stage by stage: what a pass without a depth, and a bottom from a file, become."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapping.survey import correct_survey
from perception.bottom_files import GivenBottom
from perception.readers import Survey, open_survey
from perception.readers.netcdf import write_netcdf
from perception.strips import BottomFileError, StripConfig
from scenarios import survey_map
from scenarios.passes import each_pass, strips_of
from scenarios.survey_map import build_passes, keep_passes, looks_of
from tests.perception.echo_fixtures import Survey as Pings
from tests.perception.echo_fixtures import flat, make_swath


@pytest.fixture(scope="module")
def without_depth(tmp_path_factory: pytest.TempPathFactory) -> Survey:
    """Two passes with the bow up by 4 degrees, of unknown depth."""
    folder = tmp_path_factory.mktemp("nodepth")
    unknown = np.full(80, np.nan)
    paths = []
    for number in (0, 1):
        pings = Pings(n_pings=80, n_samples=300)
        swath = make_swath(flat, pings, np.random.default_rng(number))
        swath = replace(
            swath,
            time_s=swath.time_s + 600.0 * number,
            easting_m=swath.easting_m + 8.0 * number,
            depth_m=unknown,
            pitch_rad=np.full(80, np.radians(4.0)),
        )
        paths.append(folder / f"{number}.nc")
        write_netcdf(paths[-1], swath)
    return open_survey(paths)


def test_height_offsets_and_pitch_reach_the_joint_map_of_a_survey_without_depth(
    without_depth: Survey,
) -> None:
    passes = build_passes(without_depth)
    corrected = correct_survey([p.strip for p in passes])
    corrected = replace(corrected, height_m=np.array([0.7, -0.4]))
    for look, height_m, made in zip(
        looks_of(without_depth, passes, corrected), (0.7, -0.4), passes, strict=True
    ):
        lift_m = made.bottom.first_return_m * (1 - np.cos(np.radians(4.0)))
        np.testing.assert_allclose(-look.swath.depth_m, height_m + lift_m, atol=1e-6)


def _bottom(ping: np.ndarray, altitude_m: float) -> GivenBottom:
    values = np.full(len(ping), altitude_m)
    seen = np.ones(len(ping), bool)
    return GivenBottom(ping, values, values, 0.0 * values + 0.05, seen, "b.csv", "digest")


def test_a_bottom_file_that_does_not_fit_stops_the_survey(without_depth: Survey) -> None:
    ping = np.arange(160)
    far = _bottom(ping, 10.0)
    far.altitude_m[ping == 100] = 99.0
    with pytest.raises(BottomFileError, match="ping 100 is beyond its range"):
        build_passes(without_depth, config=StripConfig(given_bottom=far))
    half = _bottom(ping[:80], 10.0)
    with pytest.raises(BottomFileError, match="no altitude for any ping of pass 1"):
        build_passes(without_depth, config=StripConfig(given_bottom=half))


def test_a_bottom_file_need_not_speak_of_a_pass_that_gave_no_strip(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pings = Pings(n_pings=60, n_samples=300)
    swath = make_swath(flat, pings, np.random.default_rng(0))
    mute = replace(
        swath,
        time_s=swath.time_s + 600,
        port=np.zeros_like(swath.port),
        starboard=np.zeros_like(swath.starboard),
    )
    write_netcdf(tmp_path / "0.nc", swath)
    write_netcdf(tmp_path / "1.nc", mute)
    survey = open_survey([tmp_path / "0.nc", tmp_path / "1.nc"])
    given = StripConfig(given_bottom=_bottom(np.arange(60), 10.0))
    with caplog.at_level(logging.WARNING):
        assert [index for index, _ in strips_of(survey, given)] == [0]
    assert "left out" in caplog.text


def test_passes_are_made_one_at_a_time_and_kept_when_asked(
    without_depth: Survey, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []

    def make(index: int) -> int:
        made.append(index)
        return 10 * index

    passes = each_pass(without_depth, make)
    assert next(passes) == (0, 0) and made == [0]
    assert list(passes) == [(1, 10)]
    monkeypatch.setattr(survey_map, "_recent", {})
    keep_passes(without_depth, None, ())
    assert build_passes(without_depth) == ()
