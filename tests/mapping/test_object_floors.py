"""Objects on ground that is not level: a pass measures them as if it were, the map puts that right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mapping.object_floors import on_floor
from mapping.objects import merge_objects
from perception.object_table import ObjectRow, ObjectTable
from perception.records import FloatArray, Grid
from perception.shadows import crater_depth, hill_height

Height = Callable[[FloatArray], FloatArray]
SONAR_M, FOOT_M, WIDTH_M = 12.0, 20.0, 0.5


def _leaning(x: FloatArray) -> FloatArray:
    return 0.1 * x


def _bent(x: FloatArray) -> FloatArray:
    """Level to 15 m from the track, a slope of 0.12 beyond."""
    return 0.12 * np.maximum(np.abs(x) - 15.0, 0.0)


def _seen(kind: str, floor: Height, side: int) -> ObjectTable:
    """A metre of hill or crater 20 m beside a track northwards, as a pass measures it, by exact rays.

    A hill is a thin wall, its shadow from its top to the floor; a crater's ray grazes the near rim and ends on its floor,
    a metre below the floor around.
    """
    graze = FOOT_M if kind == "hill" else FOOT_M - WIDTH_M
    top = float(floor(np.array(side * graze))) + (kind == "hill")
    fall = (SONAR_M - top) / graze
    x = graze + np.arange(0.001, 20, 0.001)
    ground = floor(side * x) - (kind == "crater")
    hit = int(np.argmax(SONAR_M - fall * x <= ground))
    start = np.hypot(graze, SONAR_M - top)
    stop = np.hypot(x[hit], SONAR_M - ground[hit])
    relation = hill_height if kind == "hill" else crater_depth
    row = ObjectRow(
        easting_m=side * FOOT_M, northing_m=0.0, kind=kind,
        height_m=float(relation(stop - start, start, SONAR_M)), sigma_m=0.7, slant_range_m=float(start),
        shadow_length_m=float(stop - start), pass_index=0, ping=0, across_m=side * FOOT_M, along_m=0.0,
        half_across_m=WIDTH_M, half_along_m=WIDTH_M, drop_m=SONAR_M, floor_sigma_m=0.6,
    )  # fmt: skip
    return ObjectTable.of([row])


def _map(floor: Height, sigma_m: float) -> Grid:
    east = np.arange(-60.0, 60.0, 0.5) + 0.25
    heights = np.tile(-30.0 + floor(east), (40, 1))
    return Grid(heights, -60.0, 10.0, 0.5, sigma_m=np.full(heights.shape, sigma_m))


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("kind", ["hill", "crater"])
def test_a_floor_known_to_bend_gives_the_height_back(kind: str, side: int) -> None:
    table = _seen(kind, _bent, side)
    mended = on_floor(table, _map(_bent, 0.01), np.zeros(1), np.zeros(1))
    # A cell more at the shadow's end leaves a few per cent.
    assert abs(table.height_m[0] - 1) > 0.12
    assert abs(mended.height_m[0] - 1) < 0.06
    assert mended.sigma_m[0] == pytest.approx(np.sqrt(0.7**2 - 0.6**2), rel=0.01)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("kind", ["hill", "crater"])
def test_a_floor_that_leans_evenly_changes_nothing(kind: str, side: int) -> None:
    """Heights above a plane through the floor below the sonar shrink along a ray as those above a level one."""
    table = _seen(kind, _leaning, side)
    mended = on_floor(table, _map(_leaning, 0.01), np.zeros(1), np.zeros(1))
    assert abs(table.height_m[0] - 1) < 0.01
    assert abs(mended.height_m[0] - 1) < 0.06


def test_a_map_no_surer_than_the_pass_moves_it_by_its_share_only() -> None:
    table = _seen("hill", _bent, 1)
    full, half = (on_floor(table, _map(_bent, s), np.zeros(1), np.zeros(1)) for s in (1e-6, 0.5))
    moved = half.height_m - table.height_m, full.height_m - table.height_m
    assert 0.3 < moved[0][0] / moved[1][0] < 0.8
    assert full.sigma_m[0] < half.sigma_m[0] < table.sigma_m[0]


def test_open_shadows_and_unmapped_ground_leave_an_object_alone() -> None:
    table = _seen("hill", _bent, 1)
    far = replace(table, easting_m=np.array([500.0]))
    least = replace(table, lower_bound=np.array([True]))
    for one in (far, least):
        assert_allclose(
            on_floor(one, _map(_bent, 0.01), np.zeros(1), np.zeros(1)).height_m, one.height_m
        )
    bare = replace(_map(_bent, 0.01), sigma_m=None)
    assert on_floor(table, bare, np.zeros(1), np.zeros(1)) is table


@pytest.mark.parametrize("kind", ["hill", "crater"])
def test_the_errors_of_a_maps_floor_stay_within_the_claimed_sigma(kind: str) -> None:
    """Maps that err from place to place, each told its sigma: by what the heights scatter, the table says so."""
    rng, sigma_m, heights, claimed = np.random.default_rng(3), 0.2, [], []
    # A pass that knows nothing of its floor: all of it is the map's.
    table = replace(_seen(kind, _bent, 1), floor_sigma_m=np.array([50.0]))
    table = replace(table, sigma_m=np.array([50.0]), height_m=table.height_m + 5.0)
    true = _map(_bent, sigma_m)
    east = np.arange(true.shape[1])[None, :] * true.cell_m
    for _ in range(300):
        # Waves of some metres: alike around one object, independent of what is below the sonar and at the end.
        wave = sum(
            sigma_m / np.sqrt(4) * np.sqrt(2) * np.sin(east / k + rng.uniform(0, 2 * np.pi))
            for k in rng.uniform(3.0, 6.0, 4)
        )
        noisy = replace(true, elevation_m=true.elevation_m + wave)
        mended = on_floor(table, noisy, np.zeros(1), np.zeros(1))
        heights.append(mended.height_m[0])
        claimed.append(mended.floor_sigma_m[0])
    scatter = np.std(heights) / np.mean(claimed)
    assert 0.3 < scatter < 1.15, scatter


def test_what_lies_below_the_sonar_counts_in_the_sigma() -> None:
    table = replace(
        _seen("hill", _bent, 1), floor_sigma_m=np.array([50.0]), sigma_m=np.array([60.0])
    )
    good = _map(_bent, 0.01)
    assert good.sigma_m is not None
    poor = good.sigma_m.copy()
    poor[:, np.abs(good.centres()[0]) < 2.0] = 1.0
    share = float(table.slant_range_m[0] / (table.slant_range_m + table.shadow_length_m)[0])
    mended = on_floor(table, replace(good, sigma_m=poor), np.zeros(1), np.zeros(1))
    assert mended.floor_sigma_m[0] == pytest.approx(1.0 - share, rel=0.1)


def test_passes_over_one_map_share_its_error() -> None:
    one = replace(_seen("hill", _bent, 1), sigma_m=np.array([0.5]), floor_sigma_m=np.array([0.4]))
    tables = [one, replace(one, pass_index=np.array([1])), replace(one, pass_index=np.array([2]))]
    apart, shared = merge_objects(tables), merge_objects(tables, one_floor=True)
    assert len(shared) == 1
    assert_allclose(shared.height_m, apart.height_m)
    assert apart.sigma_m[0] == pytest.approx(0.5 / np.sqrt(3))
    assert shared.sigma_m[0] == pytest.approx(np.sqrt(0.3**2 / 3 + 0.4**2))
