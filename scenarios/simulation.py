"""A scenario made real: the world, the survey over it, and the return."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt

from perception.records import FloatArray, Grid, InputError, Progress, silent
from scenarios.missions.frame import FileFrame
from scenarios.missions.lines import legs_to_lines, path_along, refuse_outside, survey_lines
from scenarios.schema import Scenario
from scenarios.sonar.echoes import facet_echoes, record, sonar_model
from scenarios.vehicle.motion import Motion, at_times, fly, sonar_poses
from scenarios.vehicle.navigation import (
    Estimate,
    Reckoning,
    SurfaceFixes,
    dead_reckon,
    read_instruments,
    surface_fixes,
    tide_m,
)
from scenarios.vehicle.soundings import beam_ranges
from scenarios.world.build import World, build_world
from scenarios.world.components import Raster
from scenarios.world.prior import prior_map

# The true motion is kept this often; a ping or a row of navigation falls between samples.
_MOTION_STEP_S = 0.1


@dataclass(frozen=True, slots=True)
class Pinged:
    """A run as the sonar saw it: truth and belief at each ping, and the recorder's counts."""

    truth: Motion
    estimate: Estimate
    counts: npt.NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class NavRun:
    """The run of nav.csv: truth and belief at each row, and the beams (n, 4), NaN no return."""

    truth: Motion
    estimate: Estimate
    beams_m: FloatArray


@dataclass(frozen=True, slots=True)
class Simulation:
    """Everything that a scenario makes."""

    scenario: Scenario
    world: World
    prior: Grid
    survey: Pinged
    fixes: SurfaceFixes
    nav: NavRun
    back: Pinged | None


def simulate(scenario: Scenario, progress: Progress = silent) -> Simulation:
    """Simulate a scenario; the same seed gives the same bits for any number of threads.

    Raises
    ------
    InputError
        The CRS, the start or a raster cannot be used, the track leaves the world or the water, or
        objects do not fit.
    """
    # What can be refused is refused before any work is done.
    FileFrame(scenario.world.crs)
    start_time_s(scenario)
    refuse_outside(survey_lines(scenario.mission), scenario.world)
    refuse_outside(legs_to_lines(scenario.locate.legs), scenario.world)
    rasters = _rasters(scenario)
    root = np.random.default_rng(scenario.seed)
    world_rng, prior_rng, survey_rng, fix_rng, return_rng, beam_rng = root.spawn(6)
    progress("building the world", 0, 1)
    world = build_world(scenario.world, rng=world_rng, rasters=rasters)
    prior = prior_map(world.floor, scenario.world, scenario.prior, rng=prior_rng)
    progress("building the world", 1, 1)
    motion, reckoning, survey = _survey(scenario, world, survey_rng, progress)
    fixes = surface_fixes(survey.truth, scenario.navigation, rng=fix_rng)
    back = None
    if scenario.locate.track == "return":
        motion, reckoning, back = _return(scenario, world, return_rng, progress)
    else:
        reckoning = _offset(reckoning, scenario, return_rng)
    nav = _nav_run(scenario, world, motion, reckoning, beam_rng)
    return Simulation(scenario, world, prior, survey, fixes, nav, back)


def _rasters(scenario: Scenario) -> Mapping[str, Grid]:
    from mapping.rasters import read_map

    parts = [part for part in scenario.world.terrain if isinstance(part, Raster)]
    return {part.path: read_map(Path(part.path)) for part in parts}


def _survey(
    scenario: Scenario, world: World, rng: np.random.Generator, progress: Progress
) -> tuple[Motion, Reckoning, Pinged]:
    fly_rng, reckon_rng, ping_rng = rng.spawn(3)
    mission = scenario.mission
    path = path_along(survey_lines(mission), scenario.vehicle.speed_m_s * _MOTION_STEP_S)
    motion = fly(
        path,
        world.floor,
        scenario.world,
        scenario.vehicle,
        altitude_m=mission.altitude_m,
        follow=mission.follow,
        start_s=start_time_s(scenario),
        rng=fly_rng,
    )
    reckoning = dead_reckon(
        motion,
        scenario.navigation,
        start_sigma_m=scenario.navigation.start_sigma_m,
        rng=reckon_rng,
    )
    pinged = _ping(
        scenario, world, motion, reckoning, mission.altitude_m, mission.turns, ping_rng, progress
    )
    return motion, reckoning, pinged


def _return(
    scenario: Scenario, world: World, rng: np.random.Generator, progress: Progress
) -> tuple[Motion, Reckoning, Pinged | None]:
    """Come back later, with a start that is far off, along the legs of [locate]."""
    fly_rng, reckon_rng, ping_rng = rng.spawn(3)
    config = scenario.locate
    lines = legs_to_lines(config.legs) if len(config.legs) > 1 else survey_lines(scenario.mission)
    path = path_along(lines, scenario.vehicle.speed_m_s * _MOTION_STEP_S)
    motion = fly(
        path,
        world.floor,
        scenario.world,
        scenario.vehicle,
        altitude_m=config.altitude_m,
        follow="terrain",
        start_s=start_time_s(scenario) + 3600.0 * config.hours_later,
        rng=fly_rng,
    )
    reckoning = dead_reckon(
        motion, scenario.navigation, start_sigma_m=config.start_sigma_m, rng=reckon_rng
    )
    if not config.side_scan:
        return motion, reckoning, None
    pinged = _ping(
        scenario, world, motion, reckoning, config.altitude_m, "record", ping_rng, progress
    )
    return motion, reckoning, pinged


def _offset(reckoning: Reckoning, scenario: Scenario, rng: np.random.Generator) -> Reckoning:
    """Shift the survey's own navigation by the start error of [locate]."""
    east, north = scenario.locate.start_sigma_m * rng.standard_normal(2)
    return replace(
        reckoning,
        error_east_m=reckoning.error_east_m + east,
        error_north_m=reckoning.error_north_m + north,
    )


def _ping(
    scenario: Scenario,
    world: World,
    motion: Motion,
    reckoning: Reckoning,
    altitude_m: float,
    turns: str,
    rng: np.random.Generator,
    progress: Progress,
) -> Pinged:
    """Ping along a run."""
    sensor_rng, echo_rng = rng.spawn(2)
    # XTF keeps hundredths of a second: ping on them, so file and truth agree.
    period_s = max(round(scenario.sonar.ping_period_s, 2), 0.01)
    time_s = np.round(np.arange(motion.time_s[0], motion.time_s[-1], period_s), 2)
    truth = at_times(motion, time_s)
    keep = (truth.line >= 0) | (turns == "record")
    truth = at_times(motion, time_s[keep])
    poses = sonar_poses(motion)
    at_pings = np.column_stack([np.interp(truth.time_s, motion.time_s, c) for c in poses.T])
    model = sonar_model(scenario.sonar, depth_m=scenario.world.depth_m, cell_m=world.floor.cell_m)
    power = facet_echoes(world.floor, world.albedo, at_pings, model, progress)
    counts = record(
        power,
        model,
        scenario.sonar,
        altitude_m=altitude_m,
        sonar_altitude_m=truth.altitude_m,
        sonar_depth_m=tide_m(truth.time_s, scenario.navigation) - truth.elevation_m,
        rng=echo_rng,
    )
    estimate = read_instruments(truth, reckoning, scenario.navigation, rng=sensor_rng)
    return Pinged(truth, estimate, counts)


def _nav_run(
    scenario: Scenario,
    world: World,
    motion: Motion,
    reckoning: Reckoning,
    rng: np.random.Generator,
) -> NavRun:
    sensor_rng, beam_rng = rng.spawn(2)
    config = scenario.locate
    time_s = np.arange(motion.time_s[0], motion.time_s[-1], config.row_period_s)
    truth = at_times(motion, time_s)
    estimate = read_instruments(truth, reckoning, scenario.navigation, rng=sensor_rng)
    beams = beam_ranges(truth, world.floor)
    draws = beam_rng.random((2, *beams.shape))
    beams = beams * (1.0 + config.beam_noise * beam_rng.standard_normal(beams.shape))
    wrong = draws[0] < config.beam_outliers
    beams = np.where(wrong, beams * beam_rng.uniform(0.3, 1.5, beams.shape), beams)
    beams[draws[1] < config.beam_dropouts] = np.nan
    return NavRun(truth, estimate, beams)


def start_time_s(scenario: Scenario) -> float:
    """Return the survey's start in seconds since 1970 UTC.

    Raises
    ------
    InputError
        `mission.start` is no ISO 8601 time.
    """
    text = scenario.mission.start
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise InputError(
            f"mission.start = {text!r}: is no ISO 8601 time; write one as 2026-05-01T08:00:00Z"
        ) from error
    return float(np.round((moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp(), 2))


def summary(simulation: Simulation) -> dict[str, float]:
    """Return the figures that describe a simulation, units in their names."""
    survey, nav = simulation.survey, simulation.nav
    error = np.hypot(
        survey.estimate.easting_m - survey.truth.easting_m,
        survey.estimate.northing_m - survey.truth.northing_m,
    )
    start = np.hypot(
        nav.estimate.easting_m[0] - nav.truth.easting_m[0],
        nav.estimate.northing_m[0] - nav.truth.northing_m[0],
    )
    length = np.hypot(np.diff(survey.truth.easting_m), np.diff(survey.truth.northing_m)).sum()
    return {
        "pings": len(survey.counts),
        "lines": len(np.unique(survey.truth.line[survey.truth.line >= 0])),
        "track_km": float(length / 1000.0),
        "altitude_min_m": float(survey.truth.altitude_m.min()),
        "altitude_mean_m": float(survey.truth.altitude_m.mean()),
        "relief_rms_m": float(simulation.world.floor.elevation_m.std()),
        "objects": len(simulation.world.objects),
        "drift_rms_m": float(np.sqrt(np.mean(error**2))),
        "drift_end_m": float(error[-1]),
        "nav_rows": len(nav.truth.time_s),
        "nav_start_error_m": float(start),
    }
