"""Benchmark `navigation-observability`: what `locate --observability` foretells, beside runs on the same ground.

For each ground a floor and a prior map are drawn, and straight lines of 300 m through random cells on
random headings of the raster's. Each line is navigated as a mission of its own from a start of 50 m an axis,
and the smoothed position at the line's middle, the raster's cell, is compared with the truth. The rms
error over the lines is set beside the rms of the raster's values at the same cells and headings, and
beside the linear bound's.

`BATHYNAV_LINES` sets the number of lines on each ground (default 40: the rms is then known to 10 % or so).
"""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np

from localization.measurements import Sensors
from localization.mission import navigate
from localization.navfile import nav_table
from localization.navigator import Navigator
from localization.observability import ObservabilityConfig, observability
from localization.terrain import terrain_map
from perception.records import FloatArray, Progress
from scenarios.benchmarks import Row, Table
from scenarios.benchmarks.navigation_sets import SetConfig, prior_map, sounded, spectral_floor

_BASE = SetConfig(extent_m=2500.0)
_GROUNDS = {
    "15 m relief": replace(_BASE, relief_m=15.0),
    "5 m, rough": replace(_BASE, relief_m=5.0, hurst=0.6, outer_m=400.0),
    "3 m": replace(_BASE, relief_m=3.0),
    "3 m, smooth": replace(_BASE, relief_m=3.0, hurst=1.4, outer_m=800.0),
    "3 m, map error over 30 m": replace(_BASE, relief_m=3.0, error_length_m=30.0),
    "1 m": replace(_BASE, relief_m=1.0),
    "0.3 m": replace(_BASE, relief_m=0.3, hurst=0.8, outer_m=800.0),
}
_STREAM = 931
# From the map's edge, in metres: half a line, the beams' reach and the start's error.
_MARGIN_M = 350.0


def run(progress: Progress) -> Table:
    """Foretell and navigate on every ground."""
    number = int(os.environ.get("BATHYNAV_LINES", "40"))
    rows: list[Row] = []
    for k, (name, config) in enumerate(_GROUNDS.items()):
        progress("observability", k, len(_GROUNDS))
        error, foretold, bound = _ground(config, number, np.random.default_rng([k, _STREAM]))
        rms, told, linear = (float(np.sqrt(np.mean(x**2))) for x in (error, foretold, bound))
        figures = (
            ("rms error of the runs", rms, "m", ""), ("foretold", told, "m", ""),
            ("error over foretold", rms / told, "", "0.8 to 1.2"),
            ("error over linear bound", rms / linear, "", ""),
            ("the same, medians", float(np.median(error) / np.median(foretold)), "", "0.83 if Gaussian"),
        )  # fmt: skip
        rows += [Row(name, "bathynav", *figure, f"{number} lines") for figure in figures]
    progress("observability", len(_GROUNDS), len(_GROUNDS))
    return Table("navigation-observability", tuple(rows), {"lines": number})


def _ground(
    config: SetConfig, number: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Errors, values foretold and linear bounds, (lines,) each, on one ground."""
    floor = spectral_floor(config, rng)
    prior = prior_map(floor, config, rng)
    terrain = terrain_map(prior)
    crossing = ObservabilityConfig(altitude_m=config.altitude_m, headings=4)
    sensors = Sensors()
    found = observability(terrain, sensors, rng, crossing)
    bound = observability(terrain, sensors, rng, replace(crossing, lines=0))
    n, edge = prior.shape[0], round(_MARGIN_M / config.cell_m)
    half = round(crossing.path_m / crossing.spacing_m / 2)
    along = np.arange(-half, half + 1) * crossing.spacing_m
    out = []
    for _ in range(number):
        row, col = rng.integers(edge, n - edge, 2)
        k = int(rng.integers(crossing.headings))
        heading = found.headings_rad[k] + np.pi * rng.integers(2)
        east = prior.west_m + (col + 0.5) * config.cell_m
        north = prior.north_m - (row + 0.5) * config.cell_m
        track = east + along * np.sin(heading), north + along * np.cos(heading)
        nav = nav_table(sounded(config, floor, track, rng, rng))
        result = navigate(Navigator(terrain, nav.sensors, rng), nav, [], crs=prior.crs)
        t = result.smoothed
        error = np.hypot(t.easting_m[half] - east, t.northing_m[half] - north)
        out.append((error, found.by_heading_m[k, row, col], bound.by_heading_m[k, row, col]))
    error, foretold, linear = np.array(out).T
    return error, foretold, linear
