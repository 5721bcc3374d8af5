"""XTF: what was written comes back, whatever the recorder's habits and whatever is broken."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from perception.geodesy import LOCAL_CRS
from perception.readers import PingFlag, open_survey
from perception.records import InputError
from tests.perception.xtf_maker import (
    START,
    Plan,
    attitude_bytes,
    echo,
    make_xtf,
    navigation_bytes,
    xtf_packets,
)

REAL = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "sidescan"


def said(survey, text: str) -> bool:
    return any(text in defect for defect in survey.defects)


def test_headers_and_samples_come_back_as_written(tmp_path):
    plan = Plan()
    survey = open_survey([make_xtf(tmp_path / "a.xtf", plan)])
    assert survey.crs == "EPSG:32619" and survey.utc and survey.n_pings == 60
    assert survey.n_passes == 1
    swath = survey.swath(0)
    assert_allclose(swath.time_s - START.timestamp(), 0.2 * np.arange(60), atol=0.011)
    # 0.011 m: metres a degree of latitude are rounded in the plan.
    assert_allclose(np.diff(swath.northing_m), 0.4, rtol=5e-3)
    assert_allclose(swath.depth_m, 10.0)
    assert_allclose(np.degrees(swath.roll_rad), -2.5)
    assert_allclose(np.degrees(swath.pitch_rad), 1.5)
    assert_allclose(swath.sample_m, 30.0 / 256, rtol=1e-6)
    assert_allclose(swath.sound_speed_m_s, 1500.0)
    rng = np.random.default_rng(0)
    assert_allclose(swath.port[0], echo(plan, rng, 0).astype(np.uint16))
    assert_allclose(swath.starboard[0], echo(plan, rng, 1).astype(np.uint16))


@pytest.mark.parametrize("port_far", [True, False])
@pytest.mark.parametrize("starboard_far", [True, False])
@pytest.mark.parametrize("altitude_m", [2.0, 6.0, 18.0])
def test_the_near_end_is_found_from_the_echoes(tmp_path, port_far, starboard_far, altitude_m):
    plan = Plan(
        port_far_first=port_far, starboard_far_first=starboard_far, altitude_m=altitude_m,
        samples=1024,
        tweak=lambda i, ping, channels: setattr(ping, "SensorPrimaryAltitude", 0.0),
    )  # fmt: skip
    swath = open_survey([make_xtf(tmp_path / "a.xtf", plan)]).swath(0)
    bottom = round(altitude_m / 30.0 * 1024)
    for side in (swath.port, swath.starboard):
        assert np.median(side[:, 10 : bottom - 2]) < 0.05 * np.median(side[:, bottom : bottom + 50])
    assert np.isnan(swath.altitude_hint_m).all()


@pytest.mark.parametrize(
    ("dtype", "sample_format", "scale"),
    [
        (np.uint8, 0, 1 / 240), (np.uint8, 8, 1 / 240), (np.uint16, 0, 1.0), (np.uint16, 3, 1.0),
        (np.uint32, 2, 1.0), (np.uint32, 0, 50.0), (np.float32, 5, 1e-4), (np.float32, 0, 1e-4),
    ],
)  # fmt: skip
def test_every_sample_width_reads_the_same(tmp_path, dtype, sample_format, scale):
    plan = Plan(dtype=dtype, sample_format=sample_format, scale=scale, n=30)
    swath = open_survey([make_xtf(tmp_path / "a.xtf", plan)]).swath(0)
    rng = np.random.default_rng(0)
    assert_allclose(swath.port[0], echo(plan, rng, 0).astype(dtype), rtol=1e-6)


def test_signed_waveforms_become_amplitudes(tmp_path):
    plan = Plan(n=30)
    header, *packets = xtf_packets(plan)
    rng = np.random.default_rng(1)
    signed = [header]
    for packet in packets:
        raw = bytearray(packet)
        for at in (256 + 64, 256 + 64 + 512 + 64):
            level = np.frombuffer(bytes(raw[at : at + 512]), "<u2").astype(float) / 8
            swing = level * rng.choice([-1, 1], 256)
            raw[at : at + 512] = swing.astype("<i2").tobytes()
        signed.append(bytes(raw))
    path = tmp_path / "a.xtf"
    path.write_bytes(b"".join(signed))
    survey = open_survey([path])
    assert "signed" in survey.files[0].bits
    assert np.nanmin(survey.swath(0).port) >= 0


def test_samples_and_range_may_change_from_ping_to_ping(tmp_path):
    def tweak(i, ping, channels):
        if i >= 30:
            for channel in channels:
                channel.NumSamples = 128
                channel.SlantRange = 20.0
                channel.TimeDuration = 20.0 / 750.0

    path = make_xtf(tmp_path / "a.xtf", Plan(tweak=tweak, port_far_first=False))
    swath = open_survey([path]).swath(0)
    assert swath.port.shape == (60, 256)
    assert_allclose(swath.sample_m[[0, 59]], [30.0 / 256, 20.0 / 128], rtol=1e-6)
    assert np.isfinite(swath.port[30:, :128]).all() and np.isnan(swath.port[30:, 128:]).all()


def test_a_recording_delay_moves_the_samples_outward(tmp_path):
    def tweak(i, ping, channels):
        for channel in channels:
            channel.TimeDelay = 4.0 / 1500.0 * 2.0  # 4 m of slant range

    plain = open_survey([make_xtf(tmp_path / "a.xtf", Plan())]).swath(0)
    late = open_survey([make_xtf(tmp_path / "b.xtf", Plan(tweak=tweak))]).swath(0)
    shift = round(4.0 / (30.0 / 256))
    assert np.isnan(late.port[:, :shift]).all()
    assert_allclose(late.port[:, shift:], plain.port)


def test_halved_sound_speed_is_doubled_and_told(tmp_path):
    def tweak(i, ping, channels):
        ping.SoundVelocity = 742.0

    survey = open_survey([make_xtf(tmp_path / "a.xtf", Plan(tweak=tweak))])
    assert_allclose(survey.pings.sound_speed_m_s, 1484.0)
    assert said(survey, "halved")


def test_block_weights_are_undone(tmp_path):
    def tweak(i, ping, channels):
        channels[0].Weight = 3 if i % 2 else 0

    swath = open_survey([make_xtf(tmp_path / "a.xtf", Plan(tweak=tweak))]).swath(0)
    ratio = np.median(swath.port[1::2]) / np.median(swath.port[::2])
    assert_allclose(ratio, 1 / 8, rtol=0.1)


def test_zero_position_in_the_first_ping_is_filled_and_in_no_pass(tmp_path):
    def tweak(i, ping, channels):
        if i == 0:
            ping.SensorXcoordinate = ping.SensorYcoordinate = ping.SensorDepth = 0.0

    survey = open_survey([make_xtf(tmp_path / "a.xtf", Plan(tweak=tweak))])
    pings = survey.pings
    assert pings.pass_index[0] == -1 and np.all(pings.pass_index[1:] == 0)
    assert pings.flags[0] & PingFlag.POSITION_FILLED
    assert_allclose(pings.northing_m[1] - pings.northing_m[0], 0.4, atol=0.05)
    assert_allclose(pings.depth_m[0], 10.0)
    assert survey.swath(0).ping[0] == 1


def test_metres_without_a_zone_give_a_local_grid_and_one_warning(tmp_path):
    path = make_xtf(tmp_path / "a.xtf", Plan(nav_units=0))
    survey = open_survey([path])
    assert survey.crs == LOCAL_CRS and len(survey.warnings) == 1
    assert_allclose(survey.pings.easting_m, 500000.0)
    assert_allclose(survey.pings.heading_rad, 0.0, atol=1e-12)
    placed = open_survey([path], crs="EPSG:32619")
    assert placed.crs == "EPSG:32619" and not placed.warnings
    assert_allclose(placed.pings.northing_m, survey.pings.northing_m)


def test_degrees_declared_as_metres_are_seen_through(tmp_path):
    def tweak(i, ping, channels):
        ping.SensorXcoordinate, ping.SensorYcoordinate = -68.8, 48.5 + 0.4 * i / 111200.0

    plan = Plan(nav_units=0, tweak=tweak)
    survey = open_survey([make_xtf(tmp_path / "a.xtf", plan)])
    assert survey.crs == "EPSG:32619" and said(survey, "taken for degrees")


def test_the_ship_position_serves_where_the_sensor_has_none(tmp_path):
    def tweak(i, ping, channels):
        ping.ShipXcoordinate, ping.ShipYcoordinate = ping.SensorXcoordinate, ping.SensorYcoordinate
        ping.SensorXcoordinate = ping.SensorYcoordinate = 0.0
        ping.ShipGyro, ping.SensorHeading = 0.5, 0.0

    survey = open_survey([make_xtf(tmp_path / "a.xtf", Plan(tweak=tweak))])
    plain = open_survey([make_xtf(tmp_path / "b.xtf", Plan())])
    assert_allclose(survey.pings.northing_m, plain.pings.northing_m)
    turned = np.degrees(survey.pings.heading_rad - plain.pings.heading_rad)
    assert_allclose(turned % 360.0, 0.5, atol=1e-6)


def test_navigation_packets_serve_where_pings_have_no_position(tmp_path):
    def tweak(i, ping, channels):
        ping.SensorXcoordinate = ping.SensorYcoordinate = 0.0

    packets = {
        i: [navigation_bytes(START + timedelta(seconds=0.2 * i), -68.8, 48.5 + 0.4 * i / 111200.0)]
        for i in range(0, 60, 5)
    }
    path = make_xtf(tmp_path / "a.xtf", Plan(n=56, tweak=tweak, before_ping=packets))
    survey = open_survey([path])
    assert_allclose(np.diff(survey.pings.northing_m), 0.4, rtol=5e-3)
    assert said(survey, "navigation packets")


def test_true_headings_become_grid_headings(tmp_path):
    def track(t):
        return -71.9, 48.5 + 2.0 * t / 111200.0, 0.0  # 2.9 degrees west of zone 19's meridian

    survey = open_survey([make_xtf(tmp_path / "a.xtf", Plan(track=track))])
    pings = survey.pings
    course = np.arctan2(np.ptp(pings.easting_m) * np.sign(pings.easting_m[-1] - pings.easting_m[0]),
                        np.ptp(pings.northing_m))  # fmt: skip
    heading = (pings.heading_rad + np.pi) % (2 * np.pi) - np.pi
    assert abs(np.degrees(course)) > 2.0
    assert_allclose(heading, course, atol=1e-4)


def test_attitude_packets_are_interpolated_to_the_pings(tmp_path):
    packets = {
        i: [attitude_bytes(START + timedelta(seconds=0.2 * i), 0.1 * i, -0.05 * i, 10.0 + 0.2 * i)]
        for i in range(0, 60, 4)
    }

    def track(t):
        return -68.8, 48.5 + 2.0 * t / 111200.0, 10.0

    plan = Plan(n=57, before_ping=packets, track=track)
    survey = open_survey([make_xtf(tmp_path / "a.xtf", plan)])
    index = np.arange(57)
    # Hundredths of seconds in the ping against a slope of 0.5 deg/s: 0.01 deg.
    assert_allclose(np.degrees(survey.pings.roll_rad), 0.1 * index, atol=0.01)
    assert_allclose(np.degrees(survey.pings.pitch_rad), -0.05 * index, atol=0.01)
    assert survey.files[0].packets == {"sonar": 57, "attitude": 15}


def test_depth_zero_throughout_is_unknown_and_told(tmp_path):
    def tweak(i, ping, channels):
        ping.SensorDepth = 0.0

    survey = open_survey([make_xtf(tmp_path / "a.xtf", Plan(tweak=tweak))])
    assert np.isnan(survey.pings.depth_m).all()
    assert any("relative to the sonar" in w for w in survey.warnings)


def test_a_clock_without_a_date_gives_seconds(tmp_path):
    def tweak(i, ping, channels):
        ping.Year = ping.Month = ping.Day = 0

    survey = open_survey([make_xtf(tmp_path / "a.xtf", Plan(tweak=tweak))])
    assert not survey.utc
    assert_allclose(np.diff(survey.pings.time_s), 0.2, atol=0.011)


def test_single_stamps_running_backwards_are_mended(tmp_path):
    def tweak(i, ping, channels):
        if i in (20, 40):
            ping.Minute -= 1

    survey = open_survey([make_xtf(tmp_path / "a.xtf", Plan(tweak=tweak))])
    assert_allclose(survey.pings.time_s - START.timestamp(), 0.2 * np.arange(60), atol=0.02)
    assert survey.n_passes == 1 and said(survey, "clock wrong in 2 pings")
    assert np.flatnonzero(survey.pings.flags & PingFlag.CLOCK_FILLED).tolist() == [20, 40]


def test_a_clock_set_back_ends_the_pass(tmp_path):
    def tweak(i, ping, channels):
        if i >= 30:
            ping.Hour -= 1

    survey = open_survey([make_xtf(tmp_path / "a.xtf", Plan(tweak=tweak))])
    assert survey.n_passes == 2 and said(survey, "set back 1 time")


def test_a_clock_of_whole_seconds_is_spread(tmp_path):
    def tweak(i, ping, channels):
        ping.HSeconds = 0

    survey = open_survey([make_xtf(tmp_path / "a.xtf", Plan(tweak=tweak))])
    assert_allclose(np.diff(survey.pings.time_s), 0.2, atol=1e-6)
    assert said(survey, "spread evenly")


def test_positions_held_between_fixes_are_interpolated(tmp_path):
    def track(t):
        held = np.floor(t + 1e-9)
        return -68.8, 48.5 + 2.0 * held / 111200.0, 0.0

    plan = Plan(track=track)
    survey = open_survey([make_xtf(tmp_path / "a.xtf", plan)])
    assert_allclose(np.diff(survey.pings.northing_m), 0.4, rtol=0.06)
    assert survey.n_passes == 1 and survey.pings.usable.all()


def test_one_sided_packets_of_a_ping_are_joined(tmp_path):
    whole = xtf_packets(Plan(n=30))
    packets = [whole[0]]
    for packet in whole[1:]:
        head, port, starboard = packet[:256], packet[256:832], packet[832:1408]
        for body in (port, starboard):
            one = bytearray(head)
            one[4:6] = (1).to_bytes(2, "little")
            one[10:14] = (256 + 576).to_bytes(4, "little")
            packets.append(bytes(one) + body)
    path = tmp_path / "a.xtf"
    path.write_bytes(b"".join(packets))
    joined = open_survey([path])
    plain = open_survey([make_xtf(tmp_path / "b.xtf", Plan(n=30))])
    assert joined.n_pings == 30
    assert_allclose(joined.swath(0).port, plain.swath(0).port)
    assert_allclose(joined.swath(0).starboard, plain.swath(0).starboard)


def test_two_channels_without_a_type_are_taken_for_port_and_starboard(tmp_path):
    untyped = xtf_packets(Plan(channel_types=(1, 2)))
    header = bytearray(untyped[0])
    header[256] = header[256 + 128] = 0
    path = tmp_path / "a.xtf"
    path.write_bytes(bytes(header) + b"".join(untyped[1:]))
    survey = open_survey([path])
    assert said(survey, "channel 0 is taken for port and channel 1 is taken for starboard")
    swath = survey.swath(0)
    assert_allclose(np.median(swath.starboard) / np.median(swath.port), 2.0, rtol=0.1)


def test_packets_of_a_sub_bottom_profiler_are_no_pings(tmp_path):
    plan = Plan(channel_types=(1, 2, 0))
    header, *side_scan = xtf_packets(plan)
    mixed = []
    for packet in side_scan:
        profile = bytearray(packet[:256] + packet[256 + 2 * 576 : 256 + 3 * 576])
        profile[4:6] = (1).to_bytes(2, "little")
        profile[10:14] = len(profile).to_bytes(4, "little")
        sides = bytearray(packet[: 256 + 2 * 576])
        sides[4:6] = (2).to_bytes(2, "little")
        sides[10:14] = len(sides).to_bytes(4, "little")
        mixed += [bytes(sides), bytes(profile)]
    path = tmp_path / "a.xtf"
    path.write_bytes(header + b"".join(mixed))
    survey = open_survey([path])
    assert survey.n_pings == 60 and survey.files[0].packets == {"sonar": 120}
    assert survey.swath(0).ping.tolist() == list(range(60))


def test_channels_that_all_call_themselves_0_count_by_their_place(tmp_path):
    def tweak(i, ping, channels):
        channels[1].ChannelNumber = 0

    swath = open_survey([make_xtf(tmp_path / "a.xtf", Plan(tweak=tweak))]).swath(0)
    assert_allclose(np.median(swath.starboard) / np.median(swath.port), 2.0, rtol=0.1)


def test_packets_that_do_not_state_their_length_are_read(tmp_path):
    header, *packets = xtf_packets(Plan())
    for i, packet in enumerate(packets):
        packets[i] = packet[:10] + bytes(4) + packet[14 : 256 + 2 * (64 + 512)]
    path = tmp_path / "a.xtf"
    path.write_bytes(header + b"".join(packets))
    survey = open_survey([path])
    assert survey.n_pings == 60 and not said(survey, "corrupt")


def test_lengths_that_count_a_padding_which_is_not_there_cost_no_ping(tmp_path):
    header, *packets = xtf_packets(Plan(samples=250))
    path = tmp_path / "a.xtf"
    path.write_bytes(header + b"".join(p[: 256 + 2 * (64 + 500)] for p in packets))
    survey = open_survey([path])
    assert survey.n_pings >= 59


def test_headings_far_off_the_track_are_told_and_kept(tmp_path):
    def tweak(i, ping, channels):
        ping.SensorHeading = 60.0

    survey = open_survey([make_xtf(tmp_path / "a.xtf", Plan(tweak=tweak))])
    assert said(survey, "60 deg off the track")
    assert abs(np.degrees(survey.pings.heading_rad[0]) - 60.0) < 1.0


def test_a_single_side_leaves_the_other_empty(tmp_path):
    survey = open_survey([make_xtf(tmp_path / "a.xtf", Plan(channel_types=(2,)))])
    swath = survey.swath(0)
    assert np.isnan(swath.port).all() and np.isfinite(swath.starboard).all()
    assert said(survey, "no port channel")


def test_starboard_before_port_is_told_by_the_channel_type(tmp_path):
    swath = open_survey([make_xtf(tmp_path / "a.xtf", Plan(channel_types=(2, 1)))]).swath(0)
    assert_allclose(np.median(swath.starboard) / np.median(swath.port), 2.0, rtol=0.1)


def test_other_channels_and_packets_beside_the_side_scan_are_left_alone(tmp_path):
    multibeam = bytearray(bytes(xtf_packets(Plan(n=1))[1][:256]) + b"\x07" * 320)
    multibeam[2] = 17
    multibeam[10:14] = (576).to_bytes(4, "little")
    plan = Plan(channel_types=(0, 1, 2), before_ping={i: [bytes(multibeam)] for i in range(60)})
    survey = open_survey([make_xtf(tmp_path / "a.xtf", plan)])
    assert survey.n_pings == 60 and survey.files[0].packets == {"sonar": 60, "bathy xyza": 60}
    swath = survey.swath(0)
    assert_allclose(np.median(swath.starboard) / np.median(swath.port), 2.0, rtol=0.1)


def test_a_file_cut_in_mid_packet_keeps_all_before(tmp_path):
    path = make_xtf(tmp_path / "a.xtf")
    path.write_bytes(path.read_bytes()[:-100])
    survey = open_survey([path])
    assert survey.n_pings == 59 and said(survey, "stops in mid-packet")


@pytest.mark.parametrize("damage", ["magic", "length longer", "length shorter", "noise", "zeros"])
def test_corrupt_packets_are_skipped_and_counted(tmp_path, damage):
    packets = xtf_packets(Plan())
    bad = bytearray(packets[21])
    if damage == "magic":
        bad[0] = 0
    elif damage == "length longer":
        bad[10:14] = (len(bad) + 700).to_bytes(4, "little")
    elif damage == "length shorter":
        bad[10:14] = (300).to_bytes(4, "little")
    elif damage == "noise":
        bad[:] = np.random.default_rng(3).integers(0, 256, len(bad), np.uint8).tobytes()
    else:
        bad[:] = bytes(len(bad))
    packets[21] = bytes(bad)
    path = tmp_path / "a.xtf"
    path.write_bytes(b"".join(packets))
    survey = open_survey([path])
    # A wrong length alone leaves the ping itself readable.
    assert survey.n_pings in ((60,) if damage == "length longer" else (59,))
    assert said(survey, "corrupt place")
    assert survey.pings.number[-1] == 59


def test_two_files_are_one_survey_in_the_order_given(tmp_path):
    first = make_xtf(tmp_path / "a.xtf", Plan(n=40))
    later = Plan(n=30, start=START + timedelta(minutes=5), nav_units=3)
    second = make_xtf(tmp_path / "b.xtf", later)
    survey = open_survey([second, first])
    assert survey.n_pings == 70 and survey.n_passes == 2
    assert survey.swath(0).ping[0] == 0 and survey.swath(0).source == "b.xtf"
    assert survey.swath(1).ping[0] == 30 and survey.swath(1).n_pings == 40


def test_a_record_given_twice_counts_once_and_is_told(tmp_path):
    first = make_xtf(tmp_path / "a.xtf", Plan(n=40))
    copy = tmp_path / "b.xtf"
    copy.write_bytes(first.read_bytes())
    for paths in ([first, first], [first, copy]):
        survey = open_survey(paths)
        assert survey.n_pings == 40 and survey.n_passes == 1
        assert any("again: left out" in text for text in survey.warnings)
    other = make_xtf(tmp_path / "c.xtf", Plan(n=40, seed=1))
    assert open_survey([first, other]).n_pings == 80


def test_a_grid_whose_metres_are_none_here_is_refused(tmp_path):
    path = make_xtf(tmp_path / "a.xtf", Plan(n=40))
    zone = open_survey([path]).crs
    with pytest.raises(InputError, match=r"EPSG:3857 is made for another place: .* % off"):
        open_survey([path], crs="EPSG:3857")
    assert zone.startswith("EPSG:32") and not open_survey([path], crs=zone).warnings


def test_files_that_continue_each_other_are_one_pass(tmp_path):
    plan = Plan(n=60)
    header, *packets = xtf_packets(plan)
    for name, part in (("a", packets[:30]), ("b", packets[30:])):
        (tmp_path / f"{name}.xtf").write_bytes(header + b"".join(part))
    survey = open_survey([tmp_path / "a.xtf", tmp_path / "b.xtf"])
    whole = open_survey([make_xtf(tmp_path / "c.xtf", plan)])
    assert survey.n_passes == 1
    assert_allclose(survey.swath(0).port, whole.swath(0).port)


def refused(path: Path, text: str, crs: str | None = None) -> None:
    with pytest.raises(InputError) as caught:
        open_survey([path], crs=crs)
    message = str(caught.value)
    assert text in message and "\n" not in message
    assert crs is not None or path.name in message


def test_what_cannot_be_used_is_refused_with_the_reason(tmp_path):
    def nowhere(i, ping, channels):
        ping.SensorXcoordinate = ping.SensorYcoordinate = 0.0

    def nan(i, ping, channels):
        ping.SensorXcoordinate = ping.SensorYcoordinate = float("nan")

    refused(tmp_path / "absent.xtf", "no such file")
    (tmp_path / "empty.xtf").write_bytes(b"")
    refused(tmp_path / "empty.xtf", "is empty")
    noise = np.random.default_rng(0).integers(0, 256, 50000, np.uint8).tobytes()
    (tmp_path / "noise.xtf").write_bytes(noise)
    refused(tmp_path / "noise.xtf", "no sonar file")
    (tmp_path / "head.xtf").write_bytes(b"\x7b" + noise)
    refused(tmp_path / "head.xtf", "no side-scan")
    refused(make_xtf(tmp_path / "one.xtf", Plan(n=1)), "1 usable of 1 side-scan ping")
    refused(make_xtf(tmp_path / "nine.xtf", Plan(n=9)), "at least 10")
    refused(make_xtf(tmp_path / "zero.xtf", Plan(tweak=nowhere)), "has a valid position")
    refused(make_xtf(tmp_path / "nan.xtf", Plan(tweak=nan)), "has a valid position")
    refused(make_xtf(tmp_path / "sub.xtf", Plan(channel_types=(0, 3))), "no port or starboard")
    good = make_xtf(tmp_path / "good.xtf")
    for crs, why in (
        ("EPSG:4326", "degrees"),
        ("nonsense", "does not know"),
        ("EPSG:2263", "unit"),
    ):
        refused(good, why, crs)


def test_ten_pings_are_enough(tmp_path):
    survey = open_survey([make_xtf(tmp_path / "a.xtf", Plan(n=10))])
    assert survey.n_passes == 1 and survey.swath(0).n_pings == 10


def test_the_iver2_file_is_read_with_all_its_quirks():
    path = REAL / "scotsman-iver2.xtf"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    survey = open_survey([path])
    assert survey.n_pings == 461 and survey.n_passes == 1 and survey.crs == "EPSG:32619"
    assert survey.pings.pass_index[0] == -1 and np.all(survey.pings.pass_index[1:] == 0)
    assert_allclose(survey.pings.sound_speed_m_s, 1500.0)
    swath = survey.swath(0)
    # Near the vehicle lie the transmit pulse (saturated) and the quiet water column.
    for side in (swath.port, swath.starboard):
        assert np.median(side[:, :8]) == 32767
        assert np.median(side[:, 10:60]) < 500
    # Heading is true in the file; west of the zone's middle line by 0.83 deg it is 0.13 deg off grid.
    assert 0.05 < abs(np.degrees(swath.heading_rad[0]) - 354.18) < 0.2
