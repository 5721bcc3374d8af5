"""A planted floor, echoed by an independent little sonar, asked back from the inversion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from perception.inversion import InversionConfig, InversionResult, Look, invert
from perception.occlusion import find_dark
from perception.records import FloatArray, InputError, Swath

ALTITUDE_M = 12.0
FAST = InversionConfig(iterations=3, samples=4)


def hills(east: FloatArray, north: FloatArray) -> FloatArray:
    """Return a smooth floor at 30 m depth with relief of some 0.5 m."""
    return (
        -30.0 + 0.6 * np.sin(east / 6.5) * np.cos(north / 8.0) + 0.3 * np.cos((east + north) / 7.0)
    )


def echo(east: float, north: float, heading: float, side: int, up: float, reach: float,
         sample: float, rng: np.random.Generator) -> FloatArray:  # fmt: skip
    """Return amplitudes of one ping: facets of 4 cm summed into bins, four looks, a beam pattern.

    Own discretisation: points along the ray, histogram by slant range; visible where the angle grows.
    """
    g = np.arange(0.02, reach, 0.04)
    azimuth = heading + (1 if side else -1) * np.pi / 2
    z = hills(east + np.sin(azimuth) * g, north + np.cos(azimuth) * g)
    slope = np.gradient(z, g)
    drop = up - z
    slant, angle = np.hypot(g, drop), np.arctan2(g, drop)
    seen = angle >= np.maximum.accumulate(angle)
    cosine = np.maximum(drop + g * slope, 0) / (slant * np.sqrt(1 + slope**2))
    pattern = np.exp(0.8 * np.cos(2.5 * angle + side))
    power = seen * cosine**2 * np.sqrt(1 + slope**2) * pattern * np.exp(0.01 * slant)
    bins = int(reach / sample)
    total = np.bincount((slant / sample).astype(int), power, minlength=bins + 200)[:bins]
    return np.sqrt(total * rng.gamma(4, 0.25, bins)) * 50


def survey(tracks: list[tuple[float, float, float]], length: float = 60.0, shift: float = 0.0,
           seed: int = 0) -> list[Look]:  # fmt: skip
    """Return looks along tracks (east, north, heading) over the hills."""
    rng = np.random.default_rng(seed)
    reach, sample = 45.0, 0.15
    looks = []
    for index, (e0, n0, heading) in enumerate(tracks):
        s = np.arange(0, length, 0.75)
        east, north = e0 + np.sin(heading) * s, n0 + np.cos(heading) * s
        up = np.full(len(s), -30.0 + ALTITUDE_M)
        both = [
            np.array([echo(*p, heading, side, -30.0 + ALTITUDE_M, reach, sample, rng)
                      for p in zip(east, north, strict=True)], np.float32)
            for side in (0, 1)
        ]  # fmt: skip
        across = np.linspace(-7, 7, 281)
        plane = hills(
            east[:, None] + np.cos(heading) * across, north[:, None] - np.sin(heading) * across
        )
        first = np.min(np.hypot(across, up[:, None] - plane), axis=1)
        n, nan = len(s), np.full(len(s), np.nan)
        swath = Swath(
            time_s=s, ping=np.arange(n), easting_m=east + shift, northing_m=north + shift,
            depth_m=-up, heading_rad=np.full(n, heading), pitch_rad=np.zeros(n),
            roll_rad=np.zeros(n), altitude_hint_m=nan, sample_m=np.full(n, sample),
            port=both[0], starboard=both[1], sound_speed_m_s=np.full(n, 1500.0),
            crs="EPSG:32633", pass_index=index,
        )  # fmt: skip
        noise = 0.03 * rng.standard_normal(n)
        looks.append(Look(swath, first + noise, np.full(n, 0.03)))
    return looks


# Off the cells' edges: on an edge rounding alone decides which cell an echo belongs to.
PARALLEL = [(0.3, 0.2, 0.0), (30.3, 60.2, np.pi)]


@pytest.fixture(scope="module")
def looks() -> list[Look]:
    return survey(PARALLEL)


@pytest.fixture(scope="module")
def result(looks: list[Look]) -> InversionResult:
    return invert(looks, 1.0, FAST)


def errors(result: InversionResult, shift: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Return error and claimed sigma between the tracks."""
    east, north = result.grid.centres()
    e, n = np.meshgrid(east - shift, north - shift)
    inside = (e > 3) & (e < 27) & (n > 8) & (n < 52)
    assert result.grid.sigma_m is not None
    return (result.grid.elevation_m - hills(e, n))[inside], result.grid.sigma_m[inside]


def test_two_short_passes_of_unknown_gain_beat_the_soundings(
    result: InversionResult, looks: list[Look]
) -> None:
    """Half way between tracks soundings know nothing of 0.6 m hills; echoes do."""
    from scipy.interpolate import griddata

    error, _ = errors(result)
    points = np.concatenate(
        [
            np.c_[k.swath.easting_m, k.swath.northing_m, -k.swath.depth_m - k.altitude_m]
            for k in looks
        ]
    )
    e, n = np.meshgrid(np.arange(3.5, 27), np.arange(8.5, 52))
    soundings = np.abs(griddata(points[:, :2], points[:, 2], (e, n)) - hills(e, n)).mean()
    # Two lines 60 m long settle a free gain poorly; the relief shows in the spread about the mean error.
    assert np.abs(error).mean() < soundings
    assert np.std(error) < 0.6 * soundings


def test_errors_are_of_the_claimed_size(result: InversionResult) -> None:
    error, sigma = errors(result)
    # One smooth floor between two lines errs as a whole: a single draw, not a rate.
    assert np.abs(error).mean() < 3 * sigma.mean()
    assert np.all(sigma > 0)


@pytest.mark.slow
def test_steps_on_narrow_cells_keep_the_frame_and_the_claimed_errors(looks: list[Look]) -> None:
    """The last steps trace cells half as wide; the map returned is of the cells asked for."""
    whole = InversionConfig(iterations=6, samples=2)
    spread_m = []
    # Two draws of the echoes' noise: of one alone the two spreads differ by centimetres either way.
    for drawn in (looks, survey(PARALLEL, seed=1)):
        wide = invert(drawn, 1.0, replace(whole, fine_nodes=0))
        fine = invert(drawn, 1.0, whole)
        assert fine.grid.shape == wide.grid.shape
        assert (fine.grid.west_m, fine.grid.north_m) == (wide.grid.west_m, wide.grid.north_m)
        assert len(fine.step_m) > len(wide.step_m)
        error, sigma = errors(fine)
        spread_m.append((np.std(error), np.std(errors(wide)[0])))
        assert np.abs(error).mean() < 1.5 * sigma.mean()
    # Smooth hills without detail below a cell: nothing to gain, and two short lines tell no dome of centimetres.
    on_narrow, on_wide = np.mean(spread_m, axis=0)
    assert on_narrow < on_wide + 0.02


def test_shifting_the_world_shifts_the_map(result: InversionResult) -> None:
    """A whole number of cells: the same echoes give the same heights."""
    moved = invert(survey(PARALLEL, shift=100.0), 1.0, FAST)
    assert_allclose(moved.grid.west_m - result.grid.west_m, 100.0)
    # Ground range, facets and cells are rounded anew; between the tracks centimetres may change.
    first, second = errors(result)[0], errors(moved, shift=100.0)[0]
    assert np.abs(first - second).mean() < 0.05


def test_the_unit_of_the_recorder_does_not_matter(
    result: InversionResult, looks: list[Look]
) -> None:
    louder = [
        replace(k, swath=replace(k.swath, port=7 * k.swath.port, starboard=7 * k.swath.starboard))
        for k in looks
    ]
    again = invert(louder, 1.0, FAST)
    # Looser than rounding: the solver stops at a part of the first residual, which the unit changes.
    assert_allclose(again.grid.elevation_m, result.grid.elevation_m, atol=0.02)


def test_one_pass_is_not_worse_than_its_soundings() -> None:
    looks = survey(PARALLEL[:1])
    joint = invert(looks, 1.0, FAST).grid
    silent = [
        replace(k, swath=replace(k.swath, port=np.full_like(k.swath.port, np.nan),
                                 starboard=np.full_like(k.swath.port, np.nan)))
        for k in looks
    ]  # fmt: skip
    east, north = joint.centres()
    e, n = np.meshgrid(east, north)
    inside = (np.abs(e) < 30) & (n > 8) & (n < 52) & np.isfinite(joint.elevation_m)
    nearest = np.interp(n, looks[0].swath.northing_m,
                        -looks[0].swath.depth_m - looks[0].altitude_m)  # fmt: skip
    own = np.abs(joint.elevation_m - hills(e, n))[inside].mean()
    assert own < np.abs(nearest - hills(e, n))[inside].mean()
    with pytest.raises(InputError, match="no pass has an echo"):
        invert(silent, 1.0, FAST)


def test_cells_lie_on_multiples_of_the_cell_and_rows_run_south(result: InversionResult) -> None:
    grid = result.grid
    assert_allclose(grid.west_m % 1.0, 0.0, atol=1e-9)
    assert_allclose(grid.north_m % 1.0, 0.0, atol=1e-9)
    error, _ = errors(result)
    assert np.isfinite(error).all()


def test_no_sounding_is_refused_with_the_way_out(looks: list[Look]) -> None:
    blind = [replace(k, altitude_m=np.full_like(k.altitude_m, np.nan)) for k in looks]
    with pytest.raises(InputError, match="bottom track"):
        invert(blind, 1.0, FAST)
    with pytest.raises(InputError, match="no pass"):
        invert([], 1.0, FAST)


def test_a_look_of_wrong_length_is_refused(looks: list[Look]) -> None:
    with pytest.raises(ValueError, match="one value per ping"):
        replace(looks[0], altitude_m=looks[0].altitude_m[:-1])


def test_dark_runs_are_found_whole_and_short_ones_left() -> None:
    power = np.ones((1, 200))
    power[0, 60:90] = 0.001
    power[0, 140:144] = 0.001
    dark = np.zeros(power.shape, np.bool_)
    find_dark(power, np.ones_like(power), 5, 8, 0.04, dark)
    # The running mean finds all of the run but what a bright neighbour hides: none here.
    assert dark[0, 60:90].all()
    assert dark.sum() == 30
