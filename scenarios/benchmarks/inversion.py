"""The joint inversion beside interpolated soundings, on floors of the repository's simulator.

Poses are the true ones: what is measured is the inversion, not the navigation. The bottom track, the
gain, the albedo and the roughness are the estimator's own.
"""

from __future__ import annotations

import resource
import time
from typing import Any

import numpy as np

from perception.inversion import Look, invert
from perception.records import FloatArray, Grid, Progress, Swath, silent
from scenarios.benchmarks import Row, Table
from scenarios.simulation import Simulation

_PARALLEL: dict[str, Any] = {
    "heading_deg": 0.0, "count": 3, "spacing_m": 45.0, "length_m": 130.0,
}  # fmt: skip
_GEOMETRIES: dict[str, tuple[dict[str, Any], ...]] = {
    "one pass": ({**_PARALLEL, "count": 1},),
    "three parallel": (_PARALLEL,),
    "three + three crossed": (_PARALLEL, {**_PARALLEL, "heading_deg": 90.0}),
}
# Profile exponent and longest wavelength: rough, middling, smooth.
_TERRAINS = {"rough": (2.2, 80.0), "middling": (2.6, 100.0), "smooth": (3.2, 120.0)}
_GOALS = {
    "three parallel": ("<= 0.12", "<= 0.18"),
    "three + three crossed": ("<= 0.06", "<= 0.11"),
    "one pass": ("", "<= 1"),
}


def run(progress: Progress) -> Table:
    """Invert each geometry over each terrain."""
    rows: list[Row] = []
    cases = [(g, t) for g in _GEOMETRIES for t in _TERRAINS]
    for done, (geometry, terrain) in enumerate(cases):
        progress("inversions", done, len(cases))
        rows += _case(geometry, terrain)
    progress("inversions", len(cases), len(cases))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    rows.append(Row("all", "process", "peak memory", peak, "GB", "<= 2", "simulator included"))
    return Table("inversion", tuple(rows), {"terrains": _TERRAINS, "geometries": _GEOMETRIES})


def _case(geometry: str, terrain: str) -> list[Row]:
    simulation = _simulated(geometry, terrain)
    looks = looks_of(simulation)
    start = time.perf_counter()
    grid = invert(looks, 1.0).grid
    seconds = time.perf_counter() - start
    error, sigma, soundings = errors(grid, simulation, looks)
    joint, alone = float(np.mean(np.abs(error))), float(np.mean(np.abs(soundings)))
    goal_m, goal_ratio = _GOALS[geometry]
    case = f"{geometry}, {terrain}"
    return [
        Row(case, "soundings interpolated", "mean absolute error", alone, "m"),
        Row(case, "joint", "mean absolute error", joint, "m", goal_m),
        Row(case, "joint / soundings", "ratio", joint / alone, "", goal_ratio),
        Row(case, "joint", "within 1 sigma", 100 * float(np.mean(np.abs(error) < sigma)), "%", "60-76"),
        Row(case, "joint", "within 2 sigma", 100 * float(np.mean(np.abs(error) < 2 * sigma)), "%", "90-98"),
        Row(case, "joint", "time", seconds, "s", "", f"{grid.elevation_m.size} cells"),
    ]  # fmt: skip


def _simulated(geometry: str, terrain: str) -> Simulation:
    from scenarios.schema import scenario_of
    from scenarios.simulation import simulate

    slope, longest = _TERRAINS[terrain]
    tree = {
        "name": "inversion",
        "seed": 7,
        "world": {
            "size_east_m": 340.0,
            "size_north_m": 340.0,
            "depth_m": 60.0,
            "terrain": [
                {"kind": "fractal", "rms_m": 1.0, "slope": slope, "longest_m": longest,
                 "shortest_m": 1.0}
            ],
            "albedo": {"rms_db": 1.5},
        },
        "sonar": {"looks": 4.0, "range_m": 75.0},
        "mission": {"block": list(_GEOMETRIES[geometry]), "altitude_m": 15.0, "follow": "depth"},
    }  # fmt: skip
    return simulate(scenario_of(tree, "benchmark"), silent)


def looks_of(simulation: Simulation) -> list[Look]:
    """Return the survey's lines as looks, at their true poses with a bottom track of the echoes."""
    from perception.attitude import levelled
    from perception.bottom import track_bottom

    pinged, config = simulation.survey, simulation.scenario.sonar
    looks = []
    sample_m = config.range_m / config.samples
    for line in np.unique(pinged.truth.line[pinged.truth.line >= 0]):
        own = np.flatnonzero(pinged.truth.line == line)
        truth, n = pinged.truth, len(own)
        port, starboard = (pinged.counts[own, side].astype(np.float32) for side in (0, 1))
        swath = Swath(
            time_s=truth.time_s[own], ping=np.arange(n), easting_m=truth.easting_m[own],
            northing_m=truth.northing_m[own], depth_m=-truth.elevation_m[own],
            heading_rad=truth.heading_rad[own], pitch_rad=truth.pitch_rad[own],
            roll_rad=truth.roll_rad[own], altitude_hint_m=np.full(n, np.nan),
            sample_m=np.full(n, sample_m), port=port, starboard=starboard,
            sound_speed_m_s=np.full(n, 1500.0), crs=simulation.scenario.world.crs,
            pass_index=int(line),
        )  # fmt: skip
        bottom = track_bottom(np.square(port), np.square(starboard), sample_m)
        looks.append(
            Look(
                levelled(swath, bottom.first_return_m)[0],
                np.where(bottom.valid, bottom.first_return_m, np.nan),
                bottom.sigma_m,
            )
        )
    return looks


def errors(
    grid: Grid, simulation: Simulation, looks: list[Look]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the map's error, its sigma, and the error of interpolated soundings, between the lines."""
    from scipy.interpolate import griddata
    from scipy.ndimage import uniform_filter

    floor = simulation.world.floor
    size = max(1, round(grid.cell_m / floor.cell_m))
    mean = Grid(uniform_filter(floor.elevation_m, size), floor.west_m, floor.north_m, floor.cell_m)
    east, north = np.meshgrid(*grid.centres())
    truth = mean.sample(east, north)
    swaths = [look.swath for look in looks]
    e = np.concatenate([s.easting_m for s in swaths])
    n = np.concatenate([s.northing_m for s in swaths])
    z = np.concatenate([-s.depth_m - k.altitude_m for s, k in zip(swaths, looks, strict=True)])
    middle_e, middle_n = float(np.mean(e)), float(np.mean(n))
    inside = (np.abs(east - middle_e) < 45) & (np.abs(north - middle_n) < 45)
    inside &= np.isfinite(grid.elevation_m) & np.isfinite(truth)
    known = np.isfinite(z)
    points = np.c_[e[known], n[known]]
    where = (east[inside], north[inside])
    soundings = griddata(points, z[known], where)
    # Beside a single line there is nothing to interpolate between: the nearest sounding.
    nearest = griddata(points, z[known], where, method="nearest")
    soundings = np.where(np.isfinite(soundings), soundings, nearest)
    assert grid.sigma_m is not None
    error = grid.elevation_m[inside] - truth[inside]
    return error, grid.sigma_m[inside], soundings - truth[inside]
