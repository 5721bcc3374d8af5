"""Least heights at one swath's edge: overruled where others saw plain ground, kept wherever a boulder may stand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from mapping.fusion import fuse
from mapping.object_layer import read_objects
from mapping.objects import MergedObjects, merge_objects, write_objects
from mapping.overruled import overruled
from perception.object_table import ObjectRow, ObjectTable
from perception.quality import CellFlag
from perception.records import ElevationStrip, Grid
from tests.mapping.worlds import CRS, Drift, World, fly

RADIUS_M, LEAST_M = 2.0, 1.5


def _passes() -> list[ElevationStrip]:
    world = World(np.full((256, 256), -40.0), np.zeros((256, 256)))
    legs = [(100.0 + k, 20.0, 0.0, 60.0) for k in range(3)]
    still = Drift(0.0, 0.0, 0.0)
    flown = fly(world, legs, np.random.default_rng(0), still, half_swath_m=20.0)
    return [replace(f.strip, flags=np.zeros(f.strip.echo.shape, np.uint8)) for f in flown]


def _place(strips: list[ElevationStrip]) -> tuple[float, float]:
    return float(strips[0].easting_m[0]) + 8.0, float(np.median(strips[0].northing_m))


def _merged(
    strips: list[ElevationStrip], seen_by: tuple[int, ...] = (0,), radius_m: float = RADIUS_M
) -> tuple[MergedObjects, np.ndarray]:
    east, north = _place(strips)
    tables = [
        ObjectTable.of([
            ObjectRow(
                easting_m=east, northing_m=north, kind="hill", height_m=LEAST_M, sigma_m=0.7 * LEAST_M,
                slant_range_m=45.0, shadow_length_m=3.0, pass_index=k, ping=0, across_m=8.0, along_m=0.0,
                half_across_m=radius_m, half_along_m=radius_m, lower_bound=True,
            )
        ] if k in seen_by else [])
        for k in range(len(strips))
    ]  # fmt: skip
    owner = np.repeat(np.arange(len(strips)), [len(t) for t in tables])
    return merge_objects(tables), owner


def _overruled(strips: list[ElevationStrip], grid: Grid | None = None, **more: object) -> bool:
    merged, owner = _merged(strips, **more)  # type: ignore[arg-type]
    assert len(merged) == 1
    found = fuse(strips, 0.5) if grid is None else grid
    return bool(overruled(merged, owner, found, strips)[0])


def test_two_passes_that_heard_plain_ground_overrule_a_third_ones_open_shadow() -> None:
    assert _overruled(_passes())


def test_a_second_look_at_it_keeps_it() -> None:
    assert not _overruled(_passes(), seen_by=(0, 2))


def test_ground_that_the_others_did_not_hear_keeps_it() -> None:
    for flag in (CellFlag.SHADOW, CellFlag.AMBIGUOUS):
        strips = _passes()
        strips[1].flags[:] = flag
        assert not _overruled(strips)
    strips = _passes()
    assert not _overruled([strips[0], strips[1], replace(strips[2], flags=None)])


def test_a_boulder_that_the_map_shows_is_kept_though_smoothed() -> None:
    strips = _passes()
    grid = fuse(strips, 0.5)
    east, north = _place(strips)
    x, y = np.meshgrid(*grid.centres())
    # Two thirds of its height are left, beside its stated place.
    bump = 0.67 * 1.2 * LEAST_M * np.exp(-0.5 * ((x - east - 1.0) ** 2 + (y - north) ** 2))
    assert not _overruled(strips, replace(grid, elevation_m=grid.elevation_m + bump))


def test_what_the_map_cannot_show_or_does_not_know_is_kept() -> None:
    strips = _passes()
    grid = fuse(strips, 0.5)
    assert grid.sigma_m is not None
    assert not _overruled(strips, grid, radius_m=0.8)
    assert not _overruled(strips, replace(grid, sigma_m=grid.sigma_m + LEAST_M))
    assert not _overruled(strips, replace(grid, sigma_m=None))
    east, _ = _place(strips)
    hole = np.abs(grid.centres()[0] - east) < 1.0
    assert not _overruled(
        strips, replace(grid, elevation_m=np.where(hole, np.nan, grid.elevation_m))
    )


def test_planning_takes_no_overruled_object(tmp_path: Path) -> None:
    merged, _ = _merged(_passes())
    grid = Grid(np.zeros((4, 4)), -2.0, 2.0, 0.5, crs=CRS)
    for mark in (False, True):
        path = tmp_path / f"{mark}.gpkg"
        write_objects(path, replace(merged, overruled=np.array([mark])), CRS)
        assert len(read_objects(path, grid).height_m) == (0 if mark else 1)
    csv = tmp_path / "objects.csv"
    csv.write_text("easting_m,northing_m,height_m,overruled\n1,1,2,1\n2,1,3,\n3,1,4,False\n")
    assert read_objects(csv, grid).height_m.tolist() == [3.0, 4.0]
