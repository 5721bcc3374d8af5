"""One round of registration: the floor that places echoes is of bounded size, however far a survey reaches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapping import rounds
from mapping.rounds import affordable_cell, known_floor
from mapping.survey import correct_survey
from perception.records import ElevationStrip
from tests.mapping.worlds import Drift, World, fly, make_world


def strips_apart(far_m: float) -> list[ElevationStrip]:
    """Three passes over a plane 15 m below, from south-west to north-east, the last `far_m` away on each axis."""
    rng = np.random.default_rng(0)
    world = World(np.full((128, 128), -40.0), np.zeros((128, 128)))
    one = fly(world, [(64.0, 20.0, 0.0, 40.0)], rng, Drift(0.0, 0.0, 0.0), half_swath_m=30.0)[0]
    return [
        replace(one.strip, easting_m=one.strip.easting_m + m, northing_m=one.strip.northing_m + m)
        for m in (0.0, 0.5 * far_m, far_m)
    ]


def test_a_small_survey_keeps_the_cell_that_its_altitude_asks_for() -> None:
    strips = strips_apart(100.0)
    assert affordable_cell(strips, 2.5) == 2.5
    floor = known_floor(strips)
    assert floor is not None and floor.cell_m == pytest.approx(15.0 / 6.0, rel=0.05)


def test_the_floor_of_a_wide_survey_has_wider_cells_and_the_same_height(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At a sixth of the altitude 40 km square would be 256 million cells."""
    strips = strips_apart(40_000.0)
    wide = affordable_cell(strips, 2.5)
    assert wide == pytest.approx(40_000.0 / np.sqrt(rounds._FLOOR_CELLS), rel=0.02)
    monkeypatch.setattr(rounds, "affordable_cell", lambda s, c: affordable_cell(s, c, 40_000))
    floor = known_floor(strips)
    assert floor is not None and floor.elevation_m.size <= 1.02 * 40_000
    there = floor.sample(strips[1].easting_m, strips[1].northing_m)
    np.testing.assert_allclose(there, -40.0, atol=0.5)


def test_any_number_of_threads_finds_the_same_track_to_the_bit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(2)
    legs = [(100.0, 20.0, 0.0, 120.0), (20.0, 80.0, 90.0, 160.0)]
    flown = fly(make_world(rng, size=256), legs, rng, Drift())
    results = []
    for threads in (1, 2, 5):
        monkeypatch.setattr(rounds, "_THREADS", threads)
        results.append(correct_survey([f.strip for f in flown]))
    assert results[0].links
    for other in results[1:]:
        np.testing.assert_array_equal(other.solution.correction_m, results[0].solution.correction_m)
        np.testing.assert_array_equal(
            other.solution.covariance_m2, results[0].solution.covariance_m2
        )
