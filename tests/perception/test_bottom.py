"""The bottom track: planted altitudes asked back through everything that misleads a threshold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from perception.bottom import track_bottom
from perception.records import FloatArray, Swath
from tests.perception.echo_fixtures import Survey, flat, make_swath

SURVEY = Survey(n_pings=200, n_samples=500, heave_m=0.5)


def _truth(survey: Survey) -> FloatArray:
    along = np.arange(survey.n_pings) * survey.spacing_m
    return survey.altitude_m + survey.heave_m * np.sin(2 * np.pi * along / 12.0)


def _powers(swath: Swath) -> tuple[FloatArray, FloatArray]:
    return swath.port.astype(np.float32) ** 2, swath.starboard.astype(np.float32) ** 2


@pytest.mark.parametrize("seed, noise, slope", [(0, 0.003, -0.3), (1, 0.05, 0.0), (2, 0.01, 0.5)])
def test_altitude_comes_back_within_a_sample_under_unknown_gain(
    seed: int, noise: float, slope: float
) -> None:
    survey = replace(SURVEY, noise=noise, gain_slope_db_per_m=slope)
    port, starboard = _powers(make_swath(flat, survey, np.random.default_rng(seed)))
    track = track_bottom(port, starboard, survey.sample_m)
    assert track.valid.all()
    assert np.abs(track.altitude_m - _truth(survey)).max() < 1.5 * survey.sample_m


def test_fish_surface_return_second_bottom_and_dropouts_do_not_move_the_track() -> None:
    rng = np.random.default_rng(3)
    port, starboard = _powers(make_swath(flat, SURVEY, rng))
    truth = _truth(SURVEY)
    floor = float(np.median(port[:, 250:300]))
    for side in (port, starboard):
        # A school of fish, a surface echo that crosses the water column, the bottom's second echo.
        side[40:60, 60:85] += 3 * floor * rng.exponential(size=(20, 25))
        surface = np.linspace(60, 140, len(side)).astype(int)
        for i, k in enumerate(surface):
            side[i, k : k + 4] += 5 * floor
        second = (2 * truth / SURVEY.sample_m).astype(int)
        for i, k in enumerate(second):
            side[i, k : k + 40] *= 4
        side[120:132] = 1e-3 * floor * rng.exponential(size=(12, side.shape[1]))
    track = track_bottom(port, starboard, SURVEY.sample_m)
    heard = np.ones(len(truth), bool)
    heard[118:134] = False
    assert np.abs(track.altitude_m - truth)[heard].max() < 3 * SURVEY.sample_m
    assert not track.valid[121:131].any()
    # Across the dropout the track is carried, and says that it is less sure.
    assert np.abs(track.altitude_m - truth)[~heard].max() < 0.5
    assert track.sigma_m[126] > 3 * np.median(track.sigma_m[heard])


def test_a_hint_in_another_scale_carries_the_track_over_a_gap() -> None:
    rng = np.random.default_rng(4)
    port, starboard = _powers(make_swath(flat, replace(SURVEY, heave_m=1.5), rng))
    truth = _truth(replace(SURVEY, heave_m=1.5))
    for side in (port, starboard):
        side[60:100] = 1e-3 * rng.exponential(size=(40, side.shape[1]))
    hint = (truth + 0.95) / 1.39
    plain = track_bottom(port, starboard, SURVEY.sample_m)
    hinted = track_bottom(port, starboard, SURVEY.sample_m, hint)
    gap = slice(62, 98)
    assert np.abs(hinted.altitude_m - truth)[gap].max() < 0.15
    assert np.abs(plain.altitude_m - truth)[gap].max() > 0.5


def test_one_side_alone_is_enough_and_mirroring_changes_nothing() -> None:
    port, starboard = _powers(make_swath(flat, SURVEY, np.random.default_rng(5)))
    nothing = np.full_like(port, np.nan)
    alone = track_bottom(nothing, starboard, SURVEY.sample_m)
    assert np.abs(alone.altitude_m - _truth(SURVEY)).max() < 2 * SURVEY.sample_m
    np.testing.assert_allclose(
        track_bottom(port, starboard, SURVEY.sample_m).altitude_m,
        track_bottom(starboard, port, SURVEY.sample_m).altitude_m,
    )


def test_the_scale_of_the_echo_does_not_matter() -> None:
    port, starboard = _powers(make_swath(flat, SURVEY, np.random.default_rng(6)))
    np.testing.assert_allclose(
        track_bottom(port, starboard, SURVEY.sample_m).altitude_m,
        track_bottom(port * 1e6, starboard * 1e6, SURVEY.sample_m).altitude_m,
        rtol=1e-4,
    )


def test_on_a_side_slope_the_later_side_gives_the_vertical_height() -> None:
    """The least slant range lies uphill, at altitude times the cosine of the slope."""
    slope = np.deg2rad(15.0)
    survey = replace(SURVEY, heave_m=0.0)
    swath = make_swath(lambda x, y: np.tan(slope) * x, survey, np.random.default_rng(7))
    track = track_bottom(*_powers(swath), survey.sample_m)
    assert np.abs(track.first_return_m - 10 * np.cos(slope)).max() < 2 * survey.sample_m
    assert np.abs(track.altitude_m - 10).max() < 2.5 * survey.sample_m


def test_no_echo_at_all_is_no_bottom() -> None:
    nothing = np.full((20, 100), np.nan, np.float32)
    track = track_bottom(nothing, nothing, 0.1)
    assert np.isnan(track.altitude_m).all() and not track.valid.any()
