"""A whole mission: every row of navigation through the navigator, then smoothing and fixes.

The causal trajectory has one row for each row of `nav.csv`, made of that row and those before it.
Smoothing is for after the mission: the Rauch-Tung-Striebel recursion over the causal states, so a
position before convergence profits of what was learnt later.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from filterpy.kalman import KalmanFilter

from localization.estimate import CONVERGED, LOST, Estimate
from localization.integrity import protection_level
from localization.navfile import NavTable
from localization.navigator import Navigator
from mapping.fixes import PositionFix
from perception.records import BoolArray, FloatArray, IntArray, Progress, Trajectory, silent

# A fix every five minutes: their errors share the map's and the biases, more would repeat them.
_FIX_EVERY_S = 300.0


@dataclass(frozen=True, slots=True)
class Navigation:
    """What `navigate` gives: causal and smoothed trajectories, fixes, and the navigator's words."""

    trajectory: Trajectory
    smoothed: Trajectory
    fixes: tuple[PositionFix, ...]
    estimates: tuple[Estimate, ...]


def navigate(
    navigator: Navigator,
    nav: NavTable,
    fixes: Sequence[PositionFix] = (),
    crs: str = "",
    progress: Progress = silent,
) -> Navigation:
    """Run a navigator over a navigation table.

    Parameters
    ----------
    fixes : outside fixes (patches of a side-scan survey, USBL) with times of the table's clock;
        accepted ones are fused when their time comes.
    """
    waiting = sorted((f for f in fixes if f.accepted), key=lambda f: f.time_s)
    estimates: list[Estimate] = []
    for i, measurement in enumerate(nav):
        estimate = navigator.update(measurement)
        while waiting and waiting[0].time_s <= measurement.time_s:
            fix = waiting.pop(0)
            offset = np.array([fix.easting_m, fix.northing_m]) - reckoned_at(nav, fix.time_s)
            estimate = navigator.fuse(offset, fix.covariance_m2, measurement)
        estimates.append(estimate)
        if i % 100 == 0 or i + 1 == len(nav):
            progress("navigation", i + 1, len(nav))
    own = profile_fixes(estimates)
    return Navigation(
        trajectory=_trajectory(
            nav,
            estimates,
            crs,
            _places(estimates),
            np.array([e.covariance_m2 for e in estimates]),
            np.array([e.protection_m for e in estimates]),
        ),
        smoothed=smooth(nav, estimates, navigator.wander_m2_s(), crs),
        fixes=tuple(sorted((*own, *fixes), key=lambda f: f.time_s)),
        estimates=tuple(estimates),
    )


def _trajectory(
    nav: NavTable,
    estimates: Sequence[Estimate],
    crs: str,
    place: tuple[FloatArray, FloatArray],
    covariance_m2: FloatArray,
    protection_m: FloatArray,
) -> Trajectory:
    """Rows of the table at `place`, with covariance (n, 2, 2)."""
    return Trajectory(
        time_s=nav.time_s,
        easting_m=place[0],
        northing_m=place[1],
        depth_m=nav.depth_m,
        heading_rad=nav.heading_rad,
        sigma_easting_m=np.sqrt(covariance_m2[:, 0, 0]),
        sigma_northing_m=np.sqrt(covariance_m2[:, 1, 1]),
        cov_en_m2=covariance_m2[:, 0, 1],
        crs=crs,
        utc=nav.utc,
        status=tuple(e.status for e in estimates),
        protection_m=protection_m,
    )


def profile_fixes(estimates: Sequence[Estimate]) -> list[PositionFix]:
    """Issue a fix at convergence and every five minutes after; a loss is a fix refused."""
    fixes: list[PositionFix] = []
    due = -np.inf
    before = ""
    for e in estimates:
        if e.status == CONVERGED and (before != CONVERGED or e.time_s >= due):
            fixes.append(_fix(e, True, "innovations fit the map"))
            due = e.time_s + _FIX_EVERY_S
        elif e.status == LOST and before != LOST:
            fixes.append(_fix(e, False, e.reason or "innovations do not fit the map"))
        before = e.status
    if not fixes and estimates:
        widest = float(np.sqrt(np.linalg.eigvalsh(estimates[-1].covariance_m2)[-1]))
        reason = f"the ground gives no fix: the position is known to {widest:.0f} m only"
        fixes.append(_fix(estimates[-1], False, reason))
    return fixes


def _fix(e: Estimate, accepted: bool, reason: str) -> PositionFix:
    c = e.covariance_m2
    return PositionFix(
        e.time_s, e.easting_m, e.northing_m, float(c[0, 0]), float(c[0, 1]), float(c[1, 1]),
        "profile", accepted, reason, e.protection_m,
    )  # fmt: skip


def reckoned_at(nav: NavTable, time_s: float) -> FloatArray:
    """Dead-reckoned position (2,) at a time, between the rows of the table."""
    rows = np.flatnonzero(_fresh(nav))
    return np.array(
        [np.interp(time_s, nav.time_s[rows], x[rows]) for x in (nav.easting_m, nav.northing_m)]
    )


def smooth(
    nav: NavTable,
    estimates: Sequence[Estimate],
    wander_m2_s: tuple[float, float] = (1e-4, 1e-6),
    crs: str = "",
) -> Trajectory:
    """Smooth over a fixed interval, the mission; rows that were lost cut it in pieces.

    `wander_m2_s` is the random walk, variance per second, of position (an axis) and depth bias.
    Rows that brought nothing new (late, repeated, without a position) take the offset of the row
    before them in the file.
    """
    n = len(estimates)
    state = np.array([e.state for e in estimates])
    joint = np.array([e.state_covariance for e in estimates])
    fresh = _fresh(nav)
    rows = np.flatnonzero(fresh)
    for piece in _pieces(rows, estimates):
        if len(piece) > 1:
            state[piece], joint[piece] = _smooth_piece(
                nav, piece, state[piece], joint[piece], wander_m2_s
            )
    last = np.maximum.accumulate(np.where(fresh, np.arange(n), -1))
    stale = ~fresh & (last >= 0) & np.isfinite(nav.easting_m)
    state[stale], joint[stale] = state[last[stale]], joint[last[stale]]
    placed = np.isfinite(nav.easting_m) & np.isfinite(nav.northing_m)
    covariance = np.where(
        placed[:, None, None], joint[:, :2, :2], np.array([e.covariance_m2 for e in estimates])
    )
    causal = _places(estimates)
    place = (
        np.where(placed, nav.easting_m + state[:, 0], causal[0]),
        np.where(placed, nav.northing_m + state[:, 1], causal[1]),
    )
    protection = np.array([protection_level(c) for c in covariance])
    return _trajectory(nav, estimates, crs, place, covariance, protection)


def _places(estimates: Sequence[Estimate]) -> tuple[FloatArray, FloatArray]:
    east, north = np.array([(e.easting_m, e.northing_m) for e in estimates]).T
    return east, north


def _fresh(nav: NavTable) -> BoolArray:
    """Rows with a position and a time later than every row before."""
    known = np.isfinite(nav.time_s) & np.isfinite(nav.easting_m) & np.isfinite(nav.northing_m)
    time = np.where(known, nav.time_s, -np.inf)
    before = np.concatenate([[-np.inf], np.maximum.accumulate(time)[:-1]])
    return known & (time > before)


def _pieces(rows: IntArray, estimates: Sequence[Estimate]) -> list[IntArray]:
    """Cut the rows where the filter began again: states before and after do not follow."""
    return np.split(rows, [i for i in range(1, len(rows)) if estimates[rows[i]].afresh])


def _smooth_piece(
    nav: NavTable,
    rows: IntArray,
    state: FloatArray,
    joint: FloatArray,
    wander_m2_s: tuple[float, float],
) -> tuple[FloatArray, FloatArray]:
    n = len(rows)
    step_e, step_n = np.diff(nav.easting_m[rows]), np.diff(nav.northing_m[rows])
    f = np.tile(np.eye(5), (n, 1, 1))
    f[1:, 0, 3], f[1:, 0, 2] = step_e, step_n
    f[1:, 1, 3], f[1:, 1, 2] = step_n, -step_e
    q = np.zeros((n, 5, 5))
    seconds = np.diff(nav.time_s[rows])
    q[1:, 0, 0] = q[1:, 1, 1] = wander_m2_s[0] * seconds + 1e-9
    # Heading bias and scale hardly wander; a little keeps the recursion's inverse well posed.
    q[1:, 2, 2] = q[1:, 3, 3] = 1e-12
    q[1:, 4, 4] = wander_m2_s[1] * seconds + 1e-9
    smoother = KalmanFilter(dim_x=5, dim_z=1)
    means, covariances, _, _ = smoother.rts_smoother(state, joint, f, q)
    return means, covariances
