"""A pitched fan: where it looks is where a ray square to the array meets the floor."""

from __future__ import annotations

import numpy as np
import pytest

from perception.attitude import levelled, usable_pitch
from perception.records import FloatArray, Swath


def swath(pitch_rad: FloatArray, heading_rad: float = 0.3) -> Swath:
    n = len(pitch_rad)
    one, echoes = np.ones(n), np.ones((n, 4), np.float32)
    return Swath(
        time_s=np.arange(n, dtype=float), ping=np.arange(n), easting_m=100.0 * one,
        northing_m=200.0 * one, depth_m=30.0 * one, heading_rad=heading_rad * one,
        pitch_rad=pitch_rad, roll_rad=0.0 * one, altitude_hint_m=np.nan * one, sample_m=0.1 * one,
        port=echoes, starboard=echoes, sound_speed_m_s=1500.0 * one, crs="EPSG:32630",
    )  # fmt: skip


def test_the_level_sonar_hears_the_same_slant_ranges_on_a_level_floor() -> None:
    """Rays in the tilted plane, cast by hand, against the level sonar's ranges to the same points."""
    pitch = np.radians([-6.0, 0.0, 2.0, 9.0])
    altitude = 15.0
    slant = altitude / np.cos(pitch)
    level, lead = levelled(swath(pitch), slant)
    np.testing.assert_allclose(lead, altitude * np.tan(pitch), atol=1e-9)
    for across in (-40.0, 0.0, 25.0):
        # A point of the plane square to the array, on the floor: `lead` ahead, `across` aside.
        true_range = np.sqrt(lead**2 + across**2 + altitude**2)
        drop = altitude + 30.0 - level.depth_m
        np.testing.assert_allclose(np.hypot(across, drop), true_range, atol=1e-9)
    np.testing.assert_allclose(level.easting_m - 100.0, lead * np.sin(0.3))
    np.testing.assert_allclose(level.northing_m - 200.0, lead * np.cos(0.3))


def test_levelling_twice_changes_nothing_more() -> None:
    once, _ = levelled(swath(np.full(5, 0.1)), np.full(5, 15.0))
    twice, lead = levelled(once, np.full(5, 15.0))
    np.testing.assert_array_equal(twice.easting_m, once.easting_m)
    np.testing.assert_array_equal(lead, 0.0)


def test_a_bottom_that_is_lost_for_a_while_is_bridged() -> None:
    first = np.array([15.0, np.nan, 17.0])
    _, lead = levelled(swath(np.full(3, 0.1)), first)
    assert lead[1] == pytest.approx(16.0 * np.sin(0.1))


def test_a_column_that_cannot_be_pitch_is_left_alone() -> None:
    np.testing.assert_array_equal(usable_pitch(np.full(20, 1.2)), 0.0)
    np.testing.assert_array_equal(usable_pitch(np.array([np.nan, 0.1])), [0.0, 0.1])
