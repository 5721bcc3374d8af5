"""Objects on ground that is not level: a pass measures them as if it were, the map puts that right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mapping.object_floors import on_floor
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
