"""Splitting at turns, gaps and stops, and not elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from perception.passes import PassConfig, Track, split_passes


def track_of(legs, dt=0.2, speed=2.0, range_m=30.0, rng=None, noise_m=0.0, yaw_deg=0.0):
    """Drive legs of (length in m, turn in degrees spread over it) from north on."""
    heading = np.concatenate(
        [np.full(round(m / speed / dt), turn / max(round(m / speed / dt), 1)) for m, turn in legs]
    )
    heading = np.radians(np.cumsum(heading))
    east, north = np.cumsum(np.sin(heading)) * speed * dt, np.cumsum(np.cos(heading)) * speed * dt
    n = len(heading)
    if rng is not None:
        east, north = (
            east + noise_m * rng.standard_normal(n),
            north + noise_m * rng.standard_normal(n),
        )
        time_s = dt * np.arange(n)
        heading = heading + np.radians(yaw_deg) * np.sin(2 * np.pi * time_s / 5.0)
    return Track(dt * np.arange(n), east, north, heading % (2 * np.pi), np.full(n, range_m),
                 np.full(n, 1024))  # fmt: skip


def lengths(split):
    return np.bincount(split.pass_index[split.pass_index >= 0]).tolist()


@pytest.mark.parametrize("heading_deg", [0.0, 90.0, 179.9, 200.0, 359.9])
def test_a_straight_file_is_one_pass(heading_deg):
    rng = np.random.default_rng(1)
    track = track_of([(0.4, heading_deg), (300, 0)], rng=rng, noise_m=0.3, yaw_deg=5.0)
    assert lengths(split_passes(track)) == [len(track.time_s)]


@pytest.mark.parametrize("radius_m", [7.0, 15.0, 22.5, 60.0, 100.0])
def test_a_lawn_mower_is_one_pass_a_leg(radius_m):
    arc = np.pi * radius_m
    track = track_of([(200, 0), (arc, 180), (200, 0), (arc, -180), (200, 0)])
    split = split_passes(track)
    assert split.pass_index.max() == 2
    for number, middle in enumerate((100, 300 + arc, 500 + 2 * arc)):
        assert split.pass_index[round(middle / 0.4)] == number
    # The legs are kept but for a few metres at the turns.
    for number in range(3):
        assert (split.pass_index == number).sum() * 0.4 > 190


def test_square_corners_end_passes_and_the_turn_belongs_to_none():
    split = split_passes(track_of([(100, 0), (8, 90), (60, 0), (8, 90), (100, 0)]))
    assert split.pass_index.max() == 2
    assert split.turning.sum() * 0.4 == pytest.approx(16, abs=14)
    assert np.all(split.pass_index[split.turning] == -1)


@pytest.mark.parametrize("turn_deg", [20.0, 60.0, 120.0])
def test_a_slow_curve_stays_one_pass(turn_deg):
    rng = np.random.default_rng(2)
    track = track_of([(300, turn_deg)], rng=rng, noise_m=0.2, yaw_deg=3.0)
    split = split_passes(track)
    assert lengths(split) == [len(track.time_s)]


def test_lines_that_follow_each_other_without_a_turn_are_passes_of_their_own():
    """Simulators step from one line's end to the next one's start, 15 m aside and facing back."""
    up = track_of([(100, 0)])
    n = len(up.time_s)
    split = split_passes(
        Track(0.2 * np.arange(3 * n), np.repeat([0.0, 15.0, 30.0], n),
              np.concatenate([up.northing_m, up.northing_m[::-1], up.northing_m]),
              np.repeat([0.0, np.pi, 0.0], n), np.full(3 * n, 30.0), np.full(3 * n, 512))
    )  # fmt: skip
    assert split.pass_index.max() == 2
    assert all(count > 0.9 * n for count in lengths(split))
    for number in range(3):
        assert np.ptp(np.flatnonzero(split.pass_index == number) // n) == 0


def test_a_kink_of_twenty_degrees_is_no_turn():
    assert split_passes(track_of([(100, 0), (2, 20), (100, 0)])).pass_index.max() == 0


def test_gaps_in_time_and_in_position_end_passes():
    track = track_of([(300, 0)])
    time_s, north = track.time_s.copy(), track.northing_m.copy()
    time_s[250:] += 60.0
    north[500:] += 40.0
    split = split_passes(Track(time_s, track.easting_m, north, track.heading_rad, track.range_m,
                               track.samples))  # fmt: skip
    assert lengths(split) == [250, 250, 250] and split.gaps.tolist() == [250, 500]


def test_a_clock_set_back_ends_a_pass():
    track = track_of([(200, 0)])
    time_s = track.time_s.copy()
    time_s[250:] -= 3600.0
    split = split_passes(Track(time_s, track.easting_m, track.northing_m, track.heading_rad,
                               track.range_m, track.samples))  # fmt: skip
    assert lengths(split) == [250, 250]


def test_a_stop_ends_a_pass_and_belongs_to_none():
    track = track_of([(200, 0)])
    hold = np.concatenate([np.arange(250), np.full(200, 249), np.arange(250, 500)])
    n = len(hold)
    split = split_passes(Track(0.2 * np.arange(n), track.easting_m[hold], track.northing_m[hold],
                               np.zeros(n), np.full(n, 30.0), np.full(n, 1024)))  # fmt: skip
    assert split.pass_index.max() == 1
    assert split.stopped[270:430].all() and np.all(split.pass_index[270:430] == -1)
    assert (split.pass_index >= 0).sum() > 470


def test_a_vehicle_that_never_moves_is_still_one_pass():
    n = 100
    still = Track(0.2 * np.arange(n), np.zeros(n), np.zeros(n), np.zeros(n), np.full(n, 30.0),
                  np.full(n, 512))  # fmt: skip
    assert lengths(split_passes(still)) == [100]


def test_short_leftovers_are_in_no_pass():
    track = track_of([(300, 0)])
    time_s = track.time_s.copy()
    time_s[735:] += 60.0
    split = split_passes(Track(time_s, track.easting_m, track.northing_m, track.heading_rad,
                               track.range_m, track.samples))  # fmt: skip
    assert lengths(split) == [735] and np.all(split.pass_index[735:] == -1)


def test_ten_pings_are_a_pass_and_nine_are_none():
    for n, passes in ((10, 0), (9, -1)):
        few = Track(0.2 * np.arange(n), np.zeros(n), 0.4 * np.arange(n), np.zeros(n),
                    np.full(n, 30.0), np.full(n, 512))  # fmt: skip
        assert split_passes(few).pass_index.max(initial=-1) == passes


def test_a_line_too_long_for_memory_is_cut_in_equal_parts():
    track = track_of([(400, 0)])
    config = PassConfig(most_samples=2 * 1024 * 300)
    assert lengths(split_passes(track, config)) == [250, 250, 250, 250]


def test_passes_do_not_depend_on_place_or_heading():
    legs = [(150, 0), (40, 180), (150, 0)]
    plain = split_passes(track_of(legs))
    east_first = track_of([(0.4, 90), *legs])
    turned = split_passes(
        Track(east_first.time_s + 1e9, east_first.easting_m + 5e5, east_first.northing_m + 5e6,
              east_first.heading_rad, east_first.range_m, east_first.samples)
    )  # fmt: skip
    assert abs(np.subtract(lengths(plain), lengths(turned))).max() <= 2


def test_a_scanning_sonar_is_split_at_gaps_alone():
    track = track_of([(50, 0), (8, 180), (50, 0)])
    scanning = Track(track.time_s, track.easting_m, track.northing_m, track.heading_rad,
                     track.range_m, track.samples, image=False)  # fmt: skip
    assert lengths(split_passes(scanning)) == [len(track.time_s)]
