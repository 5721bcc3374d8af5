"""Integrity: is the filter still where it says, and how far off may it be.

Health is judged on normalised innovations over two windows: a short one that sees a filter fall off
(most soundings outside the gate), and a long one that sees a filter sit in a wrong place which fits
half well (innovations larger than claimed, or not white: over wrong ground the misfit of one ping
repeats in the next, which noise never does).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from localization.kalman import Fit
from perception.records import FloatArray

# Risk that the error exceeds the protection level, for each update.
RISK = 1e-5
# Part of starts whose stated sigma is wrong, and by what factor.
_TAIL, _TAIL_WIDTH = 0.1, 3.0
# Updates in the short and the long window.
_SHORT, _LONG = 12, 60
# With one beam in ten wild, 35 % outside the gate in 48 soundings has a chance below 1e-6.
_WILD_SHARE = 0.35
# Mean square of normalised innovations inside the gate: 1 if claimed right; 240 of them scatter by
# 0.09, and a model that is a quarter off in sigma gives 1.6.
_LARGE = 2.0
# Lag-one autocorrelation of white innovations scatters by 0.065 over 240 soundings.
_COLOURED, _COLOURED_AND_LARGE = 0.35, 1.35


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether the filter is healthy, and if not why; `grave` where nothing can speak for it."""

    healthy: bool
    reason: str = ""
    grave: bool = True


class HealthMonitor:
    """Windows of normalised innovations; `add` each update's fit, then ask `verdict`."""

    def __init__(self) -> None:
        self.normalised: deque[FloatArray] = deque(maxlen=_LONG)

    def reset(self) -> None:
        """Forget the past: a new search begins."""
        self.normalised.clear()

    @property
    def updates(self) -> int:
        """Number of updates with soundings in the window."""
        return len(self.normalised)

    def add(self, fit: Fit, beams: int) -> None:
        """Take one update's fit, of a vehicle with so many beams."""
        row = np.full(beams, np.nan)
        row[fit.beam] = fit.normalised
        self.normalised.append(row)

    def size(self) -> float:
        """Mean square of recent normalised innovations, wild ones counted at the gate."""
        recent = np.array(self.normalised)[-2 * _SHORT :]
        return float(np.nanmean(np.minimum(recent**2, 16.0))) if np.isfinite(recent).any() else 0.0

    def verdict(self) -> Verdict:
        """Judge the windows."""
        if len(self.normalised) < _SHORT // 2:
            return Verdict(True)
        rows = np.array(self.normalised)
        recent = rows[-_SHORT:]
        recent = recent[np.isfinite(recent)]
        if recent.size >= 6:
            wild = float(np.mean(np.abs(recent) > 4.0))
            if wild > _WILD_SHARE:
                return Verdict(False, f"{wild:.0%} of recent soundings do not fit the map")
        inside = np.where(np.abs(rows) < 4.0, rows, np.nan)
        count = int(np.isfinite(inside).sum())
        if count < 60:
            return Verdict(True)
        size = float(np.nanmean(inside**2))
        pair = inside[1:] * inside[:-1]
        colour = float(np.nanmean(pair) / size) if np.isfinite(pair).sum() > 40 else 0.0
        if size > _LARGE:
            return Verdict(False, f"innovations are {math.sqrt(size):.2f} times their claimed size")
        if size > _COLOURED_AND_LARGE and colour > _COLOURED:
            return Verdict(
                False,
                f"innovations repeat (autocorrelation {colour:.2f}) as over wrong ground",
                grave=False,
            )
        return Verdict(True)


def protection_level(covariance: FloatArray, risk: float = RISK) -> float:
    """Radius that a two-dimensional Gaussian error exceeds with the stated risk at most.

    The largest axis of the ellipse is taken for both (Rayleigh: ``sqrt(-2 ln risk)`` sigmas).

    >>> round(protection_level(np.eye(2)), 2)
    4.8
    """
    largest = float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    return math.sqrt(max(largest, 0.0)) * math.sqrt(-2.0 * math.log(risk))


def unproved_protection(covariance: FloatArray, away_m: float, risk: float = RISK) -> float:
    """Radius around a place not yet proved that the error exceeds with the stated risk at most.

    Before proof all rests on what was *stated* of the start, and a statement has heavier tails than
    a normal density: one in ten is taken to be three times as wide, as the search takes it. Of the
    wide part ``0.1 exp(-r^2 / (2 (3 sigma)^2)) = risk``; the place told lies `away_m` from its centre.

    >>> round(unproved_protection(np.eye(2), 0.0), 2)
    12.88
    """
    return _TAIL_WIDTH * protection_level(covariance, risk / _TAIL) + away_m


def with_doubt(
    mean: FloatArray,
    covariance: FloatArray,
    other_mean: FloatArray,
    other_covariance: FloatArray,
    doubt: float,
) -> tuple[FloatArray, FloatArray]:
    """Mix a Gaussian with another that holds with probability `doubt`; the mean stays.

    Used until a match is proved: the place found may be the wrong one of several, and then dead
    reckoning is all there is.
    """
    apart = other_mean - mean
    mixed = (1 - doubt) * covariance + doubt * (other_covariance + np.outer(apart, apart))
    return mean, mixed
