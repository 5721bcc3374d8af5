"""Derivatives of shading against a floor known in closed form, and the spread of what soundings alone tell."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from perception.gain_basis import GainBasis
from perception.inverse_sigma import spread
from perception.inverse_state import Data, InversionConfig, Solved, State, sounding_surface
from perception.multigrid import Spectrum
from perception.rays import Rays, Soundings
from perception.records import FloatArray
from perception.roughness import random_floor
from perception.shading import Rows, trace
from perception.soundings import mean_soundings, sounding_equations

UP_M, CELL_M = 15.0, 0.2


def hills(ground_m: FloatArray) -> FloatArray:
    return np.asarray(0.25 * np.sin(2 * np.pi * ground_m / 9))


def log_power(slant_m: FloatArray, rise_m: float, bent: float = 0.0) -> FloatArray:
    """Return Lambert's law at slant ranges, the angle differentiated by range on a fine line.

    The floor rises by `rise_m` and by `bent` times the ground range beyond 30 m.
    """
    ground = np.arange(2, 80, 0.002)
    drop = UP_M - hills(ground) - rise_m - bent * (ground - 30)
    slant, angle = np.hypot(ground, drop), np.arctan2(ground, drop)
    tangent = slant * np.gradient(angle, slant)
    law = 2 * np.log(tangent) - 0.5 * np.log1p(tangent**2)
    return np.asarray(np.interp(slant_m, slant, law))


def one_ray() -> Rows:
    """Return the data of one ray that looks east across the hills."""
    cols, rows = 400, 9
    surface = np.tile(hills((np.arange(cols) - 2) * CELL_M), (rows, 1))
    one = np.ones(1)
    ray = Rays(
        easting_m=0 * one, northing_m=0.8 * one, up_m=UP_M * one, azimuth_rad=np.pi / 2 * one,
        tilt_rad=0 * one, power=np.ones((1, 3500), np.float32), sample_m=0.02 * one, side=1, look=0,
    )  # fmt: skip
    dark = [np.zeros(ray.power.shape, np.bool_)]
    rows_seen, _ = trace(surface, -2 * CELL_M, 0.0, CELL_M, [ray], 2.0, dark)
    return rows_seen


def test_log_power_changes_with_height_as_the_law_says_at_fixed_range() -> None:
    """Also through the floor's bend: without it, level and profile of a rough floor are untold."""
    rows = one_ray()
    # The range of a cell's middle, on the floor itself; whole facets only, in open ground.
    ground = rows.ground_m.astype(float)
    inner = (ground > 8) & (ground < 45) & (rows.share > 0.9)
    slant = np.hypot(ground, UP_M - hills(ground))[inner]
    step = 1e-3
    expected = (log_power(slant, step) - log_power(slant, -step)) / (2 * step)
    found = rows.c_level[inner] / rows.share[inner]
    assert inner.sum() > 100
    # Cells of 0.2 m round the bend of hills 9 m long by a few per cent.
    assert_allclose(found, expected, atol=0.08 * np.abs(expected).max())
    flat = -(1 + rows.slope**2) * np.hypot(rows.c_east, rows.c_north)
    flat /= np.maximum(ground - rows.drop_m * rows.slope, 1)
    assert np.abs(flat[inner] - expected).mean() > 5 * np.abs(found - expected).mean()


def test_log_power_changes_with_slope_as_the_law_says() -> None:
    """A floor that tilts about a cell changes that cell by the slope's part and the level's."""
    rows = one_ray()
    ground = rows.ground_m.astype(float)
    chosen = (ground > 15) & (ground < 45) & (rows.share > 0.9)
    slant = np.hypot(ground, UP_M - hills(ground))[chosen]
    step = 1e-4
    expected = (log_power(slant, 0.0, step) - log_power(slant, 0.0, -step)) / (2 * step)
    found = rows.c_east[chosen] + rows.c_level[chosen] * (ground[chosen] - 30)
    assert_allclose(found, expected, atol=0.05 * np.abs(expected).max())


def nothing() -> Data:
    """Return no data at all."""
    none, whole = np.zeros(0), np.zeros(0, np.int64)
    rows = Rows(
        cell=whole, c_east=none, c_north=none, c_level=none, ratio=none, ground_m=none, drop_m=none,
        slope=none, angle_rad=none, slant_m=none, share=none, samples=none, side=whole, look=whole,
    )  # fmt: skip
    return Data(rows, none, none, none, np.zeros((0, 4), np.int64), np.zeros((0, 4)))


def test_sigma_of_soundings_alone_is_that_of_their_errors() -> None:
    """Floors drawn of the prior, sounded on two lines: errors are held against the claimed spread."""
    rng = np.random.default_rng(5)
    prior = Spectrum(2e-3, 1.0, 4.0)
    unit: list[FloatArray] = []
    for _ in range(4):
        floor = 0.2 * random_floor(prior, 1.0, 128, rng)[:65, :65]
        north = np.arange(4.0, 61)
        line = [np.full(len(north), east) for east in (16.0, 48.0)]
        east, north = np.concatenate(line), np.tile(north, 2)
        # So gentle that the nearest point is all but below.
        height = floor[north.astype(int), east.astype(int)]
        up = np.full(len(east), 15.0)
        range_m = up - height + 0.05 * rng.standard_normal(len(east))
        bottom = Soundings(east, north, up, np.zeros(len(east)), range_m, np.full(len(east), 0.05))
        basis = GainBasis(40.0)
        gentle = Spectrum(25 * prior.p0, 25 * prior.p1, 25 * prior.p2)
        state = State(
            0.0, 0.0, 1.0, (65, 65), [], bottom, gentle, Spectrum(1.0, 1.0, 1.0), basis, 0.0,
            np.zeros((65, 65)), np.zeros((65, 65)), np.zeros(basis.size), InversionConfig(samples=12),
        )  # fmt: skip
        state.surface = sounding_surface(state)
        equations = sounding_equations(state.surface, 0.0, 0.0, 1.0, bottom)
        empty = np.zeros((64, 64), bool)
        joint, alone = spread(state, Solved(nothing(), equations, empty, empty), rng)
        # Without echoes the joint sigma is that of the soundings.
        assert_allclose(np.mean(joint), np.mean(alone), rtol=0.25)
        unit.append((np.abs(state.surface - floor) / alone)[4:61, 4:61])
    pooled = np.stack(unit)
    # Four floors of a few independent patches each.
    assert 0.5 < np.mean(pooled < 1) < 0.85
    assert np.mean(pooled < 2) > 0.85


def test_a_mean_of_soundings_is_known_to_half_the_lead_at_best() -> None:
    north = np.arange(0.0, 150.0)
    bottom = Soundings(
        np.full(150, 8.0), north, np.full(150, 15.0), np.zeros(150), np.full(150, 15.0),
        np.full(150, 0.05),
    )  # fmt: skip
    equations = sounding_equations(np.zeros((160, 17)), 0.0, 0.0, 1.0, bottom)
    held = mean_soundings(equations, bottom, 0.2)
    assert held.matrix.shape[0] == 1
    assert_allclose(held.weight, 1 / (0.03**2 + 0.1**2))
    assert_allclose(held.matrix.sum(), -1.0)
