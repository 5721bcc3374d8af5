"""Splitting a survey into passes: stretches of track along which a side-scan image is whole.

A pass ends at a gap in time or position, at a stop, and at a turn. A turn is where the track's radius
falls below the slant range, so that the beams of successive pings cross inside the image, and the
heading changes by much in all; a gentle curve stays one pass.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import uniform_filter1d

from perception.records import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class PassConfig:
    """Limits of the splitting.

    `most_samples` bounds the memory of one pass (both sides together): a longer line is cut in equal
    parts, so that memory does not grow with the file. 5,900 pings of 2 x 1024 samples, at some 40 bytes each.
    """

    gap_s: float = 5.0
    gap_pings: float = 10.0
    gap_m: float = 20.0
    turn_radius_ranges: float = 1.0
    turn_rad: float = np.radians(35.0)
    straight_rad: float = np.radians(8.0)
    most_turn_rad: float = np.radians(150.0)
    stop_share: float = 0.15
    stop_m_s: float = 0.05
    stop_s: float = 10.0
    least_pings: int = 20
    fewest_pings: int = 10
    most_samples: float = 1.2e7


@dataclass(frozen=True, slots=True)
class Track:
    """The usable pings' poses, all (n,): what passes are split by.

    `image` is False for kinds that scan while they stand or turn: then only gaps split.
    """

    time_s: FloatArray
    easting_m: FloatArray
    northing_m: FloatArray
    heading_rad: FloatArray
    range_m: FloatArray
    samples: IntArray
    image: bool = True


@dataclass(frozen=True, slots=True)
class Split:
    """Result of `split_passes`, all (n,): pass number or -1, and why a ping is in none."""

    pass_index: IntArray
    turning: BoolArray
    stopped: BoolArray
    gaps: IntArray  # indices of the first ping after each gap


def split_passes(track: Track, config: PassConfig | None = None) -> Split:
    """Number the passes of a track; pings of turns, stops and short leftovers get -1."""
    config = config or PassConfig()
    n = len(track.time_s)
    gaps = _gaps(track, config)
    none = np.zeros(n, bool)
    turning, stopped = none, none
    if track.image and n >= 3:
        speed = _typical_speed(track, gaps)
        stopped = _stops(track, gaps, speed, config)
        turning = _turns(track, gaps, speed, config)
        # A track that curves nearly all along at the range's radius is better kept than lost.
        if turning.sum() > 0.85 * n:
            turning = none
    label = _pieces(track, gaps, turning | stopped, config)
    return Split(_numbered(track, label, config), turning, stopped, gaps)


def _gaps(track: Track, config: PassConfig) -> IntArray:
    """Return the indices of pings that follow a gap in time or position, or a step back in time."""
    dt = np.diff(track.time_s)
    step = np.hypot(np.diff(track.easting_m), np.diff(track.northing_m))
    if len(dt) == 0:
        return np.zeros(0, np.int64)
    usual_s = float(np.median(dt[dt > 0])) if np.any(dt > 0) else 0.0
    usual_m = float(np.median(step[step > 0])) if np.any(step > 0) else 0.0
    far = step > max(config.gap_m, config.gap_pings * usual_m)
    late = dt > max(config.gap_s, config.gap_pings * usual_s)
    return np.asarray(np.flatnonzero(far | late | (dt < 0)) + 1)


def _runs(n: int, gaps: IntArray) -> list[tuple[int, int]]:
    edges = [0, *(int(g) for g in gaps), n]
    return [(a, b) for a, b in pairwise(edges) if b > a]


def _typical_speed(track: Track, gaps: IntArray) -> float:
    """Return the median speed over ten-second windows, in which navigation noise averages out."""
    speeds = [_speed(track, a, b) for a, b in _runs(len(track.time_s), gaps) if b - a >= 3]
    return float(np.median(np.concatenate(speeds))) if speeds else 0.0


def _speed(track: Track, a: int, b: int, window_s: float = 10.0) -> FloatArray:
    time_s = track.time_s[a:b]
    # A step of a microsecond keeps equal times in order for the interpolation.
    time_s = time_s + 1e-6 * np.arange(b - a)
    early = np.maximum(time_s - window_s / 2, time_s[0])
    late = np.minimum(time_s + window_s / 2, time_s[-1])
    moved = [
        np.interp(late, time_s, axis[a:b]) - np.interp(early, time_s, axis[a:b])
        for axis in (track.easting_m, track.northing_m)
    ]
    return np.asarray(np.hypot(*moved) / np.maximum(late - early, 1e-6))


def _stops(track: Track, gaps: IntArray, usual_m_s: float, config: PassConfig) -> BoolArray:
    stopped = np.zeros(len(track.time_s), bool)
    if usual_m_s < config.stop_m_s:
        return stopped
    slow_m_s = max(config.stop_m_s, config.stop_share * usual_m_s)
    for a, b in _runs(len(stopped), gaps):
        if b - a < 3:
            continue
        slow = _speed(track, a, b) < slow_m_s
        for first, last in _true_runs(slow):
            if track.time_s[a + last - 1] - track.time_s[a + first] >= config.stop_s:
                stopped[a + first : a + last] = True
    return stopped


def _true_runs(mask: BoolArray) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _turns(track: Track, gaps: IntArray, usual_m_s: float, config: PassConfig) -> BoolArray:
    """Return the pings of turns: heading changes over half a range by more than a radius allows."""
    turning = np.zeros(len(track.time_s), bool)
    if usual_m_s < config.stop_m_s:
        return turning
    range_m = float(np.clip(np.nanmedian(track.range_m), 5.0, 200.0))
    base_m = range_m / 2
    base_s = base_m / usual_m_s
    limit_rad = base_m / (config.turn_radius_ranges * range_m)
    for a, b in _runs(len(turning), gaps):
        heading = smooth_heading(track.time_s[a:b], track.heading_rad[a:b], base_s / 4)
        time_s = track.time_s[a:b] + 1e-6 * np.arange(b - a)
        ahead = np.interp(time_s + base_s / 2, time_s, heading)
        behind = np.interp(time_s - base_s / 2, time_s, heading)
        for first, last in _true_runs(abs(ahead - behind) > limit_rad):
            before, after = behind[first], ahead[last - 1]
            if abs(after - before) < config.turn_rad:
                continue
            # The window that found the turn is wider than a tight one: keep the straight ends.
            bent = abs(heading[first:last] - before) > config.straight_rad
            still = abs(heading[first:last] - after) > config.straight_rad
            inner = np.flatnonzero(bent & still)
            if len(inner):
                turning[a + first + inner[0] : a + first + inner[-1] + 1] = True
    return turning


def smooth_heading(time_s: FloatArray, heading_rad: FloatArray, window_s: float) -> FloatArray:
    """Return the heading (n,), unwrapped and averaged over a window of time."""
    heading = np.unwrap(heading_rad)
    step_s = np.median(np.diff(time_s)) if len(time_s) > 1 else 0.0
    width = round(window_s / step_s) if step_s > 0 else 1
    width = int(np.clip(width, 1, max(len(heading) // 3, 1)))
    return np.asarray(uniform_filter1d(heading, width, mode="nearest"))


def _pieces(track: Track, gaps: IntArray, left_out: BoolArray, config: PassConfig) -> IntArray:
    """Label the stretches between gaps, turns and stops, cut again where a bend goes too far round."""
    label = np.full(len(track.time_s), -1, np.int64)
    number = 0
    for a, b in _runs(len(label), gaps):
        for first, last in _true_runs(~left_out[a:b]):
            for start, stop in _bent(track, a + first, a + last, config):
                label[start:stop] = number
                number += 1
    return label


def _bent(track: Track, a: int, b: int, config: PassConfig) -> list[tuple[int, int]]:
    """Cut a stretch whose heading swings through more than `most_turn_rad` at the swing's middle."""
    if not track.image or b - a < 3:
        return [(a, b)]
    duration_s = track.time_s[b - 1] - track.time_s[a]
    heading = smooth_heading(track.time_s[a:b], track.heading_rad[a:b], duration_s / 20)
    low, high = int(np.argmin(heading)), int(np.argmax(heading))
    if heading[high] - heading[low] <= config.most_turn_rad:
        return [(a, b)]
    first, last = min(low, high), max(low, high)
    middle = (heading[high] + heading[low]) / 2
    past = (heading[first : last + 1] > middle) == (heading[last] > middle)
    cut = a + first + max(int(np.argmax(past)), 1)
    return _bent(track, a, cut, config) + _bent(track, cut, b, config)


def _numbered(track: Track, label: IntArray, config: PassConfig) -> IntArray:
    """Drop short leftovers, cut what is too long for memory, and number passes in order."""
    pieces = [np.flatnonzero(label == k) for k in range(int(label.max(initial=-1)) + 1)]
    length_m = [
        float(np.hypot(np.ptp(track.easting_m[p]), np.ptp(track.northing_m[p]))) for p in pieces
    ]
    range_m = float(np.nanmedian(track.range_m)) if len(track.range_m) else 0.0
    least_m = min(range_m / 2, 0.2 * max(length_m, default=0.0)) if track.image else 0.0
    kept = [
        p
        for p, m in zip(pieces, length_m, strict=True)
        if len(p) >= config.least_pings and m >= least_m
    ]
    if not kept:
        longest = max(pieces, key=len, default=np.zeros(0, np.int64))
        kept = [longest] if len(longest) >= config.fewest_pings else []
    numbered = np.full(len(label), -1, np.int64)
    number = 0
    for piece in kept:
        width = 2 * int(track.samples[piece].max(initial=1))
        parts = int(np.ceil(len(piece) * width / config.most_samples))
        for part in np.array_split(piece, max(parts, 1)):
            numbered[part] = number
            number += 1
    return numbered
