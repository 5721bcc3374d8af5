"""Navigation sets for the benchmark: a fine sea floor, a vehicle over it, beams cast as rays.

Shares nothing with `localization` but the files' columns: the floor is a spectral field read with
cubic splines at any point, echoes are found by marching along each ray, and the prior map is that
field sampled at the cells' centres plus an error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy import fft, ndimage

from perception.records import FloatArray, Grid, IntArray

# Beams of the sensor sets, degrees: azimuth clockwise from the bow, and off nadir. The goals' sonar is
# `dvl`.
BEAMS_DEG: dict[str, tuple[tuple[float, float], ...]] = {
    "dvl": tuple((azimuth, 30.0) for azimuth in (45.0, 135.0, 225.0, 315.0)),
    "altimeter": ((0.0, 0.0),),
    "fan": tuple(
        (90.0 if side > 0 else 270.0, abs(side)) for side in (-60, -40, -20, 0, 20, 40, 60)
    ),
}


@dataclass(frozen=True, slots=True)
class SetConfig:
    """One kind of set; every sigma is 1-sigma.

    `relief_m` is the floor's standard deviation; `error_length_m` 0 makes the map's error white from
    cell to cell; `hurst` the fractal exponent below `outer_m`.
    """

    relief_m: float = 15.0
    hurst: float = 1.0
    outer_m: float = 1500.0
    extent_m: float = 4000.0
    cell_m: float = 5.0
    duration_s: float = 3600.0
    interval_s: float = 3.0
    speed_m_s: float = 1.5
    altitude_m: float = 60.0
    beam_noise: float = 0.01
    start_m: float = 50.0
    scale: float = 0.005
    heading_deg: float = 0.5
    depth_bias_m: float = 1.0
    map_error_m: float = 0.3
    error_length_m: float = 0.0
    drift_m_sqrt_s: float = 0.0
    outliers: float = 0.0
    attitude_deg: float = 2.0
    sensors: str = "dvl"

    @property
    def beams_rad(self) -> FloatArray:
        """Azimuth and angle off nadir (beams, 2)."""
        return np.radians(np.array(BEAMS_DEG[self.sensors]))


@dataclass(frozen=True, slots=True)
class NavigationSet:
    """What the estimator is given (`prior`, `nav` columns) and what it is not (`truth_*`)."""

    prior: Grid
    nav: dict[str, FloatArray]
    truth_easting_m: FloatArray
    truth_northing_m: FloatArray


@dataclass(frozen=True, slots=True)
class Floor:
    """A sea floor known everywhere: spline coefficients on a fine grid from the origin."""

    coefficients: FloatArray
    step_m: float

    def depth_m(self, easting_m: FloatArray, northing_m: FloatArray) -> FloatArray:
        """Depth, positive down, at any point of the plane (the field is periodic)."""
        at = np.array([np.asarray(northing_m) / self.step_m, np.asarray(easting_m) / self.step_m])
        return ndimage.map_coordinates(
            self.coefficients, at, order=3, mode="grid-wrap", prefilter=False
        )

    def raster_m(self, cell_m: float, number: int) -> FloatArray:
        """Depth at the centres of `number` x `number` cells, rows from south to north.

        The same splines as `depth_m`; where the centres repeat the spline's own steps all of them have
        the same four weights an axis.
        """
        first, every = 0.5 * cell_m / self.step_m, cell_m / self.step_m
        if not float(every).is_integer():
            centres = (np.arange(number) + 0.5) * cell_m
            return self.depth_m(*np.meshgrid(centres, centres))
        knot = int(np.floor(first))
        t = first - knot
        weights = np.array(
            [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]
        )
        at = (knot + round(every) * np.arange(number))[:, None] + np.arange(-1, 3)
        out: FloatArray = self.coefficients
        for axis in (0, 1):
            size = out.shape[axis]
            out = sum(
                w / 6 * np.take(out, at[:, k] % size, axis) for k, w in enumerate(weights) if w
            )
        return out


def spectral_floor(config: SetConfig, rng: np.random.Generator) -> Floor:
    """Draw a periodic fractal floor of standard deviation `relief_m`, 100 m deep on average."""
    step_m = config.cell_m / 2
    n = round(config.extent_m / step_m)
    amplitude = _amplitude(n, step_m, config.outer_m, config.hurst)
    field = fft.irfft2(fft.rfft2(rng.standard_normal((n, n))) * amplitude, s=(n, n))
    field = 100.0 + config.relief_m * (field / field.std())
    return Floor(ndimage.spline_filter(field, order=3, mode="grid-wrap"), step_m)


@lru_cache(maxsize=16)
def _amplitude(n: int, step_m: float, outer_m: float, hurst: float) -> FloatArray:
    k = np.hypot(np.fft.fftfreq(n, step_m)[:, None], np.fft.rfftfreq(n, step_m)[None, :])
    amplitude: FloatArray = (k**2 + outer_m**-2) ** (-(hurst + 1) / 2)
    amplitude[0, 0] = 0.0
    return amplitude


def surface_floor(depth_m: FloatArray, step_m: float) -> Floor:
    """Make a floor of a given raster (rows south to north)."""
    return Floor(ndimage.spline_filter(depth_m, order=3, mode="grid-wrap"), step_m)


def prior_map(floor: Floor, config: SetConfig, rng: np.random.Generator) -> Grid:
    """Sample the floor at the cells' centres and add the map's error."""
    n = round(config.extent_m / config.cell_m)
    error = rng.standard_normal((n, n))
    if config.error_length_m > 0:
        # A Gaussian kernel of width s gives a Gaussian correlation of length s * sqrt(2).
        width = config.error_length_m / config.cell_m / np.sqrt(2)
        error = ndimage.gaussian_filter(error, width, mode="wrap")
        error /= error.std()
    elevation = config.map_error_m * error - floor.raster_m(config.cell_m, n)[::-1]
    return Grid(
        elevation_m=elevation,
        west_m=0.0,
        north_m=config.extent_m,
        cell_m=config.cell_m,
        crs="EPSG:32631",
        sigma_m=np.full((n, n), config.map_error_m),
    )


def lawnmower(config: SetConfig, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Easting and northing of a survey of parallel lines 200 m apart, at constant speed."""
    half = config.extent_m / 2
    leg = 0.3 * config.extent_m
    x = np.array([-leg, leg, leg, -leg, -leg, leg, leg, -leg, -leg, leg, leg, -leg])
    y = np.array([0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]) * 200.0 - 500.0
    turn = rng.uniform(0, 2 * np.pi)
    corner_e = half + x * np.cos(turn) - y * np.sin(turn)
    corner_n = half + x * np.sin(turn) + y * np.cos(turn)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(corner_e), np.diff(corner_n)))])
    time_s = np.arange(0.0, config.duration_s, config.interval_s)
    s = (time_s * config.speed_m_s + rng.uniform(0, leg)) % along[-1]
    return np.interp(s, along, corner_e), np.interp(s, along, corner_n)


def cast(
    floor: Floor,
    easting_m: FloatArray,
    northing_m: FloatArray,
    depth_m: FloatArray,
    ray: FloatArray,
) -> FloatArray:
    """Slant range at which each ray first meets the floor; NaN beyond 400 m.

    Parameters
    ----------
    ray : (n, 3) unit vectors east, north, down.
    """

    def above(distance_m: FloatArray | float, which: IntArray) -> FloatArray:
        return floor.depth_m(
            easting_m[which] + distance_m * ray[which, 0],
            northing_m[which] + distance_m * ray[which, 1],
        ) - (depth_m[which] + distance_m * ray[which, 2])

    step = 2.0
    far = np.full(len(easting_m), np.nan)
    todo = np.arange(len(easting_m))
    for distance in np.arange(step, 400.0, step):
        hit = above(distance, todo) <= 0
        far[todo[hit]] = distance
        todo = todo[~hit]
        if not len(todo):
            break
    low, high = far - step, far.copy()
    met = np.flatnonzero(np.isfinite(far))
    for _ in range(14):
        middle = (low[met] + high[met]) / 2
        under = above(middle, met) <= 0
        high[met] = np.where(under, middle, high[met])
        low[met] = np.where(under, low[met], middle)
    return (low + high) / 2


def body_rays(config: SetConfig) -> FloatArray:
    """Unit vectors (beams, 3) forward, starboard, down."""
    azimuth, off = config.beams_rad.T
    return np.stack(
        [np.sin(off) * np.cos(azimuth), np.sin(off) * np.sin(azimuth), np.cos(off)], axis=1
    )


def body_to_grid(
    heading_rad: FloatArray, pitch_rad: FloatArray, roll_rad: FloatArray
) -> FloatArray:
    """Rotation (n, 3, 3) from forward-starboard-down to east-north-down."""
    ch, sh = np.cos(heading_rad), np.sin(heading_rad)
    cp, sp = np.cos(pitch_rad), np.sin(pitch_rad)
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    # Roll about the forward axis, then pitch about starboard, then heading.
    forward = np.stack([sh * cp, ch * cp, -sp], axis=-1)
    starboard = np.stack([sh * sp * sr + ch * cr, ch * sp * sr - sh * cr, cp * sr], axis=-1)
    down = np.stack([sh * sp * cr - ch * sr, ch * sp * cr + sh * sr, cp * cr], axis=-1)
    return np.stack([forward, starboard, down], axis=-1)


def make_set(
    config: SetConfig, rng: np.random.Generator, floor: Floor | None = None
) -> NavigationSet:
    """Draw one set: floor, map, track, errors of navigation, echoes."""
    floor_rng, map_rng, track_rng, beam_rng = rng.spawn(4)
    if floor is None:
        floor = spectral_floor(config, floor_rng)
    prior = prior_map(floor, config, map_rng)
    track = lawnmower(config, track_rng)
    return NavigationSet(prior, sounded(config, floor, track, track_rng, beam_rng), *track)


def sounded(
    config: SetConfig,
    floor: Floor,
    track_m: tuple[FloatArray, FloatArray],
    track_rng: np.random.Generator,
    beam_rng: np.random.Generator,
) -> dict[str, FloatArray]:
    """Columns of nav.csv for a true track, easting and northing (n,) each."""
    easting, northing = track_m
    n = len(easting)
    time_s = np.arange(n) * config.interval_s
    step_e, step_n = np.diff(easting), np.diff(northing)
    heading = np.arctan2(step_e, step_n)
    heading = np.concatenate([heading[:1], heading])
    tilt = np.radians(config.attitude_deg) * track_rng.standard_normal((2, n))
    depth = np.full(n, 100.0 - config.altitude_m)
    ray_body = body_rays(config)
    rays = np.einsum("nij,bj->nbi", body_to_grid(heading, tilt[0], tilt[1]), ray_body)
    nav = _navigation(config, track_rng, time_s, easting, northing, heading, step_e, step_n)
    nav["depth_m"] = depth + config.depth_bias_m * track_rng.standard_normal()
    nav["pitch_deg"], nav["roll_deg"] = np.degrees(tilt)
    for b in range(len(ray_body)):
        beam = cast(floor, easting, northing, depth, rays[:, b])
        beam *= 1 + config.beam_noise * beam_rng.standard_normal(n)
        wild = beam_rng.random(n) < config.outliers
        name = "altitude_m" if config.sensors == "altimeter" else f"beam{b + 1}_m"
        nav[name] = np.where(wild, beam_rng.uniform(5.0, 150.0, n), beam)
    return nav


def _navigation(
    config: SetConfig,
    rng: np.random.Generator,
    time_s: FloatArray,
    easting: FloatArray,
    northing: FloatArray,
    heading: FloatArray,
    step_e: FloatArray,
    step_n: FloatArray,
) -> dict[str, FloatArray]:
    """Dead-reckon the track with a start error, a scale, a heading error and a random walk."""
    bias = np.radians(config.heading_deg) * rng.standard_normal()
    scale = 1 + config.scale * rng.standard_normal()
    walk = config.drift_m_sqrt_s * np.sqrt(config.interval_s)
    walk = walk * rng.standard_normal((2, len(step_e)))
    start = config.start_m * rng.standard_normal(2)
    seen_e = scale * (step_e * np.cos(bias) + step_n * np.sin(bias)) + walk[0]
    seen_n = scale * (step_n * np.cos(bias) - step_e * np.sin(bias)) + walk[1]
    return {
        "time_s": time_s,
        "easting_m": easting[0] + start[0] + np.concatenate([[0.0], np.cumsum(seen_e)]),
        "northing_m": northing[0] + start[1] + np.concatenate([[0.0], np.cumsum(seen_n)]),
        "heading_deg": np.degrees(heading + bias) % 360.0,
        "speed_m_s": np.full(len(time_s), config.speed_m_s * scale),
    }


def degraded(nav_set: NavigationSet, **columns: FloatArray) -> NavigationSet:
    """Return the set with some columns of its navigation replaced."""
    return replace(nav_set, nav={**nav_set.nav, **columns})
