"""Kalman tracking after convergence: a bank of filterpy filters that differ in what is not known.

State: offset of the true position from dead reckoning (east, north), heading bias, scale, depth bias,
and for each beam the map's error under it, a Gauss-Markov process over the way travelled. Carrying
the map's error as state is what keeps the covariance honest when the error is correlated: the
filter knows that the next sounding shares it.

Two things no file tells: the correlation length of the map's error, and how far dead reckoning
wanders at random. The bank holds one filter for each of a few values and weighs them by the
likelihood of their innovations (multiple-model adaptive estimation, Magill 1965); the estimate is
the mixture.

The terrain is linearised statistically (`terrain.linearise`), over the filter's own uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from localization.likelihood import DEFAULT_LENGTH_M, GATE
from localization.measurements import Soundings
from localization.terrain import TerrainMap
from localization.view import DEPTH, EAST, NORTH, SCALE, TURN, View
from perception.records import BoolArray, FloatArray, IntArray

# Random walks of dead reckoning to choose among, m per square root of an hour, and their prior
# weights: from errors that are constant, as nav.csv's defaults have them, to a vehicle that slips or
# drifts with unmeasured currents.
_WALKS_M_SQRT_H = {0.1: 0.6, 0.7: 0.15, 4.0: 0.1, 25.0: 0.15}
# Correlation lengths to choose among beside the split that the map's spectrum suggests.
_LENGTHS_M = (30.0, 150.0)
_USUAL_WALK_M_SQRT_H = 0.7
# Ranges may be noisier than stated: half the bank's members for it, at this factor.
_NOISIER = 2.0
# More beams than this and the map's error is inflated instead of carried for each.
_MOST_BEAMS = 8
# A residual this many sigmas out is not used: with Gaussian noise one in 16,000.
_GATE = 4.0
# Evidence is forgotten over a thousand updates, so that a change can be followed in time.
_MEMORY = 0.999
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
class Hypothesis:
    """What one filter of the bank assumes."""

    walk_m2_s: float
    shared_m: float
    length_m: float
    white_m2: float
    noise_factor: float
    weight: float


def hypotheses(terrain: TerrainMap, walk_m_sqrt_h: float | None) -> list[Hypothesis]:
    """List the assumptions of the bank for a map and, where it is known, a random walk."""
    error = terrain.error
    between = error.between_m**2
    if error.correlated_m > error.filtered_m:
        length = error.length_m if np.isfinite(error.length_m) else DEFAULT_LENGTH_M
        split = (float(np.hypot(error.filtered_m, error.correlated_m)), length, between)
    else:
        split = (error.filtered_m, error.filtered_length_m, between + error.correlated_m**2)
    walks = _WALKS_M_SQRT_H if walk_m_sqrt_h is None else {walk_m_sqrt_h: 1.0}
    usual = _USUAL_WALK_M_SQRT_H if walk_m_sqrt_h is None else walk_m_sqrt_h
    members = [(walk, *split, 1.0, 0.6 * prior) for walk, prior in walks.items()]
    members += [(walk, *split, _NOISIER, 0.1 * prior) for walk, prior in walks.items()]
    if not np.isfinite(error.length_m):
        members += [(usual, error.stated_m, reach, between, 1.0, 0.15) for reach in _LENGTHS_M]
    return [
        Hypothesis(walk**2 / 3600.0, shared, reach, white, noise, weight)
        for walk, shared, reach, white, noise, weight in members
    ]


class TerrainKalman:
    """One filterpy extended Kalman filter under one hypothesis."""

    def __init__(
        self,
        hypothesis: Hypothesis,
        mean: FloatArray,
        covariance: FloatArray,
        apart_m: FloatArray,
    ) -> None:
        self.assumed = hypothesis
        beams = len(apart_m)
        self.beams = beams if beams <= _MOST_BEAMS else 0
        size = 5 + self.beams
        self.filter = ExtendedKalmanFilter(dim_x=size, dim_z=1)
        self.filter.x = np.concatenate([mean, np.zeros(self.beams)])
        self.filter.P = np.zeros((size, size))
        self.filter.P[:5, :5] = covariance
        if self.beams:
            self.filter.P[5:, 5:] = hypothesis.shared_m**2 * np.exp(-apart_m / hypothesis.length_m)

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
        self, step_e: float, step_n: float, seconds: float, tide_m2: float, apart_m: FloatArray
    ) -> None:
        """Carry the state over a dead-reckoned step; `apart_m` (beams, beams) is between footprints."""
        size = 5 + self.beams
        way = float(np.hypot(step_e, step_n))
        keep = np.exp(-way / self.assumed.length_m)
        f = np.eye(size)
        f[EAST, SCALE], f[EAST, TURN] = step_e, step_n
        f[NORTH, SCALE], f[NORTH, TURN] = step_n, -step_e
        f[5:, 5:] *= keep
        q = np.zeros((size, size))
        q[EAST, EAST] = q[NORTH, NORTH] = self.assumed.walk_m2_s * seconds
        q[TURN, TURN] = _TURN_PER_WALK**2 * self.assumed.walk_m2_s * seconds
        q[SCALE, SCALE] = _SCALE_PER_WALK**2 * self.assumed.walk_m2_s * seconds
        q[DEPTH, DEPTH] = tide_m2
        if self.beams:
            # Beams side by side share the map's error as successive pings do.
            alike = np.exp(-apart_m / self.assumed.length_m)
            q[5:, 5:] = (1 - keep**2) * self.assumed.shared_m**2 * alike
        self.filter.F, self.filter.Q = f, q
        self.filter.predict()

    def update(self, view: View) -> Fit:
        """Correct the state by an update's soundings; wild ones are left out."""
        predicted, jacobian, noise = self._model(view)
        innovation = view.elevation_m - predicted
        across = jacobian @ self.filter.P @ jacobian.T
        variance = across.diagonal() + noise
        normalised = innovation / np.sqrt(variance)
        used = np.abs(normalised) < _GATE
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
        noise = self.assumed.noise_factor**2 * view.range_m2 + self.assumed.white_m2 + view.left_m2
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


class KalmanBank:
    """The bank: one estimate from several hypotheses, weighed by their evidence."""

    def __init__(
        self, terrain: TerrainMap, walk_m_sqrt_h: float | None, tide_m_sqrt_h: float, beams: int
    ) -> None:
        self.assumed = hypotheses(terrain, walk_m_sqrt_h)
        self.tide_m2_s = tide_m_sqrt_h**2 / 3600.0
        # Distances between the beams' footprints as last seen; far apart until then.
        self.apart_m: FloatArray = np.where(np.eye(beams) > 0, 0.0, 1e6)
        self.filters: list[TerrainKalman] = []
        self.log_weight: FloatArray = np.zeros(0)

    def see(self, soundings: Soundings) -> None:
        """Take notice of how far apart the beams strike."""
        beam = soundings.beam
        self.apart_m[np.ix_(beam, beam)] = np.hypot(
            soundings.east_m[:, None] - soundings.east_m,
            soundings.north_m[:, None] - soundings.north_m,
        )

    def start(self, mean: FloatArray, covariance: FloatArray) -> None:
        """Begin tracking from a Gaussian of (east, north, turn, scale, depth bias)."""
        self.filters = [TerrainKalman(h, mean, covariance, self.apart_m) for h in self.assumed]
        self.log_weight = np.log([h.weight for h in self.assumed])

    def predict(self, step_e: float, step_n: float, seconds: float, slip_m2: float = 0.0) -> None:
        """Carry every filter over a dead-reckoned step; `slip_m2` is variance beyond the walk."""
        for f in self.filters:
            f.predict(step_e, step_n, seconds, self.tide_m2_s * seconds, self.apart_m)
            f.filter.P[:2, :2] += slip_m2 * np.eye(2)

    def shift(self, jump: FloatArray) -> None:
        """Move every offset: the dead-reckoned position jumped."""
        for f in self.filters:
            f.filter.x[:2] += jump

    def update(self, view: View) -> Fit:
        """Correct every filter; return the fit of the likeliest, with the bank's log likelihood."""
        if not len(view.height_m):
            return NO_FIT
        fits = [f.update(view) for f in self.filters]
        best = fits[int(np.argmax(self.log_weight))]
        if best.common_step_m:
            for f in self.filters:
                f.loosen_depth(best.common_step_m)
            return best
        prior = np.log([h.weight for h in self.assumed])
        # Forgetting pulls towards the prior weights, never below one part in e^12.
        weight = _MEMORY * self.log_weight + (1 - _MEMORY) * prior
        weight -= np.logaddexp.reduce(weight)
        weight += [fit.log_likelihood for fit in fits]
        total = float(np.logaddexp.reduce(weight))
        self.log_weight = np.maximum(weight - total, -12.0)
        return replace(best, log_likelihood=total)

    def fuse(self, offset_m: FloatArray, covariance_m2: FloatArray) -> bool:
        """Correct every filter by an outside fix (2,) of the offset; False where it contradicts."""
        mean, covariance = self.moments()
        apart = offset_m - mean[:2]
        if apart @ np.linalg.solve(covariance[:2, :2] + covariance_m2, apart) > _GATE**2:
            return False
        for f in self.filters:
            h = np.eye(2, 5 + f.beams)
            at = f.filter.x[:2].copy()
            f.filter.update(offset_m, lambda x, h=h: h, lambda x, at=at: at, R=covariance_m2)
        return True

    def walk_m2_s(self) -> float:
        """Return the random walk's variance per second, averaged over the bank."""
        return float(self._weights() @ [h.walk_m2_s for h in self.assumed])

    def _weights(self) -> FloatArray:
        weight = np.exp(self.log_weight - self.log_weight.max())
        share: FloatArray = weight / weight.sum()
        return share

    def moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean (5,) and covariance (5, 5) of the mixture."""
        weight = self._weights()
        means = np.array([f.mean for f in self.filters])
        mean = weight @ means
        apart = means - mean
        covariance = np.einsum("k,kij->ij", weight, [f.covariance for f in self.filters])
        return mean, covariance + np.einsum("k,ki,kj->ij", weight, apart, apart)

    def likeliest(self) -> Hypothesis:
        """Return the assumption with the most evidence."""
        return self.assumed[int(np.argmax(self.log_weight))]
