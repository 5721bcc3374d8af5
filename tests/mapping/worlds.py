"""A small world for the mapping tests: fractal ground, passes over it, navigation that drifts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from perception.records import ElevationStrip, FloatArray

CRS = "EPSG:32630"
ORIGIN = np.array([500_000.0, 5_600_000.0])


@dataclass(frozen=True)
class World:
    """Heights and albedo (log) on a 1 m grid, row 0 south, periodic."""

    height_m: FloatArray
    albedo: FloatArray

    def sample(self, field: FloatArray, east: FloatArray, north: FloatArray) -> FloatArray:
        rows, cols = north - ORIGIN[1], east - ORIGIN[0]
        return map_coordinates(field, [rows, cols], order=1, mode="grid-wrap")


def fractal(rng: np.random.Generator, size: int, rms: float, exponent: float) -> FloatArray:
    k = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size))
    k[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.normal(size=(size, size))) * k**-exponent
    field = np.fft.irfft2(spectrum, s=(size, size))
    return field * rms / field.std()


def make_world(
    rng: np.random.Generator, size: int = 512, relief_m: float = 1.0, albedo_db: float = 1.5
) -> World:
    height = -40.0 + fractal(rng, size, relief_m, 1.6) if relief_m else np.full((size, size), -40.0)
    albedo = gaussian_filter(rng.normal(size=(size, size)), 2.0, mode="wrap")
    return World(height, albedo / albedo.std() * albedo_db * np.log(10) / 10)


@dataclass(frozen=True)
class Flight:
    """A pass as it was and as the navigation has it; `strip` holds the navigation's poses."""

    strip: ElevationStrip
    true_easting_m: FloatArray
    true_northing_m: FloatArray
    true_heading_rad: FloatArray


@dataclass(frozen=True)
class Drift:
    walk_m_per_sqrt_km: float = 4.0
    heading_bias_deg: float = 0.4
    scale: float = 0.004


def fly(
    world: World,
    legs: list[tuple[float, float, float, float]],
    rng: np.random.Generator,
    drift: Drift | None = None,
    step_m: float = 0.5,
    half_swath_m: float = 50.0,
    across_step_m: float = 0.5,
    altitude_m: float = 15.0,
    height_noise_m: float = 0.3,
    height_bias_m: float = 0.1,
    turn_m: float = 60.0,
    looks: float = 4.0,
) -> list[Flight]:
    """Fly straight legs (east, north, heading in degrees, length) at 1.5 m/s, one strip each."""
    drift = drift or Drift()
    error = np.zeros(2)
    flights: list[Flight] = []
    clock, ping = 1.7e9, 0
    for index, (east0, north0, heading_deg, length) in enumerate(legs):
        bias = np.radians(drift.heading_bias_deg) * rng.normal()
        scale = drift.scale * rng.normal()
        n = int(length / step_m)
        heading = np.radians(heading_deg)
        direction = np.array([np.sin(heading), np.cos(heading)])
        turn = np.array([direction[1], -direction[0]])
        walk = rng.normal(size=(n, 2)) * drift.walk_m_per_sqrt_km * np.sqrt(step_m / 1000)
        if index:
            error = error + rng.normal(size=2) * drift.walk_m_per_sqrt_km * np.sqrt(turn_m / 1000)
        # What the navigation lacks: correction = truth - navigation.
        walk += step_m * (scale * direction + bias * turn)
        errors = error + np.cumsum(walk, axis=0)
        error = errors[-1]
        along = step_m * np.arange(n)
        truth = ORIGIN + [east0, north0] + along[:, None] * direction
        strip = _look(
            world,
            truth,
            heading,
            rng,
            half_swath_m,
            across_step_m,
            altitude_m,
            height_noise_m,
            looks,
        )
        strip = replace(
            strip,
            easting_m=truth[:, 0] - errors[:, 0],
            northing_m=truth[:, 1] - errors[:, 1],
            heading_rad=np.full(n, heading - bias),
            elevation_m=strip.elevation_m + height_bias_m * rng.normal(),
            time_s=clock + along / 1.5,
            ping=ping + np.arange(n),
            pass_index=index,
        )
        clock, ping = clock + (length + turn_m) / 1.5, ping + n + 10
        flights.append(Flight(strip, truth[:, 0], truth[:, 1], np.full(n, heading)))
    return flights


def _look(
    world: World, truth: FloatArray, heading: float, rng: np.random.Generator, half_swath_m: float,
    across_step_m: float, altitude_m: float, height_noise_m: float, looks: float,
) -> ElevationStrip:  # fmt: skip
    across = np.arange(-half_swath_m, half_swath_m + 1e-9, across_step_m)
    starboard = np.array([np.cos(heading), -np.sin(heading)])
    n = len(truth)
    east = truth[:, :1] + starboard[0] * across
    north = truth[:, 1:] + starboard[1] * across
    height = world.sample(world.height_m, east, north)
    outward = np.gradient(height, across_step_m, axis=1) * np.sign(across)
    level = -0.0 + world.sample(world.albedo, east, north) - 3.0 * np.clip(outward, -0.5, 0.3)
    # A slope facing the sonar falls outward... rises: rising outward is bright.
    level += 6.0 * np.clip(outward, -0.5, 0.3)
    speckle = rng.gamma(looks, 1 / looks, size=height.shape)
    # Heights off the track err together over metres and lose their fine structure.
    smooth = gaussian_filter(height, 4.0)
    noise = gaussian_filter(rng.normal(size=height.shape), 6.0)
    noise *= height_noise_m / noise.std()
    nothing = np.zeros(n)
    return ElevationStrip(
        elevation_m=smooth + noise,
        sigma_m=np.full(height.shape, max(height_noise_m, 0.05)),
        across_m=across,
        echo=np.exp(level) * speckle,
        shadow=np.zeros(height.shape, bool),
        time_s=nothing,
        ping=np.arange(n),
        easting_m=truth[:, 0],
        northing_m=truth[:, 1],
        depth_m=np.full(n, 25.0),
        heading_rad=np.full(n, heading),
        altitude_m=np.full(n, altitude_m),
        altitude_sigma_m=np.full(n, 0.1),
        crs=CRS,
    )


def crossed_legs(
    length: float = 300.0, apart: float = 60.0
) -> list[tuple[float, float, float, float]]:
    """Three parallel legs north and south, then three crossing them west and east."""
    middle = length / 2
    legs = []
    for i, x in enumerate((middle - apart, middle, middle + apart)):
        legs.append((x, 0.0, 0.0, length) if i % 2 == 0 else (x, length, 180.0, length))
    for i, y in enumerate((middle + apart, middle, middle - apart)):
        legs.append((0.0, y, 90.0, length) if i % 2 else (length, y, 270.0, length))
    return legs
