"""`bathynav map` in tiles: the contract's files, the map in one piece, taken up after a kill, plain refusals."""

from __future__ import annotations

import json
import resource
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyogrio.raw
import pytest
import rasterio
import shapely

from mapping.rasters import read_map
from mapping.trajectories import read_trajectory
from tests.scenarios.command_line import run_command
from tests.scenarios.tiny import write_tiny

SETTINGS = ("--cell", "0.5", "--method", "shadow")


@dataclass(frozen=True)
class Made:
    """A simulated survey, its map in one piece and its map in tiles."""

    survey: Path
    prior: Path
    whole: Path
    tiled: Path


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("tiled")
    scenario = write_tiny(folder)
    made = Made(folder / "sim/survey.xtf", folder / "sim/prior.tif", folder / "a", folder / "b")
    for arguments in (
        ("simulate", scenario, "--out", folder / "sim"),
        ("map", made.survey, *SETTINGS, "--out", made.whole, "--prior", made.prior),
        ("map", made.survey, *SETTINGS, "--out", made.tiled, "--prior", made.prior, "--tiles",
         "--tile-cells", "100", "--also", "map.nc", "--also", "map.grd"),
    ):  # fmt: skip
        _run(*arguments)
    return made


def _run(*arguments: object) -> None:
    from click.testing import CliRunner

    from scenarios.commands import bathynav

    outcome = CliRunner().invoke(bathynav, [str(a) for a in arguments])
    assert outcome.exit_code == 0, (outcome.output, outcome.exception)


def test_the_tiled_map_is_that_in_one_piece(made: Made) -> None:
    """Registration on thinned strips may move poses by millimetres, no more; both are tied to one prior."""
    whole, tiled = read_map(made.whole / "map.tif"), read_map(made.tiled / "map.tif")
    assert tiled.shape == whole.shape and tiled.crs == whole.crs and tiled.west_m == whole.west_m
    np.testing.assert_array_equal(np.isfinite(tiled.elevation_m), np.isfinite(whole.elevation_m))
    assert np.nanmax(np.abs(tiled.elevation_m - whole.elevation_m)) < 0.02
    assert np.nanmax(np.abs(tiled.sigma_m - whole.sigma_m)) < 0.02
    np.testing.assert_allclose(tiled.count, whole.count)


def test_the_folder_keeps_the_contract(made: Made) -> None:
    names = {p.name for p in made.whole.iterdir()}
    assert names <= {p.name for p in made.tiled.iterdir()}
    with rasterio.open(made.tiled / "map.tif") as raster:
        assert raster.descriptions == ("elevation", "sigma", "count")
        assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert float(raster.tags(1)["STATISTICS_MEAN"]) < 0
    with rasterio.open(made.tiled / "mosaic.tif") as raster:
        assert raster.descriptions == ("echo_db",)
    one, other = (json.loads((f / "metrics.json").read_text()) for f in (made.whole, made.tiled))
    assert set(one) <= set(other)
    for key in ("cells", "mapped_m2", "coverage_of_rectangle", "s44_2_vertical_share", "crossings"):
        assert other[key] == pytest.approx(one[key], rel=1e-3), key
    for key in ("sigma_median_m", "elevation_min_m", "prior_shift_m", "prior_mae_m"):
        assert other[key] == pytest.approx(one[key], rel=0.02, abs=0.02), key
    for name in ("map.nc", "map.grd"):
        exported = read_map(made.tiled / name)
        np.testing.assert_array_equal(
            exported.elevation_m, read_map(made.tiled / "map.tif").elevation_m
        )


def test_flags_and_contacts_lie_beside_the_map_whichever_way_it_is_made(made: Made) -> None:
    flags = []
    for folder in (made.whole, made.tiled):
        grid = read_map(folder / "map.tif")
        with rasterio.open(folder / "flags.tif") as raster:
            flags.append(raster.read(1))
            assert raster.nodata == 255 and raster.tags()["FLAG_8"] == "shadow"
        np.testing.assert_array_equal(flags[-1] == 255, np.isnan(grid.elevation_m))
        page = (folder / "contacts.html").read_text()
        assert "<h1>Contacts</h1>" in page
        said = json.loads((folder / "metrics.json").read_text())
        assert 0.0 <= said["flag_shadow_share"] < 0.5 and said["prior_shift_sigma_m"] > 0
    # Poses differ by millimetres, so that a cell in a thousand or so gets another datum.
    assert (flags[0] != flags[1]).mean() < 0.01


@pytest.mark.parametrize("kind", ["whole", "tiled"])
def test_every_file_is_tied_to_the_prior_map(made: Made, kind: str) -> None:
    folder = getattr(made, kind)
    metrics = json.loads((folder / "metrics.json").read_text())
    grid = read_map(folder / "map.tif")
    assert metrics["elevation_min_m"] == pytest.approx(np.nanmin(grid.elevation_m), abs=1e-3)
    assert metrics["elevation_max_m"] == pytest.approx(np.nanmax(grid.elevation_m), abs=1e-3)
    east, north, height, _ = np.loadtxt(folder / "soundings.csv", delimiter=",", skiprows=1).T
    # The soundings lie on the map that they are part of, to its own roughness.
    assert abs(np.nanmedian(grid.sample(east, north) - height)) < 0.15
    assert (folder / "prior-changes.gpkg").exists()


def test_a_run_without_a_prior_map_leaves_no_changes_of_an_earlier_one(
    made: Made, tmp_path: Path
) -> None:
    again = tmp_path / "again"
    shutil.copytree(made.tiled, again)
    before = read_map(again / "map.tif").elevation_m
    _run("map", made.survey, *SETTINGS, "--out", again, "--tiles", "--tile-cells", "100")
    assert not (again / "prior-changes.gpkg").exists()
    metrics = json.loads((again / "metrics.json").read_text())
    # Another folder's strips are this one's by content; its tiles too.
    shift = json.loads((made.tiled / "metrics.json").read_text())["prior_shift_m"]
    after = read_map(again / "map.tif").elevation_m
    np.testing.assert_allclose(np.nanmedian(before - after), shift, atol=1e-4)
    assert metrics["tiles_made"] == 0 and "prior_shift_m" not in metrics


def test_tracks_are_lines_of_passes_in_the_survey_s_frame(made: Made) -> None:
    track = read_trajectory(made.tiled / "trajectory.csv")
    for layer in ("corrected", "navigated"):
        meta, _, geometry, fields = pyogrio.raw.read(made.tiled / "tracks.gpkg", layer=layer)
        columns = dict(zip(meta["fields"], fields, strict=True))
        assert meta["crs"] == read_map(made.tiled / "map.tif").crs
        np.testing.assert_array_equal(columns["pass"], [0, 1, 2])
        lines = shapely.from_wkb(geometry)
        np.testing.assert_allclose(columns["length_m"], shapely.length(lines))
        assert str(columns["start"][0]).endswith("Z")
        if layer == "corrected":
            rows = track.pass_index == 0
            expected = np.column_stack([track.easting_m[rows], track.northing_m[rows]])
            np.testing.assert_allclose(shapely.get_coordinates(lines[0]), expected, atol=1e-3)
            assert columns["sigma_m"][0] > 0


@pytest.mark.parametrize(
    "more", [("--tiles", "--tile-cells", "100"), pytest.param((), marks=pytest.mark.slow)]
)
def test_a_full_disk_ends_in_one_line_and_leaves_nothing_half_written(
    made: Made, tmp_path: Path, more: tuple[str, ...]
) -> None:
    """No file may grow beyond 60 kB, as on a disk that fills up; the file system itself says so."""
    out = tmp_path / "full"

    def small_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))

    program = "import scenarios.commands as c; c.main()"
    run = subprocess.run(
        [sys.executable, "-c", program, "map", str(made.survey), "--out", str(out), *SETTINGS, *more],
        capture_output=True, text=True, preexec_fn=small_files, timeout=300, check=False,
    )  # fmt: skip
    complaints = [x for x in run.stderr.splitlines() if x.startswith("bathynav: ")]
    assert run.returncode == 1 and len(complaints) == 1, run.stderr
    assert "Traceback" not in run.stderr and "cannot be written" in complaints[0], run.stderr
    left = [p.name for p in out.rglob("*") if p.is_file()]
    assert not [name for name in left if name.startswith(".") or ".part" in name], left
    assert not (out / "map.tif").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--cell", "1000"), "--cell 1000 m: the survey is"),
        (("--cell", "0.0001"), "the echoes are"),
        (("--tiles", "--method", "joint"), "joint method knows none"),
        (("--tiles", "--scheduler", "tcp://127.0.0.1:9", "--tile-cells", "16"), "no Dask scheduler"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_in_one_line(
    made: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...],
    message: str,
) -> None:  # fmt: skip
    outcome = run_command(capsys, "map", made.survey, "--out", tmp_path / "o", *arguments)
    assert outcome.status == 1 and message in outcome.complaint


@pytest.mark.parametrize(
    ("name", "message"), [("map.xyz", "--also map.xyz"), ("../map.nc", "no folder")]
)
def test_another_format_that_is_none_is_wrong_usage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, message: str
) -> None:
    outcome = run_command(capsys, "map", "survey.xtf", "--out", tmp_path / "o", "--also", name)
    assert outcome.status == 2 and message in outcome.err


@pytest.mark.parametrize("cell", ["nan", "inf", "0", "-1"])
def test_a_cell_that_is_no_length_is_wrong_usage(
    made: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str], cell: str
) -> None:
    outcome = run_command(capsys, "map", made.survey, "--out", tmp_path / "o", f"--cell={cell}")
    assert outcome.status == 2 and "--cell" in outcome.err


def test_options_without_effect_on_a_map_in_one_piece_are_told(
    capsys: pytest.CaptureFixture[str],
) -> None:
    from click import Context

    from scenarios.commands.map_command import _tell_unused, _Tiling, command

    with Context(command) as context:
        command.parse_args(context, ["survey.xtf", "--out", "o", "--workers", "2"])
        _tell_unused(_Tiling(False, 1024, None, 2))
        assert "note: --workers: of no effect" in capsys.readouterr().err
    with Context(command) as context:
        command.parse_args(context, ["survey.xtf", "--out", "o", "--tile-cells", "64"])
        _tell_unused(_Tiling(False, 64, "tcp://h:1", None))
        assert "--scheduler, --tile-cells: of no effect" in capsys.readouterr().err
    with Context(command) as context:
        command.parse_args(context, ["survey.xtf", "--out", "o"])
        _tell_unused(_Tiling(False, 1024, None, None))
        assert capsys.readouterr().err == ""


def test_maps_too_large_for_one_piece_are_made_in_tiles_unasked(
    made: Made, capsys: pytest.CaptureFixture[str]
) -> None:
    from perception.readers import open_survey
    from perception.records import InputError
    from scenarios.commands.map_command import _choose, _Tiling
    from scenarios.survey_tiles import MOST_CELLS_AT_ONCE, MOST_JOINT_CELLS, expected_cells

    survey = open_survey([made.survey])
    no, yes = _Tiling(False, 1024, None, None), _Tiling(True, 1024, None, None)
    grid = read_map(made.whole / "map.tif")
    # Headers tell the size before any echo is read: the map's own within the reach of the swath.
    assert 1.0 <= expected_cells(survey, 0.5) / grid.elevation_m.size < 3.0
    assert _choose(survey, None, None, no, True) == ("joint", False)
    assert _choose(survey, 0.5, "shadow", no, True) == ("shadow", False)
    assert _choose(survey, 0.5, None, yes, True) == ("shadow", True)
    joint_m, whole_m = (
        0.5 * (expected_cells(survey, 0.5) / n) ** 0.5
        for n in (MOST_JOINT_CELLS, MOST_CELLS_AT_ONCE)
    )
    assert _choose(survey, 0.99 * joint_m, None, no, False) == ("shadow", True)
    assert "million cells: made in tiles" in capsys.readouterr().err
    assert _choose(survey, 0.99 * joint_m, "joint", no, True) == ("joint", False)
    assert _choose(survey, 0.99 * whole_m, "shadow", no, True) == ("shadow", True)
    with pytest.raises(InputError, match="joint method knows none"):
        _choose(survey, 0.99 * whole_m, "joint", no, True)
