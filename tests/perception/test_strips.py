"""Strips: one pass's pings to elevation with an honest sigma."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from perception import levels, quality, strip_columns
from perception.records import InputError
from perception.strips import StripConfig, build_strip, common_samples
from tests.perception.echo_fixtures import Survey, boulder, flat, gaussian, make_swath

SURVEY = Survey(n_pings=120, n_samples=500)


def test_a_flat_floor_lies_at_depth_plus_altitude_below_the_datum() -> None:
    result = build_strip(make_swath(flat, SURVEY, np.random.default_rng(0)))
    strip = result.strip
    assert_allclose(np.nanmean(strip.elevation_m), -30.0, atol=0.06)
    error = np.abs(strip.elevation_m + 30)[np.isfinite(strip.elevation_m)]
    assert np.all(error < 4 * np.nanmax(strip.sigma_m))
    assert strip.across_m[0] == -strip.across_m[-1]
    assert np.isfinite(strip.elevation_m[:, 5:-5]).all()


def test_an_object_stands_on_the_strip_where_it_stands_on_the_floor() -> None:
    result = build_strip(make_swath(gaussian(1.4, 15, 15, 1.2), SURVEY, np.random.default_rng(1)))
    strip = result.strip
    row = int(np.argmin(np.abs(result.along_m - 15)))
    column = int(np.argmin(np.abs(strip.across_m - 15)))
    assert strip.elevation_m[row, column] == pytest.approx(-28.6, abs=0.25)
    assert strip.shadow[row].any()
    assert strip.shadow[:20].mean() < 0.01


def test_mirroring_the_world_swaps_port_and_starboard() -> None:
    rng = np.random.default_rng(2)
    swath = make_swath(gaussian(1.4, 15, 15, 1.2), SURVEY, rng)
    one = build_strip(swath)
    other = build_strip(replace(swath, port=swath.starboard, starboard=swath.port))
    assert_allclose(other.strip.elevation_m, one.strip.elevation_m[:, ::-1], atol=1e-4)
    assert_allclose(np.sort(other.objects.across_m), np.sort(-one.objects.across_m))


def test_moving_the_world_moves_the_objects_and_nothing_else() -> None:
    swath = make_swath(boulder(1.0, 15, 15), SURVEY, np.random.default_rng(3))
    moved = replace(swath, easting_m=swath.easting_m + 500, northing_m=swath.northing_m - 80)
    one, other = build_strip(swath), build_strip(moved)
    assert_allclose(other.objects.easting_m, one.objects.easting_m + 500, atol=1e-6)
    assert_allclose(other.objects.northing_m, one.objects.northing_m - 80, atol=1e-6)
    assert_allclose(other.strip.elevation_m, one.strip.elevation_m, atol=1e-3)


def test_without_depth_heights_are_relative_to_the_sonar_and_the_log_says_so(
    caplog: pytest.LogCaptureFixture,
) -> None:
    swath = make_swath(flat, SURVEY, np.random.default_rng(4))
    with caplog.at_level(logging.INFO):
        strip = build_strip(replace(swath, depth_m=np.zeros(SURVEY.n_pings))).strip
    assert "relative to the sonar" in caplog.text
    assert_allclose(np.nanmean(strip.elevation_m), -10.0, atol=0.06)


def test_samples_that_change_size_within_a_pass_are_brought_together() -> None:
    swath = make_swath(flat, SURVEY, np.random.default_rng(5))
    coarse = make_swath(
        flat, replace(SURVEY, sample_m=0.12, n_samples=250), np.random.default_rng(6)
    )
    half = SURVEY.n_pings // 2
    wide = np.full((SURVEY.n_pings, 250), np.nan, np.float32)
    sample = swath.sample_m.copy()
    sides = {}
    for name in ("port", "starboard"):
        both = getattr(swath, name).copy()
        both[half:] = np.concatenate([getattr(coarse, name), wide], axis=1)[half:]
        sides[name] = both
    sample[half:] = 0.12
    mixed = replace(swath, sample_m=sample, **sides)
    port, _, common = common_samples(mixed)
    assert common in (pytest.approx(0.06), pytest.approx(0.12), pytest.approx(0.09))
    assert np.isfinite(port).any()
    result = build_strip(mixed)
    assert np.abs(result.bottom.altitude_m - 10).max() < 0.25


def test_one_side_is_enough() -> None:
    swath = make_swath(flat, SURVEY, np.random.default_rng(7))
    strip = build_strip(replace(swath, port=np.full_like(swath.port, np.nan))).strip
    assert strip.across_m.min() > 0
    assert_allclose(np.nanmean(strip.elevation_m), -30.0, atol=0.06)


def test_too_few_pings_or_no_floor_is_refused_with_the_reason() -> None:
    swath = make_swath(flat, SURVEY, np.random.default_rng(8))
    with pytest.raises(InputError, match=r"9 usable pings; at least 10"):
        build_strip(swath.take(slice(0, 9)))
    blank = np.full_like(swath.port, np.nan)
    with pytest.raises(InputError, match="shows no bottom"):
        build_strip(replace(swath, port=blank, starboard=blank))


def test_the_column_width_can_be_chosen() -> None:
    swath = make_swath(flat, SURVEY, np.random.default_rng(9))
    strip = build_strip(swath, StripConfig(cell_m=0.5)).strip
    assert_allclose(np.diff(strip.across_m), 0.5)


def test_rough_ground_errs_as_its_sigma_claims() -> None:
    """Sums of long and short waves in both directions, two passes; the sonar sounds below itself only."""
    scores = []
    for seed in range(2):
        rng = np.random.default_rng(100 + seed)
        waves = [
            (0.35 * length / 25, 2 * np.pi / length, *rng.uniform(0, 2 * np.pi, 2))
            for length in np.geomspace(4, 60, 14)
        ]

        def ground(x: np.ndarray, y: np.ndarray, waves: list = waves) -> np.ndarray:  # type: ignore[type-arg]
            return np.sum(
                [a * np.cos(k * (x * np.cos(d) + y * np.sin(d)) + p) for a, k, d, p in waves],
                axis=0,
            )

        survey = replace(SURVEY, n_pings=200, spacing_m=0.4, n_samples=300, sample_m=0.1)
        y = np.arange(200) * 0.4
        swath = make_swath(ground, survey, rng)
        result = build_strip(swath)
        x, along = np.meshgrid(result.strip.across_m, y)
        error = result.strip.elevation_m - (ground(x, along) - 30)
        scores.append((np.abs(error) / result.strip.sigma_m)[np.isfinite(error)])
    together = np.concatenate(scores)
    # Two passes are few independent floors: wider than the reach's 60-76 % and 90-98 %.
    assert 0.5 < np.mean(together < 1) < 0.85
    assert np.mean(together < 2) > 0.85


def test_a_pass_worked_on_in_short_stretches_gives_the_same_strip(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    swath = make_swath(gaussian(1.4, 15, 15, 1.2), SURVEY, np.random.default_rng(12))
    whole = build_strip(swath)
    monkeypatch.setattr(levels, "_STRETCH", 20 * 500)
    monkeypatch.setattr(strip_columns, "_LINES", 7)
    monkeypatch.setattr(quality, "_PINGS", 13)
    parts = build_strip(swath)
    for one, other in ((parts.strip, whole.strip), (parts.floor, whole.floor)):
        for name in ("elevation_m", "sigma_m", "echo", "shadow", "flags"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_array_equal(parts.levels, whole.levels)
    np.testing.assert_array_equal(parts.objects.height_m, whole.objects.height_m)
