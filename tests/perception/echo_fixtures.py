"""Hand-made pings for the tests of the echo stages: exact two-dimensional rays over a height function.

Shares no line with the estimator nor with the scenario simulator. Each ping looks square to the track;
facets a quarter of a sample wide are hidden by the largest elevation angle met so far and summed into
slant-range bins; speckle, noise floor, an unknown gain and a water column come on top.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from perception.records import FloatArray, Swath

Height = Callable[[FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True)
class Survey:
    """What the hand-made sonar does; ranges in metres."""

    n_pings: int = 120
    spacing_m: float = 0.25
    altitude_m: float = 10.0
    sample_m: float = 0.06
    n_samples: int = 800
    looks: float = 1.0
    noise: float = 0.01
    gain_slope_db_per_m: float = 0.1
    heave_m: float = 0.0
    depth_m: float = 20.0
    lambert: float = 2.0
    beam_rad: float = 0.0


def flat(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return a flat floor."""
    return np.zeros(np.broadcast(x, y).shape)


def gaussian(height_m: float, x0: float, y0: float, width_m: float) -> Height:
    """Return a Gaussian hill (or crater, where the height is negative) on a flat floor."""
    return lambda x, y: height_m * np.exp(-0.5 * ((x - x0) ** 2 + (y - y0) ** 2) / width_m**2)


def box(height_m: float, x0: float, y0: float, half_x: float, half_y: float) -> Height:
    """Return a box on a flat floor."""
    return lambda x, y: np.where((abs(x - x0) <= half_x) & (abs(y - y0) <= half_y), height_m, 0.0)


def cylinder(height_m: float, x0: float, y0: float, radius_m: float) -> Height:
    """Return an upright cylinder (or a pit) on a flat floor."""
    return lambda x, y: np.where(np.hypot(x - x0, y - y0) <= radius_m, height_m, 0.0)


def boulder(radius_m: float, x0: float, y0: float) -> Height:
    """Return a half sphere on a flat floor."""
    return lambda x, y: np.sqrt(np.maximum(radius_m**2 - (x - x0) ** 2 - (y - y0) ** 2, 0.0))


def echo_power(height: Height, y: float, altitude_m: float, side: int, s: Survey) -> FloatArray:
    """Return the mean echo power per slant bin of one side of one ping; `side` is -1 or 1."""
    step = s.sample_m / 3
    x = (np.arange(int(s.sample_m * s.n_samples / step)) + 0.5) * step
    x, z = _polyline(x, height(side * x, np.full_like(x, y)), step)
    drop = altitude_m - z
    angle = np.arctan2(-drop, x)
    seen = angle >= np.maximum.accumulate(angle) - 1e-12
    # Facets between neighbouring points; lit where both ends are.
    dx, dz = np.diff(x), np.diff(z)
    xm, dm = 0.5 * (x[1:] + x[:-1]), 0.5 * (drop[1:] + drop[:-1])
    length, slant = np.hypot(dx, dz), np.hypot(xm, dm)
    cosine = np.clip((dm * dx + xm * dz) / (length * slant + 1e-12), 0, None)
    energy = np.where(seen[1:] & seen[:-1], cosine**s.lambert * length, 0.0)
    bins = np.zeros(s.n_samples)
    index = (slant / s.sample_m).astype(int)
    inside = index < s.n_samples
    np.add.at(bins, index[inside], energy[inside])
    return bins


def _polyline(x: FloatArray, z: FloatArray, step: float) -> tuple[FloatArray, FloatArray]:
    """Fill steep rises between two columns with points, so that a wall is made of small facets too."""
    extra = np.minimum(np.abs(np.diff(z)) / step, 200).astype(int)
    if not extra.any():
        return x, z
    counts = np.append(extra + 1, 1)
    start = np.repeat(np.arange(len(x)), counts)
    part = (np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)) / np.repeat(
        counts, counts
    )
    ahead = np.minimum(start + 1, len(x) - 1)
    return x[start] + part * (x[ahead] - x[start]), z[start] + part * (z[ahead] - z[start])


def make_swath(height: Height, survey: Survey, rng: np.random.Generator) -> Swath:
    """Return the swath of a straight northward pass over `height(x_starboard, y_along)`."""
    s = survey
    y = np.arange(s.n_pings) * s.spacing_m
    altitude = s.altitude_m + s.heave_m * np.sin(2 * np.pi * y / 12.0)
    ranges = (np.arange(s.n_samples) + 0.5) * s.sample_m
    gain = 10 ** (s.gain_slope_db_per_m * ranges / 10) * 1e4
    sides = []
    for side in (-1, 1):
        power = np.array(
            [echo_power(height, yi, hi, side, s) for yi, hi in zip(y, altitude, strict=True)]
        )
        level = np.median(power[power > 0]) if np.any(power > 0) else 1.0
        power = power / level + s.noise
        power *= rng.gamma(s.looks, 1 / s.looks, power.shape)
        sides.append(np.sqrt(power * gain).astype(np.float32))
    n = s.n_pings
    return Swath(
        time_s=y / 1.5,
        ping=np.arange(n),
        easting_m=np.full(n, 1000.0),
        northing_m=y + 5000.0,
        depth_m=np.full(n, s.depth_m) - (altitude - s.altitude_m),
        heading_rad=np.zeros(n),
        pitch_rad=np.zeros(n),
        roll_rad=np.zeros(n),
        altitude_hint_m=np.full(n, np.nan),
        sample_m=np.full(n, s.sample_m),
        port=sides[0],
        starboard=sides[1],
        sound_speed_m_s=np.full(n, 1500.0),
        crs="EPSG:32619",
    )
