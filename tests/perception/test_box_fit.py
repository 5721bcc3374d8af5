"""The box fit against plain least squares, with holes and edges, at any size and cell shape."""

import numpy as np
import pytest

from perception.box_fit import box_derivatives
from perception.curvature import derivatives_3x3


def by_least_squares(z, i, j, half, dx, dy):
    """Return p, q, r, s, t and their covariance per unit noise, by the textbook."""
    rows, cols = np.mgrid[
        max(i - half[0], 0) : i + half[0] + 1, max(j - half[1], 0) : j + half[1] + 1
    ]
    inside = (rows < z.shape[0]) & (cols < z.shape[1])
    rows, cols = rows[inside], cols[inside]
    known = np.isfinite(z[rows, cols])
    x, y = (cols[known] - j) * dx, -(rows[known] - i) * dy
    design = np.column_stack([np.ones_like(x), x, y, x**2 / 2, x * y, y**2 / 2])
    solution = np.linalg.lstsq(design, z[rows[known], cols[known]], rcond=None)[0]
    return solution[1:], np.linalg.inv(design.T @ design)[1:, 1:]


@pytest.mark.parametrize("half", [(3, 2), (8, 8)])
def test_it_is_the_least_squares_fit_of_every_box(half):
    rng = np.random.default_rng(1)
    z = rng.normal(size=(40, 300)).cumsum(axis=1)
    z[10:14, 20:29] = np.nan
    z[rng.uniform(size=z.shape) < 0.05] = np.nan
    places = ((20, 150), (20, 258), (39, 299), (12, 19), (25, 2))
    for i, j in places:
        z[i, j] = 1.0
    d, gain = box_derivatives(z, 1.0, 1.7, half)
    for i, j in places:
        expected, covariance = by_least_squares(z, i, j, half, 1.0, 1.7)
        found = [plane[i, j] for plane in (d.p, d.q, d.r, d.s, d.t)]
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9)
        variances = [plane[i, j] for plane in (gain.pp, gain.qq, gain.rr, gain.ss, gain.tt)]
        np.testing.assert_allclose(variances, np.diag(covariance), rtol=1e-7)
        assert gain.rt[i, j] == pytest.approx(covariance[2, 4], rel=1e-6, abs=1e-12)


def test_nine_cells_are_the_three_by_three_fit():
    z = np.random.default_rng(2).normal(size=(12, 15))
    found, _ = box_derivatives(z, 2.0, 3.0, (1, 1))
    expected = derivatives_3x3(z, 2.0, 3.0, "least-squares")
    inner = np.s_[1:-1, 1:-1]
    for name in "pqrst":
        np.testing.assert_allclose(
            getattr(found, name)[inner], getattr(expected, name)[inner], atol=1e-12
        )


def test_a_quadratic_is_exact_at_edges_and_holes_and_far_from_zero():
    y, x = np.mgrid[:60, :500].astype(float)
    z = 3e6 + 0.3 * x - 0.1 * y + 0.01 * x**2 - 0.02 * x * y + 0.03 * y**2
    z[20:30, 50:70] = np.nan
    d, _ = box_derivatives(z, 1.0, 1.0, (4, 4))
    known = np.isfinite(z)
    np.testing.assert_allclose(d.r[known], 0.02, atol=1e-6)
    np.testing.assert_allclose(d.s[known], 0.02, atol=1e-6)  # y of the formula runs south
    np.testing.assert_allclose(d.t[known], 0.06, atol=1e-6)
    assert np.isnan(d.r[~known]).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 30), (5, 5)])
def test_a_box_larger_than_the_map_is_one_fit_of_it_all(shape):
    z = np.random.default_rng(3).normal(size=shape)
    d, gain = box_derivatives(z, 1.0, 1.0, (200, 200))
    assert np.isfinite(d.r).all()
    assert np.isfinite(gain.rr).all()
    assert (gain.rr >= -1e-9).all()
