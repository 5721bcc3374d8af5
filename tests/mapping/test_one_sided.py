"""Ground seen from both sides is left alone; ground seen from one side keeps the soundings' broad shape."""

import numpy as np

from mapping.one_sided import hold_one_sided, look_balance
from perception.records import ElevationStrip, Grid


def _strip(northing_m: float, heading_rad: float = np.pi / 2, reach_m: float = 30.0):
    n = 61
    across = np.arange(-reach_m + 0.5, reach_m)
    shape = (n, len(across))
    one = np.ones(n)
    return ElevationStrip(
        np.zeros(shape), np.ones(shape), across, np.ones(shape), np.zeros(shape, bool),
        np.arange(n, dtype=float), np.arange(n), np.linspace(0.0, 60.0, n), northing_m * one,
        10 * one, heading_rad * one, 10 * one, 0.1 * one, "EPSG:32630",
    )  # fmt: skip


def _grid(heights, sigma):
    return Grid(heights, 0.0, 80.0, 1.0, sigma_m=np.full(heights.shape, sigma))


def test_opposite_looks_balance_and_single_looks_do_not():
    grid = _grid(np.zeros((120, 60)), 0.1)
    balance = look_balance(grid, [_strip(20.0), _strip(40.0, heading_rad=3 * np.pi / 2)])
    rows = 80.0 - 0.5 - np.arange(120)
    middle = np.nanmedian(balance[(rows > 25) & (rows < 35)])
    rim = np.nanmedian(balance[(rows > 55) & (rows < 65)])
    assert middle < 0.01 and rim > 0.99


def test_a_tilt_is_taken_from_the_rim_and_left_between_the_tracks():
    rows = 80.0 - 0.5 - np.arange(120)
    tilt = np.where(rows > 50, -0.1 * (rows - 50), 0.0)[:, None] * np.ones(60)
    bump = 0.2 * np.sin(rows / 1.5)[:, None] * np.ones(60)
    joint = _grid(tilt + bump, 0.1)
    soundings = _grid(np.zeros((120, 60)), 1.5)
    strips = [_strip(20.0), _strip(40.0, heading_rad=3 * np.pi / 2)]
    held = hold_one_sided(joint, soundings, strips, altitude_m=8.0)
    middle, rim = (rows > 26) & (rows < 34), (rows > 58) & (rows < 66)
    np.testing.assert_allclose(held.elevation_m[middle], joint.elevation_m[middle], atol=0.02)
    assert abs(held.elevation_m[rim].mean()) < 0.35 < abs(joint.elevation_m[rim].mean())
    # Detail narrower than the altitude stays.
    assert held.elevation_m[rim].std(axis=0).mean() > 0.12
    assert held.sigma_m[rim].min() > 1.0 and held.sigma_m[middle].max() < 0.2


def test_beyond_the_strips_reach_sigma_is_that_of_the_nearest_strip_not_of_the_echoes():
    heights = np.zeros((120, 60))
    joint = _grid(heights, 0.1)
    reached = np.where((80.0 - 0.5 - np.arange(120) < 62)[:, None] & np.ones(60, bool), 0.0, np.nan)
    soundings = Grid(reached, 0.0, 80.0, 1.0, sigma_m=np.where(np.isfinite(reached), 1.5, np.nan))
    strips = [_strip(20.0), _strip(40.0, heading_rad=3 * np.pi / 2)]
    held = hold_one_sided(joint, soundings, strips, altitude_m=8.0)
    rows = 80.0 - 0.5 - np.arange(120)
    assert held.sigma_m[(rows > 63) & (rows < 70)].min() > 1.0
