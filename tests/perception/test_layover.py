"""Two surfaces at one range: flagged where they are, and settled by a look from elsewhere."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from perception.layover import layover_cells
from perception.records import FloatArray

ACROSS = (np.arange(-400, 400) + 0.5) * 0.05
SAMPLE = 0.05


def _block(x: FloatArray) -> FloatArray:
    """Return a block 2 m high from 10 to 12 m to starboard, its walls one cell wide."""
    return np.where((x > 10) & (x < 12), 2.0, 0.0)


def test_a_wall_that_faces_the_sonar_lies_over_the_floor_before_it_and_nothing_else() -> None:
    flags = layover_cells(_block(ACROSS)[None, :], ACROSS, np.array([8.0]), SAMPLE)[0]
    # Sonar 8 m up: the block's near edge is hypot(10, 6) = 11.66 m away, as is the floor at 8.49 m.
    x, first = ACROSS, float(np.sqrt(100 + 36 - 64))
    floor = (x > first + 0.15) & (x < 9.9)
    assert flags[floor].all()
    assert not flags[(x > 0) & (x < first - 0.15)].any()
    # The wall's foot is hypot(10, 8) = 12.81 m away, as is the block's top at 11.32 m.
    top = (x > 10.1) & (x < np.sqrt(164 - 36) - 0.15)
    assert flags[top].all()
    assert not flags[ACROSS < 0].any() and not flags[ACROSS > 12].any()


def test_a_gentle_hill_and_ground_in_shadow_are_not_ambiguous() -> None:
    gentle = 1.0 * np.exp(-0.5 * ((ACROSS - 12) / 3) ** 2)
    assert not layover_cells(gentle[None, :], ACROSS, np.array([8.0]), SAMPLE).any()
    assert not layover_cells(np.full((1, 800), np.nan), ACROSS, np.array([8.0]), SAMPLE).any()


def test_mirroring_the_ground_mirrors_the_flags() -> None:
    one = layover_cells(_block(ACROSS)[None, :], ACROSS, np.array([8.0]), SAMPLE)
    other = layover_cells(_block(ACROSS)[None, ::-1], ACROSS, np.array([8.0]), SAMPLE)
    assert_allclose(other, one[:, ::-1])
