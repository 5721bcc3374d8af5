"""Three and three crossed passes that drift, from simulated echoes to map and track, against the truth.

Drift of 4 m per root-km, a course error of 0.4 degrees and a scale error of 0.4 % (1-sigma, drawn per survey),
surface fixes of 0.4 m at both ends: of the survey, and, the other reading, of every pass. `BATHYNAV_CROSSED=2,5` takes two
maps and five tracks only. Beside the result stands what can be had at all: the same
graph with a perfect registration on every square (the Cramer-Rao bound of this model). Seeds 1 to 19 served
to develop; these did not.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from mapping.fixes import PositionFix, read_fixes
from mapping.keyframes import Keyframes, tie_fixes
from mapping.overlaps import find_overlaps
from mapping.pose_graph import Link
from mapping.pose_graph_solve import solve
from mapping.rasters import read_map
from mapping.survey import correct_survey
from mapping.survey_records import CorrectedSurvey
from mapping.trajectories import read_trajectory
from perception.readers import Survey, open_survey
from perception.records import ElevationStrip, FloatArray, Grid, Progress, Trajectory
from scenarios.benchmarks import Row, Table
from scenarios.metrics import map_error, normalised_error_squared, percent_cut, track_rms_m
from scenarios.schema import scenario_of
from scenarios.simulation import simulate
from scenarios.simulation_files import write_simulation
from scenarios.survey_map import SurveyMap, build_passes, map_survey, whole_track

_TERRAINS = {"rough": (2.2, 80.0), "middling": (2.6, 100.0), "smooth": (3.2, 120.0)}
_MAP_SEEDS = (21, 22)
# Where the vehicle surfaces: the two readings of "at both ends".
_READINGS = ("fixes at the survey's ends", "fixes at every pass's ends")
_TRACK_SEEDS = tuple(range(31, 51))


@dataclass(frozen=True, slots=True)
class Case:
    """A simulated survey as `bathynav map` gets it, with fixes at the ends of every pass, and its truth."""

    survey: Survey
    fixes: list[PositionFix]
    track: Trajectory
    floor: Grid

    def read(self) -> tuple[tuple[str, list[PositionFix]], ...]:
        """Return the fixes of each reading."""
        survey, passes = _READINGS
        return (survey, [self.fixes[0], self.fixes[-1]]), (passes, self.fixes)


def run(progress: Progress) -> Table:
    """Map a few surveys; correct the tracks of twenty smaller ones."""
    rows: list[Row] = []
    maps = [(terrain, seed) for seed in _MAP_SEEDS for terrain in _TERRAINS]
    most = os.environ.get("BATHYNAV_CROSSED", f"{len(maps)},{len(_TRACK_SEEDS)}").split(",")
    maps, seeds = maps[: int(most[0])], _TRACK_SEEDS[: int(most[1])]
    total = len(maps) + len(seeds)
    for done, (terrain, seed) in enumerate(maps):
        progress("crossed surveys", done, total)
        rows += _mapped(terrain, seed)
    results: dict[str, list[TrackResult]] = {reading: [] for reading in _READINGS}
    for done, seed in enumerate(seeds, start=len(maps)):
        progress("crossed surveys", done, total)
        for reading, result in track_results(seed):
            results[reading].append(result)
    progress("crossed surveys", total, total)
    for reading in _READINGS if seeds else ():
        rows += track_rows(reading, results[reading])
    settings: dict[str, object] = {
        "terrains": _TERRAINS,
        "maps": maps,
        "track seeds": seeds,
    }
    return Table("crossed", tuple(rows), settings)


def simulated(terrain: str, seed: int, folder: Path, length_m: float = 300.0) -> Case:
    """Simulate a survey into a folder and open its files."""
    slope, longest = _TERRAINS[terrain]
    block = {"heading_deg": 0.0, "count": 3, "spacing_m": 45.0, "length_m": length_m}
    tree: dict[str, Any] = {
        "name": "crossed",
        "seed": seed,
        "world": {
            "size_east_m": length_m + 180.0, "size_north_m": length_m + 180.0, "depth_m": 60.0,
            "terrain": [{"kind": "fractal", "rms_m": 1.0, "slope": slope, "longest_m": longest,
                         "shortest_m": 1.0}],
            "albedo": {"rms_db": 1.5},
        },
        "sonar": {"looks": 4.0, "range_m": 60.0, "samples": 800},
        "navigation": {"fix_sigma_m": 0.4, "fixes": "passes"},
        "mission": {"block": [block, {**block, "heading_deg": 90.0}], "altitude_m": 15.0},
        "locate": {"legs": [[-50.0, -50.0], [50.0, 50.0]], "side_scan": False},
    }  # fmt: skip
    write_simulation(simulate(scenario_of(tree, "benchmark")), folder)
    return Case(
        open_survey([folder / "survey.xtf"]),
        read_fixes(folder / "surface-fixes.csv"),
        read_trajectory(folder / "truth" / "trajectory.csv"),
        read_map(folder / "truth" / "elevation.tif"),
    )


def _mapped(terrain: str, seed: int) -> list[Row]:
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as name:
        case = simulated(terrain, seed, Path(name))
        passes = build_passes(case.survey)
        for reading, fixes in case.read():
            start = time.process_time()
            result = map_survey(case.survey, fixes=fixes, cell_m=1.0, passes=passes)
            seconds = time.process_time() - start
            rows += _map_rows(f"{terrain}, seed {seed}", reading, case, result, seconds)
    return rows


def _map_rows(label: str, reading: str, case: Case, result: SurveyMap, seconds: float) -> list[Row]:
    middle = _middle(result.grid, case.floor)
    error = map_error(middle, case.floor)
    # The map where it would lie were it not for the track's mean error, which the fixes leave.
    off = _mean_error(result.track, case.track)
    moved = replace(middle, west_m=middle.west_m - off[0], north_m=middle.north_m - off[1])
    before, after = (track_rms_m(t, case.track) for t in (result.raw_track, result.track))
    return [
        Row(label, reading, "map mean absolute error", error.mean_absolute_m, "m", "<= 0.12", "middle"),
        Row(label, reading, "map mean error", error.bias_m, "m", "", "heights too great where positive"),
        Row(label, reading, "moved by the track's mean error", map_error(moved, case.floor).mean_absolute_m,
            "m", "", f"by {np.hypot(*off):.2f} m"),
        Row(label, reading, "map within 1 sigma", 100 * error.within_one_sigma, "%", "60-76"),
        Row(label, reading, "track rms error", after, "m", "", f"dead reckoning {before:.2f} m"),
        Row(label, reading, "cut", percent_cut(before, after), "%", ">= 85"),
        Row(label, reading, "rounds", len(result.corrected.diagnostics.rounds), ""),
        Row(label, reading, "processor time", seconds, "s"),
    ]  # fmt: skip


def _mean_error(track: Trajectory, truth: Trajectory) -> FloatArray:
    """Return the mean error (east, north) of the passes' pings."""
    used = np.isfinite(track.time_s) if track.pass_index is None else track.pass_index >= 0
    east = np.interp(track.time_s[used], truth.time_s, truth.easting_m)
    north = np.interp(track.time_s[used], truth.time_s, truth.northing_m)
    return np.array(
        [np.mean(track.easting_m[used] - east), np.mean(track.northing_m[used] - north)]
    )


def _middle(grid: Grid, floor: Grid) -> Grid:
    """Return the map where passes of both directions saw the ground, 45 m about the middle."""
    east, north = grid.centres()
    middle = 0.5 * (floor.west_m + floor.east_m), 0.5 * (floor.south_m + floor.north_m)
    inside = (np.abs(east - middle[0]) < 45.0)[None, :] & (np.abs(north - middle[1]) < 45.0)[
        :, None
    ]
    return replace(grid, elevation_m=np.where(inside, grid.elevation_m, np.nan))


@dataclass(frozen=True, slots=True)
class TrackResult:
    """Errors (m, rms) of one survey's track before and after, with wrong registrations, and the bound.

    `mean_m` is the length of the track's mean error, which `after_m` contains.
    """

    before_m: float
    after_m: float
    mean_m: float
    spoilt_m: float
    bound_m: float
    nees: float


def track_results(seed: int) -> list[tuple[str, TrackResult]]:
    """Simulate one smaller survey, terrains taking turns, and correct it under each reading of its fixes."""
    terrain = tuple(_TERRAINS)[seed % len(_TERRAINS)]
    with tempfile.TemporaryDirectory() as name:
        case = simulated(terrain, seed, Path(name), length_m=240.0)
        strips = [r.strip for r in build_passes(case.survey)]
    return [(reading, _track_result(case, strips, fixes, seed)) for reading, fixes in case.read()]


def _track_result(
    case: Case, strips: Sequence[ElevationStrip], fixes: Sequence[PositionFix], seed: int
) -> TrackResult:
    corrected = correct_survey(strips, fixes)
    track = whole_track(case.survey, corrected.trajectory)
    raw = np.concatenate([np.column_stack(s.sonar_positions()) for s in strips])
    before = replace(corrected.trajectory, easting_m=raw[:, 0], northing_m=raw[:, 1])
    # One pose a survey: the errors of its poses are one draw. It moves along the track with the seed.
    nees = normalised_error_squared(track, case.track)
    rng = np.random.default_rng(seed)
    return TrackResult(
        before_m=track_rms_m(before, case.track),
        after_m=track_rms_m(track, case.track),
        mean_m=float(np.hypot(*_mean_error(track, case.track))),
        spoilt_m=_spoilt(corrected, case.track, rng),
        bound_m=_bound(corrected, fixes, strips),
        nees=float(nees[int(rng.uniform(0.05, 0.95) * len(nees))]),
    )


def _keyframe_rms(keyframes: Keyframes, correction_m: FloatArray, truth: Trajectory) -> float:
    east = np.interp(keyframes.time_s, truth.time_s, truth.easting_m) - keyframes.easting_m
    north = np.interp(keyframes.time_s, truth.time_s, truth.northing_m) - keyframes.northing_m
    left = correction_m - np.column_stack([east, north])
    return float(np.sqrt((left**2).sum(axis=1).mean()))


def _spoilt(corrected: CorrectedSurvey, truth: Trajectory, rng: np.random.Generator) -> float:
    """Return the error with 40 % wrong registrations over that without, at the keyframes."""
    links = list(corrected.links)
    keyframes, config = corrected.keyframes, corrected.solution.config
    for old in rng.choice(len(links), round(len(links) * 0.4 / 0.6)):
        wrong = links[old].shift_m + rng.uniform(3, 15, 2) * rng.choice([-1, 1], 2)
        links.append(replace(links[old], shift_m=wrong))
    spoilt = solve(keyframes, links, corrected.ties, config, steps=corrected.steps)
    clean = _keyframe_rms(keyframes, corrected.solution.correction_m, truth)
    return _keyframe_rms(keyframes, spoilt.correction_m, truth) / clean


def _bound(
    corrected: CorrectedSurvey, fixes: Sequence[PositionFix], strips: Sequence[Any]
) -> float:
    """Return the rms error that perfect registrations would leave: what the fixes and the drift allow."""
    keyframes, config = corrected.keyframes, corrected.solution.config
    links = []
    for w in find_overlaps(corrected.strips, 30.0):
        ends = keyframes.nearest(w.first, w.first_line), keyframes.nearest(w.second, w.second_line)
        offsets = [
            np.array([w.easting_m - keyframes.easting_m[k], w.northing_m - keyframes.northing_m[k]])
            for k in ends
        ]
        links.append(Link(*ends, offsets[0], offsets[1], np.zeros(2), 0.02**2 * np.eye(2)))
    ties = tie_fixes(fixes, strips, keyframes, config.drift_m_per_sqrt_km)
    covariance = solve(keyframes, links, ties, config, robust=False).covariance_m2
    return float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean()))


def track_rows(reading: str, results: Sequence[TrackResult]) -> list[Row]:
    """Return the ensemble's figures under one reading of where the fixes are."""

    def rms(values: Sequence[float]) -> float:
        return float(np.sqrt(np.mean(np.square(values))))

    before, after = rms([r.before_m for r in results]), rms([r.after_m for r in results])
    bound = rms([r.bound_m for r in results])
    low, high = stats.chi2.ppf([0.025, 0.975], 2 * len(results)) / len(results)
    case, method = f"{len(results)} surveys of 240 m lines", reading
    return [
        Row(case, "dead reckoning", "track rms error", before, "m"),
        Row(case, method, "track rms error", after, "m", "",
            f"{rms([r.mean_m for r in results]):.2f} m of it the mean"),
        Row(case, method, "cut", percent_cut(before, after), "%", ">= 85"),
        Row(case, method, "bound of the model, cut", percent_cut(before, bound), "%", "", f"{bound:.2f} m"),
        Row(case, method, "normalised error squared", float(np.mean([r.nees for r in results])), "",
            f"{low:.2f}-{high:.2f}", "expected 2"),
        Row(case, method, "40 % wrong registrations, error over the clean one",
            float(np.mean([r.spoilt_m for r in results])), "", "<= 1.10"),
    ]  # fmt: skip
