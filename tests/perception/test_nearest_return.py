"""The nearest point of a rough floor: how far a first return falls short of the point beneath."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from perception.contours import Roughness
from perception.nearest_return import shortfall
from perception.records import FloatArray

_CELL_M = 0.25
_ANY = Roughness(1e-3, 1.0)


def _floor(rms_m: float, longest_m: float, power: float, seed: int) -> FloatArray:
    """Return (1600, 480) heights of a random floor whose waves end at `longest_m`: not alike at every scale."""
    rng = np.random.default_rng(seed)
    rows, cols = np.meshgrid(*(np.fft.fftfreq(n, _CELL_M) for n in (1600, 480)), indexing="ij")
    wave = np.maximum(np.hypot(rows, cols), 1.0 / longest_m)
    seen = np.fft.fft2(rng.standard_normal((1600, 480))) * wave ** (-0.5 * power - 1.0)
    height: FloatArray = np.fft.ifft2(seen).real
    return np.asarray(rms_m * (height - height.mean()) / height.std())


def _first_returns(floor: FloatArray, column: int, up_m: float) -> FloatArray:
    across = _CELL_M * (np.arange(floor.shape[1]) - column)
    return np.asarray(np.min(np.hypot(across[None, :], up_m - floor), axis=1))


def _short(
    floor: FloatArray, column: int, up_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the first returns of a straight pass over a column, and what `shortfall` says of them."""
    first = _first_returns(floor, column, up_m)
    along = _CELL_M * np.arange(len(first))
    depth = np.full(len(first), 20.0)
    return first, *shortfall(first, depth, np.full(len(first), 0.02), along, _ANY)


@pytest.mark.parametrize(
    ("rms_m", "power", "least_m"), [(1.2, 1.1, 0.25), (0.8, 1.5, 0.04), (0.1, 1.5, 0.0)]
)
def test_the_mean_level_of_a_planted_floor_comes_back(
    rms_m: float, power: float, least_m: float
) -> None:
    found, true, spread, sigma = [], [], [], []
    for seed in range(6):
        floor = _floor(rms_m, 80.0, power, seed)
        first, short, short_sigma = _short(floor, 240, 15.0)
        error = 15.0 - floor[:, 240] - first
        found.append(short.mean())
        true.append(error.mean())
        spread.append(error.std())
        sigma.append(short_sigma.mean())
    assert np.mean(true) >= least_m
    assert np.mean(found) == pytest.approx(np.mean(true), rel=0.25, abs=0.01)
    assert np.mean(sigma) == pytest.approx(np.mean(spread), rel=0.35, abs=0.015)


def test_an_echo_is_placed_where_it_stands() -> None:
    """A feature on the mean level, 20 m to the side, from the slant range and the altitude as believed."""
    naive, mended = [], []
    for seed in range(6):
        floor = _floor(1.2, 80.0, 1.1, seed)
        first, short, _ = _short(floor, 240, 15.0)
        rise = -floor[:, 240]
        slant_square = 20.0**2 + 15.0**2
        naive.append(np.mean(np.sqrt(slant_square - (first - rise) ** 2)) - 20.0)
        mended.append(np.mean(np.sqrt(slant_square - (first + short - rise) ** 2)) - 20.0)
    assert np.mean(naive) > 0.2
    assert abs(np.mean(mended)) < 0.3 * np.mean(naive)


def test_a_level_floor_takes_nothing_off() -> None:
    first, short, sigma = _short(np.zeros((1600, 480)), 240, 15.0)
    assert_allclose(first, 15.0)
    assert_allclose(short, 0.0, atol=1e-3)
    assert_allclose(sigma, 0.0, atol=2e-3)


def test_a_world_twice_as_large_falls_short_by_twice_as_much() -> None:
    first = _first_returns(_floor(1.0, 80.0, 1.2, 3), 240, 15.0)
    along, depth, sigma = _CELL_M * np.arange(len(first)), np.full(len(first), 20.0), 0.0 * first
    short, spread = shortfall(first, depth, sigma, along, _ANY)
    twice, twice_spread = shortfall(2 * first, 2 * depth, sigma, 2 * along, _ANY)
    assert_allclose(twice, 2 * short, rtol=1e-6)
    assert_allclose(twice_spread, 2 * spread, rtol=1e-6)


def test_unknown_soundings_and_few_are_borne() -> None:
    nothing = np.full(12, np.nan)
    along, depth, sigma = np.arange(12.0), np.full(12, 5.0), np.full(12, 0.1)
    for first in (nothing, np.where(along > 3, 10.0, np.nan)):
        short, spread = shortfall(first, depth, sigma, along, _ANY)
        assert np.isfinite(short).all()
        assert np.isfinite(spread).all()
        assert (short >= 0).all()


def test_boulders_under_the_track_do_not_pass_for_a_rough_floor() -> None:
    """Eight of a metre on a flat floor: they lengthened every altitude by 0.15 m and more."""
    floor = _floor(0.02, 40.0, 1.5, 3)
    rows, cols = np.indices(floor.shape)
    for k in range(8):
        away_m = _CELL_M * np.hypot(rows - (100 + 190 * k), cols - 240 - 8 * (k % 3))
        floor = np.maximum(floor, 1.0 - away_m**2)
    _, short, _ = _short(floor, 240, 15.0)
    assert short.mean() < 0.03
