"""Evidence for a match: does the map explain the soundings better than no map would?

Counting updates that fit proves little: over smooth ground a short track fits in many places, and on
a wrong map in some. So two predictions of every new sounding are compared, both by ordinary kriging
(Matheron 1963) from the last soundings of all beams:

- *free ground* predicts the elevation itself, knowing only how rough the ground is: the covariance
  ``s^2 exp(-(d / L)^p)`` fitted to the map;
- *the map* predicts what is left after subtracting it, which should be as small and as smooth as the
  map's error is said to be.

The log of the likelihood ratio is the evidence: high proves the match, low refutes it, and where
ground or map tell nothing it stays about zero.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from localization.hypotheses import Hypothesis
from localization.likelihood import GATE
from localization.terrain import TerrainMap
from localization.view import View
from perception.records import BoolArray, FloatArray

# Soundings remembered: twelve pings of four beams reach back to where the aft beams repeat the fore.
_MEMORY = 48
# After this many updates that fit nothing remembered, the memory is what is wrong.
_MOST_MISSES = 4
# Beams of one update that are compared: a multibeam's are thinned to bound the time.
_MOST_BEAMS = 8


class Evidence:
    """Log likelihood ratio, update by update, of the map against free ground.

    Parameters
    ----------
    terrain : the map; its roughness describes the rival.
    """

    def __init__(self, terrain: TerrainMap) -> None:
        self.covariance = fitted_covariance(*terrain.structure)
        self.between_m2 = terrain.error.between_m**2
        self.reset()

    def reset(self) -> None:
        """Forget the soundings: the depth sensor stepped, or another place is tried."""
        # Columns: easting, northing, elevation, elevation less map, variances of the two.
        self.known: FloatArray = np.zeros((0, 6))
        self.misses = 0

    def update(self, view: View, assumed: Hypothesis) -> float:
        """Return the evidence gained by an update's soundings, and learn them.

        Parameters
        ----------
        view : the soundings over the map, from the match before this update.
        assumed : what the match assumes of noise and map error; the rival is granted its noise.
        """
        noise = assumed.noise_factor**2 * view.range_m2
        new = np.stack(
            [
                view.east_m,
                view.north_m,
                view.elevation_m,
                view.elevation_m - view.height_m,
                noise,
                noise + view.unplaced_m2 + view.left_m2 + self.between_m2,
            ],
            axis=1,
        )
        every = max(1, math.ceil(len(new) / _MOST_BEAMS))
        new = new[::every]
        gained = 0.0
        if len(self.known) >= 2 and len(new):
            free, fits_free = self._log_likelihood(new, 2, self.covariance)
            # What the map shows bounds its error: it can be no rougher than map and terrain are.
            shared = (max(assumed.shared_m**2, 1e-6), assumed.length_m, self.covariance[2])
            mapped, fits_map = self._log_likelihood(new, 3, shared)
            gained = every * (mapped - free)
            new = self._believable(new, fits_free | fits_map)
        self.known = np.concatenate([self.known, new])[-_MEMORY:]
        return gained

    def _believable(self, new: FloatArray, fits: BoolArray) -> FloatArray:
        """Keep wild beams from becoming what the next are predicted from; begin anew after many."""
        self.misses = 0 if fits.mean() >= 0.5 else self.misses + 1
        if self.misses < _MOST_MISSES:
            return new[fits]
        self.reset()
        return new

    def _log_likelihood(
        self, new: FloatArray, column: int, covariance: tuple[float, float, float]
    ) -> tuple[float, BoolArray]:
        """Log likelihood of column 2 or 3 of the new soundings, and which fit."""
        old = self.known
        predicted, spread = krige(
            old[:, :2], old[:, column], old[:, column + 2], new[:, :2], covariance
        )
        spread = spread + np.diag(new[:, column + 2])
        innovation = new[:, column] - predicted
        variance = np.diag(spread)
        inside = innovation**2 < GATE**2 * variance
        # A wild beam costs both sides the same.
        total = -0.5 * float(np.sum(GATE**2 + np.log(new[~inside, 4])))
        if inside.any():
            core, y = spread[np.ix_(inside, inside)], innovation[inside]
            total -= 0.5 * float(y @ np.linalg.solve(core, y) + np.linalg.slogdet(core)[1])
        return total, inside


def krige(
    known_m: FloatArray,
    values: FloatArray,
    variances: FloatArray,
    places_m: FloatArray,
    covariance: tuple[float, float, float],
) -> tuple[FloatArray, FloatArray]:
    """Predict values (n,) and their covariance (n, n) at `places_m` by ordinary kriging.

    Parameters
    ----------
    known_m, values, variances : (m, 2) places, (m,) values there and their noise.
    places_m : (n, 2).
    covariance : sill, length and power of ``sill exp(-(d / length)^power)``.
    """
    sill, length, power = covariance
    c = _correlations(np.concatenate([known_m, places_m]), length, power) * sill
    m = len(known_m)
    # A millionth of the sill keeps smooth covariances (power near 2) from being singular.
    old = c[:m, :m] + np.diag(variances + 1e-6 * sill + 1e-9)
    solved = np.linalg.solve(old, np.concatenate([c[:m, m:], np.ones((m, 1))], axis=1))
    weights, ones = solved[:, :-1], solved[:, -1]
    total = ones.sum()
    mean = ones @ values / total
    lack = 1.0 - ones @ c[:m, m:]
    predicted = mean + weights.T @ (values - mean)
    left = c[m:, m:] - c[m:, :m] @ weights + np.outer(lack, lack) / total
    return predicted, left


@numba.njit(cache=True)
def _correlations(places_m, length_m, power):  # type: ignore[no-untyped-def]
    """``exp(-(d / length)^power)`` between (n, 2) places, (n, n)."""
    n = len(places_m)
    out = np.ones((n, n))
    for i in range(n):
        for j in range(i):
            apart = np.hypot(places_m[i, 0] - places_m[j, 0], places_m[i, 1] - places_m[j, 1])
            out[i, j] = out[j, i] = np.exp(-((apart / length_m) ** power))
    return out


def fitted_covariance(lags_m: FloatArray, squares_m2: FloatArray) -> tuple[float, float, float]:
    """Fit sill (m^2), length (m) and power to a structure function D = 2 s^2 (1 - exp(-(d/L)^p)).

    Powers up to 2 give a valid covariance; at 2 itself the matrices are singular in all but name.
    """
    sill = max(float(squares_m2.max()) * 0.75, 1e-6)
    share = np.clip(squares_m2 / (2 * sill), 1e-9, 0.95)
    # log(-log(1 - D / 2 s^2)) = p log d - p log L is a line; the short lags are what predicts.
    near = slice(0, max(min(len(lags_m), 5), 2))
    x, y = np.log(lags_m[near]), np.log(-np.log1p(-share[near]))
    if len(x) < 2:
        return sill, float(lags_m[0]) * 10, 1.5
    power = float(np.clip(np.polyfit(x, y, 1)[0], 0.5, 1.9))
    return sill, float(np.exp(np.mean(x) - np.mean(y) / power)), power
