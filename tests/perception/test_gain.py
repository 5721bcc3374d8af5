"""Equalisation: whatever the sonar's gain, a nominal floor comes out at one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from perception.gain import Equalised, effective_looks, equalise, incidence_coordinate
from tests.perception.echo_fixtures import Survey, box, flat, make_swath

SURVEY = Survey(n_pings=200, n_samples=500, noise=0.001)


def _equalised(survey: Survey, seed: int = 0, factor: np.ndarray | None = None) -> Equalised:
    swath = make_swath(flat, survey, np.random.default_rng(seed))
    power = swath.starboard.astype(np.float32) ** 2
    if factor is not None:
        power = power * factor
    altitude = np.full(survey.n_pings, survey.altitude_m)
    return equalise(power, survey.sample_m, altitude, altitude, np.zeros(survey.n_pings))


def _level_by_range(ratio: np.ndarray) -> np.ndarray:
    """Mean level in stretches of 25 samples, nadir's first ones left out."""
    return np.array([np.nanmean(ratio[:, k : k + 25]) for k in range(185, 475, 25)])


@pytest.mark.parametrize("slope_db", [-0.5, 0.0, 0.7])
def test_a_wrong_time_varying_gain_is_taken_out(slope_db: float) -> None:
    result = _equalised(replace(SURVEY, gain_slope_db_per_m=slope_db))
    # 5000 samples of one look a stretch: 1.5 % of scatter; 6 % is 0.25 dB.
    assert_allclose(_level_by_range(result.ratio), 1.0, atol=0.06)


def test_a_beam_pattern_and_a_slow_albedo_are_taken_out() -> None:
    ranges = (np.arange(SURVEY.n_samples) + 0.5) * SURVEY.sample_m
    pattern = 10 ** (0.4 * np.cos(ranges / 2.0))
    albedo = 10 ** (0.1 * np.sin(np.arange(SURVEY.n_pings) / 60.0))
    result = _equalised(SURVEY, factor=albedo[:, None] * pattern)
    assert_allclose(_level_by_range(result.ratio), 1.0, atol=0.08)
    along = np.nanmean(result.ratio[:, 200:], axis=1).reshape(10, 20).mean(axis=1)
    assert_allclose(along, 1.0, atol=0.1)


@pytest.mark.parametrize("looks", [1.0, 4.0])
def test_looks_are_estimated_from_the_speckle(looks: float) -> None:
    result = _equalised(replace(SURVEY, looks=looks))
    assert_allclose(result.looks, looks, rtol=0.12)
    pure = np.log(np.random.default_rng(1).gamma(looks, 1 / looks, 100_000))
    assert_allclose(effective_looks(pure), looks, rtol=0.03)


def test_a_shadow_stays_dark_and_the_water_column_is_no_data() -> None:
    survey = replace(SURVEY, noise=0.01)
    swath = make_swath(box(1.5, 15, 25, 1.5, 3), survey, np.random.default_rng(2))
    altitude = np.full(survey.n_pings, survey.altitude_m)
    power = swath.starboard.astype(np.float32) ** 2
    result = equalise(power, survey.sample_m, altitude, altitude, np.zeros(survey.n_pings))
    # Ping 100 looks at the middle of the box; its shadow spans 18.7 to 21.7 m.
    shadow = result.ratio[92:108, int(19.2 / 0.06) : int(21.0 / 0.06)]
    assert shadow.mean() < 0.1
    assert np.isnan(result.ratio[:, : int(10 / 0.06)]).all()


def test_unit_of_the_recorder_does_not_matter() -> None:
    one = _equalised(SURVEY).ratio
    other = _equalised(SURVEY, factor=np.array(1e-6)).ratio
    assert_allclose(one, other, rtol=1e-3)


def test_incidence_coordinate_is_fine_at_nadir_and_logarithmic_far_off() -> None:
    coordinate = incidence_coordinate(np.array([10.0, 10.05, 100.0, 200.0]), np.array([10.0]))[0]
    assert coordinate[0] == 0
    assert_allclose(coordinate[1], 0.1, rtol=0.01)
    assert_allclose(coordinate[3] - coordinate[2], np.log(2), rtol=0.01)


def test_a_side_without_echo_is_all_no_data() -> None:
    nothing = np.full((20, 50), np.nan, np.float32)
    result = equalise(nothing, 0.1, np.ones(20), np.ones(20), np.zeros(20))
    assert np.isnan(result.ratio).all()


def test_a_recorder_that_compresses_levels_is_expanded_and_a_linear_one_is_not() -> None:
    survey = replace(SURVEY, noise=0.001)
    swath = make_swath(box(1.5, 15, 25, 1.5, 3), survey, np.random.default_rng(8))
    altitude = np.full(survey.n_pings, survey.altitude_m)
    power = swath.starboard.astype(np.float64) ** 2
    ratios = {}
    for name, values in (("linear", power), ("compressed", power**0.3)):
        result = equalise(values, survey.sample_m, altitude, altitude, np.zeros(survey.n_pings))
        ratios[name] = result
    assert ratios["linear"].expansion == pytest.approx(1.0, abs=0.1)
    # 36 dB of water below floor became 11, and is brought back to 18.
    assert ratios["compressed"].expansion > 1.5
    shadow = np.s_[92:108, int(19.2 / 0.06) : int(21.0 / 0.06)]
    assert ratios["compressed"].ratio[shadow].mean() < 0.25
