"""Motion, dead reckoning and soundings against their stated errors and plain geometry."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from perception.records import Grid, InputError
from scenarios.missions.lines import path_along, survey_lines
from scenarios.sections import (
    Block,
    MissionSection,
    NavigationSection,
    VehicleSection,
    WorldSection,
)
from scenarios.vehicle.motion import at_times, coloured, fly, sonar_poses
from scenarios.vehicle.navigation import dead_reckon, read_instruments, surface_fixes, tide_m
from scenarios.vehicle.soundings import beam_ranges, rotation_to_map

WORLD = WorldSection(size_east_m=1400.0, size_north_m=300.0, cell_m=1.0)
STILL = {
    "roll_rms_deg": 0.0, "pitch_rms_deg": 0.0, "yaw_rms_deg": 0.0, "heave_rms_m": 0.0,
    "wander_rms_m": 0.0, "crab_deg": 0.0,
}  # fmt: skip


def floor(slope=0.0):
    east = np.arange(1400) + 0.5 - 700
    z = np.broadcast_to(-60.0 + slope * east, (300, 1400)).copy()
    return Grid(z, 559300.0, 5550150.0, 1.0)


def flown(lines=((-500.0, 0.0, 500.0, 0.0),), seed=0, slope=0.0, follow="terrain", **keys):
    vehicle = VehicleSection(**{**STILL, **keys})
    return fly(
        path_along(lines, 0.15), floor(slope), WORLD, vehicle, altitude_m=15.0, follow=follow,
        start_s=0.0, rng=np.random.default_rng(seed),
    )  # fmt: skip


def test_block_lines_are_flown_to_and_fro_at_their_spacing():
    block = Block(heading_deg=90.0, count=3, spacing_m=40.0, length_m=100.0, north_m=5.0)
    lines = np.array(survey_lines(MissionSection(block=(block,))))
    # Starboard of an eastward line is south.
    assert_allclose(lines[:, 1], [45.0, 5.0, -35.0], atol=1e-9)
    assert_allclose(lines[:, 0], [-50.0, 50.0, -50.0], atol=1e-9)


def test_path_has_even_steps_through_lines_and_turns():
    path = path_along([(0, 0, 100, 0), (100, -40, 0, -40)], 0.15)
    steps = np.hypot(np.diff(path.east_m), np.diff(path.north_m))
    assert_allclose(steps, 0.15, rtol=0.02)
    assert set(np.unique(path.line)) == {-1, 0, 1}


def test_straight_flight_has_its_speed_heading_and_altitude():
    motion = flown()
    assert_allclose(motion.heading_rad, np.pi / 2, atol=1e-9)
    assert_allclose(motion.speed_m_s, 1.5, rtol=1e-6)
    assert_allclose(motion.altitude_m, 15.0, atol=1e-6)


def test_terrain_is_followed_with_the_pitch_of_the_slope_and_a_depth_is_kept():
    climbing = flown(slope=0.05)
    middle = slice(1000, -1000)
    assert_allclose(climbing.pitch_rad[middle], np.arctan(0.05), atol=1e-3)
    assert_allclose(climbing.altitude_m[middle], 15.0, atol=0.05)
    level = flown(slope=0.01, follow="depth")
    assert np.ptp(level.elevation_m) < 0.2
    assert level.altitude_m.min() > 5.0


def test_a_vehicle_kept_at_depth_climbs_over_what_stands_in_its_way():
    motion = flown(slope=0.05, follow="depth")
    assert motion.altitude_m.min() >= 0.4 * 15.0 - 0.1


def test_track_outside_the_world_is_refused_with_the_size_it_needs():
    with pytest.raises(InputError, match=r"world.size_east_m = 1400: the track leaves"):
        flown(lines=((-800.0, 0.0, 800.0, 0.0),))


def test_rocking_has_its_rms_and_period():
    time_s = np.arange(0, 4000, 0.1)
    series = [
        coloured(time_s, rms=2.0, period_s=8.0, rng=np.random.default_rng(s)) for s in range(5)
    ]
    assert_allclose(np.std(series), 2.0, rtol=0.1)
    crossings = np.mean([(np.diff(np.sign(s)) > 0).sum() for s in series])
    assert_allclose(4000 / crossings, 8.0, rtol=0.2)


def test_random_walk_grows_by_the_root_of_the_distance():
    """4 m per root kilometre an axis, over many runs of one kilometre."""
    motion = flown()
    config = NavigationSection(heading_bias_deg=0.0, speed_scale=0.0)
    ends = []
    for seed in range(300):
        walk = dead_reckon(motion, config, start_sigma_m=0.0, rng=np.random.default_rng(seed))
        ends.append((walk.error_east_m[-1], walk.error_north_m[-1]))
    # 1-sigma of a standard deviation from 300 draws is 4 %.
    assert_allclose(np.std(ends, axis=0), 4.0, rtol=0.16)


def test_heading_bias_turns_and_scale_stretches_the_reckoned_track():
    motion = flown()
    config = NavigationSection(
        random_walk_m_per_sqrt_km=0.0, heading_bias_deg=1.0, speed_scale=0.01
    )
    run = dead_reckon(motion, config, start_sigma_m=0.0, rng=np.random.default_rng(3))
    length = motion.easting_m[-1] - motion.easting_m[0]
    bias, scale = run.heading_bias_rad, run.speed_scale
    assert bias != 0 and scale != 1
    # Flying east, a heading read too large reckons to the south.
    assert_allclose(run.error_north_m[-1], -scale * length * np.sin(bias), rtol=1e-9)
    assert_allclose(run.error_east_m[-1], length * (scale * np.cos(bias) - 1), rtol=1e-9)
    read = read_instruments(
        motion, run, NavigationSection(heading_noise_deg=0.0), rng=np.random.default_rng(0)
    )
    assert_allclose(read.heading_rad - motion.heading_rad, bias, atol=1e-12)


def test_depth_reads_from_the_surface_and_the_tide_moves_it():
    motion = flown()
    config = NavigationSection(depth_bias_m=0.0, depth_noise_m=0.0, tide_amplitude_m=2.0)
    run = dead_reckon(motion, config, start_sigma_m=0.0, rng=np.random.default_rng(0))
    read = read_instruments(motion, run, config, rng=np.random.default_rng(0))
    assert_allclose(tide_m(motion.time_s, config) - read.depth_m, motion.elevation_m, atol=1e-9)


@pytest.mark.parametrize(("kind", "count"), [("none", 0), ("ends", 2), ("passes", 4)])
def test_surface_fixes_fall_on_the_ends(kind, count):
    motion = flown(lines=((-100.0, 0.0, 100.0, 0.0), (100.0, -40.0, -100.0, -40.0)))
    config = NavigationSection(fixes=kind, fix_sigma_m=1e-6)
    fixes = surface_fixes(motion, config, rng=np.random.default_rng(0))
    assert len(fixes.time_s) == count
    if count:
        assert_allclose(fixes.easting_m[[0, -1]], motion.easting_m[[0, -1]], atol=0.01)
    if count == 4:
        assert_allclose(fixes.easting_m - 560000, [-100, 100, 100, -100], atol=0.3)


def test_body_axes_follow_the_conventions():
    """Level and north: forward north, starboard east; bow up lifts forward; roll lowers starboard."""
    motion = at_times(flown(lines=((0.0, -50.0, 0.0, 50.0),)), np.array([10.0]))
    level = rotation_to_map(motion)[0]
    assert_allclose(level, [[0, 1, 0], [1, 0, 0], [0, 0, -1]], atol=1e-9)
    object.__setattr__(motion, "pitch_rad", np.array([0.1]))
    object.__setattr__(motion, "roll_rad", np.array([0.2]))
    turned = rotation_to_map(motion)[0]
    assert turned[2, 0] > 0 and turned[2, 1] < 0
    assert_allclose(turned.T @ turned, np.eye(3), atol=1e-12)


def test_beams_have_their_analytic_range_over_a_slope():
    motion = at_times(flown(slope=0.1, follow="depth"), np.array([100.0, 300.0]))
    got = beam_ranges(motion, floor(0.1))
    tilt, azimuth = np.deg2rad(30), np.deg2rad([45, 135, 225, 315])
    # Heading east on a floor that rises to the east; pitch is nothing at constant depth.
    ahead = np.sin(tilt) * np.cos(azimuth)
    altitude = motion.altitude_m[:, None]
    expected = altitude / (np.cos(tilt) + 0.1 * ahead)
    assert_allclose(motion.pitch_rad, 0.0, atol=0.2)
    body = rotation_to_map(motion)
    direction = np.einsum(
        "nij,bj->nbi", body,
        np.stack([ahead, np.sin(tilt) * np.sin(azimuth), np.full(4, np.cos(tilt))], axis=1),
    )  # fmt: skip
    expected = altitude / (-direction[..., 2] + 0.1 * direction[..., 0])
    assert_allclose(got, expected, rtol=1e-5)


def test_poses_carry_the_rates_of_the_motion():
    motion = flown(yaw_rms_deg=2.0, heave_rms_m=0.3)
    poses = sonar_poses(motion)
    rate = np.gradient(motion.heading_rad, motion.time_s)
    assert_allclose(poses[:, 6], rate)
    assert_allclose(poses[:, 8], 1.5, rtol=0.02)
