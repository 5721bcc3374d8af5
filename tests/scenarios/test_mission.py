"""The whole way on a tiny survey: every stage's folder, resumable, the same to the byte."""

import json

import numpy as np
import pytest
import rasterio

from mapping.rasters import read_map, write_map
from mapping.trajectories import read_trajectory
from perception.records import Grid
from scenarios.pipeline import STAGES
from scenarios.scores import score_map, score_route
from tests.scenarios.command_line import run_command
from tests.scenarios.tiny import write_tiny


@pytest.fixture(scope="module")
def mission(tmp_path_factory):
    """A finished mission, run through the command line."""
    folder = tmp_path_factory.mktemp("mission")
    write_tiny(folder)
    return folder


@pytest.fixture(scope="module")
def finished(mission):
    from scenarios.pipeline import run_mission
    from scenarios.schema import load_scenario

    out = mission / "out"
    run_mission(load_scenario(mission / "tiny.toml"), out, quiet=True)
    return out


def test_every_stage_leaves_its_folder_with_numbers_and_config(finished):
    for stage in STAGES:
        assert (finished / stage / "metrics.json").exists(), stage
        assert (finished / stage / "config.toml").exists(), stage
    metrics = json.loads((finished / "metrics.json").read_text())
    for key in ("map_mae_m", "track_rms_before_m", "track_rms_after_m", "nav_rms_with_fixes_m"):
        assert np.isfinite(metrics[key]), key
    assert metrics["route_solved"] in (True, False) and metrics["total_s"] > 0


def test_the_map_file_keeps_the_contract(finished):
    with rasterio.open(finished / "map" / "map.tif") as source:
        assert source.descriptions == ("elevation", "sigma", "count")
        assert set(source.dtypes) == {"float32"} and np.isnan(source.nodata)
        assert source.crs.to_epsg() == 32630
        cell = source.transform.a
        assert source.transform.c / cell == pytest.approx(round(source.transform.c / cell))
        elevation, sigma = source.read(1), source.read(2)
    assert np.isfinite(sigma[np.isfinite(elevation)]).all() and (sigma[sigma == sigma] > 0).all()


def test_the_trajectory_has_one_row_for_every_ping_in_order(finished):
    track = read_trajectory(finished / "map" / "trajectory.csv")
    truth = read_trajectory(finished / "simulate" / "truth" / "trajectory.csv")
    assert len(track.time_s) == len(truth.time_s)
    np.testing.assert_array_equal(track.ping, np.arange(len(truth.time_s)))
    np.testing.assert_allclose(track.time_s, truth.time_s, atol=0.01)


def test_the_map_beats_interpolated_soundings_of_the_same_survey(finished):
    scores = score_map(finished / "map", finished / "simulate" / "truth")
    assert scores["map_to_soundings_ratio"] < 1.0
    # Three passes of a few minutes: the share scatters widely about the 68 % it should be.
    assert 0.4 < scores["map_within_1sigma"] < 0.95


def test_a_route_is_scored_by_its_least_altitude_over_the_true_floor(tmp_path):
    """A boulder of 2 m between two waypoints, under a level route 5 m above the floor around it."""
    floor = np.full((41, 41), -30.0)
    floor[20, 20] = -28.0
    (tmp_path / "truth").mkdir()
    write_map(tmp_path / "truth" / "elevation.tif", Grid(floor, 0.0, 41.0, 1.0, crs="EPSG:32630"))
    route = tmp_path / "route.csv"
    route.write_text("easting_m,northing_m,depth_m,distance_m\n2.5,20.5,25,0\n38.5,20.5,25,36\n")
    found = score_route(route, tmp_path / "truth")["route_min_true_altitude_m"]
    assert found == pytest.approx(3.0, abs=0.3)


def test_an_interrupted_mission_goes_on_where_it_stopped(finished):
    from scenarios.pipeline import run_mission
    from scenarios.schema import load_scenario

    before = (finished / "map" / "map.tif").read_bytes()
    made = (finished / "map" / "map.tif").stat().st_mtime_ns
    route = (finished / "plan" / "metrics.json").read_text()
    # As a kill in the last stage leaves it: no metrics.json on top, half of the last folder.
    (finished / "metrics.json").unlink()
    (finished / "plan" / ".stage.json").write_text('{"key": "", "seconds": 0.0}')
    run_mission(load_scenario(finished / "scenario.toml"), finished, quiet=True)
    assert (finished / "map" / "map.tif").stat().st_mtime_ns == made, "the map was not made again"
    assert (finished / "map" / "map.tif").read_bytes() == before
    again = json.loads((finished / "plan" / "metrics.json").read_text())
    assert again["cost"] == json.loads(route)["cost"]


def test_a_folder_that_no_mission_wrote_is_not_replaced(finished, tmp_path, capsys):
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / "map.tif").write_text("a survey's result")
    outcome = run_command(capsys, "run", finished / "scenario.toml", "--out", tmp_path)
    assert outcome.status == 1 and "no mission wrote" in outcome.complaint
    assert (tmp_path / "map" / "map.tif").read_text() == "a survey's result"


def test_the_shadow_method_maps_the_same_ground(finished, tmp_path, capsys):
    survey = finished / "simulate" / "survey.xtf"
    outcome = run_command(
        capsys, "map", survey, "--method", "shadow", "--cell", "1", "--out", tmp_path / "map"
    )
    assert outcome.status == 0, outcome.err
    grid = read_map(tmp_path / "map" / "map.tif")
    joint = read_map(finished / "map" / "map.tif")
    assert grid.cell_m == 1.0
    assert abs(np.nanmedian(grid.elevation_m) - np.nanmedian(joint.elevation_m)) < 0.5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--cell", "0"), ""),
        (("--fixes", "none.csv"), "none.csv: no such file"),
        (("--crs", "EPSG:4326"), "EPSG:4326"),
        (("--install", "none.toml"), "none.toml: no such file"),
        (("--sound-speed", "15000"), "15000"),
    ],
)
def test_wrong_options_of_map_end_in_one_line(finished, tmp_path, capsys, arguments, message):
    survey = finished / "simulate" / "survey.xtf"
    outcome = run_command(capsys, "map", survey, "--out", tmp_path / "map", *arguments)
    if not message:
        assert outcome.status == 2
    else:
        assert outcome.status == 1 and message in outcome.complaint
    assert not list((tmp_path / "map").glob("*.tif"))


def test_an_output_folder_that_cannot_be_written_is_said_before_any_work(
    finished, tmp_path, capsys
):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    for line in (
        ("map", finished / "simulate" / "survey.xtf"),
        ("regions", finished / "map" / "map.tif"),
        ("run", finished / "scenario.toml"),
        ("simulate", finished / "scenario.toml"),
    ):
        outcome = run_command(capsys, *line, "--out", blocked / "out")
        assert outcome.status == 1 and str(blocked) in outcome.complaint, line


def test_a_scenario_with_an_unknown_key_is_refused_naming_key_value_and_file(tmp_path, capsys):
    path = write_tiny(tmp_path, "\n[map]\ncel_m = 2.0\n")
    outcome = run_command(capsys, "run", path, "--out", tmp_path / "out")
    assert outcome.status == 1
    assert all(word in outcome.complaint for word in ("tiny.toml", "map.cel_m", "2.0", "cell_m"))
