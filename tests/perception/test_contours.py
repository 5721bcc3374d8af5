"""Levelled contour lines, roughness learned from soundings, and what lies beside the line."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from perception.contours import Roughness, floor_beside, learn_roughness, level_lines


def _walk(n: int, scale: float, rng: np.random.Generator) -> np.ndarray:
    """A random walk has the variogram ``scale * h`` where its steps have variance 2 scale."""
    return np.cumsum(rng.normal(0, np.sqrt(2 * scale), n))


def test_levelling_is_the_dense_least_squares_solution() -> None:
    rng = np.random.default_rng(0)
    along, rough = np.sort(rng.uniform(0, 50, 30)), Roughness(0.01, 1.0)
    floor, sigma = rng.normal(size=30), rng.uniform(0.05, 0.3, 30)
    floor[7] = np.nan
    height, spread = level_lines(floor, sigma, along, rough)
    known = np.isfinite(floor)
    rows = np.eye(30)[known] / sigma[known, None]
    links = np.diff(np.eye(30), axis=0) / np.sqrt(2 * rough.variogram(np.diff(along)))[:, None]
    matrix = np.vstack([rows, links])
    right = np.concatenate([floor[known] / sigma[known], np.zeros(29)])
    assert_allclose(height, np.linalg.lstsq(matrix, right, rcond=None)[0], atol=1e-8)
    assert_allclose(spread, np.sqrt(np.diag(np.linalg.inv(matrix.T @ matrix))), rtol=1e-6)


def test_levelled_heights_err_as_they_claim() -> None:
    rng = np.random.default_rng(1)
    along = np.arange(4000) * 0.5
    truth = _walk(4000, 0.004 * 0.5, rng)
    noise = 0.2
    height, sigma = level_lines(
        truth + rng.normal(0, noise, 4000), np.full(4000, noise), along, Roughness(0.004, 1.0)
    )
    score = np.abs(height - truth) / sigma
    assert np.std(height - truth) < 0.5 * noise
    # 68 % and 95 % with the few hundred independent stretches there are.
    assert 0.6 < np.mean(score < 1) < 0.76 and 0.9 < np.mean(score < 2) < 0.99


def test_roughness_of_a_random_walk_is_learned() -> None:
    rng = np.random.default_rng(2)
    along = np.arange(4000) * 0.5
    floor = _walk(4000, 0.01 * 0.5, rng) + rng.normal(0, 0.03, 4000)
    rough = learn_roughness(floor, np.full(4000, 0.03), along, 30.0)
    assert abs(rough.power - 1.0) < 0.2
    assert_allclose(rough.variogram(np.array(10.0)), 0.1, rtol=0.35)


def test_a_few_soundings_or_a_flat_floor_give_a_usable_roughness() -> None:
    assert learn_roughness(np.zeros(3), np.ones(3), np.arange(3.0), 10).scale > 0
    flat = learn_roughness(np.zeros(200), np.full(200, 0.01), np.arange(200.0), 30)
    assert 0 < flat.variogram(np.array(10.0)) < 1e-2


def test_beside_the_line_a_plane_along_it_is_kept_and_sigma_grows() -> None:
    along = np.arange(200.0)
    floor, sigma = floor_beside(
        0.05 * along, np.full(200, 0.02), along, np.array([0.0, 5.0, 20.0]), Roughness(0.01, 1.2)
    )
    middle = slice(85, 115)
    assert_allclose(floor[middle], (0.05 * along[middle])[:, None] * np.ones(3), atol=1e-6)
    assert np.all(np.diff(sigma, axis=1) > 0)
    assert_allclose(sigma[:, 0], 0.02, atol=1e-4)


def test_ground_beside_a_rough_line_errs_as_claimed() -> None:
    """A two-dimensional field of known variogram; the line knows one row of it."""
    rng = np.random.default_rng(3)
    n, power = 512, 1.2
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(n), np.fft.fftfreq(n)))
    k[0, 0] = np.inf
    scores = []
    for _ in range(4):
        white = np.fft.fft2(rng.normal(size=(n, n)))
        field = np.fft.ifft2(white * k ** -(1 + power / 2)).real
        along = np.arange(n, dtype=float)
        line = field[0]
        rough = learn_roughness(line, np.full(n, 1e-3 * np.std(line)), along, 60.0)
        distance = np.array([5.0, 15.0, 40.0])
        floor, sigma = floor_beside(line, np.zeros(n), along, distance, rough)
        for j, d in enumerate(distance):
            scores.append(np.abs(field[int(d)] - floor[:, j])[100:400] / sigma[100:400, j])
    scores = np.concatenate(scores)
    assert 0.5 < np.mean(scores < 1) < 0.85 and np.mean(scores < 2) > 0.88
