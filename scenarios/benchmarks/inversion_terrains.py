"""The joint inversion over ten terrains it was not developed on.

Pooled over the terrains, errors are held against the claimed sigma; each terrain also has its own rows. The
seeds are kept apart from those looked at while developing (below 100).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from perception.inversion import invert
from perception.records import FloatArray, Progress, silent
from scenarios.benchmarks import Row, Table
from scenarios.benchmarks.inversion import errors, looks_of
from scenarios.simulation import Simulation

_LINES: dict[str, Any] = {"heading_deg": 0.0, "count": 3, "spacing_m": 45.0, "length_m": 130.0}
_SEED = 101


def _fractal(slope: float, longest_m: float, rms_m: float = 1.0) -> dict[str, Any]:
    return {
        "kind": "fractal", "rms_m": rms_m, "slope": slope, "longest_m": longest_m, "shortest_m": 1.0,
    }  # fmt: skip


def _scattered(kind: str, count: int, height_m: float) -> dict[str, Any]:
    size = {"size_east_m": 180.0, "size_north_m": 180.0, "spacing_m": 8.0}
    return {
        "kind": kind, "count": count, "height_min_m": 0.4 * height_m, "height_max_m": height_m, **size,
    }  # fmt: skip


TERRAINS: dict[str, list[dict[str, Any]]] = {
    "rougher": [_fractal(2.0, 60.0)],
    "rough": [_fractal(2.2, 80.0)],
    "middling": [_fractal(2.6, 100.0)],
    "smooth": [_fractal(3.2, 120.0)],
    "gentle": [_fractal(2.6, 100.0, 0.3)],
    "dunes": [
        _fractal(2.6, 100.0, 0.2),
        {"kind": "sand-waves", "height_m": 1.2, "length_m": 22.0, "azimuth_deg": 20.0},
    ],
    "boulders": [_fractal(2.8, 100.0, 0.4), _scattered("boulders", 40, 1.5)],
    "pockmarks": [
        _fractal(2.8, 100.0, 0.4),
        {**_scattered("pockmarks", 25, 2.0), "aspect_min": 2.0, "aspect_max": 4.0},
    ],
    "step": [
        _fractal(2.6, 100.0, 0.4),
        {"kind": "ridge", "height_m": 3.0, "width_m": 25.0, "wall_m": 8.0, "azimuth_deg": 70.0},
    ],
    "slope": [_fractal(2.6, 100.0, 0.5), {"kind": "plane", "slope_deg": 3.0, "toward_deg": 60.0}],
}


def run(progress: Progress) -> Table:
    """Invert three parallel passes over each terrain."""
    rows: list[Row] = []
    off, claimed, alone = [], [], []
    for done, name in enumerate(TERRAINS):
        progress("terrains", done, len(TERRAINS))
        simulation = _simulated(TERRAINS[name], [_LINES], 340.0, _SEED + done)
        looks = looks_of(simulation)
        grid = invert(looks, 1.0).grid
        error, sigma, soundings = errors(grid, simulation, looks)
        rows += _rows(name, error, sigma, soundings)
        off.append(error)
        claimed.append(sigma)
        alone.append(soundings)
    rows += _rows("all ten", *(np.concatenate(part) for part in (off, claimed, alone)))
    progress("terrains", len(TERRAINS), len(TERRAINS))
    return Table("inversion-terrains", tuple(rows), {"terrains": TERRAINS, "seed": _SEED})


def _rows(case: str, error: FloatArray, sigma: FloatArray, soundings: FloatArray) -> list[Row]:
    joint, alone = float(np.mean(np.abs(error))), float(np.mean(np.abs(soundings)))
    unit = np.abs(error) / sigma
    return [
        Row(case, "soundings interpolated", "mean absolute error", alone, "m"),
        Row(case, "joint", "mean absolute error", joint, "m", "<= 0.12 at 1 m rms relief"),
        Row(case, "joint / soundings", "ratio", joint / alone, "", "<= 0.18"),
        Row(case, "joint", "within 1 sigma", 100 * float(np.mean(unit < 1)), "%", "60-76"),
        Row(case, "joint", "within 2 sigma", 100 * float(np.mean(unit < 2)), "%", "90-98"),
    ]  # fmt: skip


def _simulated(
    terrain: list[dict[str, Any]], block: list[dict[str, Any]], size_m: float, seed: int
) -> Simulation:
    from scenarios.schema import scenario_of
    from scenarios.simulation import simulate

    tree = {
        "name": "inversion-terrains",
        "seed": seed,
        "world": {
            "size_east_m": size_m, "size_north_m": size_m, "depth_m": 60.0,
            "cell_m": 0.25, "terrain": terrain, "albedo": {"rms_db": 1.5},
        },
        "sonar": {"looks": 4.0, "range_m": 75.0},
        "mission": {"block": block, "altitude_m": 15.0, "follow": "depth"},
    }  # fmt: skip
    return simulate(scenario_of(tree, "benchmark"), silent)
