"""Errors against truth are what a hand calculation says."""

import numpy as np
import pytest

from perception.records import Grid, NoOverlapError, Trajectory
from scenarios.metrics import (
    cell_means,
    interpolated_soundings,
    map_error,
    normalised_error_squared,
    track_rms_m,
)


def _tilted(cell_m: float, size_m: float = 20.0) -> Grid:
    """A plane that rises 0.1 m per metre east and falls 0.2 m per metre north."""
    n = int(size_m / cell_m)
    grid = Grid(np.zeros((n, n)), west_m=500_000.0, north_m=5_000_000.0, cell_m=cell_m)
    e, north = grid.centres()
    heights = 0.1 * (e - 500_000.0)[None, :] - 0.2 * (north - 5_000_000.0)[:, None]
    return Grid(heights, 500_000.0, 5_000_000.0, cell_m)


def _track(time_s, e, n, sigma=1.0):
    one = np.ones(len(time_s))
    return Trajectory(
        np.asarray(time_s, float), np.asarray(e, float), np.asarray(n, float), 0 * one, 0 * one,
        sigma * one, sigma * one, 0 * one,
    )  # fmt: skip


def test_cell_means_of_a_plane_are_its_heights_at_the_cells_centres():
    coarse = _tilted(2.0)
    means = cell_means(_tilted(0.5), coarse)
    np.testing.assert_allclose(means, coarse.elevation_m, atol=1e-9)


def test_map_error_finds_a_planted_bias_and_share_within_sigma():
    truth, grid = _tilted(0.5), _tilted(2.0)
    heights = grid.elevation_m + 0.3
    heights[0, 0] = np.nan
    shifted = Grid(
        heights, grid.west_m, grid.north_m, grid.cell_m, sigma_m=np.full(grid.shape, 0.2)
    )
    error = map_error(shifted, truth)
    assert error.cells == grid.elevation_m.size - 1
    np.testing.assert_allclose([error.bias_m, error.mean_absolute_m, error.rms_m], 0.3, atol=1e-9)
    assert (error.within_one_sigma, error.within_two_sigma) == (0.0, 1.0)


def test_a_map_beside_the_truth_is_refused():
    truth = _tilted(0.5)
    far = Grid(truth.elevation_m, truth.west_m + 1e4, truth.north_m, truth.cell_m)
    with pytest.raises(NoOverlapError, match="share no cell"):
        map_error(far, truth)


def test_soundings_of_a_plane_interpolate_to_the_plane():
    frame = _tilted(1.0)
    rng = np.random.default_rng(1)
    e = frame.west_m + rng.uniform(-5, 25, 400)
    n = frame.north_m - rng.uniform(-5, 25, 400)
    z = 0.1 * (e - 500_000.0) - 0.2 * (n - 5_000_000.0)
    surface = interpolated_soundings(e, n, z, frame)
    np.testing.assert_allclose(surface.elevation_m, frame.elevation_m, atol=1e-6)


def test_track_error_is_the_distance_between_matched_poses():
    truth = _track([0, 10], [0, 100], [0, 0])
    track = _track([0, 5, 10, 99], [3, 53, 103, 0], [4, 4, 4, 0], sigma=5.0)
    assert track_rms_m(track, truth) == pytest.approx(5.0)
    np.testing.assert_allclose(normalised_error_squared(track, truth)[:3], 1.0)
