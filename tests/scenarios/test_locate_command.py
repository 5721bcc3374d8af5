"""`bathynav locate` as a user calls it: files in, files out, one plain line when it cannot."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner, Result
from scipy import ndimage

from mapping.rasters import OpenMap, write_map
from perception.records import Grid, InputError, NoOverlapError
from scenarios import locating
from scenarios.benchmarks.navigation_sets import NavigationSet, SetConfig, make_set
from scenarios.commands.locate import command, in_words

CONFIG = SetConfig(extent_m=2000.0, duration_s=420.0)


@pytest.fixture(scope="module")
def drawn() -> NavigationSet:
    return make_set(CONFIG, np.random.default_rng(1))


@pytest.fixture(scope="module")
def files(drawn: NavigationSet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("set")
    write_map(folder / "prior.tif", drawn.prior)
    pd.DataFrame(drawn.nav).to_csv(folder / "nav.csv", index=False)
    return folder


def locate(*arguments: object, text: str | None = None) -> Result:
    return CliRunner().invoke(command, [str(a) for a in arguments], input=text)


def test_a_set_is_navigated_and_every_row_answered(
    files: Path, drawn: NavigationSet, tmp_path: Path
) -> None:
    result = locate("--map", files / "prior.tif", "--nav", files / "nav.csv", "--out", tmp_path)
    assert result.exit_code == 0, result.output
    track = pd.read_csv(tmp_path / "trajectory.csv")
    assert len(track) == len(drawn.nav["time_s"])
    for name in ("sigma_easting_m", "cov_en_m2", "status", "protection_m", "time", "time_s"):
        assert name in track
    error = np.hypot(
        track.easting_m - drawn.truth_easting_m, track.northing_m - drawn.truth_northing_m
    )
    assert error[70:].max() < 5.0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["converged"] is True
    assert metrics["seed"] == 0
    for name in ("trajectory-smoothed.csv", "fixes.csv", "locate.png", "config.toml"):
        assert (tmp_path / name).stat().st_size > 0


def test_a_map_elsewhere_fails_with_both_extents(files: Path, tmp_path: Path) -> None:
    nav = pd.read_csv(files / "nav.csv")
    nav.easting_m += 400_000
    nav.to_csv(tmp_path / "nav.csv", index=False)
    result = locate(
        "--map", files / "prior.tif", "--nav", tmp_path / "nav.csv", "--out", tmp_path / "out"
    )
    assert isinstance(result.exception, NoOverlapError)
    assert "does not meet the prior map" in str(result.exception)
    assert not (tmp_path / "out" / "trajectory.csv").exists()


def test_of_a_large_map_only_the_part_in_reach_is_read_and_the_track_is_the_same(
    drawn: NavigationSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A map of 6 km, of which the mission reaches a third."""
    wide = np.pad(drawn.prior.elevation_m, 400, mode="reflect")
    prior = Grid(
        wide, drawn.prior.west_m - 2000.0, drawn.prior.north_m + 2000.0, 5.0, drawn.prior.crs,
        np.full(wide.shape, 0.3),
    )  # fmt: skip
    write_map(tmp_path / "prior.tif", prior)
    pd.DataFrame(drawn.nav).head(40).to_csv(tmp_path / "nav.csv", index=False)
    texts, sizes = [], []
    reading = OpenMap.read

    def counted(opened: OpenMap, *window: slice) -> Grid:
        grid = reading(opened, *window)
        sizes.append(grid.elevation_m.size)
        return grid

    monkeypatch.setattr(OpenMap, "read", counted)
    for name, limit in (("whole", 10_000_000), ("part", 100_000)):
        monkeypatch.setattr(locating, "_LARGE_CELLS", limit)
        result = locate(
            "--map", tmp_path / "prior.tif", "--nav", tmp_path / "nav.csv", "--out", tmp_path / name
        )
        assert result.exit_code == 0, result.output
        texts.append((tmp_path / name / "trajectory.csv").read_text())
    assert texts[0] == texts[1]
    assert sizes[-1] < 0.7 * wide.size < max(sizes)


def test_a_map_without_sigma_is_used_with_one_that_is_told(files: Path, tmp_path: Path) -> None:
    grid = make_set(CONFIG, np.random.default_rng(1)).prior
    bare = Grid(grid.elevation_m, grid.west_m, grid.north_m, grid.cell_m, grid.crs)
    write_map(tmp_path / "bare.tif", bare)
    result = locate(
        "--map", tmp_path / "bare.tif", "--nav", files / "nav.csv", "--out", tmp_path / "out"
    )
    assert result.exit_code == 0, result.output
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert "S-44" in metrics["map_sigma_source"]


def test_the_same_seed_gives_the_same_file(files: Path, tmp_path: Path) -> None:
    texts = []
    for name in ("a", "b"):
        nav = pd.read_csv(files / "nav.csv").head(60)
        nav.to_csv(tmp_path / "nav.csv", index=False)
        locate(
            "--map", files / "prior.tif", "--nav", tmp_path / "nav.csv", "--out", tmp_path / name
        )
        texts.append((tmp_path / name / "trajectory.csv").read_text())
    assert texts[0] == texts[1]


def test_following_writes_a_line_for_each_row(files: Path) -> None:
    lines = (files / "nav.csv").read_text().splitlines()[:31]
    result = locate("--follow", "--map", files / "prior.tif", text="\n".join(lines) + "\n")
    assert result.exit_code == 0, result.output
    told = [json.loads(line) for line in result.output.splitlines()]
    assert len(told) == 30
    assert told[-1]["time_s"] == 87.0


def test_following_nothing_says_so(files: Path) -> None:
    result = locate("--follow", "--map", files / "prior.tif", text="")
    assert isinstance(result.exception, InputError)


def test_observability_is_a_map_and_a_picture(tmp_path: Path) -> None:
    from mapping.rasters import read_map

    small = make_set(
        SetConfig(extent_m=600.0, duration_s=30.0, outer_m=300.0), np.random.default_rng(2)
    )
    write_map(tmp_path / "prior.tif", small.prior)
    result = locate("--observability", "--map", tmp_path / "prior.tif", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    layer = read_map(tmp_path / "out" / "observability.tif")
    assert layer.shape == small.prior.shape
    assert (tmp_path / "out" / "observability.png").exists()
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert 0.05 < metrics["sigma_best_median_m"] <= metrics["sigma_worst_median_m"] < 71.0


@pytest.mark.parametrize("compact", [False, True])
def test_a_patch_is_placed_with_its_heading_and_drawn(
    files: Path, drawn: NavigationSet, tmp_path: Path, compact: bool
) -> None:
    """A turned square read from the map itself comes back; its rivals are in a table."""
    prior = drawn.prior
    turn, side = np.radians(110.0), 120
    centre = np.array([prior.west_m + 900.0, prior.north_m - 1100.0])
    at = (np.arange(side) - (side - 1) / 2) * prior.cell_m
    x, y = np.meshgrid(at, at[::-1])
    row, col = prior.fractional_index(
        centre[0] + np.cos(turn) * x + np.sin(turn) * y,
        centre[1] + np.cos(turn) * y - np.sin(turn) * x,
    )
    height = ndimage.map_coordinates(prior.elevation_m, [row, col], order=1)
    write_map(tmp_path / "patch.tif", Grid(height, 0.0, side * prior.cell_m, prior.cell_m))
    arguments = ["--map", files / "prior.tif", "--patch", tmp_path / "patch.tif"]
    result = locate(*arguments, *["--compact"] * compact, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "heading of the patch's north (deg)" in result.output
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["fix"] is True, metrics["verdict"]
    assert np.hypot(metrics["easting_m"] - centre[0], metrics["northing_m"] - centre[1]) < 10.0
    # Zone 31's grid north and true north differ by the convergence, up to 3 degrees so far west.
    assert abs(metrics["heading_deg"] - 110.0) < 4.0
    table = pd.read_csv(tmp_path / "out" / "hypotheses.csv")
    assert table.accepted.sum() == 1
    assert (tmp_path / "out" / "patch.png").stat().st_size > 0
    assert metrics["map_carried_percent"] == pytest.approx(100.0) or compact


def test_a_patch_is_placed_on_a_map_of_the_sigma_that_is_given(
    files: Path, drawn: NavigationSet, tmp_path: Path
) -> None:
    """A map said to be very wrong is smoothed before a patch is compared with it."""
    prior = drawn.prior
    part = Grid(prior.elevation_m[100:180, 100:180], 0.0, 400.0, prior.cell_m)
    write_map(tmp_path / "patch.tif", part)
    sigmas = []
    for sigma in (0.1, 3.0):
        out = tmp_path / str(sigma)
        result = locate(
            "--map", files / "prior.tif", "--patch", tmp_path / "patch.tif", "--heading", 0,
            "--map-sigma", sigma, "--out", out,
        )  # fmt: skip
        assert result.exit_code == 0, result.output
        metrics = json.loads((out / "metrics.json").read_text())
        sigmas.append(metrics["sigma_easting_m"])
        assert f"map_sigma_m = {sigma}" in (out / "config.toml").read_text()
        assert metrics["sigma_heading_deg"] == pytest.approx(0.5)
    assert sigmas[1] > 1.05 * sigmas[0]


def test_a_patch_without_any_place_has_no_row_of_nan(files: Path, tmp_path: Path) -> None:
    flat = Grid(np.zeros((40, 40)), 0.0, 200.0, 5.0)
    write_map(tmp_path / "flat.tif", flat)
    result = locate(
        "--map", files / "prior.tif", "--patch", tmp_path / "flat.tif", "--heading", 0, "--out", tmp_path / "out"
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "no fix" in result.output and "nan" not in result.output
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["ambiguity"] is None


def test_soundings_off_the_map_are_told_in_the_verdict(files: Path, tmp_path: Path) -> None:
    table = pd.read_csv(files / "nav.csv")
    table = table.assign(depth_m=-table.depth_m).head(40)
    table.to_csv(tmp_path / "up.csv", index=False)
    result = locate("--map", files / "prior.tif", "--nav", tmp_path / "up.csv", "--out", tmp_path)
    assert result.exit_code == 0, result.output
    assert "above the map throughout: units, sign of depth, or datum?" in result.output


def test_figures_are_printed_in_words_and_one_sigma_at_a_time() -> None:
    told = in_words(
        {"sigma_last_m": 1.234567, "converged": True, "easting_m": 512345.678, "events": ""}
    )
    assert told == [
        ("1-sigma at the end, both axes together (m)", "1.235"), ("easting (m)", "512345.68"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("--observability", "--follow"),
        ("--observability", "--nav", "x.csv"),
        ("--patch", "p.tif", "--follow"),
        ("--nav", "x.csv", "--compact"),
        ("--patch", "p.tif", "--out", "out", "--sensors", "dvl.toml"),
        ("--patch", "p.tif", "--out", "out", "--map-error-length", "20"),
        ("--patch", "p.tif", "--out", "out", "--particles", "4000"),
        ("--patch", "p.tif", "--out", "out", "--seed", "0"),
    ],
)
def test_wrong_usage_is_exit_two(files: Path, arguments: tuple[str, ...]) -> None:
    result = locate("--map", files / "prior.tif", *arguments)
    assert result.exit_code == 2
