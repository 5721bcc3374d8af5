"""One Kalman filter that tracks after convergence, under one hypothesis of what no file tells.

State: offset of the true position from dead reckoning (east, north), heading bias, scale, depth bias,
and for each beam the map's error under it, a Gauss-Markov process over the way travelled. Carrying
the map's error as state is what keeps the covariance honest when the error is correlated: the
filter knows that the next sounding shares it.

The terrain is linearised statistically (`terrain.linearise`), over the filter's own uncertainty. The
bank of such filters is in `localization.bank`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from localization.hypotheses import Hypothesis
from localization.likelihood import GATE
from localization.view import DEPTH, EAST, NORTH, SCALE, TURN, View
from perception.records import BoolArray, FloatArray, IntArray

# More beams than this and the map's error is inflated instead of carried for each.
_MOST_BEAMS = 8
# A residual this many sigmas out is not used: with Gaussian noise one in 16,000.
OUTSIDE = 4.0
# Heading bias and scale wander with the position: radians and parts of 1 for each metre of its walk.
_TURN_PER_WALK = float(np.radians(0.015))
_SCALE_PER_WALK = 2e-4


@dataclass(frozen=True, slots=True)
class Fit:
    """How an update's soundings fitted the prediction.

    Attributes
    ----------
    normalised : (n,) residual over its predicted sigma, every sounding that met the map.
    used : (n,) inside the gate.
    beam : (n,) index of the beam.
    common_step_m : shift of all soundings together that would make them fit, 0 if there is none.
    log_likelihood : of the soundings used.
    """

    normalised: FloatArray
    used: BoolArray
    beam: IntArray
    common_step_m: float
    log_likelihood: float


NO_FIT = Fit(np.zeros(0), np.zeros(0, bool), np.zeros(0, np.int64), 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Way:
    """A dead-reckoned step, as all filters of one correlation length take it.

    `transition` is the state's; `keep` the part of the map's error that stays; `alike` (beams, beams)
    the covariance of its error between the beams, of unit variance.
    """

    transition: FloatArray
    keep: float
    alike: FloatArray


def way_of(step_e: float, step_n: float, length_m: float, alike: FloatArray) -> Way:
    """Return what a step does to a state whose map error is alike over `length_m`."""
    beams = carried(len(alike))
    keep = math.exp(-math.hypot(step_e, step_n) / length_m)
    f = np.eye(5 + beams)
    f[EAST, SCALE], f[EAST, TURN] = step_e, step_n
    f[NORTH, SCALE], f[NORTH, TURN] = step_n, -step_e
    f[5:, 5:] *= keep
    return Way(f, keep, alike)


def carried(beams: int) -> int:
    """Return the number of beams whose map error is a state: all, or none of too many."""
    return beams if beams <= _MOST_BEAMS else 0


class TerrainKalman:
    """One filterpy extended Kalman filter under one hypothesis.

    Parameters
    ----------
    mean, covariance : (5,) and (5, 5) of east, north, turn, scale and depth bias.
    alike : (beams, beams) covariance of the map's error between the beams, of unit variance.
    """

    def __init__(
        self,
        hypothesis: Hypothesis,
        mean: FloatArray,
        covariance: FloatArray,
        alike: FloatArray,
    ) -> None:
        self.assumed = hypothesis
        self.beams = carried(len(alike))
        size = 5 + self.beams
        self.filter = ExtendedKalmanFilter(dim_x=size, dim_z=1)
        self.filter.x = np.concatenate([mean, np.zeros(self.beams)])
        self.filter.P = np.zeros((size, size))
        self.filter.P[:5, :5] = covariance
        if self.beams:
            self.filter.P[5:, 5:] = hypothesis.shared_m**2 * alike

    def take(self, x: FloatArray, p: FloatArray) -> None:
        """Take another state and covariance, all components."""
        self.filter.x, self.filter.P = x.copy(), p.copy()

    @property
    def mean(self) -> FloatArray:
        """Mean (5,) of east, north, turn, scale and depth bias."""
        x: FloatArray = self.filter.x[:5]
        return x

    @property
    def covariance(self) -> FloatArray:
        """Covariance (5, 5) of the same."""
        p: FloatArray = self.filter.P[:5, :5]
        return p

    def predict(self, way: Way, seconds: float, tide_m2: float, slip_m2: float = 0.0) -> None:
        """Carry the state over a dead-reckoned step.

        Parameters
        ----------
        way : the step under this filter's correlation length.
        tide_m2, slip_m2 : variance that depth bias and position gain, beyond the walk.
        """
        size = 5 + self.beams
        q = np.zeros((size, size))
        walk = self.assumed.walk_m2_s * seconds
        q[EAST, EAST] = q[NORTH, NORTH] = walk
        q[TURN, TURN] = _TURN_PER_WALK**2 * walk
        q[SCALE, SCALE] = _SCALE_PER_WALK**2 * walk
        q[DEPTH, DEPTH] = tide_m2
        if self.beams:
            # Beams side by side share the map's error as successive pings do.
            q[5:, 5:] = (1 - way.keep**2) * self.assumed.shared_m**2 * way.alike
        self.filter.F, self.filter.Q = way.transition, q
        self.filter.predict()
        if slip_m2:
            self.filter.P[:2, :2] += slip_m2 * np.eye(2)

    def update(self, view: View, between_m2: float) -> Fit:
        """Correct the state by an update's soundings; wild ones are left out.

        Parameters
        ----------
        between_m2 : variance of what interpolation between the map's cells misses.
        """
        ekf = self.filter
        # Too many beams to carry: all that share a place count as one.
        crowd = 0.0 if self.beams else self.assumed.shared_m**2 * max(len(view.height_m), 1)
        predicted, jacobian, noise, variance = _predicted(
            ekf.x, ekf.P, view.centre, view.height_m, view.jacobian, view.range_m2, view.left_m2,
            view.beam, self.assumed.noise_factor**2, crowd + between_m2,
        )  # fmt: skip
        innovation = view.elevation_m - predicted
        normalised = innovation / np.sqrt(variance)
        used = np.abs(normalised) < OUTSIDE
        step = wild = 0.0
        if not used.all():
            step = _common_step(innovation, np.sqrt(variance), used)
            wild = _cost_of_wild(variance[~used])
            if not used.any():
                return Fit(normalised, used, view.beam, step, wild)
        h, hx = jacobian[used], predicted[used]
        ekf.update(view.elevation_m[used], lambda x: h, lambda x: hx, R=np.diag(noise[used]))
        fit = -0.5 * (float(ekf.y @ ekf.SI @ ekf.y) + _log_determinant(ekf.S))
        return Fit(normalised, used, view.beam, step, fit + wild)

    def loosen_depth(self, step_m: float) -> None:
        """Let the depth bias move by a step: a sensor was reset, or ballast shifted."""
        self.filter.P[DEPTH, :] = 0.0
        self.filter.P[:, DEPTH] = 0.0
        self.filter.P[DEPTH, DEPTH] = step_m**2


def _cost_of_wild(variance: FloatArray) -> float:
    """Log likelihood of soundings outside the gate, whatever they read; see `likelihood`."""
    return float(-0.5 * np.sum(GATE**2 + np.log(variance)))


def _common_step(innovation: FloatArray, sigma: FloatArray, used: BoolArray) -> float:
    """Return the shift that explains an update in which most soundings fail together, or 0."""
    failed = ~used
    if failed.sum() < 3 or failed.sum() < 0.75 * len(used):
        return 0.0
    shift = float(np.median(innovation))
    agree = np.abs(innovation - shift) < 3.0 * sigma
    return shift if agree.sum() >= 3 and agree.mean() >= 0.75 else 0.0


@numba.njit(cache=True)
def _predicted(x, p, centre, height, slopes, range_m2, left_m2, beam, noisier, more_m2):  # type: ignore[no-untyped-def]
    """Predict the elevations of an update's soundings.

    Returns
    -------
    elevations (n,), Jacobian (n, size), noise variances (n,), and variances with the state's own (n,)
    """
    n, size = height.size, x.size
    predicted = np.empty(n)
    noise = np.empty(n)
    variance = np.empty(n)
    jacobian = np.zeros((n, size))
    for i in range(n):
        predicted[i] = height[i]
        for a in range(5):
            jacobian[i, a] = slopes[i, a]
            # The depth bias enters whole; the rest by how far this filter is from the view's centre.
            apart = x[a] if a == DEPTH else x[a] - centre[a]
            predicted[i] += slopes[i, a] * apart
        if size > 5:
            jacobian[i, 5 + beam[i]] = 1.0
            predicted[i] += x[5 + beam[i]]
        noise[i] = noisier * range_m2[i] + left_m2[i] + more_m2
        variance[i] = noise[i]
        for a in range(size):
            for b in range(size):
                variance[i] += jacobian[i, a] * p[a, b] * jacobian[i, b]
    return predicted, jacobian, noise, variance


@numba.njit(cache=True)
def _log_determinant(s):  # type: ignore[no-untyped-def]
    """Logarithm of the determinant of a positive definite (n, n), by elimination."""
    a = s.copy()
    n = len(a)
    total = 0.0
    for k in range(n):
        total += np.log(a[k, k])
        for i in range(k + 1, n):
            part = a[i, k] / a[k, k]
            for j in range(k + 1, n):
                a[i, j] -= part * a[k, j]
    return total
