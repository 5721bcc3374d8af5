"""Global matching, patch fixes, observability, evidence."""

from __future__ import annotations

import navsets
import numpy as np
import pytest

from localization.correlation import Spectra, masked_ncc, match_patch, rotated
from localization.integrity import protection_level
from localization.measurements import Sensors
from localization.observability import ObservabilityConfig, bound_at
from localization.patch import Patch, match_patch_near
from localization.rival import fitted_covariance, krige
from localization.terrain import terrain_map


def patch_at(
    row: float, col: float, turn: float, side: int, rng: np.random.Generator, noise_m: float
) -> np.ndarray:
    """Heights of a turned square on cells of 5 m, from the analytic floor."""
    q = np.arange(side) - (side - 1) / 2
    r, c = np.meshgrid(q, q, indexing="ij")
    rows = row + np.cos(turn) * r + np.sin(turn) * c
    cols = col - np.sin(turn) * r + np.cos(turn) * c
    height = navsets.floor_m((cols + 0.5) * 5.0, navsets.EXTENT_M - (rows + 0.5) * 5.0)
    return np.asarray(height + noise_m * rng.standard_normal((side, side)) + 3.0)


def test_masked_correlation_is_numpy_s_where_nothing_is_masked() -> None:
    rng = np.random.default_rng(0)
    values, patch = rng.standard_normal((20, 24)), rng.standard_normal((6, 5))
    ncc, _ = masked_ncc(Spectra(values, patch.shape), patch, 30)
    for i, j in ((0, 0), (7, 11), (14, 19)):
        expected = np.corrcoef(values[i : i + 6, j : j + 5].ravel(), patch.ravel())[0, 1]
        assert ncc[i + 5, j + 4] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("turn", [None, 0.0])
def test_a_patch_with_holes_is_placed_to_a_part_of_a_cell(turn: float | None) -> None:
    rng = np.random.default_rng(1)
    true_turn = 2.2 if turn is None else 0.0
    values = navsets.prior(rng, error_m=0.1).elevation_m
    patch = patch_at(131.3, 97.6, true_turn, 61, rng, 0.4)
    patch[10:20, 5:25] = np.nan
    result = match_patch(values, patch, turn)
    best = result.best
    assert result.accepted, result.reason
    assert np.hypot(best.row - 131.3, best.col - 97.6) < 0.3
    assert abs(best.turn_rad - true_turn) < np.radians(1.0)


def test_a_patch_of_other_ground_is_not_accepted() -> None:
    rng = np.random.default_rng(2)
    values = navsets.prior(rng, error_m=0.1).elevation_m
    other = rng.standard_normal((61, 61)).cumsum(axis=0).cumsum(axis=1) / 20
    result = match_patch(values, other, 0.0)
    assert not result.accepted
    assert result.reason


def test_turning_there_and_back_gives_the_patch_again() -> None:
    rng = np.random.default_rng(3)
    patch = patch_at(100, 100, 0.0, 41, rng, 0.0)
    there = rotated(patch, 0.7)
    back = rotated(there, -0.7)
    middle = slice((back.shape[0] - 21) // 2, (back.shape[0] - 21) // 2 + 21)
    # Two bilinear readings of a floor whose second difference is below 0.1 m a cell.
    np.testing.assert_allclose(back[middle, middle], patch[10:31, 10:31], atol=0.3)


def strip_patch(rng: np.random.Generator, relief_m: float, offset: np.ndarray) -> Patch:
    along, across = np.meshgrid(np.arange(-75, 75, 3.0), np.arange(-40, 41, 2.0), indexing="ij")
    east, north = 600 + along.ravel(), 600 + across.ravel()
    height = navsets.floor_m(east, north, relief_m) + 0.3 * rng.standard_normal(east.size) + 1.2
    e, n = east - offset[0], north - offset[1]
    centre = (600 - offset[0], 600 - offset[1])
    return Patch(0.0, centre, e, n, height, np.full(east.size, 0.3))


def test_a_patch_near_its_place_gives_a_fix_of_honest_sigma() -> None:
    squares = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        terrain = terrain_map(navsets.prior(rng))
        fix = match_patch_near(
            terrain, strip_patch(rng, 8.0, rng.normal(0, 15, 2)), 225.0 * np.eye(2)
        )
        assert fix.accepted, fix.reason
        d = np.array([fix.easting_m - 600, fix.northing_m - 600])
        assert np.hypot(*d) < 3.0
        squares.append(d @ np.linalg.solve(fix.covariance_m2, d))
    # Mean of 5 chi-square values of 2 degrees of freedom: 99.9 % lie below 5.9.
    assert np.mean(squares) < 5.9


def test_flat_ground_gives_no_patch_fix_and_says_why() -> None:
    rng = np.random.default_rng(9)
    terrain = terrain_map(navsets.prior(rng, relief_m=0.0))
    fix = match_patch_near(terrain, strip_patch(rng, 0.0, np.zeros(2)), 225.0 * np.eye(2))
    assert not fix.accepted
    assert "no relief in common" in fix.reason


def test_a_patch_off_the_map_is_refused() -> None:
    rng = np.random.default_rng(9)
    terrain = terrain_map(navsets.prior(rng))
    fix = match_patch_near(terrain, strip_patch(rng, 8.0, np.array([5e4, 0])), 225.0 * np.eye(2))
    assert not fix.accepted
    assert "too little in common" in fix.reason


def test_the_bound_of_flat_ground_is_the_start_s_and_relief_lowers_it() -> None:
    config, sensors = ObservabilityConfig(path_m=200.0), Sensors()
    flat, rough = (
        bound_at(terrain_map(navsets.prior(np.random.default_rng(0), relief)), sensors, config, 0.5)
        for relief in (0.0, 8.0)
    )
    middle = (slice(60, 180), slice(60, 180))
    np.testing.assert_allclose(np.nanmedian(flat[middle]), 50 * np.sqrt(2), rtol=0.15)
    assert np.nanmedian(rough[middle]) < 3.0


def test_twice_the_relief_halves_the_bound() -> None:
    config, sensors = ObservabilityConfig(path_m=200.0), Sensors()
    medians = [
        np.nanmedian(
            bound_at(
                terrain_map(navsets.prior(np.random.default_rng(0), r, 0.05), error_length_m=5.0),
                sensors, config, 0.5,
            )[60:180, 60:180]
        )
        for r in (6.0, 12.0)
    ]  # fmt: skip
    assert medians[0] / medians[1] == pytest.approx(2.0, rel=0.15)


def test_kriging_reads_its_own_data_back_and_knows_less_far_away() -> None:
    rng = np.random.default_rng(4)
    place = rng.uniform(0, 100, (20, 2))
    values = np.sin(place[:, 0] / 30)
    at = np.concatenate([place[:1], [[1000.0, 1000.0]]])
    predicted, covariance = krige(place, values, np.full(20, 1e-6), at, (1.0, 40.0, 1.5))
    assert predicted[0] == pytest.approx(values[0], abs=1e-2)
    assert covariance[0, 0] < 1e-2 < 0.9 < covariance[1, 1]


def test_a_fitted_covariance_gives_the_structure_function_back() -> None:
    lags = 5.0 * 2.0 ** np.arange(8)
    squares = 2 * 4.0 * (1 - np.exp(-((lags / 200.0) ** 1.6)))
    sill, length, power = fitted_covariance(lags, squares)
    near = 2 * sill * (1 - np.exp(-((lags[:4] / length) ** power)))
    np.testing.assert_allclose(near, squares[:4], rtol=0.15)


def test_the_protection_level_is_breached_as_often_as_stated() -> None:
    rng = np.random.default_rng(5)
    error = rng.standard_normal((200_000, 2))
    share = np.mean(np.hypot(*error.T) > protection_level(np.eye(2), risk=1e-2))
    assert share == pytest.approx(1e-2, rel=0.1)
