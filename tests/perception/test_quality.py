"""Quality flags, hidden ground, and the bottom track that is edited by hand and given back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from perception.bottom_files import bottom_rows, read_bottom, write_bottom_csv
from perception.quality import CellFlag, saturated_samples, surface_samples, turning_pings
from perception.records import InputError, Swath
from perception.strip_files import read_strip, strip_dataset, write_strip
from perception.strips import StripConfig, build_strip
from perception.unseen import hidden_sigma
from tests.perception.echo_fixtures import Survey, box, flat, make_swath

SURVEY = Survey(n_pings=80, n_samples=500)


@pytest.fixture(scope="module")
def swath() -> Swath:
    return make_swath(box(1.0, 15, 10, 0.8, 0.8), SURVEY, np.random.default_rng(5))


def test_only_a_crowd_at_the_greatest_value_is_saturation() -> None:
    rng = np.random.default_rng(0)
    free = rng.exponential(100, (50, 400))
    assert not saturated_samples(free).any()
    clipped = np.minimum(free, 250.0)
    assert np.array_equal(saturated_samples(clipped), free >= 250.0)
    assert not saturated_samples(np.zeros((50, 400))).any()


def test_turning_follows_the_bend_and_not_the_compass_noise() -> None:
    along = np.arange(400) * 0.25
    heading = np.where(along > 50, (along - 50) / 30.0, 0.0)
    heading += np.random.default_rng(1).normal(0, 0.005, 400)
    turning = turning_pings(along, heading, 40.0)
    assert not turning[along < 40].any() and turning[along > 60].all()


def test_a_surface_return_is_flagged_where_it_stands_out_only() -> None:
    rng = np.random.default_rng(2)
    ratio = rng.exponential(1, (100, 500))
    depth, altitude = np.full(100, 15.0), np.full(100, 10.0)
    assert not surface_samples(ratio, depth, altitude, 0.06).any()
    ratio[:, 248:253] *= 4
    found = surface_samples(ratio, depth, altitude, 0.06)
    assert found[:, 250].all() and not found[:, 270:].any()
    assert not surface_samples(ratio, depth, altitude + 10, 0.06).any()


def test_flags_reach_the_strip_file_with_their_meanings(swath: Swath, tmp_path: Path) -> None:
    result = build_strip(swath)
    flags = result.strip.flags
    assert flags is not None
    shadow = (flags & CellFlag.SHADOW) > 0
    assert np.mean(shadow == result.strip.shadow) > 0.99 and shadow.any()
    attributes = strip_dataset(result.strip)["flags"].attrs
    assert attributes["flag_meanings"].split()[:2] == ["no_bottom", "turning"]
    assert list(attributes["flag_masks"]) == [flag.value for flag in CellFlag]
    write_strip(tmp_path / "strip.nc", result.strip)
    again = read_strip(tmp_path / "strip.nc").flags
    assert again is not None and np.array_equal(again, flags)


def test_hidden_ground_is_uncertain_up_to_its_ray() -> None:
    across = np.arange(-20, 20) + 0.5
    shadow = np.zeros((2, 40), bool)
    shadow[:, 30:35] = True  # starboard 10 to 15 m
    sigma = hidden_sigma(shadow, across, np.full(2, 12.0))
    assert (sigma[~shadow] == 0).all()
    below_ray = 12.0 * (1 - across[30:35] / 15.0)
    assert (sigma[0, 30:35] <= 0.5 * below_ray + 1e-6).all() and (sigma[0, 30:35] > 0).all()
    assert sigma[0, 31] > sigma[0, 30] and sigma[0, 33] > sigma[0, 34]
    mirrored = hidden_sigma(shadow[:, ::-1], across, np.full(2, 12.0))
    assert np.allclose(mirrored[:, ::-1], sigma)


def _written(swath: Swath, path: Path) -> list[str]:
    result = build_strip(swath)
    rows = bottom_rows(swath.time_s, swath.ping, 0, result.tracked, True, False)
    write_bottom_csv(path, rows)
    return rows


def test_an_unedited_bottom_gives_the_same_strip(swath: Swath, tmp_path: Path) -> None:
    _written(swath, tmp_path / "bottom.csv")
    mine = build_strip(swath)
    given = build_strip(swath, StripConfig(given_bottom=read_bottom(tmp_path / "bottom.csv")))
    assert np.allclose(given.strip.altitude_m, mine.strip.altitude_m, atol=2e-3)


def test_an_edited_bottom_is_taken_and_missing_pings_are_carried(
    swath: Swath, tmp_path: Path
) -> None:
    rows = _written(swath, tmp_path / "bottom.csv")
    lines = [line.split(",") for line in rows]
    for line in lines[20:40]:
        line[4] = "8.000"
    del lines[50:60]
    write_bottom_csv(tmp_path / "edited.csv", [",".join(line) for line in lines])
    result = build_strip(swath, StripConfig(given_bottom=read_bottom(tmp_path / "edited.csv")))
    assert np.allclose(result.tracked.altitude_m[20:40], 8.0)
    assert np.all(result.tracked.first_return_m[20:40] <= 8.0)
    assert not result.tracked.valid[50:60].any() and result.tracked.valid[:50].all()
    assert np.all(np.abs(result.tracked.altitude_m[50:60] - 10) < 0.2)


@pytest.mark.parametrize(
    "text, message",
    [
        ("ping,depth\n1,2\n", "lacks the column altitude_m"),
        ("ping,altitude_m\n", "no row"),
        ("ping,altitude_m\n1,deep\n", "line 2: altitude_m is 'deep'"),
        ("ping,altitude_m\n1,-3\n", "positive"),
        ("ping,altitude_m\n1,3\n1,4\n", "two rows"),
    ],
)
def test_a_wrong_bottom_file_is_refused_by_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "b.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_bottom(tmp_path / "b.csv")


def test_a_bottom_of_another_survey_or_beyond_range_is_refused(tmp_path: Path) -> None:
    swath = make_swath(flat, SURVEY, np.random.default_rng(1))
    path = tmp_path / "b.csv"
    path.write_text("ping,altitude_m\n1,10\n2,99\n")
    with pytest.raises(InputError, match=r"ping 2 is beyond its range of 30\.0 m"):
        build_strip(swath, StripConfig(given_bottom=read_bottom(path)))
    later = replace(swath, time_s=swath.time_s + 3600.0)
    _written(swath, path)
    with pytest.raises(InputError, match=r"3600 s away .* another record"):
        build_strip(later, StripConfig(given_bottom=read_bottom(path)))
    moved = replace(swath, ping=swath.ping + 1000)
    with pytest.raises(InputError, match="no altitude for any ping of pass 0"):
        build_strip(moved, StripConfig(given_bottom=read_bottom(path)))
