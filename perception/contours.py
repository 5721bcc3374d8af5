"""The floor between objects: consecutive contour lines levelled together, and what one line of soundings
says about the ground beside it.

A side-scan ping measures the floor's height once, below the sonar. How far that holds to the side is learned
from the pass itself: the soundings' own variogram, taken as the same in all directions, gives by
kriging the weights over the line of soundings and the variance at every distance from it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d

from perception.records import FloatArray


@dataclass(frozen=True, slots=True)
class Roughness:
    """Power-law variogram of the sea floor: half the mean square difference at lag h is ``scale h^power``.

    `scale` in m^2 at 1 m; `power` between 0.2 (white) and 1.9 (smooth).
    """

    scale: float
    power: float

    def variogram(self, lag_m: FloatArray) -> FloatArray:
        """Return the variogram (m^2) at `lag_m`."""
        return self.scale * np.power(np.maximum(lag_m, 1e-9), self.power)


# A floor at which the altimeter sees nothing still has ripples: 1 cm at 10 m.
LEAST_SCALE = 1e-5


def level_lines(
    floor_m: FloatArray, sigma_m: FloatArray, along_m: FloatArray, roughness: Roughness
) -> tuple[FloatArray, FloatArray]:
    """Adjust the overall height of every contour line at once, by least squares.

    Unknown is one height per line. Each line's own sounding is one observation; that consecutive lines
    differ by no more than the floor's roughness over their spacing is another. The normal
    equations are tridiagonal and are solved for all lines together, as the founding paper's adjustment
    of contour lines has it.

    Parameters
    ----------
    floor_m, sigma_m : (n,) height of each line's floor below the sonar, and its 1-sigma; NaN no sounding.
    along_m : (n,) place of the lines along the track, rising.
    roughness : of the floor.

    Returns
    -------
    height_m, sigma_m : (n,) levelled heights and their 1-sigma.
    """
    n = len(floor_m)
    known = np.isfinite(floor_m) & np.isfinite(sigma_m)
    if n == 0 or not known.any():
        return np.full(n, np.nan), np.full(n, np.nan)
    weight = np.where(known, 1 / np.square(np.maximum(np.where(known, sigma_m, 1.0), 1e-4)), 0.0)
    diagonal = weight.copy()
    off = np.zeros(n)
    if n > 1:
        link = 1 / np.maximum(2 * roughness.variogram(np.diff(along_m)), 1e-10)
        diagonal[:-1] += link
        diagonal[1:] += link
        off[1:] = -link
    right = weight * np.where(known, floor_m, 0.0)
    height = solveh_banded(np.vstack([off, diagonal]), right) if n > 1 else right / diagonal
    return height, np.sqrt(_inverse_diagonal(diagonal, off))


def _inverse_diagonal(diagonal: FloatArray, off: FloatArray) -> FloatArray:
    """Return the diagonal of the inverse of a symmetric tridiagonal matrix, by two recursions."""
    n = len(diagonal)
    forward, backward = diagonal.copy(), diagonal.copy()
    for i in range(1, n):
        forward[i] = diagonal[i] - off[i] ** 2 / forward[i - 1]
    for i in range(n - 2, -1, -1):
        backward[i] = diagonal[i] - off[i + 1] ** 2 / backward[i + 1]
    return 1 / (forward + backward - diagonal)


def learn_roughness(
    floor_m: FloatArray,
    sigma_m: FloatArray,
    along_m: FloatArray,
    reach_m: float,
    between_objects: bool = False,
) -> Roughness:
    """Learn the variogram from the soundings of a pass, their own noise taken off.

    Lags run from a few pings to `reach_m` or half the pass, evenly in their logarithm. `between_objects` learns
    it by medians: of most of the ground, whatever objects under the track or a cliff add.
    """
    half = half_median_square if between_objects else _half_square
    known = np.isfinite(floor_m)
    floor, along = floor_m[known], along_m[known]
    if len(floor) < 8 or np.ptp(along) <= 0:
        return Roughness(1e-3, 1.0)
    noise = float(np.median(np.square(sigma_m[known])))
    length = float(along[-1] - along[0])
    step = length / (len(along) - 1)
    even = np.interp(np.arange(along[0], along[-1], step), along, floor)
    top = min(max(reach_m, 4 * step), 0.5 * length)
    lags = np.unique(np.geomspace(1, max(2, top / step), 14).astype(int))
    lags = lags[lags < len(even)]
    values = np.array([half(even[k:] - even[:-k]) for k in lags])
    values = np.maximum(values - noise, 0.05 * values) + 1e-12
    counts = len(even) / lags
    # Far lags have few independent pairs; near ones are mostly noise.
    weights = np.sqrt(np.minimum(counts, 50) * values / (values + noise))
    if len(lags) < 2:
        return Roughness(max(values[0] / (lags[0] * step), LEAST_SCALE), 1.0)
    power, log_scale = np.polyfit(np.log(lags * step), np.log(values), 1, w=weights)
    power = float(np.clip(power, 0.2, 1.9))
    log_scale = float(np.average(np.log(values) - power * np.log(lags * step), weights=weights**2))
    return Roughness(max(float(np.exp(log_scale)), LEAST_SCALE), power)


def _half_square(differences: FloatArray) -> float:
    """Return half the mean square of differences: the mean of a plain and of a robust estimate.

    Few large differences are objects under the track, which the plain mean takes for rough floor, or the
    one ridge of the pass, which the robust estimate (Cressie & Hawkins 1980, by square roots) leaves
    out; the soundings alone do not tell which.
    """
    count = len(differences)
    root = float(np.mean(np.sqrt(np.abs(differences))))
    robust = 0.5 * root**4 / (0.457 + 0.494 / count)
    return 0.5 * (robust + 0.5 * float(np.mean(np.square(differences))))


def half_median_square(differences: FloatArray) -> float:
    """Return half the mean square that normal differences with this median size would have."""
    return 0.5 * float(np.median(np.abs(differences)) / 0.6745) ** 2


def floor_beside(
    height_m: FloatArray,
    sigma_m: FloatArray,
    along_m: FloatArray,
    distance_m: FloatArray,
    roughness: Roughness,
) -> tuple[FloatArray, FloatArray]:
    """Return the expected floor (n, d) at each distance beside the line, and its 1-sigma.

    Ordinary kriging from the line of soundings with a power variogram: weights depend on the place along
    the line over the distance only, so one set serves every distance, stretched.

    Parameters
    ----------
    height_m, sigma_m, along_m : (n,) levelled line.
    distance_m : (d,) distances to the side, not negative.
    """
    offsets, weights, unit_variance = _line_kriging(roughness.power)
    n = len(along_m)
    if n == 0 or len(distance_m) == 0:
        return np.empty((n, len(distance_m))), np.empty((n, len(distance_m)))
    step = max((along_m[-1] - along_m[0]) / max(n - 1, 1), 1e-6)
    even = np.arange(n) * step + along_m[0]
    line = np.interp(even, along_m, height_m)
    # A weight at a distance stands for a stretch of the line and not for one line of it: the line is
    # smoothed to the spacing of the weights. Few distances are worked out; between them all is smooth.
    worked = np.unique(
        np.concatenate([[0.0], np.geomspace(0.5 * step, distance_m.max() + step, 28)])
    )
    kept = np.empty((n, len(worked)))
    for j, distance in enumerate(worked):
        calm = gaussian_filter1d(
            line, max(0.25 * distance / step, 0.01), mode="nearest", truncate=3.0
        )
        at = along_m[:, None] + offsets * distance
        # Beyond the ends the line holds its last height.
        kept[:, j] = np.interp(at, even, calm) @ weights
    high = np.clip(np.searchsorted(worked, distance_m), 1, len(worked) - 1)
    part = (distance_m - worked[high - 1]) / (worked[high] - worked[high - 1])
    floor = kept[:, high - 1] * (1 - part) + kept[:, high] * part
    variance = roughness.scale * np.power(distance_m, roughness.power) * unit_variance
    return floor, np.sqrt(np.square(sigma_m)[:, None] + variance)


def _line_kriging(power: float) -> tuple[FloatArray, FloatArray, float]:
    """Return offsets along a line (in units of the distance), kriging weights, variance at distance 1."""
    offsets = np.sinh(np.linspace(-1.8, 1.8, 15))
    count = len(offsets)
    between = np.abs(offsets[:, None] - offsets) ** power
    to_point = np.hypot(offsets, 1.0) ** power
    matrix = np.ones((count + 1, count + 1))
    matrix[:count, :count], matrix[count, count] = between, 0.0
    solution = np.linalg.solve(matrix, np.append(to_point, 1.0))
    weights = solution[:count]
    # Kriging variance, in units of scale * distance^power (variogram, so once and not twice).
    return offsets, weights, float(weights @ to_point + solution[count])
