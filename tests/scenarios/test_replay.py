"""A replay shows high ground dark, the track behind the vehicle, and stays inside the terminal."""

import numpy as np
import pytest

from mapping.rasters import write_map
from mapping.trajectories import write_trajectory
from perception.records import Grid, InputError, Trajectory
from scenarios.replay import find_mission, frames


def _mission():
    heights = np.tile(np.linspace(-20.0, -10.0, 100), (60, 1))
    grid = Grid(heights, 1000.0, 2060.0, 1.0, crs="EPSG:32630")
    t = np.arange(50.0)
    one = np.ones(50)
    track = Trajectory(
        t, 1010.0 + t, 2030.0 + 0 * t, 5 * one, 1.57 * one, one, one, 0 * one, grid.crs, False
    )
    return grid, track


def test_frames_fit_and_move_east_with_the_vehicle():
    grid, track = _mission()
    shown = list(frames(grid, track, 80, 20, 5))
    assert len(shown) == 5
    assert all(len(f.lines) <= 20 and max(map(len, f.lines)) <= 80 for f in shown)
    places = [next(line.index("V") for line in f.lines if "V" in line) for f in shown]
    assert places == sorted(places) and places[0] < places[-1]
    assert shown[0].lines[0][0] == "." and shown[0].lines[0][-1] == "@"
    assert "heading 90 deg" in shown[-1].caption


def test_a_folder_without_a_mission_is_refused_and_one_with_is_read(tmp_path):
    with pytest.raises(InputError, match=r"holds no map\.tif"):
        find_mission(tmp_path)
    grid, track = _mission()
    write_map(tmp_path / "map" / "map.tif", grid)
    write_trajectory(tmp_path / "map" / "trajectory.csv", track)
    found, poses = find_mission(tmp_path)
    assert found.shape == grid.shape and len(poses.time_s) == 50
