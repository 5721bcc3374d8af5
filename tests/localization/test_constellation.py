"""Patches placed by their constellation of peaks and pits, and later soundings as witness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from localization.constellation import Constellation, turned
from localization.landmarks import Landmarks, find_landmarks
from localization.particles import ParticleFilter
from localization.terrain import TerrainMap, terrain_map
from localization.witness import Opinion, opinion_of
from perception.records import FloatArray, Grid

SIDE_M = 3000.0
_COLUMNS = ("easting_m", "northing_m", "kind", "strength_per_m", "size_m")


def strewn(number: int, rng: np.random.Generator) -> Landmarks:
    """Landmarks at random over a square of 3 km, as of a map smoothed at 20 m."""
    return Landmarks(
        easting_m=rng.uniform(0, SIDE_M, number),
        northing_m=rng.uniform(0, SIDE_M, number),
        kind=rng.choice([1, 2], number),
        strength_per_m=np.exp(rng.normal(-6, 0.5, number)),
        size_m=np.exp(rng.normal(3.2, 0.4, number)),
        scale_m=20.0,
        area_m2=SIDE_M**2,
    )


def seen(
    marks: Landmarks, at: tuple[float, float], turn: float, side_m: float, rng: np.random.Generator
) -> Landmarks:
    """What a patch at a place and turn shows of them, in its own axes, errors of 5 m added."""
    places = np.stack([marks.easting_m - at[0], marks.northing_m - at[1]], axis=1)
    own = turned(places, np.full(len(marks), -turn)) + rng.normal(0, 5, (len(marks), 2))
    use = np.all(np.abs(own) < side_m / 2, axis=1) & (rng.random(len(marks)) > 0.2)

    def noisy(values: FloatArray) -> FloatArray:
        return np.asarray(values[use] * np.exp(rng.normal(0, 0.2, int(use.sum()))))

    return Landmarks(
        own[use, 0], own[use, 1], marks.kind[use], noisy(marks.strength_per_m),
        noisy(marks.size_m), 20.0, side_m**2,
    )  # fmt: skip


@pytest.mark.parametrize("known", [True, False])
def test_a_turned_patch_is_placed_and_its_error_is_as_claimed(known: bool) -> None:
    rng = np.random.default_rng(0)
    marks = strewn(900, rng)
    constellation = Constellation(Landmarks.unpacked(marks.packed()))
    squares = []
    for turn in (0.0, 1.1, 2.9, 5.0):
        at = (rng.uniform(500, 2500), rng.uniform(500, 2500))
        result = constellation.match(seen(marks, at, turn, 500.0, rng), turn if known else None)
        assert result.accepted, result.reason
        best = result.hypotheses[0]
        off = np.array([best.easting_m - at[0], best.northing_m - at[1]])
        assert np.hypot(*off) < 12.0
        assert abs((best.turn_rad - turn + np.pi) % (2 * np.pi) - np.pi) < 0.05
        squares.append(float(off @ np.linalg.solve(best.covariance[:2, :2], off)))
    # Two are expected of each; the four together stay below the 99.9 % point of eight.
    assert sum(squares) < 26.1


def test_landmarks_of_elsewhere_are_not_accepted() -> None:
    rng = np.random.default_rng(1)
    constellation = Constellation(strewn(900, rng))
    other = strewn(900, rng)
    for _ in range(5):
        result = constellation.match(seen(other, (1500, 1500), 0.4, 500.0, rng))
        assert not result.accepted
        assert result.reason


def test_a_patch_that_is_in_the_map_twice_is_ambiguous() -> None:
    rng = np.random.default_rng(2)
    one = strewn(900, rng)
    twice = Landmarks(
        np.concatenate([one.easting_m, one.easting_m + SIDE_M]), np.tile(one.northing_m, 2),
        np.tile(one.kind, 2), np.tile(one.strength_per_m, 2), np.tile(one.size_m, 2), 20.0,
        2 * SIDE_M**2,
    )  # fmt: skip
    patch = seen(one, (1500, 1500), 0.4, 500.0, rng)
    result = Constellation(twice).match(patch)
    assert not result.accepted
    assert "ambiguous" in result.reason
    first, second = result.hypotheses[:2]
    assert abs(first.easting_m - second.easting_m) == pytest.approx(SIDE_M, abs=5.0)


def test_too_few_landmarks_say_so() -> None:
    rng = np.random.default_rng(3)
    marks = strewn(900, rng)
    few = seen(marks, (1500, 1500), 0.0, 30.0, rng)
    assert "too few" in Constellation(marks).match(few).reason


def test_a_packed_landmark_takes_eight_bytes_and_comes_back() -> None:
    marks = strewn(500, np.random.default_rng(4))
    data = marks.packed()
    assert len(data) == 40 + 8 * 500
    back = Landmarks.unpacked(data)
    # A tenth of the scale is the step of place; 2^(1/16) and 2^(1/4000) of size and strength.
    np.testing.assert_allclose(back.easting_m, marks.easting_m, atol=1.01)
    np.testing.assert_allclose(back.size_m, marks.size_m, rtol=0.05)
    np.testing.assert_allclose(back.strength_per_m, marks.strength_per_m, rtol=1e-3)


def test_packing_keeps_wide_maps_strong_hills_and_none_at_all() -> None:
    marks = strewn(50, np.random.default_rng(5))
    wide = replace(
        marks, easting_m=1000.0 * marks.easting_m, strength_per_m=1e6 * marks.strength_per_m,
        size_m=1e9 * marks.size_m,
    )  # fmt: skip
    back = Landmarks.unpacked(wide.packed())
    # The step is the extent over what 16 bits count; what no byte holds is held at its end.
    step = np.ptp(wide.easting_m) / 65_535
    np.testing.assert_allclose(back.easting_m, wide.easting_m, atol=0.51 * step)
    assert (back.strength_per_m == 1.0).all() and np.ptp(back.size_m) == 0
    none = Landmarks.unpacked(replace(marks, **{n: np.zeros(0) for n in _COLUMNS}).packed())
    assert len(none) == 0 and none.scale_m == 20.0
    assert "too few" in Constellation(none).match(marks).reason


def test_landmarks_of_a_surface_are_its_hills_and_hollows_clear_of_the_border() -> None:
    x = (np.arange(100) + 0.5) * 5.0
    easting, northing = np.meshgrid(x, x[::-1])
    hills = [(150.0, 150.0, 4.0), (350.0, 200.0, 4.0), (250.0, 380.0, -4.0), (495.0, 250.0, 4.0)]
    height = sum(
        a * np.exp(-((easting - e) ** 2 + (northing - n) ** 2) / (2 * 40.0**2)) for e, n, a in hills
    )
    marks = find_landmarks(Grid(np.asarray(height), 0.0, 500.0, 5.0))
    for e, n, a in hills[:3]:
        near = np.hypot(marks.easting_m - e, marks.northing_m - n) < 10.0
        assert list(marks.kind[near]) == [1 if a > 0 else 2]
    # The last hill is cut by the border.
    assert not np.any(np.hypot(marks.easting_m - 495, marks.northing_m - 250) < 30)


def flat() -> TerrainMap:
    return terrain_map(Grid(np.zeros((40, 40)), 0.0, 200.0, 5.0, "", np.full((40, 40), 0.1)))


@pytest.mark.parametrize(
    ("at", "sigma", "said"),
    [
        ((0.0, 0.0), 5.0, Opinion.CONFIRMS),
        ((80.0, 0.0), 5.0, Opinion.CONTRADICTS),
        ((80.0, 0.0), 60.0, Opinion.OPEN),
    ],
)
def test_a_witness_confirms_contradicts_or_does_not_know(
    at: tuple[float, float], sigma: float, said: Opinion
) -> None:
    witness = ParticleFilter(flat(), 2000, np.random.default_rng(5))
    spread = np.diag([sigma, sigma, 0.01, 0.005, 1.0]) ** 2
    # The search starts with half of its cloud three times as wide, weighted to match.
    witness.start(np.array([*at, 0.0, 0.0, 0.0]), spread)
    place = np.diag([3.0, 3.0, 0.01, 0.005, 1.0]) ** 2
    assert opinion_of(witness, np.zeros(5), place, 12.0) is said
