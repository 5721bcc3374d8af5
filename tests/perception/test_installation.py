"""Each effect of installation and water, planted and asked back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from perception.corrections import (
    Table,
    column_speed,
    straight_layback,
    with_declination,
    with_lever_arm,
    with_mounting,
    with_sound_speed,
    with_tide,
    with_tow,
    without_latency,
)
from perception.installation import read_installation
from perception.readers import PingFlag, open_survey
from perception.records import InputError, Swath
from tests.perception.xtf_maker import START, Plan, make_xtf

NOTHING = (0.0, 0.0, 0.0)


def swath(n=50, heading_deg=0.0, **changes) -> Swath:
    time_s = 1.7e9 + 0.5 * np.arange(n)
    heading = np.full(n, np.radians(heading_deg))
    along = 1.0 * np.arange(n)
    base = Swath(
        time_s=time_s, ping=np.arange(n), easting_m=5e5 + along * np.sin(heading),
        northing_m=5e6 + along * np.cos(heading), depth_m=np.full(n, 10.0), heading_rad=heading,
        pitch_rad=np.zeros(n), roll_rad=np.zeros(n), altitude_hint_m=np.full(n, 20.0),
        sample_m=np.full(n, 0.1), port=np.zeros((n, 4)), starboard=np.zeros((n, 4)),
        sound_speed_m_s=np.full(n, 1500.0), crs="EPSG:32619", flags=np.zeros(n, np.int64),
    )  # fmt: skip
    return replace(base, **changes)


def moved(after: Swath, before: Swath) -> tuple[np.ndarray, ...]:
    return (after.easting_m - before.easting_m, after.northing_m - before.northing_m,
            after.depth_m - before.depth_m)  # fmt: skip


@pytest.mark.parametrize(
    ("heading", "arm", "east", "north"),
    [(0, (2, 0, 0), 0, 2), (90, (2, 0, 0), 2, 0), (0, (0, 3, 0), 3, 0), (90, (0, 3, 0), 0, -3),
     (225, (np.sqrt(2), 0, 0), -1, -1)],
)  # fmt: skip
def test_a_lever_arm_turns_with_the_heading(heading, arm, east, north):
    before = swath(heading_deg=heading)
    found = moved(with_lever_arm(before, NOTHING, arm), before)
    for value, wanted in zip(found, (east, north, 0.0), strict=True):
        assert_allclose(value, wanted, atol=1e-8)


def test_a_lever_arm_counts_from_the_navigation_point_and_down_is_deeper():
    before = swath()
    after = with_lever_arm(before, (1.0, 0.0, -2.0), (1.0, 0.0, 0.5))
    assert_allclose(moved(after, before)[2], 2.5)


def test_pitch_and_roll_tilt_the_lever_arm():
    n = 50
    bow_up = swath(pitch_rad=np.full(n, np.radians(30)))
    assert_allclose(moved(with_lever_arm(bow_up, NOTHING, (2, 0, 0)), bow_up)[2], -1.0)
    listing = swath(roll_rad=np.full(n, np.radians(30)))
    assert_allclose(moved(with_lever_arm(listing, NOTHING, (0, 2, 0)), listing)[2], 1.0)


def test_mounting_angles_add_where_the_vehicle_is_level():
    turned = with_mounting(swath(heading_deg=350), 15.0, -4.0, 3.0)
    assert_allclose(np.degrees(turned.heading_rad), 5.0)
    assert_allclose(np.degrees(turned.pitch_rad), -4.0)
    assert_allclose(np.degrees(turned.roll_rad), 3.0)


def test_a_sonar_turned_square_swaps_pitch_and_roll():
    """Mounted facing starboard, the bow's pitch becomes the sonar's roll."""
    n = 50
    turned = with_mounting(swath(pitch_rad=np.full(n, 0.2)), 90.0)
    assert_allclose(turned.roll_rad, 0.2, atol=1e-12)
    assert_allclose(turned.pitch_rad, 0.0, atol=1e-12)


@pytest.mark.parametrize("lag_s", [0.7, -0.3])
def test_a_late_position_is_brought_to_its_ping(lag_s):
    before = swath()  # 2 m/s north: a fix that is 0.7 s late lies 1.4 m behind
    after = without_latency(before, navigation_s=lag_s)
    assert_allclose(moved(after, before)[1], 2.0 * lag_s, atol=1e-6)


def test_latencies_of_depth_attitude_and_compass_act_on_their_own_column():
    n = 50
    ramp = 0.01 * np.arange(n)
    before = swath(
        depth_m=ramp, roll_rad=ramp, pitch_rad=-ramp, heading_rad=(6.2 + ramp) % 6.2831853
    )
    after = without_latency(before, depth_s=1.0, attitude_s=2.0, compass_s=-0.5)
    assert_allclose(after.depth_m - ramp, 0.02, atol=1e-9)
    assert_allclose(after.roll_rad - ramp, 0.04, atol=1e-9)
    assert_allclose(after.pitch_rad + ramp, -0.04, atol=1e-9)
    assert_allclose(np.unwrap(after.heading_rad) - 6.2 - ramp, -0.01, atol=1e-6)


def test_declination_turns_magnetic_headings_but_not_a_track():
    magnetic = swath(heading_deg=355.0)
    assert_allclose(np.degrees(with_declination(magnetic, 12.0).heading_rad), 7.0)
    from_track = swath(flags=np.full(50, int(PingFlag.HEADING_FILLED)))
    assert_allclose(with_declination(from_track, 12.0).heading_rad, 0.0)


def test_a_towed_sonar_follows_the_track_one_layback_behind():
    straight = swath(n=200, heading_deg=30.0)
    after = with_tow(straight, np.full(200, 25.0), (-5.0, 0.0, 0.0), NOTHING)
    east, north, _ = moved(after, straight)
    assert_allclose(east, -30 * np.sin(np.radians(30)), atol=0.01)
    assert_allclose(north, -30 * np.cos(np.radians(30)), atol=0.01)


def test_on_a_bend_the_fish_is_where_the_ship_was():
    n, radius = 400, 100.0
    angle = 1.0 * np.arange(n) / radius
    ship = swath(n=n, easting_m=radius * (1 - np.cos(angle)), northing_m=radius * np.sin(angle),
                 heading_rad=angle % (2 * np.pi))  # fmt: skip
    after = with_tow(ship, np.full(n, 40.0), NOTHING, NOTHING, follow_track=True)
    # Smoothing over 10 s cuts a bend of 100 m by (10 m)^2 / (6 * 100 m).
    assert_allclose(after.easting_m[50:350], ship.easting_m[10:310], atol=0.3)
    assert_allclose(after.northing_m[50:350], ship.northing_m[10:310], atol=0.3)
    course = np.degrees(after.heading_rad[50:350] - ship.heading_rad[10:310] + np.pi) % 360 - 180
    assert_allclose(course, 0.0, atol=0.5)


def test_layback_of_a_straight_cable():
    assert_allclose(straight_layback(50.0, np.array([30.0, 80.0, np.nan]), 0.0), [40.0, 0.0, 50.0])


def test_tide_refers_depths_to_the_datum():
    tide = Table(np.array([1.7e9 - 10, 1.7e9 + 100.0]), np.array([1.0, 3.2]), "tide.csv")
    before = swath()
    after = with_tide(before, tide)
    assert_allclose(before.depth_m - after.depth_m, 1.0 + (before.time_s - 1.7e9 + 10) * 0.02)


def test_a_tide_that_does_not_cover_the_survey_is_refused():
    tide = Table(np.array([1.7e9 + 5, 1.7e9 + 100.0]), np.array([1.0, 3.2]), "tide.csv")
    with pytest.raises(InputError, match=r"tide\.csv.*covers"):
        with_tide(swath(), tide)


def test_ranges_scale_with_the_true_sound_speed():
    after = with_sound_speed(swath(), np.full(50, 1470.0))
    assert_allclose(after.sample_m, 0.1 * 1470 / 1500)
    assert_allclose(after.sound_speed_m_s, 1470.0)


def test_the_column_speed_is_the_harmonic_mean_below_the_sonar():
    layers = Table(
        np.array([0.0, 19.999, 20.001, 100.0]), np.array([1520.0, 1520.0, 1480.0, 1480.0])
    )
    # Sonar at 10 m, bottom at 30 m: half the column in each layer.
    assert_allclose(column_speed(swath(), layers), 2 / (1 / 1520 + 1 / 1480), rtol=1e-5)
    unknown = swath(altitude_hint_m=np.full(50, np.nan))
    assert_allclose(column_speed(unknown, layers), 90 / (10 / 1520 + 80 / 1480), rtol=1e-5)


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_a_survey_applies_the_whole_file(tmp_path):
    sonar = make_xtf(tmp_path / "a.xtf", Plan())
    install = write(
        tmp_path / "install.toml",
        """
        sound_speed = 1470
        [sonar]
        offset_m = [1.0, 0, 0.5]
        roll_deg = 2.5
        [navigation]
        offset_m = [-1.0, 0, 0]
        latency_s = 0.5
        [compass]
        declination_deg = 90
        [vertical]
        datum = "MLLW"
        """,
    )
    tide = write(
        tmp_path / "tide.csv",
        "time,height_m\n2024-05-06T07:00:00Z,2.0\n2024-05-06T08:00:00+00:00,2.0\n",
    )
    plain = open_survey([sonar])
    survey = open_survey([sonar], installation=read_installation(install, tide))
    assert survey.datum == "MLLW"
    assert_allclose(survey.pings.sample_m / plain.pings.sample_m, 0.98)
    # Declination turns the arm of 2 m east; half a second late at 2 m/s is 1 m north.
    assert_allclose(survey.pings.easting_m - plain.pings.easting_m, 2.0, atol=0.01)
    assert_allclose(survey.pings.northing_m - plain.pings.northing_m, 1.0, atol=0.05)
    level = survey.pings.depth_m - plain.pings.depth_m
    down = 2.0 * -np.sin(np.radians(1.5)) + 0.5 * np.cos(np.radians(1.5)) * np.cos(np.radians(2.5))
    assert_allclose(level, down - 2.0, atol=1e-6)
    assert_allclose(np.degrees(survey.pings.roll_rad), 0.0, atol=1e-6)
    assert_allclose(survey.swath(0).sample_m, survey.pings.sample_m)


def test_a_profile_file_and_a_value_are_told_apart(tmp_path):
    profile = write(tmp_path / "p.csv", "depth_m,speed_m_s\n0,1520\n50,1480\n")
    assert read_installation(sound_speed="1490").sound_speed_m_s == 1490.0
    found = read_installation(sound_speed=str(profile)).sound_profile
    assert_allclose(found.at, [0, 50])
    assert read_installation() is None


def test_a_profile_in_install_toml_is_named_from_beside_it(tmp_path):
    write(tmp_path / "p.csv", "depth_m,speed_m_s\n0,1520\n50,1480\n")
    install = write(tmp_path / "install.toml", 'sound_speed = "p.csv"\n')
    assert_allclose(read_installation(install).sound_profile.value, [1520, 1480])
    # The option has the last word.
    assert read_installation(install, sound_speed="1490").sound_profile is None


def test_a_fixed_depth_is_the_sonars_own(tmp_path):
    install = write(tmp_path / "i.toml", "[sonar]\ndepth_m = 0.7\noffset_m = [0, 0, 3]\n")
    survey = open_survey([make_xtf(tmp_path / "a.xtf")], installation=read_installation(install))
    assert_allclose(survey.pings.depth_m, 0.7)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[sonnar]\n", "unknown key 'sonnar'"),
        ("[sonar]\nroll = 3\n", "sonar.roll: unknown key"),
        ("[sonar]\noffset_m = [1, 2]\n", "sonar.offset_m: must be [forward, starboard, down]"),
        ("[sonar]\nroll_deg = 'x'\n", "sonar.roll_deg: must be a number"),
        ("[sonar]\npitch_deg = 120\n", "sonar.pitch_deg: must lie between -90 and 90"),
        ("[navigation]\nlatency_s = nan\n", "navigation.latency_s: must be a number"),
        ("[tow]\ntowed = 1\n", "tow.towed: must be true or false"),
        ("[tow]\ntowed = true\n", "needs layback_m or cable_out_m"),
        ("sonar = 3\n", "sonar must be a table"),
        ("sound_speed = 750\n", "must lie between 1300 and 1700"),
        ("[sonar\n", "not valid TOML"),
    ],
)  # fmt: skip
def test_a_wrong_key_or_value_is_named(tmp_path, text, why):
    with pytest.raises(InputError) as caught:
        read_installation(write(tmp_path / "install.toml", text))
    assert why in str(caught.value)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("when,height_m\n1,2\n", "lacks the column time"),
        ("time,height_m\n", "holds no row"),
        ("time,height_m\nnoon,2\n", "line 2"),
        ("time,height_m\n2024-05-06T07:00:00Z,nan\n", "line 2: is not finite"),
    ],
)
def test_a_wrong_tide_file_is_told_by_line(tmp_path, text, why):
    with pytest.raises(InputError, match=why):
        read_installation(tide=write(tmp_path / "tide.csv", text))


def test_a_tide_needs_a_dated_clock(tmp_path):
    def tweak(i, ping, channels):
        ping.Year = 0

    tide = write(tmp_path / "tide.csv", f"time,height_m\n{START.isoformat()},1\n")
    installation = read_installation(tide=tide)
    with pytest.raises(InputError, match="no date"):
        open_survey([make_xtf(tmp_path / "a.xtf", Plan(tweak=tweak))], installation=installation)


def test_a_tide_needs_a_depth(tmp_path):
    def tweak(i, ping, channels):
        ping.SensorDepth = 0.0

    tide = write(
        tmp_path / "tide.csv",
        "time,height_m\n2024-05-06T07:00:00Z,2.0\n2024-05-06T08:00:00Z,2.0\n",
    )
    sonar = make_xtf(tmp_path / "a.xtf", Plan(tweak=tweak))
    with pytest.raises(InputError, match="no depth that a tide could correct"):
        open_survey([sonar], installation=read_installation(tide=tide))
    fixed = write(tmp_path / "i.toml", "[sonar]\ndepth_m = 0.5\n")
    survey = open_survey([sonar], installation=read_installation(fixed, tide))
    assert_allclose(survey.pings.depth_m, 0.5 - 2.0)
