"""StarFish, Humminbird, Lowrance, JSF and our NetCDF: made here and read back; real files where they are."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from perception.readers import open_survey, scan_file
from perception.readers.jsf import HEADER
from perception.readers.lowrance import _FRAMES
from perception.readers.netcdf import write_netcdf
from perception.records import InputError, Swath

REAL = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "sidescan"


def real(name: str) -> Path:
    path = REAL / name
    if not path.exists():
        pytest.skip(f"{path} is not there")
    return path


# StarFish


def starfish_record(opcode: int, i: int, body: bytes) -> bytes:
    ms = 1000 + 100 * i
    head = struct.pack("<BBHBBBBHIH", 1, opcode, 2020, 3, 4, 5, 6, ms, 7, 0)
    return head + body + b"\x99"


def starfish_log(n: int = 40, south: bool = False) -> bytes:
    rng = np.random.default_rng(5)
    out = b"StarfishScanlineLog".ljust(1000, b"\0")
    for i in range(n):
        zone = b"K" if south else b"P"
        out += starfish_record(
            0x21, i, zone + struct.pack("<Bddd", 21, 1459800.0 + 0.2 * i, 213600.0, 1.0)
        )
        out += starfish_record(0x20, i, struct.pack("<d", 10.0))
        out += starfish_record(0x24, i, struct.pack("<d", 3.0))
        sides = b""
        for side in range(2):
            levels = rng.integers(20 + 50 * side, 40 + 50 * side, 100, np.uint8)
            sides += struct.pack("<4fI", 38, 0, -42, 25, 100) + levels.tobytes()
        out += starfish_record(0x26, i, sides)
    return out


def test_a_starfish_log_comes_back(tmp_path):
    path = tmp_path / "a.logdoc"
    path.write_bytes(starfish_log())
    survey = open_survey([path])
    assert survey.n_pings == 40 and survey.crs == "EPSG:32621" and survey.utc
    swath = survey.swath(0)
    assert_allclose(swath.northing_m, 1459800.0 + 0.2 * np.arange(40))
    assert_allclose(np.diff(swath.time_s), 0.1, atol=1e-6)
    assert_allclose(swath.sample_m, 0.25)
    assert_allclose(swath.depth_m, 3.0)
    assert swath.port.max() < 40 and swath.starboard.min() >= 70
    # Zone 21 at 59.65 W: 2.65 degrees west of its meridian, 13 N: convergence -0.6 degrees.
    assert_allclose(np.degrees(swath.heading_rad), 10.6, atol=0.02)


def test_a_starfish_log_of_the_southern_hemisphere(tmp_path):
    path = tmp_path / "a.logdoc"
    path.write_bytes(starfish_log(south=True))
    assert open_survey([path]).crs == "EPSG:32721"


def test_a_starfish_log_with_foreign_bytes_and_a_cut_end_keeps_the_rest(tmp_path):
    path = tmp_path / "a.logdoc"
    log = starfish_log()
    path.write_bytes(log[:5000] + b"\x01\x26noise" * 9 + log[5000:-77])
    survey = open_survey([path])
    assert survey.n_pings in (38, 39)


def test_the_barbados_log_is_read():
    survey = open_survey([real("starfish_iver2_barbados_20160112.logdoc")])
    assert survey.n_pings == 3259 and survey.crs == "EPSG:32621"
    assert np.isnan(survey.pings.depth_m).all() and np.isnan(survey.pings.altitude_hint_m).all()
    pings = survey.pings
    assert pings.northing_m.min() > 1459807 and pings.easting_m.max() < 213635
    assert survey.swath(0).port.max() <= 188


# Humminbird


def humminbird_record(number: int, ms: int, channel: int, north: int, levels: np.ndarray) -> bytes:
    def long(tag: int, value: int) -> bytes:
        return bytes([tag]) + struct.pack(">i", value)

    head = b"\xc0\xde\xab\x21"
    head += long(0x80, number) + long(0x81, ms) + long(0x82, -12414199) + long(0x83, north)
    head += long(0x84, 65536 + 1977) + long(0x85, 65536 + 27) + long(0x87, 52)
    head += bytes([0x50, channel]) + long(0x92, 455000) + long(0xA0, len(levels)) + b"\x21"
    return head + levels.astype(np.uint8).tobytes()


def humminbird_folder(folder: Path, n: int = 50) -> Path:
    inner = folder / "R00001"
    inner.mkdir(parents=True)
    rng = np.random.default_rng(2)
    for channel, name in ((2, "B002"), (3, "B003")):
        data = b""
        for i in range(n):
            levels = rng.integers(10 * channel, 10 * channel + 9, 300 + i % 3)
            data += humminbird_record(2 * i + channel, 100 * i, channel, 4396652 + i, levels)
        (inner / f"{name}.SON").write_bytes(data)
    words = (0, 0, 0, 0, 0, 1700000000, -12414199, 4396652, *[0] * 8)
    (folder / "R00001.DAT").write_bytes(struct.pack(">16i", *words))
    return folder / "R00001.DAT"


def test_a_humminbird_recording_comes_back_by_its_dat_its_folder_or_a_channel(tmp_path):
    dat = humminbird_folder(tmp_path)
    for path in (dat, tmp_path / "R00001", tmp_path / "R00001" / "B002.SON"):
        survey = open_survey([path])
        assert survey.n_pings == 50 and survey.crs == "EPSG:32612"
        swath = survey.swath(0)
        assert_allclose(swath.time_s, 1.7e9 + 0.1 * np.arange(50))
        assert swath.n_samples == 302 and np.isnan(swath.port[0, 300:]).all()
        assert np.nanmin(swath.port) >= 20 and np.nanmax(swath.port) < 29
        assert np.nanmin(swath.starboard) >= 30 and np.nanmax(swath.starboard) < 39
        assert_allclose(swath.altitude_hint_m, 5.2)


def test_humminbird_metres_become_the_known_place():
    """36.8788 N, 111.5143 W is where the boat was (data sheet); PROJ agrees to a centimetre."""
    import pyproj

    from perception.readers.humminbird import _geographic

    x, y = np.array([-12414199]), np.array([4396652])
    lon, lat = _geographic(x, y)
    there = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=merc +ellps=intl "
        "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
    ).transform(x, y)
    assert_allclose(lon, there[0], atol=1e-9)
    assert_allclose(lat, there[1], atol=1e-6)


def test_a_corrupt_humminbird_record_is_skipped(tmp_path):
    dat = humminbird_folder(tmp_path)
    son = tmp_path / "R00001" / "B003.SON"
    data = bytearray(son.read_bytes())
    data[3700:3720] = bytes(20)
    son.write_bytes(bytes(data[:-40]))
    survey = open_survey([dat])
    assert survey.n_pings == 50 and survey.n_passes == 1
    assert any("corrupt record" in d for d in survey.defects)


def test_the_glen_canyon_recording_is_read():
    survey = open_survey([real("humminbird_pyhum/test.DAT")])
    assert survey.n_pings == 3453 and survey.n_passes == 1 and survey.crs == "EPSG:32612"
    swath = survey.swath(0)
    # Beam in the first ping's field: 197.7 true; the column is quiet out to the first return.
    assert abs(np.degrees(swath.heading_rad[0]) - 198.0) < 1.0
    assert np.nanmedian(swath.port[:, 20:40]) < np.nanmedian(swath.port[:, 300:600])


# Our own NetCDF


def plain_swath(n: int = 60, scanning: bool = False) -> Swath:
    rng = np.random.default_rng(4)
    port = rng.random((n, 40)).astype(np.float32)
    port[:, 35:] = np.nan
    return Swath(
        time_s=1.7e9 + 0.25 * np.arange(n), ping=np.arange(n),
        easting_m=400000.0 + 0.5 * np.arange(n), northing_m=np.full(n, 5.4e6),
        depth_m=np.full(n, 12.0), heading_rad=np.full(n, np.pi / 2), pitch_rad=np.full(n, 0.02),
        roll_rad=np.full(n, -0.03), altitude_hint_m=np.full(n, 9.0), sample_m=np.full(n, 0.2),
        port=np.full((n, 40), np.nan, np.float32) if scanning else port,
        starboard=2 * port, sound_speed_m_s=np.full(n, 1490.0), crs="EPSG:32619",
        sonar="made up", frequency_hz=455e3,
        scan_angle_rad=np.radians(np.linspace(-60, 60, n)) if scanning else None,
    )  # fmt: skip


@pytest.mark.parametrize("scanning", [False, True])
def test_a_swath_goes_out_and_comes_back(tmp_path, scanning):
    swath = plain_swath(scanning=scanning)
    write_netcdf(tmp_path / "a.nc", swath)
    survey = open_survey([tmp_path / "a.nc"])
    assert survey.crs == "EPSG:32619" and survey.utc and survey.n_passes == 1
    back = survey.swath(0)
    for name in ("time_s", "easting_m", "northing_m", "depth_m", "heading_rad", "pitch_rad",
                 "roll_rad", "altitude_hint_m", "sample_m", "sound_speed_m_s"):  # fmt: skip
        assert_allclose(getattr(back, name), getattr(swath, name), atol=1e-7, err_msg=name)
    assert_allclose(back.starboard, swath.starboard[:, :35])
    if scanning:
        assert_allclose(back.scan_angle_rad, swath.scan_angle_rad)
        assert np.isnan(back.port).all()
    else:
        assert_allclose(back.port, swath.port[:, :35])
        assert back.scan_angle_rad is None


def test_a_netcdf_of_something_else_is_refused_by_what_it_lacks(tmp_path):
    import netCDF4

    with netCDF4.Dataset(tmp_path / "map.nc", "w") as data:
        data.createDimension("x", 3)
        data.createVariable("elevation", "f4", ("x",))
    with pytest.raises(InputError, match="it lacks time, easting, northing"):
        scan_file(tmp_path / "map.nc")
    write_netcdf(tmp_path / "cut.nc", plain_swath())
    whole = (tmp_path / "cut.nc").read_bytes()
    (tmp_path / "cut.nc").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"cut\.nc"):
        scan_file(tmp_path / "cut.nc")


# EdgeTech JSF


def jsf_message(kind: int, subsystem: int, channel: int, body: bytes) -> bytes:
    head = struct.pack("<HBBHBBBBHI", 0x1601, 0xD, 0, kind, 0, subsystem, channel, 0, 0, len(body))
    return head + body


def jsf_file(n: int = 40, data_format: int = 0, units: int = 2) -> bytes:
    rng = np.random.default_rng(8)
    out = jsf_message(428, 0, 0, b"information" * 3)
    for i in range(n):
        for subsystem, count in ((20, 100), (21, 200)):
            for channel in (0, 1):
                head = np.zeros(1, HEADER)
                head["time"], head["ms_today"] = 1700000000 + i // 10, 100 * (i % 10)
                head["ping"], head["samples"], head["format"] = 1000 + i, count, data_format
                head["validity"] = 0b0100001001101001
                if units == 2:
                    head["x"], head["y"] = -68.8 * 600000, 48.4 * 600000 + 6 * i
                else:
                    head["x"], head["y"] = 500000 * 100, (5000000 + i) * 100
                head["units"] = units
                head["interval_ns"] = 40000000 // count // 5 * 5
                head["start_10hz"], head["end_10hz"] = 60000, 60000
                head["depth_mm"], head["altitude_mm"] = 7500, 4200
                head["sound_speed"], head["weight"] = 1480.0, 2
                head["heading_cdeg"], head["pitch"], head["roll"] = 100, 182, -364
                level = rng.integers(100 * (1 + channel), 100 * (1 + channel) + 50, count)
                if data_format == 1:
                    level = np.stack([level, np.zeros(count, int)], axis=1) * [[-1, 1]]
                body = head.tobytes() + level.astype("<i2").tobytes()
                out += jsf_message(80, subsystem, channel, body)
    return out


@pytest.mark.parametrize("data_format", [0, 1])
def test_a_jsf_file_comes_back(tmp_path, data_format):
    (tmp_path / "a.jsf").write_bytes(jsf_file(data_format=data_format))
    survey = open_survey([tmp_path / "a.jsf"])
    assert survey.n_pings == 40 and survey.crs == "EPSG:32619" and survey.utc
    swath = survey.swath(0)
    # The finer of two frequencies; weight 2 means a quarter.
    assert swath.n_samples == 200
    assert 25 <= np.nanmin(swath.port) and np.nanmax(swath.port) < 37.5  # noqa: SIM300
    assert 50 <= np.nanmin(swath.starboard) and np.nanmax(swath.starboard) < 62.5  # noqa: SIM300
    assert_allclose(swath.time_s, 1.7e9 + 0.1 * np.arange(40), atol=1e-6)
    assert_allclose(swath.sample_m, 200e-6 * 740)
    assert_allclose(swath.altitude_hint_m, 4.2)
    assert_allclose(swath.depth_m, 7.5)
    assert_allclose(np.degrees(swath.roll_rad), -2.0, atol=1e-3)
    assert_allclose(np.degrees(swath.pitch_rad), 1.0, atol=1e-3)
    assert survey.files[0].frequency_hz == 600e3


def test_a_jsf_in_centimetres_and_with_damage(tmp_path):
    data = bytearray(jsf_file(units=4))
    start = data.find(b"\x01\x16", 9000)
    data[start : start + 100] = bytes(100)
    (tmp_path / "a.jsf").write_bytes(bytes(data[:-50]))
    survey = open_survey([tmp_path / "a.jsf"])
    assert survey.n_pings >= 38
    assert_allclose(survey.pings.easting_m, 500000.0)
    assert any("corrupt" in d for d in survey.defects)
    assert any("mid-message" in d for d in survey.defects)


# Lowrance


def sl2_file(channels: tuple[int, ...], n: int = 30) -> bytes:
    out = struct.pack("<HHHH", 2, 0, 3200, 0)
    rng = np.random.default_rng(9)
    frame = _FRAMES[2]
    for i in range(n):
        for channel in channels:
            near = rng.integers(10 * channel, 10 * channel + 9, 200).astype(np.uint8)
            level = near if channel != 5 else np.concatenate([near[:100], 100 + near[100:]])
            head = np.zeros(1, frame)
            head["offset"], head["frame_bytes"] = len(out), 144 + len(level)
            head["channel"], head["packet_bytes"], head["number"] = channel, len(level), 6 * i
            head["lower_ft"], head["depth_ft"], head["unix_s"] = 30 / 0.3048, 10.0, 1.6e9
            head["east"], head["north"] = 3585761 + i, 8384000
            head["heading"], head["ms"] = np.pi / 2, 100 * i
            out += head.tobytes() + level.tobytes()
    return out


@pytest.mark.parametrize("channels", [(0, 3, 4), (0, 5), (4, 3, 2)])
def test_an_sl2_log_with_side_scan_comes_back(tmp_path, channels):
    (tmp_path / "a.sl2").write_bytes(sl2_file(channels))
    survey = open_survey([tmp_path / "a.sl2"])
    assert survey.n_pings == 30 and survey.utc
    swath = survey.swath(0)
    assert_allclose(swath.altitude_hint_m, 3.048, rtol=1e-6)
    assert_allclose(np.diff(swath.time_s), 0.1, atol=1e-6)
    if 5 in channels:
        assert swath.n_samples == 100 and swath.port.max() < 100 <= swath.starboard.min()
        assert_allclose(swath.sample_m, 0.3, rtol=1e-6)
    else:
        assert swath.port.max() < 40 <= swath.starboard.min()
        assert_allclose(swath.sample_m, 0.15, rtol=1e-6)


def test_an_sl2_without_side_scan_is_told_and_not_mapped(tmp_path):
    path = tmp_path / "a.sl2"
    path.write_bytes(sl2_file((0, 2)))
    assert scan_file(path).packets == {"primary": 30, "downscan": 30}
    with pytest.raises(InputError, match="holds no side-scan"):
        open_survey([path])


def test_a_damaged_sl2_keeps_the_frames_around(tmp_path):
    data = bytearray(sl2_file((3, 4)))
    data[3000:3400] = bytes(400)
    (tmp_path / "a.sl2").write_bytes(bytes(data[:-30]))
    survey = open_survey([tmp_path / "a.sl2"])
    assert survey.n_pings >= 27
    assert any("corrupt" in d for d in survey.defects)


def test_the_ladoga_log_is_told():
    raw = scan_file(real("lowrance_input.sl2"))
    assert raw.packets == {"primary": 111, "downscan": 111} and len(raw.pings) == 0
    assert "water depth 3.98 to 4.22 m" in raw.notes
