"""A mission's figures against its truth: map, track, navigation."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapping.rasters import read_map
from mapping.trajectories import read_trajectory
from perception.records import Grid, Trajectory
from scenarios.metrics import (
    interpolated_soundings,
    map_error,
    percent_cut,
    track_rms_m,
)


def score_mission(out: Path, stages: list[str]) -> dict[str, float]:
    """Return the figures of the stages that ran, units in their names."""
    scores: dict[str, float] = {}
    truth = out / "simulate" / "truth"
    if "map" in stages:
        scores |= score_map(out / "map", truth)
    if "locate" in stages:
        scores |= score_navigation(out / "simulate" / "nav.csv", out / "locate", truth)
    if "plan" in stages and (out / "plan" / "route.csv").exists():
        scores |= score_route(out / "plan" / "route.csv", truth)
    return scores


def score_route(path: Path, truth: Path) -> dict[str, float]:
    """Score a route by its least altitude over the true floor, looked up every quarter of a cell."""
    floor = read_map(truth / "elevation.tif")
    route = np.genfromtxt(path, delimiter=",", names=True)
    along = route["distance_m"]
    steps = max(2, int(4.0 * along[-1] / floor.cell_m))
    at = np.linspace(0.0, along[-1], steps)
    easting, northing, depth = (
        np.interp(at, along, route[name]) for name in ("easting_m", "northing_m", "depth_m")
    )
    altitude = -depth - floor.sample(easting, northing)
    return {"route_min_true_altitude_m": float(np.nanmin(altitude))}


def score_map(folder: Path, truth: Path) -> dict[str, float]:
    """Score `map.tif` beside interpolated soundings on the same cells, and the track."""
    grid = read_map(folder / "map.tif")
    floor = read_map(truth / "elevation.tif")
    flown = read_trajectory(truth / "trajectory.csv")
    track = read_trajectory(folder / "trajectory.csv")
    raw = read_trajectory(folder / "trajectory-navigated.csv")
    soundings = _soundings(folder, grid)
    between = np.where(np.isfinite(grid.elevation_m), soundings.elevation_m, np.nan)
    beside: dict[str, float] = {}
    # A single straight line has nothing between its soundings to compare.
    if np.isfinite(between).any():
        ours, simple = map_error(grid, floor, between), map_error(soundings, floor, between)
        beside = {
            "map_mae_between_tracks_m": ours.mean_absolute_m,
            "soundings_mae_between_tracks_m": simple.mean_absolute_m,
            "map_to_soundings_ratio": ours.mean_absolute_m / simple.mean_absolute_m,
        }
    before, after = track_rms_m(_used(raw), flown), track_rms_m(_used(track), flown)
    return {
        **map_error(grid, floor).flat("map"),
        **beside,
        "track_rms_before_m": before,
        "track_rms_after_m": after,
        "track_cut_percent": percent_cut(before, after),
    }


def _soundings(folder: Path, grid: Grid) -> Grid:
    """Interpolate the altimeter's soundings along the corrected track: the simpler method."""
    columns = np.genfromtxt(folder / "soundings.csv", delimiter=",", names=True)
    return interpolated_soundings(
        columns["easting_m"], columns["northing_m"], columns["elevation_m"], grid
    )


def _used(track: Trajectory) -> Trajectory:
    """Return the poses that belong to a pass."""
    if track.pass_index is None:
        return track
    keep = track.pass_index >= 0
    names = (
        "time_s", "easting_m", "northing_m", "depth_m", "heading_rad", "sigma_easting_m",
        "sigma_northing_m", "cov_en_m2", "ping", "pass_index",
    )  # fmt: skip
    values = {n: getattr(track, n) for n in names}
    return replace(track, **{n: v[keep] for n, v in values.items() if v is not None})


def score_navigation(nav_csv: Path, folder: Path, truth: Path) -> dict[str, float]:
    """Score the localization run: dead reckoning alone against the filter, over its second half."""
    flown = read_trajectory(truth / "nav.csv")
    found = read_trajectory(folder / "trajectory.csv")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        nav = np.genfromtxt(nav_csv, delimiter=",", names=True)
    late = found.time_s >= 0.5 * (found.time_s[0] + found.time_s[-1])

    def rms(easting_m: np.ndarray, northing_m: np.ndarray, rows: np.ndarray) -> float:
        e = np.interp(found.time_s, flown.time_s, flown.easting_m)
        n = np.interp(found.time_s, flown.time_s, flown.northing_m)
        squared = (easting_m - e) ** 2 + (northing_m - n) ** 2
        return float(np.sqrt(np.mean(squared[rows])))

    everything = np.ones(len(late), bool)
    return {
        "nav_rms_without_fixes_m": rms(nav["easting_m"], nav["northing_m"], everything),
        "nav_rms_with_fixes_m": rms(found.easting_m, found.northing_m, everything),
        "nav_rms_second_half_m": rms(found.easting_m, found.northing_m, late),
    }
