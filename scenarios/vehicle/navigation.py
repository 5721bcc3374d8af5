"""What the vehicle believes: dead reckoning that drifts, a depth gauge, fixes at the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.records import FloatArray
from scenarios.sections import NavigationSection
from scenarios.vehicle.motion import Motion


@dataclass(frozen=True, slots=True)
class Reckoning:
    """How far dead reckoning is off, at the times of the motion it was made from.

    `error_east_m`, `error_north_m` (n,) reckoned minus true; the other numbers are the run's
    constants: heading read minus true, speed scale, depth read minus true.
    """

    time_s: FloatArray
    error_east_m: FloatArray
    error_north_m: FloatArray
    heading_bias_rad: float
    speed_scale: float
    depth_bias_m: float


@dataclass(frozen=True, slots=True)
class Estimate:
    """What the vehicle's own instruments say, all (n,); headings from grid north."""

    time_s: FloatArray
    easting_m: FloatArray
    northing_m: FloatArray
    heading_rad: FloatArray
    pitch_rad: FloatArray
    roll_rad: FloatArray
    depth_m: FloatArray
    altitude_m: FloatArray
    speed_m_s: FloatArray


def dead_reckon(
    motion: Motion,
    config: NavigationSection,
    *,
    start_sigma_m: float,
    rng: np.random.Generator,
) -> Reckoning:
    """Integrate what the log and compass say of the motion, from a start that is off.

    Each step is scaled and turned by constants drawn once, plus a random walk whose 1-sigma an axis
    grows with the root of the distance.
    """
    start, constants, walk = rng.spawn(3)
    bias_rad = float(np.deg2rad(config.heading_bias_deg) * constants.standard_normal())
    scale = float(1.0 + config.speed_scale * constants.standard_normal())
    depth_bias_m = float(config.depth_bias_m * constants.standard_normal())
    de, dn = np.diff(motion.easting_m), np.diff(motion.northing_m)
    cos_b, sin_b = np.cos(bias_rad), np.sin(bias_rad)
    # A heading read too large turns the reckoned step clockwise.
    step_e = scale * (de * cos_b + dn * sin_b) - de
    step_n = scale * (dn * cos_b - de * sin_b) - dn
    sigma = config.random_walk_m_per_sqrt_km * np.sqrt(np.hypot(de, dn) / 1000.0)
    jitter = walk.standard_normal((2, len(de))) * sigma
    offset = start_sigma_m * start.standard_normal(2)
    return Reckoning(
        motion.time_s,
        offset[0] + _integral(step_e + jitter[0]),
        offset[1] + _integral(step_n + jitter[1]),
        bias_rad,
        scale,
        depth_bias_m,
    )


def read_instruments(
    motion: Motion,
    reckoning: Reckoning,
    config: NavigationSection,
    *,
    rng: np.random.Generator,
) -> Estimate:
    """Return what the instruments say at the times of `motion`, each reading with its noise."""
    n = len(motion.time_s)
    noise = rng.standard_normal((3, n))
    depth = tide_m(motion.time_s, config) - motion.elevation_m + reckoning.depth_bias_m
    error = {
        name: np.interp(motion.time_s, reckoning.time_s, getattr(reckoning, name))
        for name in ("error_east_m", "error_north_m")
    }
    easting = motion.easting_m + error["error_east_m"]
    northing = motion.northing_m + error["error_north_m"]
    return Estimate(
        time_s=motion.time_s,
        easting_m=easting,
        northing_m=northing,
        heading_rad=motion.heading_rad
        + reckoning.heading_bias_rad
        + np.deg2rad(config.heading_noise_deg) * noise[0],
        pitch_rad=motion.pitch_rad,
        roll_rad=motion.roll_rad,
        depth_m=depth + config.depth_noise_m * noise[1],
        altitude_m=motion.altitude_m * (1.0 + config.altimeter_noise * noise[2]),
        speed_m_s=reckoning.speed_scale * motion.speed_m_s,
    )


def _integral(steps: FloatArray) -> FloatArray:
    return np.concatenate(([0.0], np.cumsum(steps)))


def tide_m(time_s: FloatArray, config: NavigationSection) -> FloatArray:
    """Return the surface's height above the datum."""
    return config.tide_amplitude_m * np.sin(2 * np.pi * time_s / config.tide_period_s)


@dataclass(frozen=True, slots=True)
class SurfaceFixes:
    """Absolute positions with their times, (n,); `sigma_m` is 1-sigma an axis."""

    time_s: FloatArray
    easting_m: FloatArray
    northing_m: FloatArray
    sigma_m: float


def surface_fixes(
    motion: Motion, config: NavigationSection, *, rng: np.random.Generator
) -> SurfaceFixes:
    """Return fixes at the ends of the survey, or of each of its lines, or none."""
    starts = np.flatnonzero(np.diff(motion.line, prepend=-2) != 0)
    starts = starts[motion.line[starts] >= 0]
    ends = np.flatnonzero(np.diff(motion.line, append=-2) != 0)
    ends = ends[motion.line[ends] >= 0]
    rows = {
        "none": np.zeros(0, int),
        "ends": np.array([starts[0], ends[-1]]),
        "passes": np.sort(np.concatenate([starts, ends])),
    }[config.fixes]
    error = config.fix_sigma_m * rng.standard_normal((2, len(rows)))
    return SurfaceFixes(
        motion.time_s[rows],
        motion.easting_m[rows] + error[0],
        motion.northing_m[rows] + error[1],
        config.fix_sigma_m,
    )
