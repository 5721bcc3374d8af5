"""Terrain matching as the task of an experiment: one ground, one map, one vehicle, one filter, one seed.

A sweep over these keys compares terrain classes (by rms slope), map errors (white or correlated),
sensor sets, filters and start errors; see docs/experiments.md. The generator is that of the benchmarks
and shares nothing with the estimator but the columns of nav.csv.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, ValidationError
from scipy import ndimage

from localization.estimate import CONVERGED, LOST
from localization.measurements import beam_vectors, soundings_of
from localization.navfile import NavTable, nav_table
from localization.navigator import Navigator
from localization.particles import ParticleFilter
from localization.pointmass import PointMassFilter
from localization.reckoning import start_covariance
from localization.terrain import TerrainMap, terrain_map
from mapping.rasters import read_map
from perception.records import FloatArray, InputError
from scenarios.benchmarks.navigation_bound import causal_bound
from scenarios.benchmarks.navigation_sets import (
    Floor,
    NavigationSet,
    SetConfig,
    make_set,
    spectral_floor,
    surface_floor,
)
from scenarios.sections import Section

# A fix is false when it claims less than this and is off by more than that.
_CLAIMED_M, _OFF_M = 10.0, 25.0
# Times that the series of a run are kept at.
SERIES = 60
# A run is lost that ends off by more than this, a start's error of one sigma.
_LOST_M = 50.0


class GroundSection(Section):
    """The true sea floor: fractal, or a raster; its class is its rms slope."""

    rms_slope_deg: float | None = Field(
        default=None, gt=0, le=45, description="scales the ground to this rms slope over a cell"
    )
    relief_m: float = Field(default=15.0, gt=0, description="standard deviation where no slope is")
    hurst: float = Field(default=1.0, gt=0, le=2, description="fractal exponent")
    outer_m: float = Field(default=1500.0, gt=0, description="longest scale of the fractal, m")
    raster: str = Field(default="", description="elevation raster taken for the ground instead")
    extent_m: float = Field(default=4000.0, ge=1000, description="side of the square, m")


class PriorSection(Section):
    """The map that the vehicle carries."""

    cell_m: float = Field(default=5.0, gt=0, description="cell, m")
    error_m: float = Field(default=0.3, ge=0, description="1-sigma of its error, m")
    error_length_m: float = Field(default=0.0, ge=0, description="correlation length, 0 white, m")
    length_told: bool = Field(default=False, description="whether the vehicle knows that length")


class VoyageSection(Section):
    """The vehicle, its sensors, and the errors of its dead reckoning (1-sigma)."""

    sensors: Literal["dvl", "altimeter", "fan"] = "dvl"
    beam_noise: float = Field(default=0.01, ge=0, le=0.5, description="part of the range")
    outliers: float = Field(default=0.0, ge=0, le=0.5, description="part of beams that are wild")
    duration_s: float = Field(default=1800.0, ge=60)
    interval_s: float = Field(default=3.0, gt=0)
    speed_m_s: float = Field(default=1.5, gt=0)
    altitude_m: float = Field(default=60.0, gt=0)
    start_m: float = Field(default=50.0, gt=0)
    scale: float = Field(default=0.005, ge=0)
    heading_deg: float = Field(default=0.5, ge=0)
    depth_bias_m: float = Field(default=1.0, ge=0)
    drift_m_sqrt_s: float = Field(default=0.0, ge=0)


class FilterSection(Section):
    """What estimates the position."""

    kind: Literal["navigator", "particles", "point-mass", "dead-reckoning"] = "navigator"
    particles: int = Field(default=4000, ge=200, le=200_000)


class TerrainExperiment(Section):
    """One run of task `terrain`."""

    seed: int = Field(default=0, ge=0)
    name: str = ""
    ground: GroundSection = GroundSection()
    prior: PriorSection = PriorSection()
    voyage: VoyageSection = VoyageSection()
    filter: FilterSection = FilterSection()


def experiment_of(tree: dict[str, Any], source: str) -> TerrainExperiment:
    """Validate the config of one run, `source` named in messages."""
    try:
        return TerrainExperiment.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{source}: {where} = {first['input']!r}: {first['msg']}") from error


def terrain_task(config: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Draw a set, navigate it, score it; the function that workers call."""
    run = experiment_of(config, "sweep")
    floor_rng, set_rng, filter_rng = np.random.default_rng(run.seed).spawn(3)
    settings = _set_config(run)
    floor, settings = _ground(run.ground, settings, floor_rng)
    drawn = make_set(settings, set_rng, floor)
    nav = nav_table(drawn.nav)
    told = settings.error_length_m if run.prior.length_told else None
    terrain = terrain_map(drawn.prior, told)
    track = FILTERS[run.filter.kind](nav, terrain, run.filter.particles, filter_rng)
    return scores(track, drawn, causal_bound(floor, settings, drawn))


def _set_config(run: TerrainExperiment) -> SetConfig:
    voyage = run.voyage.model_dump()
    return SetConfig(
        relief_m=run.ground.relief_m, hurst=run.ground.hurst, outer_m=run.ground.outer_m,
        extent_m=run.ground.extent_m, cell_m=run.prior.cell_m, map_error_m=run.prior.error_m,
        error_length_m=run.prior.error_length_m, **voyage,
    )  # fmt: skip


def _ground(
    ground: GroundSection, settings: SetConfig, rng: np.random.Generator
) -> tuple[Floor, SetConfig]:
    """Draw or read the floor, scaled to its class."""
    step_m = settings.cell_m
    side = round(settings.extent_m / step_m)
    if ground.raster:
        height = read_map(Path(ground.raster)).elevation_m[::-1]
        filled = np.where(np.isfinite(height), height, np.nanmedian(height))
        depth = -ndimage.zoom(filled, side / np.array(filled.shape), order=3)[:side, :side]
    else:
        at = np.arange(side) * step_m
        depth = spectral_floor(settings, rng).depth_m(*np.meshgrid(at, at))
    depth = depth - depth.mean()
    factor = ground.relief_m / depth.std()
    if ground.rms_slope_deg is not None:
        slopes = [np.diff(depth, axis=axis) / step_m for axis in (0, 1)]
        rms = np.sqrt(sum(float(np.mean(s**2)) for s in slopes))
        factor = np.tan(np.radians(ground.rms_slope_deg)) / rms
    depth = depth * factor
    # The vehicle keeps its depth: the ground must stay below it.
    deep = np.maximum(100.0 + depth, 100.0 - settings.altitude_m + 10.0)
    return surface_floor(deep, step_m), replace(settings, relief_m=float(depth.std()))


@dataclass(frozen=True, slots=True)
class Track:
    """What a filter told at each row: position (n, 2), covariance (n, 2, 2), status (n,)."""

    place_m: FloatArray
    covariance_m2: FloatArray
    status: tuple[str, ...]


def _by_navigator(
    nav: NavTable, terrain: TerrainMap, particles: int, rng: np.random.Generator
) -> Track:
    from localization.navigator import NavigatorConfig

    navigator = Navigator(terrain, nav.sensors, rng, NavigatorConfig(particles=particles))
    told = [navigator.update(m) for m in nav]
    return Track(
        np.array([(e.easting_m, e.northing_m) for e in told]),
        np.array([e.covariance_m2 for e in told]),
        tuple(e.status for e in told),
    )


def _by_particles(
    nav: NavTable, terrain: TerrainMap, particles: int, rng: np.random.Generator
) -> Track:
    return _alone(nav, ParticleFilter(terrain, particles, rng))


def _by_point_masses(
    nav: NavTable, terrain: TerrainMap, particles: int, rng: np.random.Generator
) -> Track:
    return _alone(nav, PointMassFilter(terrain))


def _alone(nav: NavTable, search: ParticleFilter | PointMassFilter) -> Track:
    """A filter by itself: no tracking, no integrity; it is converged when it says so."""
    sensors = nav.sensors
    vectors = beam_vectors(sensors.beams)
    fractions = np.array([b.fraction or sensors.beam_fraction for b in sensors.beams])
    search.start(np.zeros(5), start_covariance(sensors))
    place, covariances, status = [], [], []
    before = nav.row(0)
    for m in nav:
        step = np.array([m.easting_m - before.easting_m, m.northing_m - before.northing_m])
        seconds, way = m.time_s - before.time_s, float(np.hypot(*step))
        search.predict(float(step[0]), float(step[1]), 4.0**2 / 3600 * seconds)
        soundings = soundings_of(m, vectors, fractions, sensors.beam_floor_m)
        if soundings.count:
            tide = sensors.tide_m_sqrt_h**2 / 3600 * seconds
            search.update(soundings, m.easting_m, m.northing_m, way, tide)
        mean, covariance = search.moments()
        place.append((m.easting_m + mean[0], m.northing_m + mean[1]))
        covariances.append(covariance[:2, :2])
        largest = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
        status.append(CONVERGED if largest < _CLAIMED_M else "searching")
        before = m
    return Track(np.array(place), np.array(covariances), tuple(status))


def _reckoned(
    nav: NavTable, terrain: TerrainMap, particles: int, rng: np.random.Generator
) -> Track:
    """Dead reckoning with the covariance of its stated errors: what terrain has to beat."""
    s = nav.sensors
    place = np.stack([nav.easting_m, nav.northing_m], axis=1)
    far = place - place[0]
    along = np.einsum("ni,nj->nij", far, far) * s.scale**2
    across = np.stack([far[:, 1], -far[:, 0]], axis=1)
    covariance = along + np.einsum("ni,nj->nij", across, across) * s.heading_rad**2
    return Track(place, covariance + s.start_m**2 * np.eye(2), ("dead-reckoning",) * len(place))


FILTERS: dict[str, Callable[[NavTable, TerrainMap, int, np.random.Generator], Track]] = {
    "navigator": _by_navigator,
    "particles": _by_particles,
    "point-mass": _by_point_masses,
    "dead-reckoning": _reckoned,
}


def scores(track: Track, drawn: NavigationSet, bound_m: FloatArray) -> dict[str, Any]:
    """Metrics of a run: numbers of its second half, and series as JSON lists.

    `cep50_m` and `cep95_m` are quantiles of the horizontal error; `nees` is the mean normalised error
    squared (2 if claimed right); `available` the share of rows converged; series are `SERIES` samples.
    """
    error = track.place_m - np.stack([drawn.truth_easting_m, drawn.truth_northing_m], axis=1)
    away = np.hypot(*error.T)
    square = np.einsum("ni,nij,nj->n", error, np.linalg.inv(track.covariance_m2), error)
    claimed = np.sqrt(np.linalg.eigvalsh(track.covariance_m2)[:, -1])
    converged = np.array(track.status) == CONVERGED
    false = (claimed < _CLAIMED_M) & (away > _OFF_M)
    half = len(away) // 2
    late = away[half:]
    time_s = drawn.nav["time_s"]
    at = np.linspace(0, len(away) - 1, SERIES).round().astype(int)
    return {
        "rms_m": float(np.sqrt(np.mean(late**2))),
        "cep50_m": float(np.quantile(late, 0.5)),
        "cep95_m": float(np.quantile(late, 0.95)),
        "sigma_m": float(np.mean(claimed[half:])),
        "nees": float(square[half:].mean()),
        "bound_m": float(np.sqrt(np.mean(bound_m[half:] ** 2))),
        "converged_after_s": float(time_s[np.argmax(converged)]) if converged.any() else None,
        "available": float(converged.mean()),
        "false_fix": float(false.any()),
        "false_rows": float(false.sum()),
        "lost": float(away[-1] > _LOST_M),
        "rows_lost": float(np.sum(np.array(track.status) == LOST)),
        "series_time_s": json.dumps(np.round(time_s[at], 1).tolist()),
        "series_error_m": json.dumps(np.round(away[at], 3).tolist()),
        "series_nees": json.dumps(np.round(square[at], 3).tolist()),
        "series_bound_m": json.dumps(np.round(bound_m[at], 3).tolist()),
    }
