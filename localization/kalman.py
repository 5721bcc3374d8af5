"""One Kalman filter that tracks after convergence, under one hypothesis of what no file tells.

State: offset of the true position from dead reckoning (east, north), heading bias, scale, depth bias,
and for each beam the map's error under it, a Gauss-Markov process over the way travelled. Carrying
the map's error as state is what keeps the covariance honest when the error is correlated: the
filter knows that the next sounding shares it.

The terrain is linearised statistically (`terrain.linearise`), over the filter's own uncertainty. The
bank of such filters is in `localization.bank`.
"""

from __future__ import annotations

from dataclasses import dataclass

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
        beams = len(alike)
        self.beams = beams if beams <= _MOST_BEAMS else 0
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

    def predict(
        self, step_e: float, step_n: float, seconds: float, tide_m2: float, alike: FloatArray
    ) -> None:
        """Carry the state over a dead-reckoned step; `alike` as at the start, of the beams now."""
        size = 5 + self.beams
        keep = np.exp(-float(np.hypot(step_e, step_n)) / self.assumed.length_m)
        f = np.eye(size)
        f[EAST, SCALE], f[EAST, TURN] = step_e, step_n
        f[NORTH, SCALE], f[NORTH, TURN] = step_n, -step_e
        f[5:, 5:] *= keep
        q = np.zeros((size, size))
        walk = self.assumed.walk_m2_s * seconds
        q[EAST, EAST] = q[NORTH, NORTH] = walk
        q[TURN, TURN] = _TURN_PER_WALK**2 * walk
        q[SCALE, SCALE] = _SCALE_PER_WALK**2 * walk
        q[DEPTH, DEPTH] = tide_m2
        if self.beams:
            # Beams side by side share the map's error as successive pings do.
            q[5:, 5:] = (1 - keep**2) * self.assumed.shared_m**2 * alike
        self.filter.F, self.filter.Q = f, q
        self.filter.predict()

    def update(self, view: View, between_m2: float) -> Fit:
        """Correct the state by an update's soundings; wild ones are left out.

        Parameters
        ----------
        between_m2 : variance of what interpolation between the map's cells misses.
        """
        predicted, jacobian, noise = self._model(view)
        noise = noise + between_m2
        innovation = view.elevation_m - predicted
        across = jacobian @ self.filter.P @ jacobian.T
        variance = across.diagonal() + noise
        normalised = innovation / np.sqrt(variance)
        used = np.abs(normalised) < OUTSIDE
        step = _common_step(innovation, np.sqrt(variance), used)
        wild = _cost_of_wild(variance[~used])
        if not used.any():
            return Fit(normalised, used, view.beam, step, wild)
        h, hx = jacobian[used], predicted[used]
        self.filter.update(
            view.elevation_m[used], lambda x: h, lambda x: hx, R=np.diag(noise[used])
        )
        y, inverse = self.filter.y, self.filter.SI
        fit = -0.5 * (float(y @ inverse @ y) + float(np.linalg.slogdet(self.filter.S)[1]))
        return Fit(normalised, used, view.beam, step, fit + wild)

    def loosen_depth(self, step_m: float) -> None:
        """Let the depth bias move by a step: a sensor was reset, or ballast shifted."""
        self.filter.P[DEPTH, :] = 0.0
        self.filter.P[:, DEPTH] = 0.0
        self.filter.P[DEPTH, DEPTH] = step_m**2

    def _model(self, view: View) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Predicted elevations, Jacobian and variances of the soundings."""
        n = len(view.height_m)
        jacobian = np.zeros((n, 5 + self.beams))
        jacobian[:, :5] = view.jacobian
        x = self.filter.x
        # The depth bias enters whole; the rest by how far this filter is from the view's centre.
        apart = x[:5] - view.centre
        apart[DEPTH] = x[DEPTH]
        predicted = view.height_m + view.jacobian @ apart
        noise = self.assumed.noise_factor**2 * view.range_m2 + view.left_m2
        if self.beams:
            jacobian[np.arange(n), 5 + view.beam] = 1.0
            predicted = predicted + x[5 + view.beam]
        else:
            # Too many beams to carry: all that share a place count as one.
            noise = noise + self.assumed.shared_m**2 * max(n, 1)
        return predicted, jacobian, noise


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
