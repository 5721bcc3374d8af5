"""Dead reckoning from the last trusted state: what is known when the match is not believed."""

from __future__ import annotations

import numpy as np

from localization.measurements import Sensors
from perception.records import FloatArray

# Mean (5,) and covariance (5, 5) of east, north, heading bias, scale, depth bias.
Gaussian = tuple[FloatArray, FloatArray]

# What may have gone wrong unseen since the last trusted state, an axis.
_LOST_M = 10.0
# A trusted state is kept every so many proved updates, and so many of them.
_EVERY, _KEPT = 20, 4
# Proved updates after which the track itself is what a lost filter falls back on.
_SETTLED = 60
# A box grows no more after this many losses.
_MOST_GROWTH = 4


def start_covariance(sensors: Sensors) -> FloatArray:
    """Covariance (5, 5) of the start, as the sensors' sigmas state it."""
    s = sensors
    sigma = np.array([s.start_m, s.start_m, s.heading_rad, s.scale, s.depth_bias_m])
    return np.diag(np.maximum(sigma, 1e-6) ** 2)


class Reckoning:
    """The last trusted state, and a few older ones, carried on by odometry.

    Parameters
    ----------
    walk_m2_s : random walk of dead reckoning, variance per second and axis.
    """

    def __init__(self, sensors: Sensors, walk_m2_s: float) -> None:
        self.state: Gaussian = (np.zeros(5), start_covariance(sensors))
        self.trusted: list[Gaussian] = []
        self.walk_m2_s = walk_m2_s
        self.tide_m2_s = sensors.tide_m_sqrt_h**2 / 3600.0

    def advance(self, step_m: FloatArray, seconds: float, slip_m2: float) -> None:
        """Carry all states over a dead-reckoned step; `slip_m2` is variance beyond the walk."""
        f = np.eye(5)
        f[0, 3], f[0, 2], f[1, 3], f[1, 2] = step_m[0], step_m[1], step_m[1], -step_m[0]
        q = np.zeros((5, 5))
        q[0, 0] = q[1, 1] = self.walk_m2_s * seconds + slip_m2
        q[4, 4] = self.tide_m2_s * seconds
        moved: list[Gaussian] = [
            (f @ mean, f @ covariance @ f.T + q) for mean, covariance in (self.state, *self.trusted)
        ]
        self.state, self.trusted = moved[0], moved[1:]

    def shift(self, jump_m: FloatArray) -> None:
        """Move every offset by what the dead-reckoned position jumped against."""
        move = np.array([jump_m[0], jump_m[1], 0.0, 0.0, 0.0])
        self.state = self.state[0] + move, self.state[1]
        self.trusted = [(mean + move, covariance) for mean, covariance in self.trusted]

    def trust(self, state: Gaussian, proved: int) -> None:
        """Keep a state to return to; older ones are surer not to be spoilt already."""
        if proved % _EVERY == 0:
            self.trusted = [*self.trusted, state][-_KEPT:]
        if proved > _SETTLED:
            self.state = state

    def fall_back(self) -> None:
        """Return to the oldest trusted state."""
        if self.trusted:
            self.state, self.trusted = self.trusted[0], []

    def box(self, losses: int, grow: float) -> FloatArray:
        """Covariance to search in, and to tell, after so many losses: it grows with every one."""
        growth = grow ** (2 * min(losses - 1, _MOST_GROWTH))
        box = self.state[1].copy()
        box[:2, :2] = growth * (box[:2, :2] + _LOST_M**2 * np.eye(2))
        return box
