"""Flags on the map: what most data of a cell bear, the same in tiles and in one piece, readable as bits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import rasterio

from mapping.flag_layer import (
    NO_FLAGS,
    flag_figures,
    flagged_cells,
    map_flags,
    rows_of,
    vote,
    write_flags,
)
from mapping.fusion import fuse
from mapping.gridding import Window
from mapping.placed import boxes, placed
from perception.quality import CellFlag
from perception.records import ElevationStrip
from tests.mapping.worlds import Drift, World, fly


def passes(number: int = 1) -> list[ElevationStrip]:
    """Passes over one line, each a metre farther east; no flags yet."""
    world = World(np.full((256, 256), -40.0), np.zeros((256, 256)))
    legs = [(100.0 + k, 20.0, 0.0, 60.0) for k in range(number)]
    still = Drift(0.0, 0.0, 0.0)
    flown = fly(world, legs, np.random.default_rng(0), still, half_swath_m=20.0)
    return [replace(f.strip, flags=np.zeros(f.strip.echo.shape, np.uint8)) for f in flown]


def test_a_flag_lies_where_the_strip_has_it_and_ground_without_data_has_none() -> None:
    strip = passes()[0]
    strip.flags[:, strip.across_m > 10.0] = CellFlag.SHADOW | CellFlag.TURNING
    grid = fuse([strip], 1.0)
    grid = replace(
        grid, elevation_m=np.where(np.arange(grid.shape[0])[:, None] < 5, np.nan, grid.elevation_m)
    )
    flags = map_flags([strip], grid)
    east, _ = grid.centres()
    away = east - strip.easting_m[0]
    inside = np.isfinite(grid.elevation_m)
    assert (flags[~inside] == NO_FLAGS).all()
    right, left = (np.broadcast_to(m, grid.shape) & inside for m in (away > 11.0, away < 9.0))
    assert (flags[right] == CellFlag.SHADOW | CellFlag.TURNING).all() and right.any()
    assert (flags[left] == 0).all() and left.any()
    cells = flagged_cells(flags)
    assert cells["shadow"] == cells["turning"] > 0 and cells["no_bottom"] == 0
    assert 0.2 < flag_figures(cells, int(inside.sum()))["flag_shadow_share"] < 0.3


def test_what_one_pass_sees_badly_and_two_see_well_bears_no_flag() -> None:
    strips = passes(3)
    strips[0].flags[:] = CellFlag.SHADOW
    flags = map_flags(strips, fuse(strips, 1.0))
    assert (flags == CellFlag.SHADOW).mean() < 0.05
    strips[1].flags[:] = CellFlag.SHADOW
    flags = map_flags(strips, fuse(strips, 1.0))
    assert (flags == CellFlag.SHADOW).mean() > 0.9


def test_votes_of_a_window_are_those_of_the_whole() -> None:
    strip = passes()[0]
    strip.flags[::3, ::2] = CellFlag.HIGHLIGHT
    one = placed(strip)
    grid = fuse([strip], 0.7)
    whole = Window(round(grid.south_m / 0.7), round(grid.west_m / 0.7), *grid.shape)
    part = Window(whole.row + 20, whole.col + 11, 30, 25)
    counts = []
    for window in (whole, part):
        counts.append(vote(one, rows_of(strip), boxes(one, 0.7), 0.7, window))
    np.testing.assert_array_equal(counts[0][part.within(whole)], counts[1])
    assert counts[1][..., 0].min() > 0


def test_the_file_says_what_its_bits_mean(tmp_path: Path) -> None:
    strip = passes()[0]
    strip.flags[:] = CellFlag.SATURATED
    grid = fuse([strip], 1.0)
    write_flags(tmp_path / "flags.tif", map_flags([strip], grid), grid)
    with rasterio.open(tmp_path / "flags.tif") as raster:
        assert raster.dtypes == ("uint8",) and raster.nodata == NO_FLAGS
        assert raster.descriptions == ("flags",)
        assert raster.tags()["FLAG_4"] == "saturated" and raster.tags()["FLAG_8"] == "shadow"
        assert set(np.unique(raster.read(1))) <= {CellFlag.SATURATED, NO_FLAGS}
