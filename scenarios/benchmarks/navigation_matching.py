"""Benchmark `navigation-matching`: a patch of 100 x 100 cells placed on a map of 1,000 x 1,000.

The sea floor is the fractal of `navigation_sets`, read anew for each patch with splines at its own turn
and place, with 1 m of white noise; the map has 0.3 m. Methods, as `bathynav locate --patch` has them: the
compact map of landmarks and thumbnail (`--compact`) and the raster itself, each with the heading unknown
and known; landmarks alone beside them. Patches are whole, have holes (shadows) over a quarter of them, or lie
partly off the map.

`BATHYNAV_PATCHES` sets the number of patches for each ground and harm (default 12); the raster over all
headings takes seconds a patch and gets the first quarter of them. A match is right within 5 cells and 5 degrees.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from localization.compact import CompactMap
from localization.constellation import Constellation
from localization.landmarks import Landmarks, find_landmarks
from localization.placing import Place, Placing, place_on_compact, place_on_raster
from perception.records import FloatArray, Grid, Progress
from scenarios.benchmarks import Row, Table
from scenarios.benchmarks.navigation_sets import Floor, SetConfig, spectral_floor

_CELL_M, _SIDE, _PATCH = 5.0, 1000, 100
_NOISE_M, _MAP_NOISE_M = 1.0, 0.3
_NEAR_M, _NEAR_RAD = 5 * _CELL_M, float(np.radians(5.0))
_GROUNDS = {"15 m relief": 15.0, "3 m relief": 3.0}


@dataclass(frozen=True, slots=True)
class Placed:
    """A patch (its own axes, rows southward) and where it truly lies."""

    grid: Grid
    easting_m: float
    northing_m: float
    turn_rad: float


def run(progress: Progress) -> Table:
    """Draw maps and patches, match them in every way, count."""
    number = int(os.environ.get("BATHYNAV_PATCHES", "12"))
    rows: list[Row] = []
    for ground, relief in _GROUNDS.items():
        config = SetConfig(relief_m=relief, extent_m=_SIDE * _CELL_M, cell_m=_CELL_M)
        rng = np.random.default_rng([int(relief), 20261122])
        floor = spectral_floor(config, rng)
        prior = _map_of(floor, rng)
        carried = CompactMap.of(prior)
        share = len(carried.packed()) / (4.0 * prior.elevation_m.size)
        rows.append(Row(ground, "compact map", "map carried", 100 * share, "% of raster", "<= 1"))
        methods = _methods(carried, prior)
        for harm in ("whole", "a quarter of holes", "a third off the map"):
            patches = [draw_patch(floor, rng, harm) for _ in range(number)]
            for k, (name, method) in enumerate(methods.items()):
                progress(f"{ground}, {harm}", k, len(methods))
                slow = name == "raster, heading unknown"
                chosen = patches[: max(number // 4, 3)] if slow else patches
                rows += _measure(f"{ground}, {harm}", name, method, chosen)
    return Table("navigation-matching", tuple(rows), {"patches": number})


def _methods(carried: CompactMap, prior: Grid) -> dict[str, Callable[[Placed], Placing]]:
    constellation = Constellation(Landmarks.unpacked(carried.landmarks))

    def by_marks(patch: Placed) -> Placing:
        found = constellation.match(find_landmarks(patch.grid))
        places = tuple(
            Place(h.easting_m, h.northing_m, h.turn_rad, h.covariance, h.score)
            for h in found.hypotheses
        )
        return Placing(places, found.accepted, found.reason, len(carried.landmarks))

    return {
        "landmarks alone, heading unknown": by_marks,
        "compact map, heading unknown": lambda p: place_on_compact(carried, p.grid),
        "compact map, heading known": lambda p: place_on_compact(carried, p.grid, p.turn_rad),
        "raster, heading unknown": lambda p: place_on_raster(prior, p.grid),
        "raster, heading known": lambda p: place_on_raster(prior, p.grid, p.turn_rad),
    }


def _measure(
    case: str, name: str, method: Callable[[Placed], Placing], patches: list[Placed]
) -> list[Row]:
    right = accepted = false = 0
    errors: list[float] = []
    squares: list[float] = []
    began = time.perf_counter()
    for patch in patches:
        placing = method(patch)
        if not placing.places:
            continue
        best = placing.places[0]
        apart = np.array([best.easting_m - patch.easting_m, best.northing_m - patch.northing_m])
        away = float(np.hypot(*apart))
        off = abs((best.turn_rad - patch.turn_rad + np.pi) % (2 * np.pi) - np.pi)
        good = away < _NEAR_M and off < _NEAR_RAD
        right += good
        accepted += good and placing.accepted
        false += placing.accepted and not good
        if good and placing.accepted:
            errors.append(away)
            squares.append(float(apart @ np.linalg.solve(best.covariance[:2, :2], apart)))
    n = len(patches)
    each = (time.perf_counter() - began) / n
    rms = float(np.sqrt(np.mean(np.square(errors)))) if errors else None
    figures = (
        ("right", 100 * right / n, "%", ">= 95"), ("right and accepted", 100 * accepted / n, "%", ""),
        ("accepted and wrong", 100 * false / n, "%", "<= 1"),
        ("rms error of the accepted", rms, "m", ""),
        ("normalised error squared", float(np.mean(squares)) if squares else None, "", "2 expected"),
        ("time a patch", each, "s", ""),
    )  # fmt: skip
    note = f"{n} patches"
    return [
        Row(case, name, figure, value, unit, goal, note) for figure, value, unit, goal in figures
    ]


def _map_of(floor: Floor, rng: np.random.Generator) -> Grid:
    centre = (np.arange(_SIDE) + 0.5) * _CELL_M
    easting, northing = np.meshgrid(centre, centre[::-1])
    height = -floor.depth_m(easting, northing) + _MAP_NOISE_M * rng.standard_normal(easting.shape)
    sigma = np.full(height.shape, _MAP_NOISE_M)
    return Grid(height, 0.0, _SIDE * _CELL_M, _CELL_M, sigma_m=sigma)


def draw_patch(floor: Floor, rng: np.random.Generator, harm: str) -> Placed:
    """Draw a patch at a random place and turn, noise added, holes cut."""
    extent, half = _SIDE * _CELL_M, _PATCH * _CELL_M / 2
    turn = float(rng.uniform(0, 2 * np.pi))
    east, north = rng.uniform(2 * half, extent - 2 * half, 2)
    if harm.endswith("off the map"):
        # The floor is periodic: beyond the map's edge the patch sees ground that the map lacks.
        east = half / 3
    at = (np.arange(_PATCH) - (_PATCH - 1) / 2) * _CELL_M
    x, y = np.meshgrid(at, at[::-1])
    e = east + np.cos(turn) * x + np.sin(turn) * y
    n = north + np.cos(turn) * y - np.sin(turn) * x
    if harm.endswith("off the map"):
        # Not the other side of the same map: ground 0.37 of the extent away is another's.
        n = np.where(e < 0, n + 0.37 * extent, n)
        e = np.where(e < 0, e + 0.41 * extent, e)
    height = -floor.depth_m(e, n) + _NOISE_M * rng.standard_normal(e.shape)
    if harm.endswith("holes"):
        height = _holed(height, rng)
    return Placed(Grid(height, -half, half, _CELL_M), float(east), float(north), turn)


def _holed(height_m: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Cut bands as shadows have them, until a quarter is gone."""
    rows, cols = np.indices(height_m.shape)
    while np.isfinite(height_m).mean() > 0.75:
        angle, at = rng.uniform(0, np.pi), rng.uniform(-50, 50)
        along = (cols - 50) * np.cos(angle) + (rows - 50) * np.sin(angle)
        across = (rows - 50) * np.cos(angle) - (cols - 50) * np.sin(angle) - at
        middle = rng.uniform(-40, 40)
        band = (np.abs(across) < 3) & (np.abs(along - middle) < 25)
        height_m = np.where(band, np.nan, height_m)
    return height_m
