"""`bathynav simulate`: every named scenario held to one contract, in a small size."""

import csv
import sys
from pathlib import Path

import numpy as np
import pyproj
import pytest
import pyxtf
import tomli_w
from click.testing import CliRunner
from numpy.testing import assert_allclose

from mapping.fixes import read_fixes
from mapping.rasters import read_map
from scenarios.commands import main
from scenarios.commands.simulate import command
from scenarios.schema import library, load_scenario, scenario_of, tree_of
from scenarios.simulation import simulate


def tiny(name, **sections):
    """Return a named scenario cut to a few pings: same terrain and habits, short lines."""
    tree = tree_of(load_scenario(name))
    tree["world"] |= {"size_east_m": 240.0, "size_north_m": 240.0, "cell_m": 0.5}
    tree["mission"] |= {
        "block": [],
        "lines": [[-20.0, 0.0, 20.0, 0.0], [20.0, -20.0, -10.0, -20.0]],
    }
    tree["sonar"] |= {"samples": 128, "azimuths": 3, "ping_period_s": 1.0}
    tree["locate"] |= {"legs": [[-30.0, -10.0], [30.0, 10.0]]}
    for part in tree["world"]["terrain"]:
        if "count" in part:
            part |= {"count": 3, "size_east_m": 100.0, "size_north_m": 100.0}
    for section, keys in sections.items():
        tree[section] |= keys
    return scenario_of(tree, name)


def written(scenario, tmp_path, out="out"):
    path = tmp_path / "scenario.toml"
    path.write_text(tomli_w.dumps(tree_of(scenario)))
    result = CliRunner().invoke(command, [str(path), "--out", str(tmp_path / out)])
    assert result.exit_code == 0, result.output
    return tmp_path / out


def rows_of(path):
    with path.open() as stream:
        return list(csv.DictReader(stream))


def pings_of(path):
    _, packets = pyxtf.xtf_read(str(path))
    return packets[pyxtf.XTFHeaderType.sonar]


def files_of(folder):
    return {p.relative_to(folder): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("name", library())
def test_every_named_scenario_keeps_the_contract(name, tmp_path):
    """Runs, is repeatable to the byte, is finite, has its shapes, keeps its truth apart."""
    scenario = tiny(name)
    out = written(scenario, tmp_path)
    again = written(scenario, tmp_path, "again")
    assert files_of(out) == files_of(again)
    pings = pings_of(out / "survey.xtf")
    truth = rows_of(out / "truth/trajectory.csv")
    assert len(pings) == len(truth) > 20
    counts = np.array([ping.data for ping in pings])
    assert counts.shape[1:] == (2, 128)
    assert counts.max() > 1000 and np.median(counts) < 60000
    nav = rows_of(out / "nav.csv")
    expected = "time_s easting_m northing_m depth_m heading_deg pitch_deg roll_deg speed_m_s altitude_m beam1_m beam2_m beam3_m beam4_m"
    assert list(nav[0]) == expected.split()
    assert len(nav) == len(rows_of(out / "truth/nav.csv")) > 10
    prior, floor = read_map(out / "prior.tif"), read_map(out / "truth/elevation.tif")
    assert prior.crs == floor.crs == "EPSG:32630"
    assert np.isfinite(floor.elevation_m).all() and floor.elevation_m.max() < 0
    assert len(read_fixes(out / "surface-fixes.csv")) == 2
    beside = {p.name for p in out.iterdir()} - {"return.xtf"}
    assert beside == {
        "survey.xtf", "nav.csv", "prior.tif", "surface-fixes.csv", "scenario.toml", "config.toml",
        "metrics.json", "truth",
    }  # fmt: skip


def test_another_seed_gives_another_survey_and_threads_change_nothing(tmp_path, monkeypatch):
    scenario = tiny("demo")
    one = simulate(scenario)
    monkeypatch.setenv("NUMBA_NUM_THREADS", "3")
    assert (simulate(scenario).survey.counts == one.survey.counts).all()
    other = simulate(scenario.model_copy(update={"seed": 99}))
    assert (other.survey.counts != one.survey.counts).any()


def test_what_one_part_draws_does_not_depend_on_another_part():
    """A noisier compass leaves the floor and the prior map as they were."""
    a = simulate(tiny("demo"))
    b = simulate(tiny("demo", navigation={"heading_noise_deg": 2.0}))
    assert (a.world.floor.elevation_m == b.world.floor.elevation_m).all()
    assert (a.prior.elevation_m == b.prior.elevation_m).all()
    assert (a.survey.counts == b.survey.counts).all()


def test_file_and_truth_agree_where_navigation_is_perfect(tmp_path):
    """Positions to a millimetre, headings from true north through the convergence, times, depth."""
    perfect = {
        "random_walk_m_per_sqrt_km": 0.0, "heading_bias_deg": 0.0, "heading_noise_deg": 0.0,
        "speed_scale": 0.0, "start_sigma_m": 0.0, "depth_bias_m": 0.0, "depth_noise_m": 0.0,
        "altimeter_noise": 0.0,
    }  # fmt: skip
    straight = {"wander_rms_m": 0.0, "yaw_rms_deg": 0.0}
    out = written(tiny("demo", navigation=perfect, vehicle=straight), tmp_path)
    pings, truth = pings_of(out / "survey.xtf"), rows_of(out / "truth/trajectory.csv")
    project = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32630", always_xy=True).transform
    for ping, row in zip(pings, truth, strict=True):
        e, n = project(ping.SensorXcoordinate, ping.SensorYcoordinate)
        assert_allclose([e, n], [float(row["easting_m"]), float(row["northing_m"])], atol=1e-3)
        assert_allclose(ping.SensorHeading, float(row["heading_deg"]), atol=1e-3)
        assert_allclose(ping.SensorDepth, float(row["depth_m"]), atol=1e-3)
        assert str(ping.get_time()).startswith(row["time"][:22])
    # The first line runs due grid east with one degree of crab; here grid north lies 0.64 degrees
    # east of true north.
    mean = np.mean([float(r["heading_deg"]) for r in truth if r["line"] == "0"])
    assert_allclose(mean, 91.0 + 0.644, atol=0.01)


def test_truth_map_is_the_floor_under_the_track(tmp_path):
    out = written(tiny("demo"), tmp_path)
    floor = read_map(out / "truth/elevation.tif")
    for row in rows_of(out / "truth/trajectory.csv")[::5]:
        z = float(floor.sample(float(row["easting_m"]), float(row["northing_m"])))
        assert_allclose(-float(row["depth_m"]) - z, float(row["altitude_m"]), atol=0.15)


def test_first_return_in_the_file_is_the_true_altitude_on_flat_ground(tmp_path):
    out = written(tiny("featureless-mud", sonar={"samples": 500, "snr_db": 40.0}), tmp_path)
    truth = rows_of(out / "truth/trajectory.csv")
    for ping, row in zip(pings_of(out / "survey.xtf"), truth, strict=True):
        both = np.minimum(*(np.asarray(side, float) for side in ping.data))
        first = np.flatnonzero(both > 0.3 * np.median(both[200:400]))[0] * 0.1
        assert_allclose(first, float(row["altitude_m"]), atol=0.6)


def test_files_per_line_hold_the_pings_of_the_one_file(tmp_path):
    scenario = tiny("demo")
    whole = pings_of(written(scenario, tmp_path) / "survey.xtf")
    apart = written(tiny("demo", mission={"files": "per-line"}), tmp_path, "apart")
    parts = [p for f in sorted(apart.glob("survey-*.xtf")) for p in pings_of(f)]
    assert len(list(apart.glob("survey-*.xtf"))) == 2
    assert [p.PingNumber for p in parts] == [p.PingNumber for p in whole]
    assert all(
        (np.array(a.data) == np.array(b.data)).all() for a, b in zip(parts, whole, strict=True)
    )


def test_recorded_turns_join_the_lines(tmp_path):
    skipped = simulate(tiny("demo")).survey.truth
    recorded = simulate(tiny("demo", mission={"turns": "record"})).survey.truth
    assert len(recorded.time_s) > len(skipped.time_s)
    assert np.diff(recorded.time_s).max() < 1.01 < np.diff(skipped.time_s).max()


def test_surveys_own_track_may_be_the_one_to_locate():
    made = simulate(tiny("demo", locate={"track": "survey"}))
    assert made.back is None
    offset = made.nav.estimate.easting_m[0] - made.nav.truth.easting_m[0]
    assert abs(offset) > 2.0  # 50 m 1-sigma
    assert made.nav.truth.time_s[0] == made.survey.truth.time_s[0]


@pytest.fixture
def run(monkeypatch, capsys):
    """Call the command line as a shell would: exit status and both streams."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["bathynav", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code, *capsys.readouterr()

    return call


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("seed = 1\n[world]\ndpeth = 3\n[mission]\nlines = [[0,0,9,0]]", "world.dpeth = 3"),
        ("[mission]\nlines = [[0,0,9999,0]]", "a line ends 9999 m east"),
        ("[mission]\nlines = [[0,0,9,0]]\nstart = 'now'", "mission.start = 'now'"),
        ("[world]\ncrs = 'EPSG:4326'\n[mission]\nlines = [[0,0,9,0]]", "not a projected CRS"),
        (
            "[mission]\nlines = [[0,0,9,0]]\n[[world.terrain]]\nkind='raster'\npath='no.tif'",
            "no.tif: no such file",
        ),
        ("\x00\x01", "TOML"),
    ],
)
def test_a_bad_scenario_fails_with_one_line_and_writes_nothing(text, words, tmp_path, run):
    path = tmp_path / "bad.toml"
    path.write_text(text)
    status, _, complaint = run("simulate", str(path), "--out", str(tmp_path / "out"))
    assert status == 1
    assert words in complaint and len(complaint.strip().splitlines()) == 1
    assert not [p for p in (tmp_path / "out").rglob("*") if p.is_file()]


def test_the_scenarios_command_lists_the_library(run):
    status, listed, _ = run("scenarios")
    assert status == 0
    assert [line.split()[0] for line in listed.splitlines()] == list(library())
    assert 'name = "demo"' in run("scenarios", "demo")[1]


def test_an_output_folder_that_cannot_be_written_is_told(tmp_path, run):
    (tmp_path / "file").write_text("")
    status, _, complaint = run("simulate", "demo", "--out", str(tmp_path / "file"))
    assert status == 1 and "cannot be used as output folder" in complaint


def test_a_raster_is_found_from_the_scenario_s_own_folder(tmp_path):
    from mapping.rasters import write_map
    from perception.records import Grid

    rng = np.random.default_rng(0)
    heights = np.cumsum(rng.normal(0, 0.1, (60, 60)), axis=0)
    write_map(tmp_path / "bank.tif", Grid(heights, 500000.0, 5000000.0, 5.0, crs="EPSG:32631"))
    part = {"kind": "raster", "path": "bank.tif", "rms_m": 2.0}
    tree = tree_of(tiny("demo"))
    tree["world"]["terrain"] = [part]
    (tmp_path / "mine.toml").write_text(tomli_w.dumps(tree))
    scenario = load_scenario(tmp_path / "mine.toml")
    relief = simulate(scenario).world.floor.elevation_m
    assert np.ptp(relief) > 2.0
    # The resolved scenario finds it from anywhere.
    assert Path(scenario.world.terrain[0].path) == tmp_path / "bank.tif"


def test_a_tide_is_written_for_map_and_moves_the_depth_only(tmp_path):
    tide = {"tide_amplitude_m": 2.0, "tide_period_s": 3000.0}
    out = written(tiny("demo", navigation=tide), tmp_path)
    table = rows_of(out / "tide.csv")
    assert list(table[0]) == ["time", "height_m"]
    assert max(abs(float(row["height_m"])) for row in table) > 1.0
    calm = simulate(tiny("demo")).survey
    tidal = simulate(tiny("demo", navigation=tide)).survey
    assert (calm.truth.elevation_m == tidal.truth.elevation_m).all()
    assert np.abs(calm.estimate.depth_m - tidal.estimate.depth_m).max() > 0.5


def test_a_picture_is_drawn_on_request_beside_the_truth(tmp_path, run):
    (tmp_path / "s.toml").write_text(tomli_w.dumps(tree_of(tiny("demo"))))
    out = tmp_path / "out"
    status, printed, _ = run("simulate", str(tmp_path / "s.toml"), "--out", str(out), "--picture")
    assert status == 0 and "pings" in printed
    assert (out / "truth/simulation.png").read_bytes().startswith(b"\x89PNG")


def test_files_of_an_earlier_simulation_are_not_left_to_be_read_as_lines_of_this_one(tmp_path):
    many = tiny("demo", mission={"files": "per-line"}, navigation={"tide_amplitude_m": 0.5})
    out = written(many, tmp_path)
    assert len(list(out.glob("survey-*.xtf"))) == 2 and (out / "tide.csv").exists()
    written(tiny("demo", mission={"files": "one"}, navigation={"tide_amplitude_m": 0.0}), tmp_path)
    assert [p.name for p in out.glob("survey*.xtf")] == ["survey.xtf"]
    assert not (out / "tide.csv").exists()
