"""`bathynav map` on surveys that are awkward: each has a clear outcome and nothing is lost.

The survey is the tiny one, simulated once; the files are then spoilt one way each.
"""

from __future__ import annotations

import csv
import json
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapping.fixes import read_fixes
from mapping.graph_files import read_g2o
from perception.readers import open_survey
from perception.records import InputError
from scenarios.benchmarks.inversion import looks_of
from scenarios.commands.map_command import check_fixes
from scenarios.missions.frame import FileFrame
from scenarios.schema import load_scenario
from scenarios.simulation import Simulation, simulate
from scenarios.simulation_files import _log, write_simulation
from scenarios.sonar.xtf import SonarLog, write_xtf
from tests.mapping.gtsam_text import read_graph, solved_anew
from tests.scenarios.command_line import Outcome, run_command
from tests.scenarios.tiny import write_tiny


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Simulation, Path]:
    folder = tmp_path_factory.mktemp("tiny")
    simulation = simulate(load_scenario(write_tiny(folder)))
    write_simulation(simulation, folder / "survey")
    return simulation, folder / "survey"


@pytest.fixture(scope="module")
def lines(simulated: tuple[Simulation, Path]) -> list[SonarLog]:
    """The recorder's log of each of the three lines."""
    simulation, _ = simulated
    frame = FileFrame(simulation.scenario.world.crs)
    line = simulation.survey.truth.line
    logs = []
    for number in (0, 1, 2):
        rows = np.flatnonzero(line == number)
        part = slice(rows[0], rows[-1] + 1)
        logs.append(_log(simulation.scenario, simulation.survey, frame, part))
    return logs


def mapped(
    capsys: pytest.CaptureFixture[str], folder: Path, logs: list[SonarLog], *options: object
) -> Outcome:
    """Write the logs to files and map them, by shadows (the track is what is asked about)."""
    files = []
    for number, log in enumerate(logs):
        files.append(folder / f"line-{number}.xtf")
        write_xtf(files[-1], log)
    return run_command(
        capsys, "map", *files, "--out", folder / "map", "--method", "shadow", "-q", *options
    )


def metrics(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "map" / "metrics.json").read_text()))


def track(folder: Path) -> dict[str, np.ndarray]:
    with (folder / "map" / "trajectory.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    return {
        name: np.array([float(row[name]) for row in rows])
        for name in (
            "easting_m",
            "northing_m",
            "ping",
            "pass",
            "sigma_easting_m",
            "sigma_northing_m",
        )
    }


def moved(log: SonarLog, east_deg: float = 0.0, seconds: float = 0.0) -> SonarLog:
    return replace(log, longitude_deg=log.longitude_deg + east_deg, time_s=log.time_s + seconds)


def test_the_folder_holds_rounds_and_graph_and_the_tie_to_a_prior_map(
    simulated: tuple[Simulation, Path],
    lines: list[SonarLog],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _, survey = simulated
    done = mapped(
        capsys, tmp_path, lines, "--prior", survey / "truth" / "elevation.tif", "--fixes",
        survey / "surface-fixes.csv",
    )  # fmt: skip
    assert done.status == 0, done.err
    said = metrics(tmp_path)
    rounds = (tmp_path / "map" / "rounds.csv").read_text().splitlines()
    assert len(rounds) == said["rounds"] + 1
    assert said["prior_squares_compared"] > 0
    graph, values = read_graph(tmp_path / "map")
    assert np.isfinite(graph.error(values))
    poses = read_g2o(tmp_path / "map" / "graph.g2o")
    assert len(poses.key) > 3 and len(poses.fixed) == 1


def test_pass_by_pass_ends_where_the_batch_on_the_same_factors_ends(
    simulated: tuple[Simulation, Path],
    lines: list[SonarLog],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The file's graph solved at once from nothing gives the track that grew, and so does the command without the option."""
    _, survey = simulated
    fixes = ("--fixes", survey / "surface-fixes.csv")
    tracks = []
    for name, options in (("grown", ("--incremental",)), ("batch", ())):
        folder = tmp_path / name
        folder.mkdir()
        done = mapped(capsys, folder, lines, *fixes, *options)
        assert done.status == 0, done.err
        tracks.append(track(folder))
    graph, values = read_graph(tmp_path / "grown" / "map")
    anew = solved_anew(graph, values)
    keys = values.keys()
    for key in keys:
        np.testing.assert_allclose(values.atVector(key), anew.atVector(key), atol=1e-5)
    grown, batch = tracks
    for axis in ("easting", "northing"):
        apart = grown[f"{axis}_m"] - batch[f"{axis}_m"]
        sigma = np.hypot(grown[f"sigma_{axis}_m"], batch[f"sigma_{axis}_m"])
        assert np.sqrt(((apart / sigma) ** 2).mean()) < 0.1


def test_in_tiles_a_track_pass_by_pass_is_refused(
    lines: list[SonarLog], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done = mapped(capsys, tmp_path, lines[:1], "--incremental", "--tiles")
    assert done.status == 1 and "--incremental" in done.err and done.err.count("\n") == 1


def test_passes_that_never_meet_are_mapped_where_their_navigation_has_them(
    lines: list[SonarLog], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # A hundredth of a degree is seven hundred metres here.
    apart = [lines[0], moved(lines[1], east_deg=0.004)]
    done = mapped(capsys, tmp_path, apart)
    assert done.status == 0, done.err
    said = metrics(tmp_path)
    assert said["registrations_compared"] == 0 and said["passes"] == 2
    assert np.isfinite(track(tmp_path)["easting_m"]).all()


def test_two_surveys_in_different_zones_are_refused(
    lines: list[SonarLog], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Six degrees are four hundred kilometres: no map of a few hundred metres holds both."""
    done = mapped(capsys, tmp_path, [lines[0], moved(lines[1], east_deg=6.0)])
    assert done.status == 1
    assert " km from " in done.complaint and "each by itself" in done.complaint
    assert not (tmp_path / "map" / "map.tif").exists()


def test_a_clock_that_jumps_a_day_back_loses_no_ping(
    lines: list[SonarLog], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = [lines[0], moved(lines[1], seconds=-86_400.0), lines[2]]
    done = mapped(capsys, tmp_path, logs)
    assert done.status == 0, done.err
    poses = track(tmp_path)
    assert len(poses["ping"]) == sum(len(log.time_s) for log in logs)
    assert np.isfinite(poses["easting_m"]).all()


def test_a_pass_without_echoes_is_left_out_and_said(
    lines: list[SonarLog], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    silent = replace(lines[1], counts=np.zeros_like(lines[1].counts))
    done = mapped(capsys, tmp_path, [lines[0], silent, lines[2]])
    assert done.status == 0, done.err
    assert (tmp_path / "map" / "map.tif").exists()
    poses = track(tmp_path)
    assert len(poses["ping"]) == sum(len(log.time_s) for log in lines)
    assert len(set(poses["pass"][poses["pass"] >= 0])) == 2


def test_fixes_that_contradict_the_rest_are_counted_and_do_not_bend_the_track(
    simulated: tuple[Simulation, Path],
    lines: list[SonarLog],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _, survey = simulated
    good = read_fixes(survey / "surface-fixes.csv")
    rows = ["time,easting_m,northing_m,sigma_m"]
    truth = np.genfromtxt(survey / "truth" / "trajectory.csv", delimiter=",", names=True, dtype=None,
                          encoding="utf-8")  # fmt: skip
    for row in range(0, len(truth), max(len(truth) // 8, 1)):
        rows.append(
            f"{truth['time'][row]},{truth['easting_m'][row]},{truth['northing_m'][row]},1.0"
        )
    middle = truth[len(truth) // 2]
    rows.append(f"{middle['time']},{middle['easting_m'] + 150.0},{middle['northing_m']},1.0")
    (tmp_path / "fixes.csv").write_text("\n".join(rows) + "\n")
    done = mapped(capsys, tmp_path, lines, "--fixes", tmp_path / "fixes.csv")
    assert done.status == 0, done.err
    said = metrics(tmp_path)
    assert said["fixes_refused"] == 1 and said["fixes_used"] == len(rows) - 2
    found = track(tmp_path)
    east = np.interp(np.arange(len(found["ping"])), found["ping"], found["easting_m"])
    assert np.abs(east - truth["easting_m"]).max() < 10.0
    assert good


@contextmanager
def no_file_beyond(size: int) -> Iterator[None]:
    """Let writes fail past `size` bytes of a file, as on a disk that fills up."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_disk_that_fills_up_leaves_no_half_map_and_says_so(
    lines: list[SonarLog], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done = mapped(capsys, tmp_path, lines[:1])
    assert done.status == 0, done.err
    before = (tmp_path / "map" / "map.tif").read_bytes()
    with no_file_beyond(4096):
        done = run_command(
            capsys, "map", tmp_path / "line-0.xtf", "--out", tmp_path / "map", "--method",
            "shadow", "-q", "--cell", "0.4",
        )  # fmt: skip
    assert done.status == 1
    assert "written" in done.complaint or "room" in done.complaint
    left = [p.name for p in (tmp_path / "map").iterdir() if ".part" in p.name]
    assert not left
    assert (tmp_path / "map" / "map.tif").read_bytes() == before


def test_fixes_by_a_clock_without_date_are_taken_and_dates_refused(
    simulated: tuple[Simulation, Path], tmp_path: Path
) -> None:
    survey = open_survey([simulated[1] / "survey.xtf"])
    start = float(survey.pings.time_s[0])
    dateless = replace(survey, utc=False, pings=replace(survey.pings,
                       time_s=survey.pings.time_s - start))  # fmt: skip
    path = tmp_path / "fixes.csv"

    def check(header: str, time: str) -> None:
        path.write_text(f"{header},easting_m,northing_m,sigma_m\n{time},1,2,0.5\n")
        check_fixes(path, read_fixes(path), dateless)

    check("time_s", "30")
    with pytest.raises(InputError, match="has no date, so a `time` in UTC"):
        check("time", "1970-01-01T00:00:30Z")
    with pytest.raises(InputError, match=r"no fix lies within an hour.*of its clock"):
        check("time_s", str(start))


def test_looks_of_the_inversion_benchmark_hang_level(
    simulated: tuple[Simulation, Path],
) -> None:
    simulation, _ = simulated
    truth = simulation.survey.truth
    looks = looks_of(simulation)
    swath = looks[0].swath
    own = truth.line == swath.pass_index
    pitch = truth.pitch_rad[own]
    assert np.abs(pitch).max() > 0 and not swath.pitch_rad.any()
    first = looks[0].altitude_m
    lead = first * np.sin(pitch)
    at = np.isfinite(first)
    moved_e = (swath.easting_m - truth.easting_m[own])[at]
    np.testing.assert_allclose(moved_e, (lead * np.sin(swath.heading_rad))[at], atol=1e-6)
