"""Ambiguous looks: a planted block seen from two sides, settled by the pass that saw each place clearly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose

from mapping.flag_layer import map_flags
from mapping.fusion import combine, fuse
from mapping.placed import PassRaster
from perception.quality import CellFlag
from perception.records import ElevationStrip
from perception.strips import build_strip
from tests.perception.echo_fixtures import Height, Survey, box, make_swath


def _raster(heights: list[float], ambiguous: list[bool]) -> PassRaster:
    height = np.array([heights])
    known = np.where(np.isfinite(height), 0.01, np.nan)
    return PassRaster(
        0, 0, height, known, np.zeros_like(height), np.ones_like(height), np.array([ambiguous])
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


def _moved(ground: Height, east_m: float) -> Height:
    return lambda x, y: ground(x + east_m, y)


def _two_looks() -> list[ElevationStrip]:
    """A block at 16 m seen by two passes, 32 m apart, from either side."""
    survey = Survey(n_pings=120, n_samples=500)
    block: Height = box(1.5, 16, 15, 1.0, 1.5)
    looks = []
    for index, offset in enumerate((0.0, 32.0)):
        strip = build_strip(
            make_swath(_moved(block, offset), survey, np.random.default_rng(1))
        ).strip
        looks.append(replace(strip, easting_m=strip.easting_m + offset, pass_index=index))
    return looks


def test_two_passes_on_either_side_of_a_block_settle_each_other() -> None:
    looks = _two_looks()
    east = looks[0].easting_m[0]
    both = fuse(looks, 0.5)
    blind = fuse([replace(look, flags=None) for look in looks], 0.5)
    alone = map_flags(looks[:1], both) != 255
    folded = CellFlag.AMBIGUOUS.value
    first = ((map_flags(looks[:1], both) & folded) > 0) & alone
    open_ = ((map_flags(looks, both) & folded) > 0) & (map_flags(looks, both) != 255)
    # What one pass leaves open in front of the block the other settles.
    assert first.any() and open_.sum() < 0.3 * first.sum()
    x, y = both.centres()
    truth = box(1.5, 16, 15, 1.0, 1.5)(*np.meshgrid(x - east, y - looks[0].northing_m[0])) - 30.0
    near = first & ~open_
    error = {
        name: np.abs(grid.elevation_m - truth)[near]
        for name, grid in (("settled", both), ("blind", blind))
    }
    assert np.mean(error["settled"]) <= np.mean(error["blind"])
    # Away from what is ambiguous nothing changes.
    flagged = [(look.flags & folded) > 0 for look in looks if look.flags is not None]
    assert all(flag.any() for flag in flagged)
    calm = np.abs(x - east - 16) > 6
    assert_allclose(both.elevation_m[:, calm], blind.elevation_m[:, calm])
