"""What one line of soundings tells of the ground beside it, and what it must not pretend to tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import ndimage

from perception.gain_basis import GainBasis
from perception.inverse_sigma import _sample_sigma, prior_doubt
from perception.inverse_state import (
    InversionConfig,
    State,
    linear_problem,
    present_soundings,
    sounding_surface,
)
from perception.multigrid import Spectrum
from perception.rays import Soundings
from perception.records import FloatArray
from perception.roughness import expected_structure, learn_roughness, random_floor

UP_M = 15.0
SHAPE = (129, 97)


def dunes(wave_m: float, rng: np.random.Generator) -> FloatArray:
    """Return short-crested dunes of 0.5 m rms: waves of all directions about one length."""
    count = 256
    k = 2 * np.pi * np.hypot(*np.meshgrid(*(np.fft.fftfreq(count),) * 2))
    shape = np.exp(-0.5 * ((k * wave_m / (2 * np.pi) - 1) / 0.2) ** 2)
    floor = np.fft.ifft2(np.fft.fft2(rng.standard_normal((count, count))) * shape).real
    return np.asarray(0.5 * floor / floor.std())[: SHAPE[0], : SHAPE[1]]


def line_over(floor: FloatArray, rng: np.random.Generator) -> Soundings:
    """Return first returns of a track up the middle of a floor on cells of 1 m, swaying by 1.1 m."""
    north = np.arange(float(floor.shape[0]))
    east = floor.shape[1] // 2 + 1.1 * np.sin(2 * np.pi * north / 120.0 + rng.uniform(0, 2 * np.pi))
    across = np.arange(-9, 9.01, 0.25)
    at = np.broadcast_arrays(north[:, None], east[:, None] + across)
    drop = UP_M - ndimage.map_coordinates(floor, np.array(at), order=1)
    least = np.min(np.hypot(across, drop), axis=1) + 0.02 * rng.standard_normal(len(north))
    n = len(north)
    return Soundings(east, north, np.full(n, UP_M), np.zeros(n), least, np.full(n, 0.05))


def state_of(bottom: Soundings, roughness: Spectrum) -> State:
    """Return the state of an inversion without a single echo."""
    basis = GainBasis(60.0)
    mean = float(np.mean(bottom.up_m - bottom.range_m))
    state = State(
        0.0, 0.0, 1.0, SHAPE, [], bottom, roughness, Spectrum(1.0, 1.0, 1.0), basis, mean,
        np.full(SHAPE, mean), np.zeros(SHAPE), np.zeros(basis.size), InversionConfig(),
    )  # fmt: skip
    state.surface = sounding_surface(state)
    return state


@pytest.mark.parametrize("seed", [0, 2, 4])
def test_a_line_over_dunes_gives_no_surface_worse_than_its_nearest_sounding(seed: int) -> None:
    """Dunes have no spectrum of the form that is fitted; the misfit must not become relief.

    With too much relief at long waves the sway of the track was read as a slope across it.
    """
    rng = np.random.default_rng(seed)
    floor = dunes(60.0, rng)
    bottom = line_over(floor, rng)
    learned = learn_roughness([bottom], 0.02, 1.0, rng)
    track = bottom.up_m - bottom.range_m
    assert expected_structure(learned, np.array([50.0]), 1.0)[0] < 3.0 * 2 * np.var(track)
    error = np.abs(state_of(bottom, learned).surface - floor).mean()
    assert error < np.abs(track[:, None] - floor).mean()


def test_expected_structure_is_that_of_random_floors() -> None:
    spectrum = Spectrum(2e-3, 0.4, 2.0)
    rng = np.random.default_rng(8)
    lag = np.array([2, 6, 20])
    seen = np.zeros(3)
    for _ in range(6):
        floor = random_floor(spectrum, 1.0, 512, rng)
        seen += [np.mean((np.roll(floor, shift, axis=0) - floor) ** 2) / 6 for shift in lag]
    assert_allclose(expected_structure(spectrum, lag.astype(float), 1.0), seen, rtol=0.15)


def test_doubt_is_students_and_grows_with_the_distance_from_the_track() -> None:
    north = np.arange(101.0)
    line = Soundings(np.full(101, 50.0), north, *(np.full(101, v) for v in (15.0, 0.0, 15.0, 0.05)))
    doubt = prior_doubt(line, 0.0, 0.0, 1.0, (101, 121))
    # 100 m of track: ten stretches of 10 m, five of 20 m; not fewer than three.
    assert_allclose(doubt[50, [60, 70, 120]] ** 2, [10 / 8, 5 / 3, 3.0], rtol=0.02)
    assert np.all(np.diff(doubt[50, 50:]) >= 0)
    assert_allclose(doubt[:, :50], doubt[:, 100:50:-1])
    twice = replace(line, **{k: np.tile(getattr(line, k), 2) for k in Soundings.__slots__})
    assert_allclose(prior_doubt(twice, 0.0, 0.0, 1.0, (101, 121)), doubt, rtol=0.01)
    # Half as many soundings are the same length of track.
    thin = replace(line, **{k: getattr(line, k)[::2] for k in Soundings.__slots__})
    far = prior_doubt(thin, 0.0, 0.0, 1.0, (101, 121))[:, 70:]
    assert_allclose(far, doubt[:, 70:], rtol=0.02)


def test_errors_beside_a_line_are_of_the_claimed_size() -> None:
    """The prior is learned from each line alone: without doubt about it sigma would be too small."""
    rng = np.random.default_rng(21)
    within = []
    for _ in range(6):
        floor = random_floor(Spectrum(2e-5, 0.05, 40.0), 1.0, 256, rng)[: SHAPE[0], : SHAPE[1]]
        bottom = line_over(floor, rng)
        state = state_of(bottom, learn_roughness([bottom], 0.02, 1.0, rng))
        alone = _sample_sigma(linear_problem(state, None, present_soundings(state)), state, rng)
        sigma = alone * prior_doubt(bottom, 0.0, 0.0, 1.0, SHAPE)
        size = np.abs(state.surface - floor) / sigma
        within.append((np.mean(size < 1), np.mean(size < 2)))
    one, two = np.mean(within, axis=0)
    assert 0.55 < one < 0.85
    assert two > 0.85
