"""Registration: a planted shift comes back with an honest covariance; featureless ground is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapping.echo_places import placed_across
from mapping.overlaps import find_overlaps
from mapping.registration import Match, match
from mapping.textures import texture
from perception.records import Grid
from tests.mapping.worlds import ORIGIN, Drift, Flight, World, fly, make_world

STILL = Drift(0.0, 0.0, 0.0)
LEGS = {
    "same heading": [(200.0, 100.0, 0.0, 200.0), (205.0, 100.0, 0.0, 200.0)],
    "crossing": [(200.0, 100.0, 0.0, 200.0), (100.0, 200.0, 90.0, 200.0)],
}


def two_passes(seed: int, way: str, **world: float) -> list[Flight]:
    rng = np.random.default_rng(seed)
    return fly(make_world(rng, size=384, **world), LEGS[way], rng, STILL)


def register(flown: list[Flight], shift: tuple[float, float], search_m: float = 6.0) -> Match:
    first, second = (f.strip for f in flown)
    moved = replace(
        second,
        easting_m=second.easting_m + shift[0],
        northing_m=second.northing_m + shift[1],
    )
    centre = (ORIGIN[0] + 202.5, ORIGIN[1] + 200.0)
    return match(texture(first), texture(moved), centre, 50.0, search_m, 0.75)


@pytest.mark.parametrize("way", LEGS)
def test_a_planted_shift_comes_back_below_a_cell(way: str) -> None:
    for seed in range(3):
        rng = np.random.default_rng(100 + seed)
        shift = tuple(rng.uniform(-3, 3, 2))
        found = register(two_passes(seed, way), shift)
        assert found.accepted, found.reason
        np.testing.assert_allclose(found.shift_m, shift, atol=0.6)


def test_the_covariance_of_a_match_is_that_of_its_error() -> None:
    """Mean normalised error squared of two unknowns is near 2; a factor of two and a half either way."""
    values = []
    for seed in range(8):
        rng = np.random.default_rng(200 + seed)
        shift = rng.uniform(-2, 2, 2)
        found = register(two_passes(seed, "crossing"), (shift[0], shift[1]))
        if found.accepted:
            e = found.shift_m - shift
            values.append(e @ np.linalg.solve(found.covariance_m2, e))
    assert len(values) >= 6
    assert 0.4 < np.mean(values) < 5.0


def test_featureless_ground_is_refused() -> None:
    for seed in range(4):
        flown = two_passes(seed, "crossing", relief_m=0.0, albedo_db=0.0)
        assert not register(flown, (1.0, 0.5), search_m=10.0).accepted


def test_moving_the_world_moves_nothing() -> None:
    flown = two_passes(1, "crossing")
    here = register(flown, (1.2, -0.7))
    there = []
    for f in flown:
        strip = replace(f.strip, easting_m=f.strip.easting_m + 75.0)
        there.append(replace(f, strip=strip))
    first, second = (f.strip for f in there)
    second = replace(second, easting_m=second.easting_m + 1.2, northing_m=second.northing_m - 0.7)
    centre = (ORIGIN[0] + 277.5, ORIGIN[1] + 200.0)
    moved = match(texture(first), texture(second), centre, 50.0, 6.0, 0.75)
    np.testing.assert_allclose(moved.shift_m, here.shift_m, atol=0.02)


def test_a_strip_wholly_nan_matches_nothing() -> None:
    flown = two_passes(3, "crossing")
    empty = replace(
        flown[1].strip,
        elevation_m=np.full_like(flown[1].strip.elevation_m, np.nan),
        echo=np.full_like(flown[1].strip.echo, np.nan),
    )
    found = register([flown[0], replace(flown[1], strip=empty)], (0.0, 0.0))
    assert not found.accepted
    assert find_overlaps([flown[0].strip, empty], 50.0) == []


def test_overlaps_are_where_both_strips_are() -> None:
    flown = two_passes(4, "crossing")
    windows = find_overlaps([f.strip for f in flown], 25.0)
    assert windows
    for w in windows:
        assert abs(w.easting_m - ORIGIN[0] - 200.0) < 65.0
        assert abs(w.northing_m - ORIGIN[1] - 200.0) < 65.0
    far = replace(flown[1].strip, easting_m=flown[1].strip.easting_m + 500.0)
    assert find_overlaps([flown[0].strip, far], 25.0) == []


def test_an_echo_from_a_hill_is_placed_farther_out_than_flat_ground_has_it() -> None:
    """Slant range 25 m from 15 m up over a plateau 5 m high: sqrt(625 - 100) = 22.9 instead of 20 m."""
    rng = np.random.default_rng(0)
    world = World(np.full((64, 64), -40.0), np.zeros((64, 64)))
    strip = fly(world, [(30.0, 10.0, 0.0, 20.0)], rng, STILL)[0].strip
    height = np.full((80, 160), -35.0)
    # The floor under the track stays; the plateau begins ten metres to starboard.
    floor = Grid(height, ORIGIN[0] - 50.0, ORIGIN[1] + 60.0, 1.0)
    floor.elevation_m[:, :90] = -40.0
    placed = placed_across(strip, floor)
    column = int(np.argmin(np.abs(strip.across_m - 20.0)))
    assert placed[10, column] == pytest.approx(np.sqrt(625.0 - 100.0), abs=0.05)
    column = int(np.argmin(np.abs(strip.across_m + 20.0)))
    assert placed[10, column] == pytest.approx(-20.0, abs=0.05)
