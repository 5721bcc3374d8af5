"""How far the first return of a rough floor falls short of the height above the point beneath.

The first return comes from the nearest point of the floor. By how much that is nearer than the point
beneath depends on the floor's relief over a part of the altitude, which the soundings along the track tell, although
they are smoother than the floor for the same reason. Random floors, alike at every scale, are sounded by
their nearest points; their size and their power are turned until their soundings vary as the pass's do, and what
those fall short by is the answer.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from perception.contours import LEAST_SCALE, Roughness, half_median_square
from perception.records import FloatArray, IntArray

# Random floors have this many cells an altitude, and as many in all each way; they repeat beyond.
_CELLS = 16
_COUNT = 256
# Lags over which a pass and a random floor are to agree, in cells: a quarter of the altitude to the whole. What
# is narrower the beam's width and the tracker smooth away, and what is wider moves all points alike.
_LAGS = np.array([4, 5, 6, 8, 11, 16])
_ROUNDS = 5
# A floor's nearest point lies within 39 degrees of the plumb line.
_REACH_CELLS = 13
# Slopes beyond some 20 degrees over a third of the altitude are cliffs, which no variogram describes.
_MOST_SLOPE_SQUARE = 0.15
_LEAST_POWER, _MOST_POWER = 0.2, 1.95


def shortfall(
    first_return_m: FloatArray,
    depth_m: FloatArray,
    sigma_m: FloatArray,
    along_m: FloatArray,
    roughness: Roughness,
) -> tuple[FloatArray, FloatArray]:
    """Return by how much first returns fall short of the height above the point beneath, and its 1-sigma.

    Both (n,) in metres. The first is the mean that is to be expected, the second how far a single ping is from
    it: where the floor beneath is a trough or a top is not known.

    Parameters
    ----------
    first_return_m, depth_m, sigma_m, along_m : (n,) least slant range, the sonar's depth, 1-sigma of the range and
        place along the track, rising. NaN unknown.
    roughness : of the soundings, for passes too short to tell their own over the lags that matter.
    """
    known = np.isfinite(first_return_m) & np.isfinite(depth_m)
    if not known.any():
        return np.zeros(len(first_return_m)), np.zeros(len(first_return_m))
    altitude_m = max(float(np.median(first_return_m[known])), 0.1)
    # Half of a sounding's sigma is common to its neighbours.
    noise_m = 0.5 * float(np.median(sigma_m[known]))
    seen = _local_roughness(
        -(depth_m + first_return_m)[known], noise_m, along_m[known], altitude_m, roughness
    )
    short, spread, power = _of_random_floors(seen, altitude_m)
    # Alike at every scale: a floor's slope over a part of the altitude goes with that power of it.
    scale = (np.where(known, first_return_m, altitude_m) / altitude_m) ** (power - 1.0)
    return short * scale, spread * scale


def _local_roughness(
    height_m: FloatArray,
    noise_m: float,
    along_m: FloatArray,
    altitude_m: float,
    otherwise: Roughness,
) -> Roughness:
    """Return the power law that soundings follow over the lags that matter."""
    lag_m = _LAGS * altitude_m / _CELLS
    value = otherwise.variogram(lag_m)
    length = float(np.ptp(along_m))
    step = length / max(len(along_m) - 1, 1)
    # Shorter lags lie between two soundings, and of longer ones than a quarter of the pass there are too few.
    told = lag_m[(lag_m > step) & (lag_m < length / 4)]
    if len(told) > 1:
        lag_m = told
        # By medians: objects under the track would pass for rough floor, and lengthen every altitude.
        value = np.array(
            [half_median_square(_differences(height_m, along_m, k, step)) for k in lag_m]
        )
        value = np.maximum(value - noise_m**2, 0.05 * value) + 1e-12
    power, _ = np.polyfit(np.log(lag_m), np.log(value), 1)
    power = float(np.clip(power, _LEAST_POWER, _MOST_POWER))
    scale = float(np.exp(np.mean(np.log(value) - power * np.log(lag_m))))
    third = altitude_m / 3
    most = 0.5 * _MOST_SLOPE_SQUARE * third ** (2.0 - power)
    return Roughness(float(np.clip(scale, LEAST_SCALE, max(most, LEAST_SCALE))), power)


def _differences(
    height_m: FloatArray, along_m: FloatArray, lag_m: float, step_m: float
) -> FloatArray:
    """Return the differences of heights `lag_m` apart, from evenly spaced places."""
    at = np.arange(along_m[0], along_m[-1] - lag_m, step_m)
    return np.interp(at + lag_m, along_m, height_m) - np.interp(at, along_m, height_m)


def _of_random_floors(seen: Roughness, altitude_m: float) -> tuple[float, float, float]:
    """Return mean and spread (m) of the shortfall on floors whose soundings vary as `seen`, and their power."""
    goal = seen.variogram(_LAGS * altitude_m / _CELLS) / altitude_m**2
    columns = np.arange(0, _COUNT, 8)
    noise = np.fft.fft2(np.random.default_rng(0).standard_normal((_COUNT, _COUNT)))
    power, size = seen.power, float(np.exp(np.mean(np.log(goal))))
    lag = np.log(_LAGS) - np.mean(np.log(_LAGS))
    short = np.zeros(1)
    for _ in range(_ROUNDS):
        floor = _random_floor(noise, power)
        floor *= np.sqrt(size / np.exp(np.mean(np.log(_variogram(floor)))))
        sounded = _nearest(floor, columns)
        short = 1.0 - floor[:, columns] - sounded
        # In log: what the sounded floor lacks in size and in power.
        lack = np.log(goal / _variogram(sounded))
        size *= float(np.exp(np.mean(lack)))
        turn = float(np.clip(lack @ lag / (lag @ lag), -0.3, 0.3))
        power = float(np.clip(power + turn, _LEAST_POWER, _MOST_POWER))
    return altitude_m * float(np.mean(short)), altitude_m * float(np.std(short)), power


def _random_floor(noise: npt.NDArray[np.complex128], power: float) -> FloatArray:
    """Return a periodic floor in altitudes, of any size, whose variogram goes with that power of the lag."""
    k = np.hypot(*np.meshgrid(*(np.fft.fftfreq(_COUNT),) * 2))
    k[0, 0] = np.inf
    return np.asarray(np.fft.ifft2(noise * k ** (-0.5 * power - 1.0)).real)


def _nearest(floor: FloatArray, columns: IntArray) -> FloatArray:
    """Return the least range to the floor across each row, from an altitude above the columns' mean level."""
    nearest = np.full((len(floor), len(columns)), np.inf)
    for offset in range(-_REACH_CELLS, _REACH_CELLS + 1):
        drop = 1.0 - floor[:, (columns + offset) % _COUNT]
        nearest = np.minimum(nearest, np.hypot(offset / _CELLS, drop))
    return nearest


def _variogram(height: FloatArray) -> FloatArray:
    """Return half the mean square differences down the rows at the lags."""
    return np.array([0.5 * np.mean((np.roll(height, k, axis=0) - height) ** 2) for k in _LAGS])
