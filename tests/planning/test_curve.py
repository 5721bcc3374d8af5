"""Legs and arcs: radius, lengths, and even spacing."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from planning.curve import sample_curve, waypoints
from planning.finish import headings, least_radius


def test_a_right_angle_is_rounded_by_a_quarter_circle_of_the_radius():
    corner = np.array([[0.0, 0.0], [50.0, 0.0], [50.0, 50.0]])
    xy = waypoints(corner, 10.0, 0.5)
    legs = np.hypot(*np.diff(xy, axis=0).T)
    assert_allclose(legs, legs.mean(), rtol=2e-3)
    # Two legs of 40 and a quarter of a circle of 10.
    assert_allclose(legs.sum(), 80.0 + 5.0 * np.pi, rtol=1e-3)
    radius, _ = least_radius(xy[:, 0], xy[:, 1])
    assert_allclose(radius, 10.0, rtol=2e-3)
    assert_allclose(xy[[0, -1]], corner[[0, 2]])


def test_what_does_not_fit_is_reported_as_overlap():
    tight = np.array([[0.0, 0.0], [30.0, 0.0], [30.0, 4.0], [0.0, 4.0]])
    x, y = np.empty(500), np.empty(500)
    n, overlap = sample_curve(tight, 0, 3, 10.0, 1.0, x, y)
    assert n > 0
    # Each of the two right angles wants 10 m and may have half of the 4 m between them.
    assert_allclose(overlap, 16.0)
    assert sample_curve(tight, 0, 3, 0.0, 1.0, x, y)[1] == 0.0


def test_headings_turn_clockwise_from_north():
    east = np.array([0.0, 1.0, 1.0, 0.0])
    north = np.array([0.0, 0.0, -1.0, -1.0])
    assert_allclose(np.degrees(headings(east, north)), [90.0, 135.0, 225.0, 270.0])
