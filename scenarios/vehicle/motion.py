"""How the vehicle truly moves: along its lines, over the floor, rocking."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from perception.records import FloatArray, Grid, InputError
from scenarios.missions.lines import Path
from scenarios.sections import VehicleSection, WorldSection


@dataclass(frozen=True, slots=True)
class Motion:
    """The true motion at even times; headings from grid north, elevation above the datum.

    All arrays are (n,). `line` is the line flown, -1 in turns.
    """

    time_s: FloatArray
    easting_m: FloatArray
    northing_m: FloatArray
    elevation_m: FloatArray
    heading_rad: FloatArray
    pitch_rad: FloatArray
    roll_rad: FloatArray
    course_rad: FloatArray
    speed_m_s: FloatArray
    floor_m: FloatArray
    line: FloatArray

    @property
    def altitude_m(self) -> FloatArray:
        """Return the vertical height above the floor."""
        return self.elevation_m - self.floor_m


def coloured(
    time_s: FloatArray, *, rms: float, period_s: float, rng: np.random.Generator
) -> FloatArray:
    """Return a smooth random process of given rms and mean period at the times given.

    A sum of 48 sinusoids with frequencies spread by a factor of about two around ``1 / period``:
    narrow-band like a vehicle's rocking, and known at any time. The rms is that of the ensemble.
    """
    count = 48
    frequency = np.exp(rng.normal(np.log(1.0 / period_s), 0.35, count))
    phase = rng.uniform(0.0, 2 * np.pi, count)
    amplitude = rms * np.sqrt(2.0 / count)
    out = np.zeros(len(time_s))
    for f, p in zip(frequency, phase, strict=True):
        out += amplitude * np.sin(2 * np.pi * f * time_s + p)
    return out


def fly(
    path: Path,
    floor: Grid,
    world: WorldSection,
    vehicle: VehicleSection,
    *,
    altitude_m: float,
    follow: str,
    start_s: float,
    rng: np.random.Generator,
) -> Motion:
    """Fly a path at the vehicle's speed and return the true motion, one sample a path step.

    Raises
    ------
    InputError
        The path leaves the world, or there is no water where it should fly.
    """
    n = len(path.east_m)
    step_m = float(np.median(np.hypot(np.diff(path.east_m), np.diff(path.north_m))))
    elapsed = np.arange(n) * step_m / vehicle.speed_m_s
    wander, roll, pitch, yaw, heave = rng.spawn(5)
    off = coloured(
        elapsed,
        rms=vehicle.wander_rms_m,
        period_s=vehicle.wander_length_m / vehicle.speed_m_s,
        rng=wander,
    )
    course = _course(path.east_m, path.north_m)
    easting = world.origin_easting_m + path.east_m + off * np.cos(course)
    northing = world.origin_northing_m + path.north_m - off * np.sin(course)
    _stay_inside(easting, northing, floor, world)
    bottom = floor.sample(easting, northing)
    level = _flown_level(bottom, path, step_m, vehicle, altitude_m, follow)
    period = {"period_s": vehicle.motion_period_s}
    elevation = level + coloured(elapsed, rms=vehicle.heave_rms_m, rng=heave, **period)
    if elevation.max() > -0.5:
        raise InputError(
            f"mission.altitude_m = {altitude_m:g}: the vehicle would leave the water at "
            f"{elevation.max():.1f} m; lower it or give a greater world.depth_m"
        )
    course = _course(easting, northing)
    climb = np.arctan2(np.gradient(level), np.hypot(np.gradient(easting), np.gradient(northing)))

    def rocking(rms_deg: float, stream: np.random.Generator) -> FloatArray:
        return coloured(elapsed, rms=float(np.deg2rad(rms_deg)), rng=stream, **period)

    return Motion(
        time_s=start_s + elapsed,
        easting_m=easting,
        northing_m=northing,
        elevation_m=elevation,
        heading_rad=course + np.deg2rad(vehicle.crab_deg) + rocking(vehicle.yaw_rms_deg, yaw),
        pitch_rad=climb + rocking(vehicle.pitch_rms_deg, pitch),
        roll_rad=rocking(vehicle.roll_rms_deg, roll),
        course_rad=course,
        speed_m_s=np.hypot(np.gradient(easting), np.gradient(northing))
        * (vehicle.speed_m_s / step_m),
        floor_m=bottom,
        line=path.line,
    )


def _course(east: FloatArray, north: FloatArray) -> FloatArray:
    """Return the direction of travel, unwrapped, clockwise from grid north."""
    return np.unwrap(np.arctan2(np.gradient(east), np.gradient(north)))


def _stay_inside(
    easting: FloatArray, northing: FloatArray, floor: Grid, world: WorldSection
) -> None:
    margin = 2 * floor.cell_m
    out_e = max(floor.west_m + margin - easting.min(), easting.max() - floor.east_m + margin)
    out_n = max(floor.south_m + margin - northing.min(), northing.max() - floor.north_m + margin)
    for axis, out, size in (
        ("east", out_e, world.size_east_m),
        ("north", out_n, world.size_north_m),
    ):
        if out > 0:
            raise InputError(
                f"world.size_{axis}_m = {size:g}: the track leaves the world by {out:.1f} m; "
                f"give at least {size + 2 * out:.0f} or shorten the lines (turns need room too)"
            )


def _flown_level(
    bottom: FloatArray,
    path: Path,
    step_m: float,
    vehicle: VehicleSection,
    altitude_m: float,
    follow: str,
) -> FloatArray:
    """Return the elevation that the vehicle holds, never nearer to the floor than 0.4 altitudes."""
    sigma = vehicle.follow_length_m / step_m
    if follow == "depth":
        level = np.full(len(bottom), float(bottom.mean()) + altitude_m)
    else:
        level = ndimage.gaussian_filter1d(bottom, sigma, mode="nearest") + altitude_m
    reach = max(int(2 * sigma), 1)
    highest = ndimage.maximum_filter1d(bottom, 2 * reach + 1, mode="nearest")
    least = ndimage.gaussian_filter1d(highest, 0.5 * sigma, mode="nearest") + 0.4 * altitude_m
    return np.maximum(level, least)


def at_times(motion: Motion, time_s: FloatArray) -> Motion:
    """Interpolate the motion at the times given; `line` is that of the sample before."""
    columns = {
        name: np.interp(time_s, motion.time_s, getattr(motion, name))
        for name in (
            "easting_m", "northing_m", "elevation_m", "heading_rad", "pitch_rad", "roll_rad",
            "course_rad", "speed_m_s", "floor_m",
        )
    }  # fmt: skip
    before = np.searchsorted(motion.time_s, time_s, side="right") - 1
    line = motion.line[np.clip(before, 0, len(motion.line) - 1)]
    return Motion(time_s=np.asarray(time_s, float), line=line, **columns)


def sonar_poses(motion: Motion) -> FloatArray:
    """Return (n, 10) poses as the echo kernel wants them, rates by differences in time."""
    rate = {
        name: np.gradient(getattr(motion, name), motion.time_s)
        for name in ("heading_rad", "pitch_rad", "easting_m", "northing_m", "elevation_m")
    }
    forward = rate["easting_m"] * np.sin(motion.heading_rad) + rate["northing_m"] * np.cos(
        motion.heading_rad
    )
    return np.column_stack(
        [
            motion.easting_m, motion.northing_m, motion.elevation_m, motion.heading_rad,
            motion.pitch_rad, motion.roll_rad, rate["heading_rad"], rate["pitch_rad"], forward,
            rate["elevation_m"],
        ]
    )  # fmt: skip
