"""Mending what files have wrong with their clocks, positions and headings, one file at a time."""

from __future__ import annotations

from bisect import bisect_right
from itertools import pairwise

import numpy as np
from scipy.ndimage import median_filter

from perception.readers.raw import plural
from perception.records import BoolArray, FloatArray, IntArray

_GLITCH_SHARE = 0.1  # a clock wrong in fewer pings than this is mended, in more it is a new clock
_HELD_SHARE = (
    0.3  # positions equal to the one before in more pings than this are held between fixes
)
_REACH_S = 5.0  # positions are extrapolated no longer than this
_CRAB_RAD = np.radians(25.0)
_SPIKE_M = 50.0  # a position this far (and 20 usual steps) from its neighbours' median is wrong


def mend_clock(time_s: FloatArray, defects: list[str]) -> tuple[FloatArray, BoolArray]:
    """Return times (n,) without holes and glitches, and which were filled.

    Single wrong stamps are interpolated by ping number. A clock that was set back for good is left as
    it is, a step back in time, which ends a pass. Equal stamps of a coarse clock are spread evenly.
    """
    time_s = np.array(time_s, float)
    n = len(time_s)
    wrong = ~np.isfinite(time_s)
    steps_back = 0
    if np.any(np.diff(time_s[~wrong]) < 0):
        good = np.flatnonzero(~wrong)
        steps_back = _mark_glitches(time_s, good, wrong)
    if wrong.all():
        return np.arange(n, dtype=float), wrong
    if wrong.any():
        rows = np.arange(n)
        time_s[wrong] = np.interp(rows[wrong], rows[~wrong], time_s[~wrong])
        defects.append(f"clock wrong in {plural(int(wrong.sum()), 'ping')}: time interpolated")
    if steps_back:
        defects.append(f"the clock is set back {plural(steps_back, 'time')}: passes end there")
    return _spread_ties(time_s, defects), wrong


def _mark_glitches(time_s: FloatArray, rows: IntArray, wrong: BoolArray) -> int:
    """Mark stamps outside the longest rising sequence; return how often the clock was set back."""
    keep = _longest_rising(time_s[rows])
    if (~keep).sum() <= _GLITCH_SHARE * len(rows) or len(rows) < 10:
        wrong[rows[~keep]] = True
        return 0
    cut = int(np.argmin(np.diff(time_s[rows]))) + 1
    return 1 + sum(
        _mark_glitches(time_s, part, wrong)
        for part in (rows[:cut], rows[cut:])
        if np.any(np.diff(time_s[part]) < 0)
    )


def _longest_rising(values: FloatArray) -> BoolArray:
    """Return the members of a longest non-decreasing subsequence (patience sorting)."""
    tails: list[float] = []
    tail_at: list[int] = []
    before = np.full(len(values), -1, np.int64)
    for i, value in enumerate(values.tolist()):
        place = bisect_right(tails, value)
        if place:
            before[i] = tail_at[place - 1]
        if place == len(tails):
            tails.append(value)
            tail_at.append(i)
        else:
            tails[place], tail_at[place] = value, i
    keep = np.zeros(len(values), bool)
    at = tail_at[-1] if tail_at else -1
    while at >= 0:
        keep[at] = True
        at = int(before[at])
    return keep


def _spread_ties(time_s: FloatArray, defects: list[str]) -> FloatArray:
    """Spread equal stamps evenly up to the next different one, where they are many."""
    steps = np.diff(time_s)
    if len(steps) < 3 or np.mean(steps == 0) < 0.2 or not np.any(steps > 0):
        return time_s
    out = time_s.copy()
    starts = np.concatenate([[0], np.flatnonzero(steps != 0) + 1, [len(time_s)]])
    usual = float(np.median(steps[steps > 0]))
    for a, b in pairwise(starts):
        upto = time_s[b] if b < len(time_s) else time_s[a] + usual
        span = upto - time_s[a]
        if b - a > 1 and 0 < span <= 3 * usual:
            out[a:b] = time_s[a] + span * np.arange(b - a) / (b - a)
    defects.append(f"the clock moves in steps of {usual:g} s: pings spread evenly between")
    return out


def mend_positions(
    time_s: FloatArray, x: FloatArray, y: FloatArray, defects: list[str]
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return positions (n,) in metres without holes, and where the file had no valid one.

    Positions held between fixes (a 1 Hz GPS under 10 Hz pings) are interpolated from fix to fix.
    """
    wrong = ~np.isfinite(x + y)
    missing = int(wrong.sum())
    if missing:
        defects.append(f"no valid position in {plural(missing, 'ping')}: interpolated, in no pass")
    if wrong.all():
        return x, y, wrong
    spikes = _spikes(x, y, wrong)
    if spikes.any():
        defects.append(
            f"wild position in {plural(int(spikes.sum()), 'ping')}: interpolated, in no pass"
        )
        wrong = wrong | spikes
    held = _held(time_s, x, y, wrong)
    if held.any():
        share = held.mean()
        defects.append(
            f"positions are held between fixes ({share:.0%} of pings repeat): interpolated"
        )
    empty = wrong | held
    return _fill(time_s, x, empty), _fill(time_s, y, empty), wrong


def _spikes(x: FloatArray, y: FloatArray, wrong: BoolArray) -> BoolArray:
    """Return positions far from the median of their neighbours, of which they cannot be part."""
    out = np.zeros(len(x), bool)
    good = np.flatnonzero(~wrong)
    if len(good) < 7:
        return out
    east, north = x[good], y[good]
    away = np.hypot(
        east - median_filter(east, 7, mode="nearest"),
        north - median_filter(north, 7, mode="nearest"),
    )
    usual = float(np.median(np.hypot(np.diff(east), np.diff(north))))
    out[good] = away > max(_SPIKE_M, 20 * usual)
    return out


def _held(time_s: FloatArray, x: FloatArray, y: FloatArray, wrong: BoolArray) -> BoolArray:
    """Return the pings that repeat the position before, where the recorder holds it between fixes."""
    out = np.zeros(len(x), bool)
    good = np.flatnonzero(~wrong)
    same = (np.diff(x[good]) == 0) & (np.diff(y[good]) == 0)
    if len(same) < 10 or same.mean() < _HELD_SHARE or same.all():
        return out
    starts = np.concatenate([[0], np.flatnonzero(~same) + 1])
    lengths = np.diff(np.append(starts, len(good)))
    # A vehicle that truly stands repeats itself far longer than the fixes are apart: that is no hold.
    usual = float(np.median(lengths))
    for start, length in zip(starts, lengths, strict=True):
        if length <= 4 * usual:
            out[good[start + 1 : start + length]] = True
    return out


def _fill(time_s: FloatArray, values: FloatArray, empty: BoolArray) -> FloatArray:
    """Interpolate over time where `empty`, by the end's own speed (for a few seconds) beyond the ends."""
    if not empty.any():
        return values
    known = np.flatnonzero(~empty)
    rising = time_s[known]
    if np.any(np.diff(rising) < 0):  # a clock set back: go by ping number
        time_s = np.arange(len(values), dtype=float)
        rising = time_s[known]
    out = values.copy()
    out[empty] = np.interp(time_s[empty], rising, values[known])
    for end, side in ((known[0], known[:20]), (known[-1], known[-20:])):
        rows = np.flatnonzero(
            empty & ((np.arange(len(values)) - end) * (1 if end == known[-1] else -1) > 0)
        )
        lasted = time_s[side[-1]] - time_s[side[0]]
        if len(rows) and lasted > 0:
            slope = (values[side[-1]] - values[side[0]]) / lasted
            ahead = np.clip(time_s[rows] - time_s[end], -_REACH_S, _REACH_S)
            out[rows] = values[end] + slope * ahead
    return out


def mend_headings(
    time_s: FloatArray,
    true_heading_rad: FloatArray,
    easting_m: FloatArray,
    northing_m: FloatArray,
    convergence_rad: FloatArray,
    told: BoolArray,
    defects: list[str],
) -> tuple[FloatArray, BoolArray]:
    """Return grid headings (n,) without holes, and which were filled.

    A file without any heading, or with zero throughout along a track that does not run north, gets
    the course of its track. `told` marks pings whose emptiness is reported already.
    """
    wrong = ~np.isfinite(true_heading_rad)
    filled = np.ones(len(wrong), bool)
    course = course_over_ground(time_s, easting_m, northing_m)
    moving = bool(np.isfinite(course).any())
    if wrong.all() or (not np.any(true_heading_rad[~wrong]) and moving and not _runs_north(course)):
        if not moving:
            defects.append("no heading and a track that does not move: north assumed")
            return np.zeros(len(wrong)), filled
        defects.append("no heading recorded: the course of the track is taken")
        return course, filled
    heading = true_heading_rad - convergence_rad
    _tell_crabbing(heading[~wrong], course[~wrong], defects)
    if np.any(wrong & ~told):
        defects.append(f"no heading in {plural(int((wrong & ~told).sum()), 'ping')}: interpolated")
    if wrong.any():
        rows = np.arange(len(heading))
        heading[wrong] = np.interp(rows[wrong], rows[~wrong], np.unwrap(heading[~wrong]))
    return heading, wrong


def _tell_crabbing(heading_rad: FloatArray, course_rad: FloatArray, defects: list[str]) -> None:
    """Tell of headings that are not where the track goes: no current explains more than this."""
    apart = (heading_rad - course_rad)[np.isfinite(heading_rad + course_rad)]
    off = np.mean(np.exp(1j * apart)) if len(apart) else np.nan
    # A track that goes nowhere (turning in place, noise) has no mean difference worth telling.
    if np.isfinite(off) and abs(off) > 0.7 and abs(np.angle(off)) > _CRAB_RAD:
        defects.append(
            f"headings lie {np.degrees(np.angle(off)):.0f} deg off the track on average: kept as "
            "recorded; a declination or mounting angle belongs in install.toml"
        )


def _runs_north(course: FloatArray) -> bool:
    """Return whether a track runs north so nearly that a heading of zero may be meant."""
    return bool(np.all(abs(np.sin(course)) < np.sin(np.radians(10))) and np.cos(course).mean() > 0)


def course_over_ground(
    time_s: FloatArray, easting_m: FloatArray, northing_m: FloatArray, window_s: float = 6.0
) -> FloatArray:
    """Return the course (n,) from grid north over a window of time; NaN on a track that stands."""
    if len(time_s) < 2:
        return np.full(len(time_s), np.nan)
    clock = time_s if np.all(np.diff(time_s) >= 0) else np.arange(len(time_s), dtype=float)
    clock = clock + 1e-6 * np.arange(len(clock))
    half = min(window_s, clock[-1] - clock[0]) / 2
    moved = [
        np.interp(clock + half, clock, axis) - np.interp(clock - half, clock, axis)
        for axis in (easting_m, northing_m)
    ]
    length = np.hypot(*moved)
    course = np.where(length > 0, np.arctan2(*moved), np.nan)
    known = np.flatnonzero(length > 0.05)
    if len(known) == 0:
        return np.full(len(time_s), np.nan)
    turned = np.unwrap(course[known])
    return np.asarray(np.interp(np.arange(len(course)), known, turned))
