"""One round of registration: the floor that places echoes is of bounded size, however far a survey reaches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapping import rounds
from mapping.rounds import affordable_cell, known_floor
from perception.records import ElevationStrip
from tests.mapping.worlds import Drift, World, fly


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
