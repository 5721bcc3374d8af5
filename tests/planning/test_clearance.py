"""The proof itself: closed forms against analysis and against dense sampling."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from perception.records import bilinear
from planning.clearance import polyline_extremes
from planning.stand_off import least_stand_off


def test_a_saddle_cell_has_its_least_clearance_where_analysis_says():
    # Surface u v on the unit cell; along the diagonal it is t^2, the line is at height 1 - t / 2:
    # g = 1 - t / 2 - t^2, least at the end: -1/2; greatest at the start: 1.
    surface = np.array([[0.0, 0.0], [0.0, 1.0]])
    e = polyline_extremes(surface, np.array([0.0, 1.0]), np.array([0.0, 1.0]), np.array([1.0, 0.5]))
    assert_allclose([e.least_m[0], e.greatest_m[0]], [-0.5, 1.0], atol=1e-12)
    # The other diagonal of -u v: surface -t (1 - t), level line at 0: greatest 1/4 in the middle.
    e = polyline_extremes(-surface, np.array([1.0, 0.0]), np.array([0.0, 1.0]), np.zeros(2))
    assert_allclose([e.greatest_m[0], e.greatest_at[0]], [0.25, 0.5], atol=1e-12)


def test_the_least_between_samples_is_found_where_sampling_at_vertices_misses_it():
    surface = np.zeros((3, 9))
    surface[1, 4] = 3.0
    e = polyline_extremes(surface, np.array([1.0, 1.0]), np.array([0.0, 8.0]), np.array([5.0, 5.0]))
    assert_allclose([e.least_m[0], e.least_at[0]], [2.0, 0.5], atol=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_extremes_agree_with_dense_sampling_and_never_lie_inside_it(seed):
    rng = np.random.default_rng(seed)
    surface = rng.normal(size=(30, 40))
    row, col = rng.uniform(0, 29, 50), rng.uniform(0, 39, 50)
    z = rng.normal(size=50) + 3
    e = polyline_extremes(surface, row, col, z)
    v = np.linspace(0, 1, 4001)

    def dense(a: np.ndarray) -> np.ndarray:
        return a[:-1, None] + np.diff(a)[:, None] * v

    g = dense(z) - bilinear(surface, dense(row), dense(col))
    # Samples cannot lie below the exact least; cells rise by up to 5 m and
    # samples lie a hundredth of a cell apart, so the nearest one is off by up to 0.025 m.
    assert (e.least_m <= g.min(axis=1) + 1e-12).all()
    assert (e.greatest_m >= g.max(axis=1) - 1e-12).all()
    assert_allclose(e.least_m, g.min(axis=1), atol=0.025)
    assert_allclose(e.greatest_m, g.max(axis=1), atol=0.025)


def test_grid_lines_and_whole_numbers_do_not_trip_the_walk():
    surface = np.arange(25.0).reshape(5, 5)
    row = np.array([0.0, 4.0, 4.0, 0.0, 2.0, 2.0])
    col = np.array([0.0, 0.0, 4.0, 4.0, 2.0, 2.0])
    e = polyline_extremes(surface, row, col, 5 * row + col + 7.0)
    # A plane under parallel lines: the clearance is 7 wherever both ends agree.
    assert_allclose(e.least_m, 7.0, atol=1e-9)
    assert_allclose(e.greatest_m, 7.0, atol=1e-9)


def test_a_missing_cell_is_met_and_one_without_weight_is_not():
    surface = np.zeros((4, 4))
    surface[1, 1] = np.nan
    hit = polyline_extremes(surface, np.array([0.5, 0.5]), np.array([0.0, 3.0]), np.ones(2))
    assert np.isnan(hit.least_m[0])
    miss = polyline_extremes(surface, np.array([2.0, 2.0]), np.array([0.0, 3.0]), np.ones(2))
    assert_allclose(miss.least_m, 1.0)
    outside = polyline_extremes(surface, np.array([2.0, 2.0]), np.array([0.0, 3.2]), np.ones(2))
    assert np.isnan(outside.least_m[0])
    assert outside.worst()[0] == 0


def test_stand_off_from_a_wall_is_the_slant_distance():
    surface = np.full((21, 21), -20.0)
    surface[:, 15:] = 0.0
    d, vertex = least_stand_off(
        surface,
        (1.0, 1.0),
        np.array([10.0, 10.0]),
        np.array([5.0, 12.0]),
        np.array([-4.0, -4.0]),
        30,
    )
    # From column 12 at -4 the nearest rock is square to the wall's face, which rises 20 m over a cell.
    assert_allclose(d, 56.0 / np.sqrt(401.0), atol=2e-3)
    assert vertex == 1


def test_stand_off_over_a_slope_is_the_distance_square_to_it():
    # A plane of 45 deg, 6 m below the path: 6 / sqrt(2) square to it, between the cells' centres.
    surface = np.tile(np.arange(60.0), (40, 1))
    col = np.linspace(20.0, 30.0, 9)
    d, _ = least_stand_off(surface, (1.0, 1.0), np.full(9, 20.3), col, col + 6.0, 40.0)
    assert_allclose(d, 6.0 / np.sqrt(2.0), atol=2e-3)
