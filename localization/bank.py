"""The bank: one estimate from Kalman filters that differ in what no file tells.

The filters are weighed by the likelihood of their innovations (multiple-model adaptive estimation,
Magill 1965); the estimate is the mixture. What interpolation misses between the map's cells is alike
over about half a cell, so pings closer than that do not tell it anew: its variance is inflated by
the sum of an AR(1) sequence, ``coth(way / (2 * reach))``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from localization.hypotheses import Hypothesis, hypotheses
from localization.kalman import NO_FIT, OUTSIDE, Fit, TerrainKalman, way_of
from localization.likelihood import shared_between_m2
from localization.measurements import Soundings
from localization.terrain import TerrainMap
from localization.view import View
from perception.records import FloatArray

# Evidence is forgotten over a thousand updates, so that a change can be followed in time.
_MEMORY = 0.999
# No member is the truth, and what they all leave out repeats from ping to ping: evidence counts half.
_TEMPER = 0.5
# Every so many updates, filters of less weight than this are let go.
_TRIAL, _HOPELESS = 100, 1e-3


class KalmanBank:
    """The bank: `start`, then `see`, `predict` and `update` for every row."""

    def __init__(
        self, terrain: TerrainMap, walk_m_sqrt_h: float | None, tide_m_sqrt_h: float, beams: int
    ) -> None:
        self.terrain = terrain
        self.assumed = hypotheses(terrain, walk_m_sqrt_h)
        self.tide_m2_s = tide_m_sqrt_h**2 / 3600.0
        # Footprints of the beams from the vehicle, as last seen; far apart until then.
        self.places_m: FloatArray = 1e6 * np.arange(2.0 * beams).reshape(beams, 2)
        self.heading_m: FloatArray = np.array([0.0, 1.0])
        self.filters: list[TerrainKalman] = []
        self.log_weight: FloatArray = np.zeros(0)
        self.way_m = 0.0
        self.updates = 0

    def see(self, soundings: Soundings) -> None:
        """Take notice of where the beams strike."""
        self.places_m[soundings.beam] = np.stack([soundings.east_m, soundings.north_m], axis=1)

    def start(self, mean: FloatArray, covariance: FloatArray) -> None:
        """Begin tracking from a Gaussian of (east, north, turn, scale, depth bias)."""
        alike = self._alike()
        self.filters = [TerrainKalman(h, mean, covariance, alike[h.length_m]) for h in self.assumed]
        self.log_weight = np.log([h.weight for h in self.assumed])
        self.way_m, self.updates = 0.0, 0

    def predict(self, step_e: float, step_n: float, seconds: float, slip_m2: float = 0.0) -> None:
        """Carry every filter over a dead-reckoned step; `slip_m2` is variance beyond the walk."""
        way = math.hypot(step_e, step_n)
        self.way_m += way
        if way > 0:
            self.heading_m = np.array([step_e, step_n]) / way
        ways = {
            length: way_of(step_e, step_n, length, alike) for length, alike in self._alike().items()
        }
        for f in self.filters:
            f.predict(ways[f.assumed.length_m], seconds, self.tide_m2_s * seconds, slip_m2)

    def shift(self, jump: FloatArray) -> None:
        """Move every offset: the dead-reckoned position jumped."""
        for f in self.filters:
            f.filter.x[:2] += jump

    def readings(self) -> set[int]:
        """Return the readings of the map that filters still use."""
        return {f.assumed.reading for f in self.filters}

    def update(self, views: Mapping[int, View]) -> Fit:
        """Correct every filter; return the fit of the likeliest, with the bank's log likelihood.

        Parameters
        ----------
        views : the soundings over each of `readings`.
        """
        if not all(len(view.height_m) for view in views.values()):
            return NO_FIT
        between = shared_between_m2(self.terrain, self.way_m)
        self.way_m = 0.0
        fits = [f.update(views[f.assumed.reading], between) for f in self.filters]
        best = fits[int(np.argmax(self.log_weight))]
        if best.common_step_m:
            for f in self.filters:
                f.loosen_depth(best.common_step_m)
            return best
        prior = np.log([f.assumed.weight for f in self.filters])
        # Forgetting pulls towards the prior weights, never below one part in e^12.
        weight = _MEMORY * self.log_weight + (1 - _MEMORY) * prior
        weight -= np.logaddexp.reduce(weight)
        weight += _TEMPER * np.array([fit.log_likelihood for fit in fits])
        total = float(np.logaddexp.reduce(weight))
        self.log_weight = np.maximum(weight - total, -12.0)
        self.updates += 1
        if self.updates % _TRIAL == 0:
            self._let_go()
        return replace(best, log_likelihood=total)

    def fuse(self, offset_m: FloatArray, covariance_m2: FloatArray) -> bool:
        """Correct every filter by an outside fix (2,) of the offset; False where it contradicts."""
        mean, covariance = self.moments()
        apart = offset_m - mean[:2]
        if apart @ np.linalg.solve(covariance[:2, :2] + covariance_m2, apart) > OUTSIDE**2:
            return False
        for f in self.filters:
            h = np.eye(2, 5 + f.beams)
            at = f.filter.x[:2].copy()
            f.filter.update(offset_m, lambda x, h=h: h, lambda x, at=at: at, R=covariance_m2)
        return True

    def walk_m2_s(self) -> float:
        """Return the random walk's variance per second, averaged over the bank."""
        return float(self._weights() @ [f.assumed.walk_m2_s for f in self.filters])

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
        return self.filters[int(np.argmax(self.log_weight))].assumed

    def keep(self, chosen: list[int]) -> None:
        """Keep the filters of these indices only."""
        self.filters = [self.filters[i] for i in chosen]
        self.log_weight = self.log_weight[chosen]

    def _weights(self) -> FloatArray:
        weight = np.exp(self.log_weight - self.log_weight.max())
        share: FloatArray = weight / weight.sum()
        return share

    def _let_go(self) -> None:
        """Drop what the soundings have refuted, but of the likeliest length every random walk.

        The map's error and the ranges' noise do not change during a mission; currents do.
        """
        best, weight = self.likeliest(), self._weights()
        chosen = [
            i
            for i, f in enumerate(self.filters)
            if weight[i] > _HOPELESS
            or replace(f.assumed, walk_m2_s=best.walk_m2_s, weight=best.weight) == best
        ]
        self.keep(chosen)

    def _alike(self) -> dict[float, FloatArray]:
        """Covariance (beams, beams) of the map's error between beams, for each length assumed.

        A Janus' aft beams strike the very line that its fore beams struck before: what the map errs
        there is met twice, but the filter's process takes it for new. So the variance of a beam is
        multiplied by the number of beams that follow the same line, which makes the two looks
        together worth the one that they are.
        """
        apart = self.places_m[:, None] - self.places_m
        distance = np.hypot(apart[..., 0], apart[..., 1])
        aside = np.abs(apart[..., 0] * self.heading_m[1] - apart[..., 1] * self.heading_m[0])
        out = {}
        for length in {h.length_m for h in self.assumed}:
            near = np.exp(-distance / length)
            looks = np.sqrt(np.sum(near + np.exp(-aside / length) * (1 - near), axis=1))
            # Beams at one spot and time are one look: counted among `near`, not here.
            looks = np.maximum(looks / np.sqrt(np.sum(near, axis=1)), 1.0)
            out[length] = near * looks[:, None] * looks
        return out
