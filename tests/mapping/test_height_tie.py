"""The vertical tie: the shift comes back, and its sigma is that of its error, however far errors reach."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mapping.height_tie import sigma_of_median, tie_heights
from perception.records import Grid


def errors(
    rng: np.random.Generator, reach: float, shape: tuple[int, int] = (160, 200)
) -> np.ndarray:
    field = gaussian_filter(rng.normal(size=shape), reach, mode="wrap")
    return 0.2 * field / field.std()


@pytest.mark.parametrize("reach", [0.0, 4.0, 12.0])
def test_the_sigma_of_the_tie_is_that_of_its_error(reach: float) -> None:
    """Maps drawn forty times: the rms of error over sigma is near one, or below for errors of a cell."""
    rng = np.random.default_rng(3)
    ratios = []
    for _ in range(40):
        field = errors(rng, reach, (640, 800))[200:360, 200:400]
        ratios.append(np.median(field) / sigma_of_median(field))
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_errors_that_follow_the_passes_count_as_many_times_as_there_are_passes() -> None:
    """Six bands with an offset each: few errors are beyond two sigmas, and sigma is no wild guess."""
    rng = np.random.default_rng(6)
    ratios = []
    for _ in range(60):
        offsets = np.repeat(0.2 * rng.normal(size=6), 30)[:, None] * np.ones(200)
        field = offsets + errors(rng, 3.0, (180, 200)) * 0.3
        ratios.append(np.median(field) / sigma_of_median(field))
    assert (np.abs(ratios) > 2).mean() < 0.15
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.4


def test_a_shift_comes_back_and_every_cell_bears_its_sigma() -> None:
    rng = np.random.default_rng(4)
    ground = errors(rng, 10.0) * 10 - 30.0
    prior = Grid(ground, 0.0, 160.0, 1.0, "EPSG:32630", datum="LAT")
    sigma = np.full(ground.shape, 0.1)
    grid = Grid(ground - 1.3 + errors(rng, 5.0), 0.0, 160.0, 1.0, "EPSG:32630", sigma)
    tie = tie_heights(grid, prior)
    assert tie.shift_m == pytest.approx(1.3, abs=3 * tie.sigma_m) and 0 < tie.sigma_m < 0.1
    tied = tie.tied(grid)
    assert tied.datum == "LAT"
    np.testing.assert_allclose(tied.sigma_m, np.hypot(0.1, tie.sigma_m))
    np.testing.assert_allclose(tied.elevation_m, grid.elevation_m + tie.shift_m)
    assert abs(tie.left.statistics["median_m"]) < 1e-6
    assert tie.metrics()["prior_shift_sigma_m"] == tie.sigma_m


def test_a_scrap_of_common_ground_gives_the_scatter_of_its_cells() -> None:
    scrap = np.full((20, 20), np.nan)
    scrap[3, 4:9] = [0.0, 0.1, 0.2, 0.3, 0.4]
    assert sigma_of_median(scrap) == pytest.approx(1.4826 * 0.1)
    assert np.isnan(sigma_of_median(np.full((3, 3), np.nan)))
