"""`bathynav info` and bad sonar files, through the command line as a user meets them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from scenarios.commands import main
from tests.perception.xtf_maker import Plan, make_xtf

REAL = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "sidescan"


@pytest.fixture
def bathynav(monkeypatch, capsys):
    """Run the command line in this process; give its status, standard output and error."""

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["bathynav", *map(str, words)])
        with pytest.raises(SystemExit) as left:
            main()
        captured = capsys.readouterr()
        return int(left.value.code or 0), captured.out, captured.err

    return run


def nowhere(i, ping, channels):
    ping.SensorXcoordinate = ping.SensorYcoordinate = 0.0


def nan_positions(i, ping, channels):
    ping.SensorXcoordinate = ping.SensorYcoordinate = float("nan")


def bad_files(folder: Path) -> dict[str, tuple[Path, str]]:
    """Every kind of bad file, with a word that its one line must hold."""
    noise = np.random.default_rng(0).integers(0, 256, 30000, np.uint8).tobytes()
    made = {
        "empty.xtf": (b"", "empty"),
        "noise.xtf": (noise, "no sonar file"),
        "noise.dat": (noise, "no sonar file"),
        "head.xtf": (b"\x7b" + noise, "no side-scan"),
        "text.xtf": (b"time,easting\n1,2\n", "no sonar file"),
        "picture.png": (b"\x89PNG\r\n\x1a\n" + noise, "no sonar file"),
        "short.xtf": (b"\x7b\x01pyxtf", "no side-scan"),
    }
    found = {}
    for name, (content, word) in made.items():
        (folder / name).write_bytes(content)
        found[name] = (folder / name, word)
    found["absent.xtf"] = (folder / "absent.xtf", "no such file")
    (folder / "folder.xtf").mkdir()
    found["folder.xtf"] = (folder / "folder.xtf", "folder")
    for name, plan, word in (
        ("one.xtf", Plan(n=1), "1 usable of 1"),
        ("zero.xtf", Plan(tweak=nowhere), "valid position"),
        ("nan.xtf", Plan(tweak=nan_positions), "valid position"),
        ("subbottom.xtf", Plan(channel_types=(0, 3)), "no port or starboard"),
    ):
        found[name] = (make_xtf(folder / name, plan), word)
    whole = make_xtf(folder / "cut.xtf", Plan(n=20)).read_bytes()
    (folder / "cut.xtf").write_bytes(whole[: 1024 + 3 * 1408 + 200])
    found["cut.xtf"] = (folder / "cut.xtf", "3 usable of 3")
    return found


BAD = (
    "empty.xtf", "noise.xtf", "noise.dat", "head.xtf", "text.xtf", "picture.png", "short.xtf",
    "absent.xtf", "folder.xtf", "one.xtf", "zero.xtf", "nan.xtf", "subbottom.xtf", "cut.xtf",
)  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_gives_one_plain_line_and_status_1(tmp_path, bathynav, name):
    path, word = bad_files(tmp_path)[name]
    status, out, err = bathynav("info", path)
    assert status == 1 and out == ""
    assert len(err.strip().splitlines()) == 1
    assert str(path) in err and word in err and "Traceback" not in err
    # The way out stands after the last semicolon or is a question.
    assert ";" in err


def test_info_tells_what_a_file_holds(tmp_path, bathynav):
    path = make_xtf(tmp_path / "a.xtf", Plan())
    before = sorted(tmp_path.iterdir())
    status, out, err = bathynav("info", path)
    assert status == 0 and err == ""
    for word in ("XTF", "60 sonar", "60 usable", "port and starboard, 16-bit integer, 600 kHz",
                 "256 a side", "30.00 m", "EPSG:32619", "2024-05-06 07:08:09", "10.00 m", "6.00 m",
                 "pass 0", "23."):  # fmt: skip
        assert word in out, word
    assert sorted(tmp_path.iterdir()) == before


def test_every_defect_has_a_line_of_its_own(tmp_path, bathynav):
    def tweak(i, ping, channels):
        ping.SoundVelocity = 750.0
        ping.SensorDepth = 0.0
        ping.SensorPrimaryAltitude = 3.0
        if i == 0:
            nowhere(i, ping, channels)

    path = make_xtf(tmp_path / "a.xtf", Plan(tweak=tweak, samples=1024))
    path.write_bytes(path.read_bytes()[:-90])
    _, out, _ = bathynav("info", path)
    defects = [line for line in out.splitlines() if line.strip().startswith("defect")]
    for word in (
        "halved", "no valid position in 1 ping", "relative to the sonar", "mid-packet",
        "times the altitude field",
    ):  # fmt: skip
        assert sum(word in line for line in defects) == 1, (word, defects)
    # The bottom lies at 6 m where the field says 3; a block of the judgement is 0.23 m.
    factor = float(defects[-1].split("come at ")[1].split()[0])
    assert abs(factor - 2.0) < 0.1


def test_a_mix_of_good_and_bad_is_told_file_by_file(tmp_path, bathynav):
    good = make_xtf(tmp_path / "good.xtf", Plan())
    bad = bad_files(tmp_path)
    status, out, err = bathynav("info", bad["noise.xtf"][0], good, bad["one.xtf"][0])
    assert status == 1
    assert str(good) in out and "60 usable" in out
    assert len(err.strip().splitlines()) == 2


def test_several_files_are_also_told_as_one_survey(tmp_path, bathynav):
    later = Plan(n=30, start=Plan().start.replace(hour=9))
    paths = make_xtf(tmp_path / "a.xtf"), make_xtf(tmp_path / "b.xtf", later)
    status, out, _ = bathynav("info", *paths)
    assert status == 0
    survey = out.split("survey of 2 files")[1]
    assert "90, 90 usable, 90 in passes" in survey and "pings 60 to 89" in survey


def test_info_without_a_file_is_wrong_usage(bathynav):
    assert bathynav("info")[0] == 2


def test_quiet_says_nothing(tmp_path, bathynav):
    assert bathynav("info", "-q", make_xtf(tmp_path / "a.xtf"))[:2] == (0, "")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("scotsman-iver2.xtf", ("461 sonar", "29.98 m", "halved", " times the altitude field",
                                "port is stored far to near")),
        ("starfish_iver2_barbados_20160112.logdoc", ("3,259 sonar", "EPSG:32621", "30.00 m")),
        ("humminbird_pyhum/test.DAT", ("3,453 port", "EPSG:32612", "1479 to 1550")),
    ],
)  # fmt: skip
def test_real_files_are_told(bathynav, name, words):
    if not (REAL / name).exists():
        pytest.skip(f"{REAL / name} is not there")
    status, out, err = bathynav("info", REAL / name)
    assert status == 0 and err == ""
    for word in words:
        assert word in out, word


def test_a_sound_log_without_side_scan_is_told_by_info(bathynav):
    path = REAL / "lowrance_input.sl2"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    status, out, _ = bathynav("info", path)
    assert status == 0 and "111 primary" in out and "cannot be mapped" in out


def test_sensors_lists_every_sonar_with_its_source(bathynav):
    from perception.sonars import SENSORS, SONARS

    status, out, err = bathynav("sensors")
    assert status == 0 and err == ""
    for name in [s.name for s in SONARS] + [s.name for s in SENSORS]:
        assert name in out
    # The paper's mechanical scan: 90 steps of 1 deg at 2 R / c of 400 m.
    sheet = next(sonar for sonar in SONARS if sonar.name == "mechanical")
    steps = sheet.sector_deg / sheet.step_deg
    assert sheet.image_s == pytest.approx(steps * 2 * sheet.range_m / 1500.0, rel=0.01)


def test_a_local_grid_survives_a_map_file(tmp_path):
    from mapping.rasters import read_map, write_map
    from perception.geodesy import LOCAL_CRS
    from perception.records import Grid

    write_map(tmp_path / "a.tif", Grid(np.ones((5, 5)), 0.0, 5.0, 1.0, crs=LOCAL_CRS))
    assert read_map(tmp_path / "a.tif").crs == LOCAL_CRS


def test_files_of_two_places_are_no_survey(tmp_path, bathynav):
    here = make_xtf(tmp_path / "here.xtf", Plan())
    there = make_xtf(
        tmp_path / "there.xtf", Plan(track=lambda t: (-68.8, 51.5 + 2.0 * t / 111200.0, 0.0))
    )
    status, out, _ = bathynav("info", here, there)
    assert status == 0
    assert (
        "do not make one: there.xtf lies 33" in out and "average" not in out.split("survey of")[1]
    )
    status, out, err = bathynav("strips", here, there, "--out", tmp_path / "strips")
    assert status == 1 and out == ""
    assert len(err.strip().splitlines()) == 1 and "each by itself" in err


def test_positions_in_whole_metres_do_not_lengthen_the_track(tmp_path, bathynav):
    def stairs(t: float) -> tuple[float, float, float]:
        way = 2.0 * t / np.sqrt(2.0)
        return 500000.0 + round(way), 5000000.0 + round(way + 0.4), 45.0

    path = make_xtf(tmp_path / "a.xtf", Plan(n=600, track=stairs, nav_units=0))
    _, out, _ = bathynav("info", path)
    (track,) = (line.split() for line in out.splitlines() if line.strip().startswith("track"))
    # 599 steps of 0.2 s at 2 m/s.
    assert abs(float(track[1]) - 239.6) < 0.04 * 239.6
