"""Triangles over a floor, distance along a pass, and resampling between sample sizes."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from perception.geometry import (
    along_track,
    ground_range,
    progress_along,
    resample_rows,
    slant_range,
)


def test_ground_range_undoes_slant_range_and_refuses_the_water_column() -> None:
    ground = np.linspace(0.1, 80, 50)
    assert_allclose(ground_range(slant_range(ground, np.array(12.0)), np.array(12.0)), ground)
    assert np.isnan(ground_range(np.array(11.9), np.array(12.0)))


def test_distance_along_a_straight_line_is_its_length_with_or_without_jitter() -> None:
    rng = np.random.default_rng(0)
    n = 400
    east, north = np.linspace(0, 200, n), np.zeros(n)
    assert_allclose(along_track(east, north)[-1], 200)
    jitter = rng.normal(0, 0.5, (2, n))
    rough = along_track(east + jitter[0], north + jitter[1])[-1]
    smooth = progress_along(east + jitter[0], north + jitter[1], np.arange(n, dtype=float))
    assert rough > 300  # the plain sum counts the jitter
    assert abs(smooth[-1] - 200) < 10
    assert np.all(np.diff(smooth) > 0)


def test_navigation_slower_than_the_pings_still_gives_rising_distances() -> None:
    east = np.repeat(np.arange(40.0), 10)
    along = progress_along(east, np.zeros(400), np.arange(400.0))
    assert np.all(np.diff(along) > 0)
    assert abs(along[-1] - 39) < 3


def test_resampling_keeps_a_pattern_at_its_range_and_ends_with_the_ping() -> None:
    def pattern(slant: np.ndarray) -> np.ndarray:
        return 2 + np.sin(slant)

    sizes = np.array([0.05, 0.1])
    rows = np.full((2, 400), np.nan, np.float32)
    for i, size in enumerate(sizes):
        count = int(20 / size)
        rows[i, :count] = pattern((np.arange(count) + 0.5) * size)
    out = resample_rows(rows, sizes, 0.08, 300)
    slant = (np.arange(300) + 0.5) * 0.08
    for i in range(2):
        inside = (slant > sizes[i] / 2) & (slant < 19.9)
        # Linear interpolation of a sine: error below step^2 / 8.
        assert_allclose(out[i, inside], pattern(slant[inside]), atol=0.002)
        assert np.isnan(out[i, slant > 20.2]).all()
