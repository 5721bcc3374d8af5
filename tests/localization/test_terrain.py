"""The map as the estimator sees it: lookup, linearisation, white error filtered out."""

from __future__ import annotations

from dataclasses import replace

import navsets
import numpy as np
import pytest

from localization.maperror import assumed_sigma, filter_map
from localization.terrain import linearise, terrain_map
from perception.records import Grid, InputError, NoOverlapError, bilinear


def plane_grid() -> Grid:
    centre = (np.arange(20) + 0.5) * 5.0
    easting, northing = np.meshgrid(centre, centre[::-1])
    return Grid(0.1 * easting - 0.2 * northing - 50, 0, 100, 5, "", np.full((20, 20), 0.1))


def test_lookup_agrees_with_the_record_s_own_bilinear_interpolation() -> None:
    rng = np.random.default_rng(0)
    grid = replace(navsets.prior(rng), sigma_m=np.zeros((240, 240)))  # without error: left as it is
    terrain = terrain_map(grid)
    easting, northing = rng.uniform(-20, 1220, (2, 500))
    row, col = grid.fractional_index(easting, northing)
    expected = bilinear(grid.elevation_m, row, col)
    # Single precision of heights near 100 m is 1e-5.
    np.testing.assert_allclose(terrain.heights(easting, northing), expected, atol=1e-4)


def test_linearisation_of_a_plane_is_the_plane_whatever_the_uncertainty() -> None:
    terrain = terrain_map(plane_grid())
    root = np.linalg.cholesky(np.array([[30.0, 12.0], [12.0, 20.0]]))
    out = linearise(terrain.height_m, terrain.frame, np.array([50.0]), np.array([50.0]), root)[0]
    np.testing.assert_allclose(out[:3], [0.1 * 50 - 0.2 * 50 - 50, 0.1, -0.2], atol=1e-4)
    assert out[3] < 1e-3


def test_white_error_is_filtered_and_what_is_left_is_what_is_claimed() -> None:
    rng = np.random.default_rng(1)
    grid = navsets.prior(rng, relief_m=0.5, error_m=0.3)
    terrain = terrain_map(grid)
    easting, northing = rng.uniform(100, 1100, (2, 4000))
    truth = navsets.floor_m(easting, northing, 0.5)
    left = np.std(terrain.heights(easting, northing) - truth)
    raw = np.std(grid.sample(easting, northing) - truth)
    assert left < 0.4 * raw
    assert left < 1.5 * terrain.error.total_m
    assert terrain.error.white_m == pytest.approx(0.3, rel=0.05)


def test_a_smooth_map_of_large_sigma_is_known_to_have_a_correlated_error() -> None:
    grid = navsets.prior(np.random.default_rng(2), relief_m=1.0, error_m=0.0)
    _, _, error = filter_map(grid.elevation_m, np.full(grid.shape, 0.5), 5.0, 5.0)
    assert error.correlated_m > 0.45


def test_holes_stay_holes() -> None:
    grid = navsets.prior(np.random.default_rng(3))
    grid.elevation_m[50:60, 70:90] = np.nan
    terrain = terrain_map(grid)
    np.testing.assert_array_equal(np.isnan(terrain.height_m), np.isnan(grid.elevation_m))


def test_bounds_off_the_map_are_refused_with_both_extents() -> None:
    with pytest.raises(NoOverlapError, match="does not meet the prior map"):
        terrain_map(plane_grid(), bounds=(5e5, 5e5, 5.01e5, 5.01e5))


def test_a_map_without_sigma_is_refused() -> None:
    grid = plane_grid()
    with pytest.raises(InputError, match="--map-sigma"):
        terrain_map(Grid(grid.elevation_m, 0, 100, 5))


def test_assumed_sigma_is_the_hydrographic_standard_s() -> None:
    # IHO S-44 Order 1a at 60 m: sqrt(0.5^2 + (0.013 * 60)^2) / 1.96.
    assert assumed_sigma(60.0) == pytest.approx(0.4727, abs=1e-3)
