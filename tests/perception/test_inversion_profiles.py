"""The mean profiles across the tracks, as equations on the surface."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from perception.profiles import mean_profiles, uncrossed
from perception.rays import Rays
from perception.shading import Rows

_SHAPE, _CELL_M = (41, 61), 1.0
# Northwards along easting 10 m, looking east over 40 m.
_STARBOARD = Rays(
    easting_m=np.full(40, 10.0), northing_m=np.arange(40) + 0.3, up_m=np.full(40, 15.0),
    azimuth_rad=np.full(40, np.pi / 2), tilt_rad=np.zeros(40),
    power=np.ones((40, 400), np.float32), sample_m=np.full(40, 0.1), side=1, look=0,
)  # fmt: skip


def test_a_profiles_rows_read_the_mean_along_the_track() -> None:
    row, col = np.indices(_SHAPE)
    surface = np.sin(0.2 * col) + 0.01 * row
    held = np.ones((40, 60), bool)
    found = mean_profiles(surface, 0.0, 0.0, _CELL_M, [_STARBOARD], held, 0.1)
    # Every fourth metre across, from the fourth; every other ray.
    across = 10 + np.arange(4, 40, 4)
    expected = np.sin(0.2 * across) + 0.01 * np.mean(np.arange(0, 40, 2) + 0.3)
    assert_allclose(found.matrix @ surface.ravel(), expected, atol=1e-12)
    assert_allclose(found.value, expected, atol=1e-12)
    assert_allclose(found.weight, 100.0)


def test_relative_profiles_leave_the_level_free_and_read_the_rise() -> None:
    _, col = np.indices(_SHAPE)
    surface = 0.05 * (col - 10.0)
    held = np.ones((40, 60), bool)
    found = mean_profiles(surface, 0.0, 0.0, _CELL_M, [_STARBOARD], held, 0.1, relative=True)
    assert_allclose(found.matrix @ np.full(surface.size, 7.0), 0.0, atol=1e-12)
    assert_allclose(found.value, 0.05 * np.arange(4, 40, 4), atol=1e-12)


def test_ground_that_is_not_held_gives_no_profile() -> None:
    held = np.ones((40, 60), bool)
    held[:, 20:] = False
    frame = (np.zeros(_SHAPE), 0.0, 0.0, _CELL_M, [_STARBOARD])
    assert mean_profiles(*frame, held, 0.1).matrix.shape == (2, 41 * 61)
    none = mean_profiles(*frame, np.zeros((40, 60), bool), 0.1, relative=True)
    assert none.matrix.shape == (0, 41 * 61) and len(none.value) == 0


def test_looks_from_opposite_sides_are_uncrossed_and_those_at_right_angles_not() -> None:
    """Cell 0 is seen from west and east, cell 1 from west and south, cell 2 from west alone; cell 3 not at all."""
    cell = np.array([0, 0, 1, 1, 2])
    east = np.array([1.0, -2.0, 1.0, 0.0, 3.0])
    north = np.array([0.0, 0.0, 0.0, 1.0, 0.0])
    n = np.zeros(5)
    rows = Rows(
        cell=cell, c_east=east, c_north=north, c_level=n, ratio=n, ground_m=n, drop_m=n, slope=n,
        angle_rad=n, slant_m=n, share=n, samples=n, side=cell, look=cell,
    )  # fmt: skip
    assert uncrossed(rows, (3, 3)).ravel().tolist() == [True, False, True, False]
