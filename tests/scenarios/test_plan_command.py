"""`bathynav plan` by its files: contract, refusals, surveys, replanning."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import shapely
from click.testing import CliRunner

from mapping.rasters import write_map
from mapping.vectors import write_layer
from perception.records import NoPathError
from scenarios.commands.plan import command
from tests.planning.terrains import NORTH, WEST, canyon, flat, grid_of

COLUMNS = ["easting_m", "northing_m", "depth_m", "altitude_m", "heading_deg", "distance_m"]
KEYS = (
    "cost", "grid_cost", "lower_bound", "length_m", "mean_altitude_m", "min_altitude_m",
    "min_clearance_margin_m", "solved", "reason", "seconds", "seed", "config", "versions",
)  # fmt: skip


@pytest.fixture(scope="module")
def chart(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("map") / "map.tif"
    write_map(path, grid_of(canyon(n=160, seed=4, wall_m=12.0)))
    return path


def position(row: float, col: float) -> str:
    return f"{WEST + col + 0.5},{NORTH - row - 0.5}"


def run(*arguments: object) -> object:
    return CliRunner().invoke(command, [str(a) for a in arguments], standalone_mode=False)


def plan(chart: Path, out: Path, *more: object) -> object:
    ends = ("--start", position(6, 80), "--goal", position(150, 80))
    return run(
        "--map", chart, *ends, "--out", out, "--region-weights", "none", "--planner", "none",
        "--no-picture", *more,
    )  # fmt: skip


def test_a_solved_plan_writes_the_contracts_files(chart, tmp_path):
    result = plan(chart, tmp_path)
    assert result.exception is None, result.exception
    with (tmp_path / "route.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == COLUMNS
    table = {name: np.array([float(row[name]) for row in rows]) for name in COLUMNS}
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert all(key in metrics for key in KEYS)
    assert metrics["solved"] is True and metrics["reason"] == "" and metrics["k_sigma"] == 0
    assert metrics["lower_bound"] <= metrics["cost"]
    assert metrics["min_altitude_m"] >= 5.0 and (table["altitude_m"] >= 5.0).all()
    assert abs(table["distance_m"][-1] - metrics["length_m"]) < 1e-3
    for name in ("route.geojson", "route.gpkg", "route.gpx", "route.plan", "config.toml"):
        assert (tmp_path / name).stat().st_size > 0


def test_an_unsolved_plan_leaves_metrics_with_the_reason_and_no_route(tmp_path):
    z = flat()
    z[60:62, :] = np.nan
    write_map(tmp_path / "wall.tif", grid_of(z))
    out = tmp_path / "out"
    out.mkdir()
    (out / "route.csv").write_text("of an older run")
    result = run(
        "--map", tmp_path / "wall.tif", "--start", position(10, 60), "--goal", position(110, 60),
        "--out", out, "--region-weights", "none",
    )  # fmt: skip
    assert isinstance(result.exception, NoPathError)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["solved"] is False and "no data" in metrics["reason"]
    assert metrics["blocked_by"] == "barred"
    assert not list(out.glob("route.*"))
    assert (out / "blocked.png").exists()


def test_a_bad_start_is_told_in_one_line_and_in_the_metrics(chart, tmp_path):
    result = run(
        "--map", chart, "--start", "1,2", "--goal", position(150, 80), "--out", tmp_path,
        "--region-weights", "none",
    )  # fmt: skip
    assert "start 1.00,2.00 lies off the map" in str(result.exception)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["solved"] is False and "off the map" in metrics["reason"]


def test_a_sigma_band_is_covered_by_default(tmp_path):
    grid = grid_of(flat(), sigma_m=np.full((120, 120), 0.25))
    write_map(tmp_path / "map.tif", grid)
    result = run(
        "--map", tmp_path / "map.tif", "--start", position(10, 60), "--goal", position(110, 60),
        "--out", tmp_path / "o", "--region-weights", "none", "--planner", "none", "--no-picture",
    )  # fmt: skip
    assert result.exception is None
    metrics = json.loads((tmp_path / "o" / "metrics.json").read_text())
    assert metrics["k_sigma"] > 2.0
    assert metrics["min_altitude_m"] >= 5.0 + 0.25 * metrics["k_sigma"] - 1e-6


def test_a_survey_of_an_area_writes_lines_that_cover_it(chart, tmp_path):
    area = shapely.box(WEST + 40, NORTH - 120, WEST + 120, NORTH - 40)
    write_layer(tmp_path / "area.gpkg", [area], {"id": np.array([1])}, "EPSG:32632", "Polygon")
    limits = tmp_path / "v.toml"
    limits.write_text("[vehicle]\nceiling_m = 40\n")
    result = run(
        "--map", chart, "--survey", tmp_path / "area.gpkg", "--swath", 30, "--out", tmp_path / "o",
        "--vehicle", limits, "--no-picture",
    )  # fmt: skip
    assert result.exception is None, result.exception
    metrics = json.loads((tmp_path / "o" / "metrics.json").read_text())
    assert metrics["covered_share"] >= 0.99 and metrics["solved"] is True


def test_replanning_starts_where_the_vehicle_is(chart, tmp_path):
    assert plan(chart, tmp_path / "a").exception is None
    result = run(
        "--map", chart, "--replan", tmp_path / "a" / "route.csv", "--travelled", 50,
        "--out", tmp_path / "b", "--region-weights", "none",
    )  # fmt: skip
    assert result.exception is None, result.exception
    metrics = json.loads((tmp_path / "b" / "metrics.json").read_text())
    assert metrics["solved"] is True and metrics["length_m"] < 130


def test_a_map_too_large_to_hold_is_planned_reduced_and_proved_in_full(tmp_path, monkeypatch):
    row, col = np.mgrid[:400, :400]
    z = -60.0 + 5.0 * np.sin(row / 60.0) * np.cos(col / 50.0) + 0.3 * np.sin(row * 1.7 + col)
    grid = grid_of(z)
    write_map(tmp_path / "map.tif", grid)
    monkeypatch.setattr("planning.large.MOST_CELLS", 10_000)
    monkeypatch.setattr("planning.large.REDUCED_CELLS", 10_000)
    monkeypatch.setattr("planning.full_resolution._WINDOW_CELLS", 64.0)
    result = run(
        "--map", tmp_path / "map.tif", "--start", position(20.2, 30), "--goal", position(380, 361.3),
        "--out", tmp_path / "o", "--region-weights", "none", "--planner", "none", "--no-picture",
    )  # fmt: skip
    assert result.exception is None, result.exception
    metrics = json.loads((tmp_path / "o" / "metrics.json").read_text())
    assert metrics["solved"] is True and metrics["reduced_cell_m"] == 4.0
    with (tmp_path / "o" / "route.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    e, n, d = (np.array([float(r[c]) for r in rows]) for c in COLUMNS[:3])
    v = np.linspace(0, 1, 21)
    dense = [(a[:-1, None] + np.diff(a)[:, None] * v).ravel() for a in (e, n, d)]
    # float32 in the file: compare with the heights as stored.
    stored = grid_of(z.astype(np.float32))
    altitude = -dense[2] - stored.sample(dense[0], dense[1])
    assert altitude.min() >= 5.0
    assert abs(altitude.min() - metrics["min_altitude_m"]) < 0.05


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ((), "give --start"),
        (("--start", "1,2"), "give --start"),
        (("--survey", "a.gpkg", "--start", "1,2"), "three different things"),
        (("--start", "1,2", "--goal", "3,4", "--risk", "2"), "--risk must lie between 0 and 1"),
    ],
)
def test_wrong_usage_is_told(chart, tmp_path, options, text):
    result = run("--map", chart, "--out", tmp_path, *options)
    assert text in str(result.exception)


def test_a_vehicle_file_with_a_slip_names_the_key(chart, tmp_path):
    limits = tmp_path / "v.toml"
    limits.write_text("[vehicle]\nturn_radius = 12\n")
    result = plan(chart, tmp_path / "o", "--vehicle", limits)
    assert "unknown key 'turn_radius'" in str(result.exception)
