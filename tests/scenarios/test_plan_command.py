"""`bathynav plan` by its files: contract, refusals, surveys, replanning."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from click.testing import CliRunner

from mapping.rasters import open_map, write_bands, write_map
from mapping.vectors import write_layer
from perception.geodesy import convergence
from perception.records import Grid, InputError, NoOverlapError, NoPathError
from planning.full_resolution import FullMap, _Windows
from planning.large import is_dry, read_reduced
from planning.problem import Problem
from scenarios.commands.plan import command
from scenarios.route_inputs import position_sigma
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


def test_replanning_tells_what_held_the_old_route_and_is_not_given_again(chart, tmp_path, caplog):
    objects = tmp_path / "objects.csv"
    objects.write_text(
        f"easting_m,northing_m,kind,height_m,sigma_m\n{WEST + 30},{NORTH - 30},hill,1.0,0.1\n"
    )
    vehicle = tmp_path / "v.toml"
    vehicle.write_text("[vehicle]\nfloor_m = 6\n")
    held = ("--objects", objects, "--vehicle", vehicle)
    assert plan(chart, tmp_path / "a", *held).exception is None
    again = ("--map", chart, "--replan", tmp_path / "a" / "route.csv", "--travelled", 50,
             "--out", tmp_path / "b", "--region-weights", "none", "--no-picture")  # fmt: skip
    assert run(*again).exception is None
    assert "was planned with --objects" in caplog.text and "(floor_m): give" in caplog.text
    caplog.clear()
    assert run(*again, *held).exception is None
    assert "was planned" not in caplog.text
    # Into its own folder the old route would be gone before it is read.
    same = run(*again[:6], "--out", tmp_path / "a")
    assert "another --out" in str(same.exception) and (tmp_path / "a" / "route.csv").exists()


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
        (("--start", "1,2", "--goal", "3,4", "--risk", "2"), "not in the range 0<x<1"),
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


# ---- maps too large to hold --------------------------------------------------------------------


def rough_ground(n: int = 400) -> np.ndarray:
    row, col = np.mgrid[:n, :n]
    return -60.0 + 5.0 * np.sin(row / 60.0) * np.cos(col / 50.0) + 0.3 * np.sin(row * 1.7 + col)


@pytest.fixture
def small_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a map of 160,000 cells too large to hold."""
    monkeypatch.setattr("planning.large.MOST_CELLS", 10_000)
    monkeypatch.setattr("planning.large.REDUCED_CELLS", 10_000)
    monkeypatch.setattr("planning.full_resolution._WINDOW_CELLS", 64.0)
    monkeypatch.setattr("planning.full_resolution._REPAIR_CELLS", 100.0)


def large_plan(path: Path, out: Path, *more: object) -> dict:
    weights = () if "--regions" in more else ("--region-weights", "none")
    result = run(
        "--map", path, "--start", position(20.2, 30), "--goal", position(380, 361.3), "--out", out,
        *weights, "--planner", "none", "--no-picture", *more,
    )  # fmt: skip
    assert result.exception is None, result.exception
    return json.loads((out / "metrics.json").read_text())


def least_altitude(out: Path, z: np.ndarray) -> float:
    """Sample a written route densely over the heights as stored."""
    with (out / "route.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    e, n, d = (np.array([float(r[c]) for r in rows]) for c in COLUMNS[:3])
    v = np.linspace(0, 1, 21)
    e, n, d = ((a[:-1, None] + np.diff(a)[:, None] * v).ravel() for a in (e, n, d))
    return float(np.min(-d - grid_of(z.astype(np.float32)).sample(e, n)))


def test_a_large_map_takes_its_sigma_from_the_option_and_its_heights_from_a_depth_band(
    tmp_path, small_memory
):
    z = rough_ground()
    frame = grid_of(z)
    write_bands(tmp_path / "m.tif", {"uncertainty": np.full(z.shape, 0.1), "depth": -z}, frame)
    banded = large_plan(tmp_path / "m.tif", tmp_path / "a")
    given = large_plan(tmp_path / "m.tif", tmp_path / "b", "--map-sigma", 0.4)
    assert banded["k_sigma"] > 3 and given["k_sigma"] > 3
    for metrics, sigma, out in ((banded, 0.1, "a"), (given, 0.4, "b")):
        least = least_altitude(tmp_path / out, z)
        assert least >= 5.0 + sigma * metrics["k_sigma"] - 1e-3
        assert least <= 5.1 + sigma * metrics["k_sigma"]


def test_a_boulder_and_a_hole_that_block_means_hide_are_gone_round_at_full_resolution(
    tmp_path, small_memory
):
    z = rough_ground()
    write_map(tmp_path / "plain.tif", grid_of(z))
    large_plan(tmp_path / "plain.tif", tmp_path / "plain")
    with (tmp_path / "plain" / "route.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    middle = rows[len(rows) // 2]
    row, col = grid_of(z).fractional_index(
        *(np.array(float(middle[name])) for name in ("easting_m", "northing_m"))
    )
    row, col = round(float(row)), round(float(col))
    # A spire of one cell, too steep to fly over within the ceiling, right below the route.
    spired = z.copy()
    block = np.s_[row // 4 * 4 : row // 4 * 4 + 4, col // 4 * 4 : col // 4 * 4 + 4]
    # The block's mean tells nothing: the rest of it is as much lower.
    spired[block] -= (-32.0 - z[row, col]) / 15.0
    spired[row, col] = -32.0
    write_map(tmp_path / "spire.tif", grid_of(spired))
    metrics = large_plan(tmp_path / "spire.tif", tmp_path / "spire")
    assert metrics["stretches_replanned"] >= 1
    assert least_altitude(tmp_path / "spire", spired) >= 5.0
    # A row of specks without data, one in every block across the way: two metres are left between them.
    holed = z.copy()
    holed[200, ::4] = np.nan
    write_map(tmp_path / "holed.tif", grid_of(holed))
    large_plan(tmp_path / "holed.tif", tmp_path / "holed")
    assert least_altitude(tmp_path / "holed", holed) >= 5.0


def test_a_large_map_takes_regions_of_its_own_grid_and_refuses_others(tmp_path, small_memory):
    z = rough_ground()
    frame = grid_of(z)
    write_map(tmp_path / "map.tif", frame)
    code = np.full(z.shape, 4)
    code[:, 150:250] = 1
    bands = {"class": code, "region": np.ones_like(code)}
    write_bands(tmp_path / "regions.tif", bands, frame, dtype="int32", nodata=0)
    metrics = large_plan(
        tmp_path / "map.tif", tmp_path / "a", "--regions", tmp_path / "regions.tif"
    )
    # A peak costs 2, a valley 1; a hundred columns of peak must be crossed.
    assert metrics["cost"] > metrics["length_m"] + 95
    moved = replace(frame, west_m=frame.west_m + 7.0)
    write_bands(tmp_path / "regions.tif", bands, moved, dtype="int32", nodata=0)
    result = run(
        "--map", tmp_path / "map.tif", "--start", position(20.2, 30), "--goal", position(380, 361.3),
        "--out", tmp_path / "b", "--regions", tmp_path / "regions.tif",
    )  # fmt: skip
    assert "are not the map's" in str(result.exception)


def test_no_go_areas_of_a_large_map_hold_at_full_resolution(tmp_path, small_memory):
    z = rough_ground()
    write_map(tmp_path / "map.tif", grid_of(z))
    area = shapely.box(WEST + 180, NORTH - 260, WEST + 181.5, NORTH - 140)
    write_layer(tmp_path / "no.gpkg", [area], {"id": np.array([1])}, "EPSG:32632", "Polygon")
    large_plan(tmp_path / "map.tif", tmp_path / "a", "--avoid", tmp_path / "no.gpkg")
    with (tmp_path / "a" / "route.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    line = shapely.linestrings([(float(r["easting_m"]), float(r["northing_m"])) for r in rows])
    assert not shapely.intersects(line, area)


def test_regions_of_another_place_are_refused(chart, tmp_path):
    frame = grid_of(np.zeros((160, 160)))
    moved = replace(frame, north_m=frame.north_m + 30.0)
    bands = {"class": np.ones((160, 160)), "region": np.ones((160, 160))}
    write_bands(tmp_path / "regions.tif", bands, moved, dtype="int32", nodata=0)
    result = run(
        "--map", chart, "--start", position(6, 80), "--goal", position(150, 80),
        "--out", tmp_path / "o", "--regions", tmp_path / "regions.tif",
    )  # fmt: skip
    assert "are not the map's" in str(result.exception)


# ---- headings, missions, currents --------------------------------------------------------------


def test_headings_in_files_are_from_true_north(tmp_path):
    # Three degrees east of the zone's central meridian the grid is turned by 1.8 deg and more.
    east = 750_000.0
    grid = Grid(flat(), east, 4_500_000.0, 1.0, crs="EPSG:32632")
    write_map(tmp_path / "map.tif", grid)
    turn = math.degrees(float(convergence(np.array([east]), np.array([4_500_000.0]), grid.crs)[0]))
    assert turn > 1.8
    result = run(
        "--map", tmp_path / "map.tif", "--start", f"{east + 60},{4_500_000 - 110}",
        "--goal", f"{east + 60},{4_500_000 - 10}", "--out", tmp_path / "o",
        "--region-weights", "none", "--planner", "none", "--no-picture",
    )  # fmt: skip
    assert result.exception is None, result.exception
    with (tmp_path / "o" / "route.csv").open() as stream:
        heading = np.array([float(r["heading_deg"]) for r in csv.DictReader(stream)])
    # Straight to grid north, but for what a polished polygon wriggles.
    np.testing.assert_allclose(heading.mean(), turn, atol=0.05)
    np.testing.assert_allclose(heading, turn, atol=0.5)
    # A heading asked for is from true north too: this one is grid north, so nothing bends.
    (tmp_path / "v.toml").write_text(f"[vehicle]\nstart_heading_deg = {turn}\n")
    result = run(
        "--map", tmp_path / "map.tif", "--start", f"{east + 60},{4_500_000 - 110}",
        "--goal", f"{east + 60},{4_500_000 - 10}", "--out", tmp_path / "o", "--vehicle",
        tmp_path / "v.toml", "--region-weights", "none", "--planner", "none", "--no-picture",
    )  # fmt: skip
    assert result.exception is None, result.exception
    metrics = json.loads((tmp_path / "o" / "metrics.json").read_text())
    assert abs(metrics["length_m"] - 100.0) < 0.01


def test_a_mission_keeps_metrics_flat_and_tells_the_order(chart, tmp_path):
    result = plan(
        chart, tmp_path, "--via", position(110, 80), "--via", position(50, 80),
    )  # fmt: skip
    assert result.exception is None, result.exception
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["order"] == "0 2 1 3" and metrics["stops"] == 4
    assert not [k for k, v in metrics.items() if isinstance(v, list)]


def test_a_current_lengthens_the_way_against_it_and_shortens_the_way_with_it(tmp_path):
    write_map(tmp_path / "map.tif", grid_of(flat()))
    times = {}
    for name, current in (("still", None), ("against", "0,-0.5"), ("with", "0,0.5")):
        more = () if current is None else ("--currents", current)
        result = run(
            "--map", tmp_path / "map.tif", "--start", position(110, 60), "--goal", position(10, 60),
            "--out", tmp_path / name, "--region-weights", "none", "--planner", "none", "--no-picture",
            *more,
        )  # fmt: skip
        assert result.exception is None, result.exception
        times[name] = json.loads((tmp_path / name / "metrics.json").read_text())["travel_time_s"]
    np.testing.assert_allclose(times["still"], 100 / 1.5, rtol=1e-3)
    np.testing.assert_allclose(times["against"], 100 / 1.0, rtol=1e-2)
    np.testing.assert_allclose(times["with"], 100 / 2.0, rtol=1e-2)


def test_a_map_without_sigma_is_told_to_hold_as_it_stands(chart, tmp_path, caplog):
    assert plan(chart, tmp_path).exception is None
    assert "has no sigma" in caplog.text and "--map-sigma" in caplog.text
    caplog.clear()
    assert plan(chart, tmp_path, "--map-sigma", 0.2, "--risk", 0.1).exception is None
    assert "has no sigma" not in caplog.text


def test_an_observability_map_makes_ground_dear_by_its_mean_error(tmp_path):
    frame = grid_of(flat())
    write_map(tmp_path / "map.tif", frame)
    bands = {"sigma_best": np.zeros((120, 120)), "sigma_mean": np.full((120, 120), 2.0)}
    write_bands(tmp_path / "observability.tif", bands, frame)
    (tmp_path / "c.toml").write_text("[cost]\nposition_per_m = 0.5\n")
    result = run(
        "--map", tmp_path / "map.tif", "--start", position(10, 60), "--goal", position(110, 60),
        "--out", tmp_path / "o", "--region-weights", "none", "--planner", "none", "--no-picture",
        "--position-sigma", tmp_path / "observability.tif", "--cost", tmp_path / "c.toml",
    )  # fmt: skip
    assert result.exception is None, result.exception
    metrics = json.loads((tmp_path / "o" / "metrics.json").read_text())
    np.testing.assert_allclose(metrics["cost"], 100.0 * (1.0 + 0.5 * 2.0), rtol=1e-3)


def test_half_filled_blocks_of_a_large_map_count_with_their_sigma_in_the_second_try(
    tmp_path, small_memory
):
    z = rough_ground()
    sigma = np.full(z.shape, 0.1)
    # Specks in every block across the way, one row of heights and sigma, one of sigma alone.
    z[200, ::4] = sigma[200, ::4] = sigma[240, ::4] = np.nan
    write_map(tmp_path / "m.tif", grid_of(z, sigma_m=sigma))
    metrics = large_plan(tmp_path / "m.tif", tmp_path / "a")
    least = least_altitude(tmp_path / "a", z)
    assert metrics["k_sigma"] > 3 and least >= 5.0 + 0.1 * metrics["k_sigma"] - 1e-3


def test_a_sigma_that_lacks_in_every_block_is_still_covered_on_a_large_map(tmp_path, small_memory):
    z = rough_ground()
    sigma = np.full(z.shape, 0.1)
    sigma[::4, ::4] = np.nan
    write_map(tmp_path / "m.tif", grid_of(z, sigma_m=sigma))
    reduced = read_reduced(tmp_path / "m.tif")
    assert reduced.grid.sigma_m is not None and not reduced.loose_has_more
    np.testing.assert_allclose(reduced.grid.sigma_m, 0.1, rtol=1e-6)
    # Where a window holds no sigma at all, nothing is proved: it is barred.
    problem = Problem(reduced.grid)
    sigma[:200] = np.nan
    write_map(tmp_path / "half.tif", grid_of(z, sigma_m=sigma))
    with open_map(tmp_path / "half.tif") as opened:
        windows = _Windows(opened, FullMap(tmp_path / "half.tif", None, reduced), problem)
        box = (WEST + 50, NORTH - 100, WEST + 100, NORTH - 50)
        assert windows.surface(box, 3.0, 0.0).barred.all()


def test_a_dry_map_is_planned_large_with_stops_and_replanned(tmp_path, small_memory, monkeypatch):
    z = rough_ground() + 1000.0
    write_map(tmp_path / "dry.tif", grid_of(z))
    assert large_plan(tmp_path / "dry.tif", tmp_path / "a")["solved"]
    assert least_altitude(tmp_path / "a", z) >= 5.0
    again = ("--replan", tmp_path / "a" / "route.csv", "--travelled", 440)
    for most in (90_000, 1_000_000):
        monkeypatch.setattr("planning.large.MOST_CELLS", most)
        result = run("--map", tmp_path / "dry.tif", "--region-weights", "none", *again, "--out", tmp_path / "b")  # fmt: skip
        assert result.exception is None, result.exception
    result = run(
        "--map", tmp_path / "dry.tif", "--start", position(20, 30), "--goal", position(60, 80),
        "--via", position(30, 70), "--out", tmp_path / "c", "--region-weights", "none",
        "--planner", "none", "--no-picture",
    )  # fmt: skip
    assert result.exception is None, result.exception


def test_land_above_a_sea_map_is_no_dry_map_where_only_a_window_is_read(tmp_path):
    z = np.full((60, 60), 20.0)
    write_map(tmp_path / "dry.tif", grid_of(z))
    assert is_dry(tmp_path / "dry.tif")
    z[-1, -1] = -3.0
    write_map(tmp_path / "sea.tif", grid_of(z))
    assert not is_dry(tmp_path / "sea.tif")


def test_a_position_sigma_of_a_part_serves_all_windows_of_a_large_map(tmp_path, small_memory):
    z = rough_ground()
    write_map(tmp_path / "m.tif", grid_of(z))
    part = grid_of(np.full((60, 60), 0.5))
    write_bands(tmp_path / "part.tif", {"sigma_mean": part.elevation_m}, part)
    errors = ("--position-sigma", tmp_path / "part.tif")
    assert large_plan(tmp_path / "m.tif", tmp_path / "a", *errors)["k_sigma"] > 3
    on = position_sigma(tmp_path / "part.tif", tmp_path / "m.tif")
    np.testing.assert_array_equal(on(replace(part, west_m=WEST + 300)), 0.5)
    far = replace(part, west_m=WEST + 900)
    write_bands(tmp_path / "far.tif", {"sigma_mean": part.elevation_m}, far)
    with pytest.raises(NoOverlapError, match="does not cover the map"):
        position_sigma(tmp_path / "far.tif", tmp_path / "m.tif")
    other = replace(part, crs="EPSG:32633")
    write_bands(tmp_path / "other.tif", {"sigma_mean": part.elevation_m}, other)
    with pytest.raises(InputError, match="EPSG:32633, the map in EPSG:32632"):
        position_sigma(tmp_path / "other.tif", tmp_path / "m.tif")


def test_metrics_come_after_the_route_and_nothing_is_left_of_one_that_cannot_be_written(
    chart, tmp_path, monkeypatch
):
    def full(out: Path, *more: object) -> None:
        (out / "route.csv").write_text("half")
        assert not (out / "metrics.json").exists()
        raise InputError("disk full")

    monkeypatch.setattr("scenarios.route_runs.write_route_files", full)
    assert "disk full" in str(plan(chart, tmp_path).exception)
    assert json.loads((tmp_path / "metrics.json").read_text())["solved"] is False
    assert not (tmp_path / "route.csv").exists()


def test_objects_that_the_map_smooths_lift_the_route_and_count_in_the_metrics(chart, tmp_path):
    """A wall of boulders across the canyon: the route must clear it by its floor."""
    rows = [f"{WEST + col + 0.5},{NORTH - 80.5},hill,4.0,0.1" for col in range(2, 158, 2)]
    path = tmp_path / "objects.csv"
    path.write_text("easting_m,northing_m,kind,height_m,sigma_m\n" + "\n".join(rows) + "\n")
    least = {}
    for name, more in (("plain", ()), ("clear", ("--objects", path))):
        result = plan(chart, tmp_path / name, *more)
        assert result.exception is None, result.exception
        with (tmp_path / name / "route.csv").open() as stream:
            route = list(csv.DictReader(stream))
        least[name] = min(
            float(row["altitude_m"])
            for row in route
            if abs(float(row["northing_m"]) - (NORTH - 80.5)) < 2.0
        )
    assert least["clear"] > least["plain"] + 3.0
    assert "objects.csv" in (tmp_path / "clear" / "config.toml").read_text()
    assert json.loads((tmp_path / "clear" / "metrics.json").read_text())["standing_objects"] == 78


def test_objects_of_another_place_are_refused(chart, tmp_path):
    path = tmp_path / "objects.csv"
    path.write_text("easting_m,northing_m,kind,height_m\n10,20,hill,4.0\n")
    result = plan(chart, tmp_path / "out", "--objects", path)
    assert isinstance(result.exception, NoOverlapError)
    assert "none of its 1 objects lies on the map" in str(result.exception)


def test_ends_off_the_map_are_refused_before_the_map_is_segmented(chart, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "perception.regions.segment",
        lambda *_: pytest.fail("segmented before the ends were checked"),
    )
    result = run(
        "--map", chart, "--start", "1,2", "--goal", position(150, 80), "--out", tmp_path,
        "--no-picture",
    )  # fmt: skip
    assert isinstance(result.exception, InputError)
    assert "start 1.00,2.00 lies off the map" in str(result.exception)


def test_a_number_that_is_none_is_refused_as_wrong_usage(chart, tmp_path):
    result = plan(chart, tmp_path, "--swath", "nan")
    assert "nan is no number" in str(result.exception)


def test_a_table_that_lists_no_objects_is_refused(chart, tmp_path):
    path = tmp_path / "nav.csv"
    path.write_text(f"time_s,easting_m,northing_m\n1,{WEST + 20},{NORTH - 20}\n")
    result = plan(chart, tmp_path / "out", "--objects", path)
    assert isinstance(result.exception, InputError)
    assert "gives no object a height" in str(result.exception)


def test_a_map_of_depths_counted_downwards_is_told(tmp_path, caplog):
    grid = grid_of(-canyon(n=160, seed=4, wall_m=12.0))
    write_map(tmp_path / "map.tif", grid)
    plan(tmp_path / "map.tif", tmp_path / "out")
    assert "all its heights lie above zero" in caplog.text


def test_a_negative_sigma_is_told_and_counts_as_none(tmp_path, caplog):
    grid = grid_of(flat())
    write_map(tmp_path / "map.tif", replace(grid, sigma_m=np.full(grid.shape, -0.5)))
    result = plan(tmp_path / "map.tif", tmp_path / "out")
    assert isinstance(result.exception, InputError)
    assert "holds negative sigmas (-0.5)" in caplog.text
