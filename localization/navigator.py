"""The navigator: one measurement in, one position out, with covariance, status and protection level.

    dead reckoning -> particle search -> Kalman bank, on probation -> converged
                          ^              search anew as witness           |
                          '---- lost: health failed, from the last trusted state, a wider box

While a place is on probation the search, begun anew, is its witness (`localization.witness`).

Positions are dead-reckoned positions plus an estimated offset, so a late or repeated row costs
nothing: it is answered with the offset of the moment.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np

from localization.bank import KalmanBank
from localization.estimate import CONVERGED, LOST, RECKONING, SEARCHING, Estimate
from localization.integrity import (
    HealthMonitor,
    protection_level,
    unproved_protection,
    with_doubt,
)
from localization.measurements import Measurement, Sensors, Soundings, beam_vectors, soundings_of
from localization.particles import ParticleFilter
from localization.proof import Proof, doubt_of
from localization.reckoning import Gaussian, Reckoning
from localization.rival import Evidence
from localization.terrain import TerrainMap
from localization.view import view_of
from localization.witness import Opinion, opinion_of
from perception.records import FloatArray

logger = logging.getLogger(__name__)

# Seconds without a sounding after which the status is dead reckoning.
_SILENT_S = 15.0
# A step longer than this, and faster than both speeds below, is a reset of dead reckoning.
_LEAST_JUMP_M, _SLOW_M_S, _FASTER = 10.0, 5.0, 5.0
# Mean square of recent innovations, 1 if the match claims right, above which a proved one may fail.
_STRAINED = 1.6
# Speed error assumed while the navigation itself gives no position.
_BLIND_M_S = 0.5


@dataclass(frozen=True, slots=True)
class NavigatorConfig:
    """How the navigator decides.

    Attributes
    ----------
    particles : number in the search once it narrows (four times as many while it is wide).
    hand_over_m : largest sigma of an axis at which the Kalman bank takes over.
    probation : updates, at least, before a match is called converged.
    proof : log of the likelihood ratio, of map against free ground, that proves a match.
    converged_m : largest sigma of an axis of a converged state: an error of 25 m is then beyond three.
    walk_m_sqrt_h : random walk of dead reckoning assumed during the search.
    reset_depth_m : depth bias to allow for when the filter starts again: the cause may be a step.
    grow : factor of the box from one search to the next.
    """

    particles: int = 4000
    hand_over_m: float = 12.0
    probation: int = 6
    proof: float = 6.0
    converged_m: float = 8.0
    walk_m_sqrt_h: float = 4.0
    reset_depth_m: float = 10.0
    grow: float = 2.0


class Navigator:
    """Terrain-relative navigation, one measurement at a time.

    Parameters
    ----------
    terrain : the prior map, from `terrain_map`.
    sensors : beams and noise.
    rng : source of the search's random draws.

    Examples
    --------
    >>> navigator = Navigator(terrain, sensors, rng)        # doctest: +SKIP
    >>> estimate = navigator.update(measurement)            # doctest: +SKIP
    """

    def __init__(
        self,
        terrain: TerrainMap,
        sensors: Sensors,
        rng: np.random.Generator,
        config: NavigatorConfig | None = None,
    ) -> None:
        self.terrain = terrain
        self.sensors = sensors
        self.config = config or NavigatorConfig()
        self.vectors = beam_vectors(sensors.beams) if sensors.beams else np.zeros((0, 3))
        self.fractions = np.array([b.fraction or sensors.beam_fraction for b in sensors.beams])
        walk = sensors.walk_m_sqrt_h
        assumed = self.config.walk_m_sqrt_h if walk is None else walk
        self.reckoning = Reckoning(sensors, assumed**2 / 3600.0)
        self.search = ParticleFilter(terrain, self.config.particles, rng)
        self.bank = KalmanBank(terrain, walk, sensors.tide_m_sqrt_h, len(sensors.beams))
        self.health = HealthMonitor()
        self.tracking = False
        self.rival = Evidence(terrain)
        self.proof = Proof(self.config.probation, self.config.proof)
        self.losses = 0
        self.last: Measurement | None = None
        self.velocity: FloatArray = np.zeros(2)
        self.since_update_m = 0.0
        self.heard_s = -math.inf
        self.seen_times: set[float] = set()
        self.afresh = False
        self.search.start(*self.reckoning.state)

    # ---- one row -------------------------------------------------------------------------------

    def update(self, measurement: Measurement) -> Estimate:
        """Take one row of navigation and give the position at it."""
        m = measurement
        self.afresh = False
        if not math.isfinite(m.time_s):
            return self._estimate(m, "row without a time: not used")
        late = self.last is not None and m.time_s <= self.last.time_s
        if late and m.time_s in self.seen_times:
            return self._estimate(m, "repeated row: not used")
        self._remember(m.time_s)
        if not (math.isfinite(m.easting_m) and math.isfinite(m.northing_m)):
            return self._estimate(m, "row without a position")
        jump = "" if late else self._advance(m)
        soundings = soundings_of(m, self.vectors, self.fractions, self.sensors.beam_floor_m)
        reason = self._match(m, soundings) if soundings.count else ""
        return self._estimate(m, "; ".join(r for r in (jump, reason) if r))

    def fuse(
        self, offset_m: FloatArray, covariance_m2: FloatArray, measurement: Measurement
    ) -> Estimate:
        """Fuse an outside fix: (2,) its position less the dead-reckoned one at its time.

        A fix that contradicts a converged state by more than four sigmas is left out.
        """
        if self.tracking:
            fused = self.bank.fuse(offset_m, covariance_m2)
            self.search.fuse(offset_m, covariance_m2)
            reason = "" if fused else "outside fix contradicts the track: left out"
            return self._estimate(measurement, reason)
        self.search.fuse(offset_m, covariance_m2)
        return self._estimate(measurement, self._hand_over())

    def wander_m2_s(self) -> tuple[float, float]:
        """Random walk, variance per second, found of the position (an axis) and of the depth bias."""
        walk = self.bank.walk_m2_s() if self.tracking else self.reckoning.walk_m2_s
        return walk, self.sensors.tide_m_sqrt_h**2 / 3600.0

    def _remember(self, time_s: float) -> None:
        self.seen_times.add(time_s)
        if len(self.seen_times) > 4000:
            self.seen_times = set(sorted(self.seen_times)[-2000:])

    def _advance(self, m: Measurement) -> str:
        """Carry everything over the dead-reckoned step to a new row."""
        last = self.last
        self.last = m
        if last is None:
            self.heard_s = m.time_s
            return ""
        seconds = m.time_s - last.time_s
        step = np.array([m.easting_m - last.easting_m, m.northing_m - last.northing_m])
        reason = ""
        usual = float(np.hypot(*self.velocity))
        way = float(np.hypot(*step))
        slip_m2 = 0.0
        if way > _LEAST_JUMP_M and way > seconds * max(_SLOW_M_S, _FASTER * usual):
            # Dead reckoning was reset: the vehicle went on, its offset changed by the jump.
            likely = self.velocity * seconds
            self._shift(likely - step)
            self.afresh = True
            step, slip_m2 = likely, (_BLIND_M_S * seconds) ** 2
            reason = f"position jumped by {way:.0f} m in {seconds:.3g} s: taken as a reset"
        else:
            self.velocity = step / seconds
        self.since_update_m += float(np.hypot(*step))
        self.reckoning.advance(step, seconds, slip_m2)
        if self.tracking:
            self.bank.predict(step[0], step[1], seconds, slip_m2)
        if not self.tracking or not self.proof.believed:
            walk_m2 = self.reckoning.walk_m2_s * seconds + slip_m2
            self.search.predict(step[0], step[1], walk_m2)
        return reason

    def _shift(self, jump: FloatArray) -> None:
        """Move every offset by what the dead-reckoned position jumped against."""
        self.reckoning.shift(jump)
        self.search.shift(jump)
        self.bank.shift(jump)

    # ---- matching ------------------------------------------------------------------------------

    def _match(self, m: Measurement, soundings: Soundings) -> str:
        self.bank.see(soundings)
        if self.tracking:
            return self._track(m, soundings)
        met = self._search(m, soundings)
        self.since_update_m = 0.0
        if met > 0:
            self.heard_s = m.time_s
        return self._hand_over()

    def _search(self, m: Measurement, soundings: Soundings) -> float:
        tide = self.sensors.tide_m_sqrt_h**2 / 3600.0 * 3.0
        return self.search.update(soundings, m.easting_m, m.northing_m, self.since_update_m, tide)

    def _hand_over(self) -> str:
        """Let the Kalman bank take over once the search has one narrow place left."""
        mean, covariance = self.search.moments()
        if _largest(covariance) > self.config.hand_over_m:
            return ""
        # A Gaussian has 99.8 % within 3.5 sigmas: less means that rivals live outside.
        if self.search.share_within(mean, covariance, 3.5) < 0.98:
            return ""
        self._begin_tracking(mean, covariance)
        return "place found; on probation"

    def _begin_tracking(self, mean: FloatArray, covariance: FloatArray) -> None:
        self.bank.start(mean, covariance)
        self.health.reset()
        self.tracking = True
        self.proof.begin(self._surprise(mean, covariance))
        self.rival.reset()
        if not self.proof.believed:
            self.search.start(*self._prior())

    def _prior(self) -> Gaussian:
        """What is known without the match: the box of a search."""
        mean, covariance = self.reckoning.state
        if not self.losses:
            return mean, covariance
        box = self._box()
        # The cause of the loss may have been a step of the depth.
        box[4, :], box[:, 4] = 0.0, 0.0
        box[4, 4] = self.config.reset_depth_m**2
        return mean, box

    def _hear_witness(self, m: Measurement, soundings: Soundings) -> Opinion:
        """Let the search anew have this update's soundings, and say what it makes of the place."""
        self._search(m, soundings)
        return opinion_of(self.search, *self.bank.moments(), self.config.hand_over_m)

    def _surprise(self, mean: FloatArray, covariance: FloatArray) -> float:
        """Evidence against a place far from where dead reckoning has it, beyond three sigmas."""
        expected, spread = self.reckoning.state
        spread = spread + covariance
        use = [0, 1, 2, 3]
        apart = (mean - expected)[use]
        square = float(apart @ np.linalg.solve(spread[np.ix_(use, use)], apart))
        # The 99.9 % point of chi-square with four degrees of freedom.
        return 0.5 * max(square - 18.5, 0.0)

    def _track(self, m: Measurement, soundings: Soundings) -> str:
        mean, covariance = self.bank.moments()
        if _largest(covariance) > 2 * self.config.hand_over_m:
            # Too wide to linearise, after a long silence: search within what is known.
            self.tracking = False
            self.search.start(mean, covariance)
            return "uncertainty outgrew the Kalman bank; searching within it"
        place = np.array([m.easting_m, m.northing_m])
        views = {
            reading: view_of(self.terrain, soundings, place, mean, covariance, reading)
            for reading in self.bank.readings()
        }
        likeliest = self.bank.likeliest()
        gained = self.rival.update(views[likeliest.reading], likeliest)
        fit = self.bank.update(views)
        heard = Opinion.CONFIRMS if self.proof.believed else self._hear_witness(m, soundings)
        self.since_update_m = 0.0
        if not len(fit.normalised):
            return ""
        self.heard_s = m.time_s
        if fit.common_step_m:
            self.rival.reset()
            if not self.proof.believed:
                self.search.start(*self._prior())
            return f"depth stepped by {fit.common_step_m:+.1f} m; depth bias set free"
        self.health.add(fit, len(self.sensors.beams))
        verdict = self.health.verdict()
        if not verdict.healthy and (verdict.grave or not self.proof.vouched):
            return self._lose(verdict.reason)
        self.proof.add(gained)
        # A proved match is not given up for free ground's sake alone: where the map is coarse beside
        # the soundings' spacing, memory predicts better than the best map, and nothing is wrong.
        strained = not self.proof.believed or self.health.size() > _STRAINED
        if self.proof.refuted and strained:
            return self._lose("free ground explains the soundings better than the map")
        self.proof.updates += 1
        if heard is Opinion.CONTRADICTS:
            self.proof.fail()
            self.afresh = True
            self._begin_tracking(*self.search.moments())
            return "later soundings agree on another place; that is on probation now"
        confirmed = heard is Opinion.CONFIRMS and self.proof.holds
        if confirmed and _largest(covariance) < self.config.converged_m:
            return self._trust()
        return ""

    def _trust(self) -> str:
        self.reckoning.trust(self.bank.moments(), self.proof.updates)
        if self.proof.believed:
            return ""
        self.losses = 0
        self.proof.convince()
        return "converged"

    def _lose(self, reason: str) -> str:
        """Begin again from the last trusted state with a wider box and a free depth bias."""
        self.losses += 1
        self.afresh = True
        self.proof.fail()
        self.reckoning.fall_back()
        self.tracking = False
        self.health.reset()
        prior = self._prior()
        self.search.start(*prior)
        logger.info("lost: %s", reason)
        return f"lost: {reason}; searching again within {_largest(prior[1]):.0f} m"

    def _box(self) -> FloatArray:
        return self.reckoning.box(self.losses, self.config.grow)

    # ---- what is told --------------------------------------------------------------------------

    def _estimate(self, m: Measurement, reason: str = "") -> Estimate:
        state, joint, status = self._belief(m)
        easting, northing, blind = self._position(m)
        blur = blind**2 * np.eye(2)
        covariance = joint[:2, :2] + blur
        protection = protection_level(covariance)
        if not self.proof.believed:
            mean, reckoned = self.reckoning.state
            away = float(np.hypot(*(mean - state)[:2]))
            if self.losses:
                reckoned = self._box()
            protection = max(protection, unproved_protection(reckoned[:2, :2] + blur, away))
        return Estimate(
            time_s=m.time_s,
            easting_m=easting + float(state[0]),
            northing_m=northing + float(state[1]),
            covariance_m2=covariance,
            status=status,
            protection_m=protection,
            state=state,
            state_covariance=joint,
            reason=reason,
            afresh=self.afresh,
        )

    def _belief(self, m: Measurement) -> tuple[FloatArray, FloatArray, str]:
        """Mean (5,) and covariance (5, 5) to tell, and the status."""
        silent = m.time_s - self.heard_s > _SILENT_S
        if self.losses:
            return self.reckoning.state[0], self._box(), RECKONING if silent else LOST
        status = RECKONING if silent else SEARCHING
        if not self.tracking:
            mean, covariance = self.search.moments()
            if not self.proof.believed:
                doubt = doubt_of(-self._surprise(mean, covariance))
                mean, covariance = with_doubt(mean, covariance, *self.reckoning.state, doubt)
            return mean, covariance, status
        mean, covariance = self.bank.moments()
        if not self.proof.believed:
            doubt = self.proof.doubt
            mean, covariance = with_doubt(mean, covariance, *self.reckoning.state, doubt)
        sure = self.proof.believed and self.proof.holds
        if not silent and sure and _largest(covariance) < self.config.converged_m:
            status = CONVERGED
        return mean, covariance, status

    def _position(self, m: Measurement) -> tuple[float, float, float]:
        """Dead-reckoned position of a row, and what is not known of it when the row has none."""
        if math.isfinite(m.easting_m) and math.isfinite(m.northing_m):
            return m.easting_m, m.northing_m, 0.0
        if self.last is None or not math.isfinite(m.time_s):
            return math.nan, math.nan, 0.0
        gap = max(m.time_s - self.last.time_s, 0.0)
        ahead = self.velocity * gap
        return self.last.easting_m + ahead[0], self.last.northing_m + ahead[1], _BLIND_M_S * gap


def _largest(covariance: FloatArray) -> float:
    """Largest 1-sigma of the horizontal position."""
    return math.sqrt(max(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]), 0.0))
