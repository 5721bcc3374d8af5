"""How well soundings fit the map at a place: the one likelihood under all filters.

A sounding's residual is its elevation less the map's. Its variance has three parts:

- the range noise, turned to height by the ray and the slope, ``(s_r (down + g . out))^2``;
- the map's error, *shared* by soundings within its correlation length L. A filter that carries it
  as state (`localization.kalman`) adds nothing here; one that cannot (particles, point masses) must
  not count the same error as news each time, so it is inflated by the number of soundings that share
  it, ``n = 1 + 2 L / d`` with d the way between two updates (an AR(1) sequence of correlation
  exp(-d/L) tells n times less of its mean), times the beams that lie within L of one another;
- what interpolation misses between cells, alike over half a cell only (`shared_between_m2`).

A residual beyond `GATE` sigmas costs what an outlier costs and no more, so a wild beam cannot veto a
place. Where the map has no data a sounding costs its expected value: a hole neither attracts nor
repels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from localization.measurements import Soundings
from localization.terrain import TerrainMap, lookup
from perception.records import FloatArray

# With one beam in ten wild and spread over some 100 m, a normal density of 0.6 m falls to that of an
# outlier at 3.5 sigmas: sqrt(-2 ln(0.1/100 / (0.9/(0.6 sqrt(2 pi))))) = 3.5.
GATE = 3.5
# Correlation length assumed of the error that is not white when nothing tells it: charts are gridded
# from swaths some tens of metres wide with sound-speed and tide errors constant within them.
DEFAULT_LENGTH_M = 50.0
# An hour at rest over one spot is one look at the map's error there, whatever the number of pings.
_MOST_SHARING = 1e4


@dataclass(frozen=True, slots=True)
class SoundingNoise:
    """Variances (n,) of the soundings of one update.

    `range_m2` is independent from update to update; `between_m2` is what interpolation misses, its
    sharing counted; `shared_m2` is the map's error as it is, `inflated_m2` the sum of all with the
    map's error inflated by its sharing.
    """

    range_m2: FloatArray
    between_m2: float
    shared_m2: float
    inflated_m2: FloatArray


def sounding_noise(
    soundings: Soundings, terrain: TerrainMap, slope: float, step_m: float
) -> SoundingNoise:
    """Return the variances of an update's soundings.

    Parameters
    ----------
    slope : rms slope of the ground, which turns range noise into height.
    step_m : way since the update before.
    """
    error = terrain.error
    tilt = soundings.down**2 + 0.5 * slope**2 * (1 - soundings.down**2)
    range_m2 = soundings.range_sigma_m**2 * tilt
    length = error.length_m if np.isfinite(error.length_m) else DEFAULT_LENGTH_M
    shared: float = sum(
        variance * _sharing(soundings.east_m, soundings.north_m, reach, step_m)
        for variance, reach in (
            (error.filtered_m**2, error.filtered_length_m),
            (error.correlated_m**2, length),
        )
        if variance > 0
    )
    between = shared_between_m2(terrain, step_m)
    return SoundingNoise(
        range_m2=range_m2,
        between_m2=between,
        shared_m2=error.filtered_m**2 + error.correlated_m**2,
        inflated_m2=range_m2 + between + shared,
    )


def shared_between_m2(terrain: TerrainMap, way_m: float) -> float:
    """Variance of what interpolation misses, for soundings that come every `way_m`.

    It is alike over about half a cell L: an AR(1) sequence of correlation exp(-way / L) tells of its
    mean what ``coth(way / 2 L)`` times fewer values would.

    Parameters
    ----------
    way_m : distance since the update before; a vehicle at rest learns nothing new.
    """
    reach = 0.5 * max(terrain.cell_m, terrain.cell_north_m)
    ratio = max(way_m, 1e-3) / (2 * reach)
    return terrain.error.between_m**2 * min(1.0 / math.tanh(ratio), _MOST_SHARING)


@numba.njit(cache=True)
def _sharing(east_m, north_m, length_m, step_m):  # type: ignore[no-untyped-def]
    """Return how many soundings share one error of correlation length `length_m`."""
    across = 0.0
    for i in range(east_m.size):
        for j in range(east_m.size):
            apart = np.hypot(east_m[i] - east_m[j], north_m[i] - north_m[j])
            across += np.exp(-apart / length_m)
    along = 1.0 + 2.0 * length_m / max(step_m, 1e-3)
    return min(along * across / max(east_m.size, 1), _MOST_SHARING)


@numba.njit(cache=True, fastmath={"contract", "arcp", "reassoc", "nsz"})
def bias_marginal(heights, frame, e, n, turn, m, v, pe, pn, oe, on, z, r, walk):  # type: ignore[no-untyped-def]
    """Log likelihood of soundings at one place, the depth bias marginalised.

    The bias has the Gaussian (m, v) and is updated sounding by sounding (a scalar Kalman filter), so
    its common error is not mistaken for terrain.

    Parameters
    ----------
    e, n, turn : offset of the vehicle from dead reckoning, and heading bias.
    m, v : mean and variance of the depth bias, v before the walk of variance `walk`.
    pe, pn : dead-reckoned position; oe, on : (beams,) soundings relative to it.
    z, r : (beams,) elevation of the soundings, and variance.

    Returns
    -------
    log likelihood, m, v, number of soundings inside the gate
    """
    total = 0.0
    scale = 1.0
    v += walk
    fitting = 0
    for j in range(z.size):
        s = v + r[j]
        scale *= s
        height = lookup(
            heights, frame, pe + e + oe[j] + turn * on[j], pn + n + on[j] - turn * oe[j]
        )
        if height != height:  # NaN: no data there
            total += 0.5
            continue
        y = z[j] - height - m
        q = y * y / s
        if q > GATE * GATE:
            total += 0.5 * GATE * GATE
            continue
        total += 0.5 * q
        k = v / s
        m += k * y
        v *= 1.0 - k
        fitting += 1
    return -total - 0.5 * np.log(scale), m, v, fitting
