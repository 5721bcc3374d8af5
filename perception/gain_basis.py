"""Unknown gain: the beam pattern by angle, per side, and what the recorder did by slant range.

Both are piecewise linear on knots and enter the joint problem as unknowns. They are told apart by
relief alone (a point's range stays when its angle changes), so each has a smoothness prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.records import FloatArray, IntArray

ANGLE_STEP_RAD = np.radians(3.0)
_ANGLE_KNOTS = 36  # to 105 degrees: roll may lift the frame beyond the horizon
_RANGE_KNOTS = 21
# 1-sigma of the second difference between knots, in log power: a pattern may bend by 1.3 dB within
# 6 degrees of its middle knot; a time-varying gain bends more slowly.
_ANGLE_BEND = 0.15
_RANGE_BEND = 0.08
_LEVEL = 30.0
# 1-sigma of the first difference between knots: 0.9 dB in 3 degrees, 0.4 dB from range to range. Without it
# beam pattern and range gain run off against each other by tens of dB, and take the relief along.
_ANGLE_RISE = 0.2
_RANGE_RISE = 0.1
_RANGE_LEVEL = 0.3


@dataclass(frozen=True, slots=True)
class GainBasis:
    """The knots of all gain curves: port angles, starboard angles, slant ranges."""

    reach_m: float

    @property
    def size(self) -> int:
        return 2 * _ANGLE_KNOTS + _RANGE_KNOTS

    def precision(self) -> FloatArray:
        """Return the prior's precision matrix (size, size)."""
        out = np.zeros((self.size, self.size))
        parts = (
            (0, _ANGLE_KNOTS, _ANGLE_BEND, _ANGLE_RISE, _LEVEL),
            (_ANGLE_KNOTS, _ANGLE_KNOTS, _ANGLE_BEND, _ANGLE_RISE, _LEVEL),
            (2 * _ANGLE_KNOTS, _RANGE_KNOTS, _RANGE_BEND, _RANGE_RISE, _RANGE_LEVEL),
        )
        for first, count, bend, rise, level in parts:
            second = np.diff(np.eye(count), 2, axis=0)
            slope = np.diff(np.eye(count), 1, axis=0)
            block = second.T @ second / bend**2 + slope.T @ slope / rise**2
            block += np.eye(count) / level**2
            out[first : first + count, first : first + count] = block
        return out

    def place(
        self, angle_rad: FloatArray, slant_m: FloatArray, side: IntArray
    ) -> tuple[IntArray, FloatArray]:
        """Return the four knots (n, 4) that a datum sees and their shares."""
        knot, share = [], []
        scale = (_RANGE_KNOTS - 1) / self.reach_m
        for position, count, first in (
            (angle_rad / ANGLE_STEP_RAD, _ANGLE_KNOTS, side * _ANGLE_KNOTS),
            (slant_m * scale, _RANGE_KNOTS, 2 * _ANGLE_KNOTS),
        ):
            position = np.clip(position, 0, count - 1.001)
            lower = position.astype(np.int64)
            part = position - lower
            knot += [lower + first, lower + 1 + first]
            share += [1 - part, part]
        return np.stack(knot, axis=1), np.stack(share, axis=1)

    def angle_slope(self, gain: FloatArray, knot: IntArray) -> FloatArray:
        """Return the derivative of the beam pattern by angle at data placed by `place`."""
        return (gain[knot[:, 1]] - gain[knot[:, 0]]) / ANGLE_STEP_RAD

    def start(self, ratio: FloatArray, knot: IntArray) -> FloatArray:
        """Return a first gain: the median ratio by angle, nothing by range."""
        gain = np.zeros(self.size)
        for side in range(2):
            level = np.full(_ANGLE_KNOTS, np.nan)
            first = side * _ANGLE_KNOTS
            order = np.argsort(knot[:, 0], kind="stable")
            sorted_knot = knot[order, 0]
            edges = np.searchsorted(sorted_knot, first + np.arange(_ANGLE_KNOTS + 1))
            for k in range(_ANGLE_KNOTS):
                chosen = order[edges[k] : edges[k + 1]]
                if len(chosen) >= 30:
                    level[k] = np.median(ratio[chosen])
            known = np.flatnonzero(np.isfinite(level))
            if len(known):
                gain[first : first + _ANGLE_KNOTS] = np.interp(
                    np.arange(_ANGLE_KNOTS), known, level[known]
                )
        return gain

    def curves(self, gain: FloatArray) -> dict[str, FloatArray]:
        """Return the curves in dB: `angle_deg`, `port_db`, `starboard_db`, `range_m`, `range_db`."""
        decibel = 10 / np.log(10)
        n = _ANGLE_KNOTS
        return {
            "angle_deg": np.degrees(ANGLE_STEP_RAD) * np.arange(n),
            "port_db": decibel * gain[:n],
            "starboard_db": decibel * gain[n : 2 * n],
            "range_m": np.linspace(0, self.reach_m, _RANGE_KNOTS),
            "range_db": decibel * gain[2 * n :],
        }
