"""XTF as written is read by pyxtf with every value where it belongs."""

from dataclasses import replace

import numpy as np
import pyxtf
from numpy.testing import assert_allclose

from scenarios.sonar.xtf import SonarLog, write_xtf


def log_of(n=5, samples=33):
    rng = np.random.default_rng(0)
    return SonarLog(
        # The last hundredth of a leap day: every carry at once.
        time_s=np.datetime64("2028-02-29T23:59:59.990", "ms").astype(float) / 1000 + np.arange(n) * 0.25,
        longitude_deg=-2.16 + np.arange(n) * 1e-6,
        latitude_deg=50.09 + np.arange(n) * 1e-6,
        heading_deg=np.linspace(0, 350, n),
        pitch_deg=np.linspace(-3, 3, n),
        roll_deg=np.linspace(2, -2, n),
        depth_m=np.linspace(40, 41, n),
        altitude_m=np.linspace(15, 14, n),
        speed_m_s=np.full(n, 1.5),
        counts=rng.integers(0, 65536, (n, 2, samples)).astype(np.uint16),
        range_m=50.0, ping_period_s=0.25, sound_speed_m_s=1490.0, frequency_khz=450.0,
        horizontal_beam_deg=0.8, vertical_beam_deg=55.0, tilt_deg=30.0,
    )  # fmt: skip


def read(path):
    header, packets = pyxtf.xtf_read(str(path))
    return header, packets[pyxtf.XTFHeaderType.sonar]


def test_pings_read_back_as_written(tmp_path):
    log = log_of()
    write_xtf(tmp_path / "a.xtf", log)
    header, pings = read(tmp_path / "a.xtf")
    assert header.NavUnits == 3 and header.NumberOfSonarChannels == 2
    assert [header.ChanInfo[i].TypeOfChannel for i in range(2)] == [1, 2]
    assert len(pings) == 5
    for i, ping in enumerate(pings):
        assert (ping.data[0] == log.counts[i, 0]).all()
        assert (ping.data[1] == log.counts[i, 1]).all()
        assert_allclose(ping.SensorXcoordinate, log.longitude_deg[i], atol=1e-12)
        assert_allclose(ping.SensorYcoordinate, log.latitude_deg[i], atol=1e-12)
        for field, values in (
            ("SensorHeading", log.heading_deg), ("SensorPitch", log.pitch_deg),
            ("SensorRoll", log.roll_deg), ("SensorDepth", log.depth_m),
            ("SensorPrimaryAltitude", log.altitude_m),
        ):  # fmt: skip
            assert_allclose(getattr(ping, field), values[i], rtol=1e-6)
        assert ping.PingNumber == i
        assert ping.ping_chan_headers[0].SlantRange == 50.0
        assert_allclose(
            ping.get_time().astype("datetime64[ms]").astype(float) / 1000, log.time_s[i], atol=1e-3
        )


def test_the_carry_into_march_is_right(tmp_path):
    write_xtf(tmp_path / "a.xtf", log_of())
    _, pings = read(tmp_path / "a.xtf")
    assert (pings[0].Month, pings[0].Day, pings[0].HSeconds) == (2, 29, 99)
    assert (pings[1].Month, pings[1].Day, pings[1].Hour, pings[1].HSeconds) == (3, 1, 0, 24)
    assert (pings[0].JulianDay, pings[1].JulianDay) == (60, 61)


def test_packets_are_multiples_of_64_bytes_and_port_may_run_far_to_near(tmp_path):
    log = replace(log_of(), port_far_to_near=True)
    write_xtf(tmp_path / "a.xtf", log)
    _, pings = read(tmp_path / "a.xtf")
    assert pings[0].NumBytesThisRecord % 64 == 0
    assert (pings[2].data[0] == log.counts[2, 0, ::-1]).all()
    assert (pings[2].data[1] == log.counts[2, 1]).all()
