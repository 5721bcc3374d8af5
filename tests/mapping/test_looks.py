"""Ambiguous looks: settled by a pass that saw the place clearly, and by no guess made in a shadow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose

from mapping.flag_layer import NO_FLAGS, map_flags
from mapping.fusion import combine, fuse
from mapping.placed import PassRaster
from perception.quality import CellFlag
from perception.records import BoolArray, ElevationStrip, FloatArray, Grid
from perception.strips import build_strip
from tests.mapping.worlds import Drift, World, fly
from tests.perception.echo_fixtures import Height, Survey, box, make_swath


def _raster(heights: list[float], ambiguous: list[bool]) -> PassRaster:
    height = np.array([heights])
    known = np.where(np.isfinite(height), 0.01, np.nan)
    return PassRaster(
        0,
        0,
        height,
        known,
        np.zeros_like(height),
        np.ones_like(height),
        np.array([ambiguous]),
        ~np.array([ambiguous]),
    )


def test_clear_looks_settle_what_others_leave_open() -> None:
    nan = np.nan
    one = _raster([2.0, 2.0, 0.1, 1.0, nan], [True, True, True, True, False])
    other = _raster([0.0, nan, 0.0, 3.0, nan], [False, False, False, True, False])
    mean, sigma, count = combine([one, other], (1, 5), 1.0)
    # Contradicted; the only look; one that agrees and joins; two that dispute; none.
    assert_allclose(mean[0], [0.0, 2.0, 0.05, 2.0, nan])
    assert_allclose(sigma[0, :3], [0.1, 0.1, 0.1 / np.sqrt(2)])
    assert sigma[0, 3] > 0.9 and np.isnan(sigma[0, 4])
    assert_allclose(count[0], [1, 1, 2, 2, 0])


def test_a_guess_in_shadow_neither_settles_nor_clears() -> None:
    ambiguous, guess, other = (
        _raster([h], [a]) for h, a in ((2.0, True), (0.5, False), (0.0, False))
    )
    guess = replace(guess, clear=np.array([[False]]))
    mean, sigma, _ = combine([ambiguous, guess], (1, 1), 1.0)
    assert_allclose(mean, [[1.25]])
    assert sigma[0, 0] > 0.7
    # Who saw it puts the ambiguous look out; the guess stands as a look of its own sigma.
    mean, _, count = combine([ambiguous, guess, other], (1, 1), 1.0)
    assert_allclose(mean, [[0.25]])
    assert_allclose(count, [[2]])


def _planted() -> list[ElevationStrip]:
    """Three passes over a level floor, a strip of it seen folded (1.5 m too high), in shadow (0.4 m), and clearly."""
    world = World(np.full((256, 256), -40.0), np.zeros((256, 256)))
    legs = [(100.0 + k, 20.0, 0.0, 60.0) for k in range(3)]
    still = Drift(0.0, 0.0, 0.0)
    flown = fly(world, legs, np.random.default_rng(0), still, half_swath_m=20.0)
    strips = []
    for number, (f, wrong_m, flag) in enumerate(
        zip(flown, (1.5, 0.4, 0.0), (CellFlag.AMBIGUOUS, CellFlag.SHADOW, None), strict=True)
    ):
        strip = f.strip
        block = np.abs(strip.across_m + number - 10.0) < 2.5
        flags = np.zeros(strip.echo.shape, np.uint8)
        flags[:, block] = 0 if flag is None else flag.value
        height = strip.elevation_m + np.where(block, np.float32(wrong_m), np.float32(0))
        strips.append(replace(strip, elevation_m=height, flags=flags))
    return strips


def _error(grid: Grid, east_m: float) -> float:
    inside = np.abs(grid.centres()[0] - east_m) < 1.5
    return float(np.nanmean(np.abs(grid.elevation_m[:, inside] + 40.0)))


def test_only_a_pass_that_heard_the_ground_settles_it() -> None:
    strips = _planted()
    east = float(strips[0].easting_m[0]) + 10.0
    two, three = fuse(strips[:2], 1.0), fuse(strips, 1.0)
    bare = [replace(strip, flags=None) for strip in strips]
    inside = np.abs(two.centres()[0] - east) < 1.5
    # Folded to one and dark to the other: the two stand as they are, and the place stays ambiguous.
    assert _error(two, east) == _error(fuse(bare[:2], 1.0), east)
    assert (map_flags(strips[:2], two)[:, inside] == CellFlag.AMBIGUOUS).mean() > 0.9
    assert _error(three, east) < 0.6 * _error(fuse(bare, 1.0), east)
    known = map_flags(strips, three)[:, np.abs(three.centres()[0] - east) < 1.5]
    assert not (known[known != NO_FLAGS] & CellFlag.AMBIGUOUS).any()


def _from_west_and_east() -> list[ElevationStrip]:
    """A block at 16 m seen by two passes, 32 m apart, from either side: each has the other's front in shadow."""
    survey = Survey(n_pings=120, n_samples=500)
    block: Height = box(1.5, 16, 15, 1.0, 1.5)
    looks = []
    for index, offset in enumerate((0.0, 32.0)):

        def seen(x: FloatArray, y: FloatArray, east_m: float = offset) -> FloatArray:
            return block(x + east_m, y)

        strip = build_strip(make_swath(seen, survey, np.random.default_rng(1))).strip
        looks.append(replace(strip, easting_m=strip.easting_m + offset, pass_index=index))
    return looks


def test_ground_in_front_of_a_block_stays_open_when_the_other_pass_has_it_in_shadow() -> None:
    looks = _from_west_and_east()
    both = fuse(looks, 0.5)
    blind = fuse([replace(look, flags=None) for look in looks], 0.5)
    folded = CellFlag.AMBIGUOUS.value

    def open_(some: list[ElevationStrip]) -> BoolArray:
        flags = map_flags(some, both)
        return ((flags & folded) > 0) & (flags != NO_FLAGS)

    first = open_(looks[:1])
    assert first.any() and open_(looks)[first].mean() > 0.7
    # Away from what is ambiguous nothing changes.
    calm = np.abs(both.centres()[0] - looks[0].easting_m[0] - 16) > 6
    assert_allclose(both.elevation_m[:, calm], blind.elevation_m[:, calm])
