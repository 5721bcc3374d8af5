"""The files of a simulation: what an estimator may see, and beside it `truth/`, which it may not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tomli_w

from mapping.rasters import write_map
from perception.files import write_text
from perception.records import FloatArray, Progress, silent
from scenarios.missions.frame import FileFrame
from scenarios.schema import Scenario, tree_of
from scenarios.simulation import NavRun, Pinged, Simulation
from scenarios.sonar.xtf import SonarLog, write_xtf
from scenarios.vehicle.motion import Motion
from scenarios.vehicle.navigation import SurfaceFixes, tide_m
from scenarios.world.build import World
from scenarios.world.prior import block_mean


def write_simulation(simulation: Simulation, out: Path, progress: Progress = silent) -> None:
    """Write the files of the contract into `out`, and the truth into `out/truth`."""
    scenario = simulation.scenario
    to_file = FileFrame(scenario.world.crs)
    steps = 6
    progress("writing", 0, steps)
    write_text(out / "scenario.toml", tomli_w.dumps(tree_of(scenario)))
    written = _write_survey(simulation, out, to_file)
    progress("writing", 1, steps)
    if simulation.back is not None:
        written.append("return.xtf")
        write_xtf(out / "return.xtf", _log(scenario, simulation.back, to_file, slice(None)))
    progress("writing", 2, steps)
    write_text(out / "nav.csv", _nav_csv(simulation.nav, to_file))
    write_text(out / "surface-fixes.csv", _fixes_csv(simulation.fixes))
    if scenario.navigation.tide_amplitude_m > 0:
        written.append("tide.csv")
        write_text(out / "tide.csv", _tide_csv(simulation))
    _remove_earlier(out, written)
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


def _remove_earlier(out: Path, written: list[str]) -> None:
    """Remove an earlier simulation's files that this one has no counterpart of.

    A survey is read by the pattern survey*.xtf: a file left over would be taken for a line of it.
    """
    for pattern in ("survey.xtf", "survey-[0-9]*.xtf", "return.xtf", "tide.csv"):
        for path in out.glob(pattern):
            if path.name not in written:
                path.unlink()


def _write_survey(simulation: Simulation, out: Path, to_file: FileFrame) -> list[str]:
    """Write the sonar files and return their names."""
    scenario, survey = simulation.scenario, simulation.survey
    if scenario.mission.files == "one":
        write_xtf(out / "survey.xtf", _log(scenario, survey, to_file, slice(None)))
        return ["survey.xtf"]
    # A turn that is recorded belongs to the line before it.
    line = np.maximum.accumulate(survey.truth.line)
    names = []
    for number in np.unique(line):
        rows = np.flatnonzero(line == number)
        log = _log(scenario, survey, to_file, slice(rows[0], rows[-1] + 1))
        names.append(f"survey-{int(number) + 1:03d}.xtf")
        write_xtf(out / names[-1], log)
    return names


def _log(scenario: Scenario, pinged: Pinged, to_file: FileFrame, rows: slice) -> SonarLog:
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


def _nav_csv(run: NavRun, to_file: FileFrame) -> str:
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


def _tide_csv(simulation: Simulation) -> str:
    """Return the surface's height above the datum, every ten minutes around both runs."""
    first = simulation.survey.truth.time_s[0]
    last = max(simulation.survey.truth.time_s[-1], simulation.nav.truth.time_s[-1])
    time_s = 600.0 * np.arange(np.floor(first / 600.0) - 1, np.ceil(last / 600.0) + 2)
    height_m = tide_m(time_s, simulation.scenario.navigation)
    return _csv("time,height_m", [_iso(time_s), _numbers(height_m, 4)])


def _truth_csv(motion: Motion, to_file: FileFrame) -> str:
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
