"""What a raster of fix errors says beyond the linear bound."""

from __future__ import annotations

from dataclasses import replace

import navsets
import numpy as np
import pytest

from localization.ambiguity import Line, corrected, risen, square_miss
from localization.measurements import Sensors
from localization.observability import ObservabilityConfig, observability
from localization.terrain import TerrainMap, terrain_map

CONFIG = ObservabilityConfig(headings=2, lines=12, path_m=200.0)


@pytest.fixture(scope="module")
def terrain() -> TerrainMap:
    return terrain_map(navsets.prior(np.random.default_rng(0), error_m=0.1))


def line_on(terrain: TerrainMap, spacing_m: float, noise_m: float, start_m: float) -> Line:
    along = np.arange(40) * spacing_m
    east = np.full(40, terrain.west_m + 400.0)
    return Line(
        east,
        terrain.north_m - 300.0 - along,
        noise_m**2 * np.eye(40),
        np.full(40, noise_m**2),
        start_m,
        1.0,
    )


def test_on_rough_ground_the_linear_bound_stands(terrain: TerrainMap) -> None:
    found = observability(terrain, Sensors(), np.random.default_rng(1), CONFIG)
    bound = observability(terrain, Sensors(), np.random.default_rng(1), replace(CONFIG, lines=0))
    assert 0.8 <= found.over_bound < 1.3
    assert np.all(found.mean_m[np.isfinite(found.mean_m)] > 0)
    assert np.nanmedian(found.mean_m / bound.mean_m) == pytest.approx(found.over_bound, rel=0.1)


def test_flat_ground_leaves_the_start_s_own_error(terrain: TerrainMap) -> None:
    flat = np.zeros_like(terrain.height_m)
    rng = np.random.default_rng(2)
    line = line_on(terrain, 4.0, 0.3, 20.0)
    square = np.mean([square_miss(flat, terrain.frame, line, 1.0, rng) for _ in range(60)])
    # Nothing is learnt: 20 m an axis, cut off at three sigmas; 360 draws of it scatter by 5 %.
    assert np.sqrt(square) == pytest.approx(20.0 * np.sqrt(2), rel=0.15)


def test_ground_that_repeats_itself_is_missed_by_its_period() -> None:
    """The bound of a sine is small; its next crest is as likely, and 60 m away."""
    n = 200
    at = np.arange(n) * 5.0
    height = 3.0 * np.sin(2 * np.pi * at / 60.0)[:, None] + 3.0 * np.sin(2 * np.pi * at / 60.0)
    grid = replace(
        navsets.prior(np.random.default_rng(0)),
        elevation_m=height, sigma_m=np.full((n, n), 0.1), west_m=0.0, north_m=1000.0,
    )  # fmt: skip
    repeating = terrain_map(grid)
    line = line_on(repeating, 4.0, 0.3, 50.0)
    rng = np.random.default_rng(3)
    missed = square_miss(repeating.height_m, repeating.frame, line, 0.5, rng)
    assert np.sqrt(missed) > 20.0


def test_a_curve_rises_and_gives_its_knots_back() -> None:
    rng = np.random.default_rng(4)
    bound = rng.uniform(1.0, 30.0, 400)
    square = (bound * (1 + bound / 30.0)) ** 2 * rng.chisquare(12, 400) / 12
    knots = risen(bound, square)
    assert np.all(np.diff(knots[1]) >= 0)
    assert corrected(np.array([5.0, 15.0, 25.0]), knots) == pytest.approx(
        [5.83, 22.5, 45.8], rel=0.12
    )


def test_a_map_shorter_than_the_path_has_the_bound_alone(terrain: TerrainMap) -> None:
    config = replace(CONFIG, path_m=1300.0)
    found = observability(terrain, Sensors(), np.random.default_rng(5), config)
    assert found.over_bound == 1.0
