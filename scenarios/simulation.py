"""A scenario made real: the world, the survey over it, the return, and their files.

`simulate` assembles the parts and `write_simulation` writes what an estimator may see beside
`truth/`, which it may not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt
import tomli_w

from perception.files import write_text
from perception.records import FloatArray, Grid, InputError, Progress, silent
from scenarios.missions.lines import legs_to_lines, path_along, survey_lines
from scenarios.schema import Scenario, tree_of
from scenarios.sonar.echoes import facet_echoes, record, sonar_model
from scenarios.sonar.xtf import SonarLog, write_xtf
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
from scenarios.world.prior import block_mean, prior_map

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


def simulate(
    scenario: Scenario, *, folder: Path | None = None, progress: Progress = silent
) -> Simulation:
    """Simulate a scenario; the same seed gives the same bits for any number of threads.

    Parameters
    ----------
    folder : where the paths of `raster` components start; the working folder if absent.
    """
    # What can be refused is refused before any work is done.
    _Geodesy(scenario.world.crs)
    start_time_s(scenario)
    rasters = _rasters(scenario, folder)
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


def _rasters(scenario: Scenario, folder: Path | None) -> Mapping[str, Grid]:
    from mapping.rasters import read_map

    parts = [part for part in scenario.world.terrain if isinstance(part, Raster)]
    return {part.path: read_map((folder or Path()) / part.path) for part in parts}


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


def write_simulation(simulation: Simulation, out: Path, progress: Progress = silent) -> None:
    """Write the files of the contract into `out`, and the truth into `out/truth`."""
    from mapping.rasters import write_map

    scenario = simulation.scenario
    to_file = _Geodesy(scenario.world.crs)
    steps = 6
    progress("writing", 0, steps)
    write_text(out / "scenario.toml", tomli_w.dumps(tree_of(scenario)))
    _write_survey(simulation, out, to_file)
    progress("writing", 1, steps)
    if simulation.back is not None:
        write_xtf(out / "return.xtf", _log(scenario, simulation.back, to_file, slice(None)))
    progress("writing", 2, steps)
    write_text(out / "nav.csv", _nav_csv(simulation.nav, to_file))
    write_text(out / "surface-fixes.csv", _fixes_csv(simulation.fixes))
    write_map(out / "prior.tif", simulation.prior)
    progress("writing", 3, steps)
    truth = out / "truth"
    floor = simulation.world.floor
    cell_m = max(scenario.world.truth_cell_m, floor.cell_m)
    write_map(truth / "elevation.tif", block_mean(floor, scenario.world, cell_m))
    progress("writing", 4, steps)
    write_text(truth / "trajectory.csv", _truth_csv(simulation.survey.truth, to_file))
    write_text(truth / "nav.csv", _truth_csv(simulation.nav.truth, to_file))
    progress("writing", 5, steps)
    write_text(truth / "objects.csv", _objects_csv(simulation.world))
    progress("writing", steps, steps)


class _Geodesy:
    """From the scenario's CRS to degrees and true north, as files have them."""

    def __init__(self, crs: str) -> None:
        import pyproj

        try:
            projected = pyproj.CRS.from_user_input(crs)
        except pyproj.exceptions.CRSError as error:
            raise InputError(f"world.crs = {crs!r}: is no CRS; give one like EPSG:32630") from error
        if not projected.is_projected or projected.axis_info[0].unit_conversion_factor != 1.0:
            raise InputError(
                f"world.crs = {crs!r}: is not a projected CRS in metres; give one like EPSG:32630"
            )
        self._inverse = pyproj.Transformer.from_crs(projected, "EPSG:4326", always_xy=True)
        self._factors = pyproj.Proj(projected).get_factors

    def degrees(
        self, easting_m: FloatArray, northing_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return longitude and latitude."""
        longitude, latitude = self._inverse.transform(easting_m, northing_m)
        return np.asarray(longitude), np.asarray(latitude)

    def true_heading_deg(
        self, heading_rad: FloatArray, easting_m: FloatArray, northing_m: FloatArray
    ) -> FloatArray:
        """Return headings from true north: grid heading plus meridian convergence."""
        longitude, latitude = self.degrees(easting_m, northing_m)
        convergence = self._factors(longitude, latitude).meridian_convergence
        return (np.rad2deg(heading_rad) + np.asarray(convergence)) % 360.0


def _write_survey(simulation: Simulation, out: Path, to_file: _Geodesy) -> None:
    scenario, survey = simulation.scenario, simulation.survey
    if scenario.mission.files == "one":
        write_xtf(out / "survey.xtf", _log(scenario, survey, to_file, slice(None)))
        return
    # A turn that is recorded belongs to the line before it.
    line = np.maximum.accumulate(survey.truth.line)
    for number in np.unique(line):
        rows = np.flatnonzero(line == number)
        log = _log(scenario, survey, to_file, slice(rows[0], rows[-1] + 1))
        write_xtf(out / f"survey-{int(number) + 1:03d}.xtf", log)


def _log(scenario: Scenario, pinged: Pinged, to_file: _Geodesy, rows: slice) -> SonarLog:
    estimate, sonar = pinged.estimate, scenario.sonar
    longitude, latitude = to_file.degrees(estimate.easting_m, estimate.northing_m)
    heading = to_file.true_heading_deg(
        estimate.heading_rad, estimate.easting_m, estimate.northing_m
    )
    return SonarLog(
        time_s=estimate.time_s[rows],
        longitude_deg=longitude[rows],
        latitude_deg=latitude[rows],
        heading_deg=heading[rows],
        pitch_deg=np.rad2deg(estimate.pitch_rad[rows]),
        roll_deg=np.rad2deg(estimate.roll_rad[rows]),
        depth_m=estimate.depth_m[rows],
        altitude_m=estimate.altitude_m[rows],
        speed_m_s=estimate.speed_m_s[rows],
        counts=pinged.counts[rows],
        range_m=sonar.range_m,
        ping_period_s=sonar.ping_period_s,
        sound_speed_m_s=sonar.sound_speed_m_s,
        frequency_khz=sonar.frequency_khz,
        horizontal_beam_deg=sonar.horizontal_beam_deg,
        vertical_beam_deg=sonar.vertical_beam_deg,
        tilt_deg=sonar.tilt_deg,
        port_far_to_near=sonar.port_order == "far-to-near",
        first_ping=rows.start or 0,
    )


def _iso(time_s: FloatArray) -> list[str]:
    """Return ISO 8601 UTC times to the millisecond."""
    stamps = np.rint(time_s * 1000.0).astype(np.int64).astype("datetime64[ms]")
    return [f"{stamp}Z" for stamp in np.datetime_as_string(stamps, unit="ms")]


def _csv(header: str, columns: list[list[str]]) -> str:
    return "\n".join([header, *(",".join(row) for row in zip(*columns, strict=True))]) + "\n"


def _numbers(values: FloatArray, digits: int) -> list[str]:
    """Format numbers; NaN is an empty field."""
    return ["" if np.isnan(v) else f"{v:.{digits}f}" for v in values]


def _nav_csv(run: NavRun, to_file: _Geodesy) -> str:
    e = run.estimate
    beams = run.beams_m.T
    header = (
        "time_s,easting_m,northing_m,depth_m,heading_deg,pitch_deg,roll_deg,speed_m_s,altitude_m"
    )
    columns = [
        _numbers(e.time_s, 3),
        _numbers(e.easting_m, 3),
        _numbers(e.northing_m, 3),
        _numbers(e.depth_m, 3),
        _numbers(to_file.true_heading_deg(e.heading_rad, e.easting_m, e.northing_m), 3),
        _numbers(np.rad2deg(e.pitch_rad), 3),
        _numbers(np.rad2deg(e.roll_rad), 3),
        _numbers(e.speed_m_s, 3),
        _numbers(e.altitude_m, 3),
        *(_numbers(beam, 3) for beam in beams),
    ]
    return _csv(header + "".join(f",beam{i + 1}_m" for i in range(len(beams))), columns)


def _fixes_csv(fixes: SurfaceFixes) -> str:
    columns = [
        _iso(fixes.time_s),
        _numbers(fixes.easting_m, 3),
        _numbers(fixes.northing_m, 3),
        [f"{fixes.sigma_m:g}"] * len(fixes.time_s),
    ]
    return _csv("time,easting_m,northing_m,sigma_m", columns)


def _truth_csv(motion: Motion, to_file: _Geodesy) -> str:
    heading = to_file.true_heading_deg(motion.heading_rad, motion.easting_m, motion.northing_m)
    columns = [
        _iso(motion.time_s),
        _numbers(motion.time_s, 3),
        _numbers(motion.easting_m, 4),
        _numbers(motion.northing_m, 4),
        _numbers(-motion.elevation_m, 4),
        _numbers(heading, 4),
        _numbers(np.rad2deg(motion.pitch_rad), 4),
        _numbers(np.rad2deg(motion.roll_rad), 4),
        _numbers(motion.altitude_m, 4),
        [str(int(line)) for line in motion.line],
    ]
    return _csv(
        "time,time_s,easting_m,northing_m,depth_m,heading_deg,pitch_deg,roll_deg,altitude_m,line",
        columns,
    )


def _objects_csv(world: World) -> str:
    objects = world.objects
    columns = [
        _numbers(np.array([o.easting_m for o in objects]), 3),
        _numbers(np.array([o.northing_m for o in objects]), 3),
        [o.kind for o in objects],
        _numbers(np.array([o.height_m for o in objects]), 3),
        _numbers(np.array([o.radius_m for o in objects]), 3),
        [o.shape for o in objects],
    ]
    return _csv("easting_m,northing_m,kind,height_m,radius_m,shape", columns)


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
