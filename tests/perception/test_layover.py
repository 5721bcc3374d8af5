"""Two surfaces at one range: flagged where they are, and settled by a look from elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose

from perception.layover import candidates, layover_cells, settled
from perception.quality import CellFlag
from perception.records import FloatArray
from perception.strips import build_strip
from tests.perception.echo_fixtures import Height, Survey, box, make_swath

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


def test_a_sample_in_the_fold_has_the_floor_the_wall_and_the_top_as_candidates() -> None:
    starboard = ACROSS > 0
    x = ACROSS[starboard]
    found = candidates(12.2, _block(x), x, 8.0)
    # Floor at sqrt(12.2^2 - 8^2), wall at 10, top at sqrt(12.2^2 - 6^2).
    assert_allclose(found, [9.211, 10.0, 10.623], atol=0.06)
    assert_allclose(candidates(10.0, _block(x), x, 8.0), [6.0], atol=0.01)


def test_clear_looks_settle_what_others_leave_open() -> None:
    nan = np.nan
    height = np.array([[2.0, 2.0, 0.1, 1.0, nan], [0.0, nan, 0.0, 3.0, nan]])
    sigma = np.full((2, 5), 0.1)
    ambiguous = np.array([[True, True, True, True, False], [False, False, False, True, False]])
    mean, spread, clear = settled(height, sigma, ambiguous)
    # Contradicted; the only look; one that agrees and joins; two that dispute; none.
    assert_allclose(mean, [0.0, 2.0, 0.05, 2.0, nan])
    assert_allclose(spread[:3], [0.1, 0.1, 0.1 / np.sqrt(2)])
    assert spread[3] > 0.9 and np.isnan(spread[4])
    assert list(clear) == [True, False, True, False, False]


def test_two_passes_on_either_side_of_a_block_settle_each_other() -> None:
    survey = Survey(n_pings=120, n_samples=500)
    block: Height = box(1.5, 16, 15, 1.0, 1.5)
    looks = []
    for side in (1, -1):
        # The second pass runs 32 m to the east and sees the block's other wall, to port.
        ground: Height = block if side > 0 else lambda x, y: block(x + 32, y)
        swath = make_swath(ground, survey, np.random.default_rng(7))
        looks.append(build_strip(replace(swath, pass_index=int(side < 0))).strip)
    line = int(np.argmin(np.abs(looks[0].northing_m - looks[0].northing_m[0] - 15)))
    place = np.arange(12.0, 20.0, 0.25)
    rows = []
    for strip, offset in zip(looks, (0.0, 32.0), strict=True):
        order = np.clip(np.searchsorted(strip.across_m, place - offset), 0, len(strip.across_m) - 1)
        assert strip.flags is not None
        flags = (strip.flags[line, order] & CellFlag.AMBIGUOUS) > 0
        rows.append((strip.elevation_m[line, order], strip.sigma_m[line, order], flags))
    near, far = rows[0][2], rows[1][2]
    # Each look is ambiguous on its own side of the block only.
    assert near[place < 15].any() and not near[place > 17.5].any()
    assert far[place > 17.0].any() and not far[place < 14.5].any()
    height, sigma, clear = settled(*(np.array(part) for part in zip(*rows, strict=True)))
    assert clear[place < 14].all() and clear[place > 18].all()
    floor = (place < 14) | (place > 18)
    assert np.all(np.abs(height[floor] + 30.0) < 4 * sigma[floor] + 0.2)
