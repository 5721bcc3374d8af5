"""Keyframes: the lines of each strip at which the pose graph corrects the navigation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from mapping.fixes import PositionFix
from perception.records import ElevationStrip, FloatArray, IntArray

# A step this many times the pass's usual speed is a jump of the navigation, not motion.
_JUMP_FACTOR = 4.0
# Passes this far apart in time are not one dive: their navigation starts anew.
_SEPARATE_DIVE_S = 4 * 3600.0


@dataclass(frozen=True, slots=True)
class Keyframes:
    """Chosen lines of all strips, in the order of the strips.

    Attributes
    ----------
    strip, line : (k,) index of the strip and of its line.
    easting_m, northing_m, heading_rad, time_s : (k,) as the navigation has them.
    way_m : (k,) length of the way from the keyframe before; NaN where nothing connects the two.
    jump_m : (k,) extra 1-sigma of the way from the keyframe before, for a jump in the navigation.
    starts : (strips + 1,) first keyframe of each strip.
    """

    strip: IntArray
    line: IntArray
    easting_m: FloatArray
    northing_m: FloatArray
    heading_rad: FloatArray
    time_s: FloatArray
    way_m: FloatArray
    jump_m: FloatArray
    starts: IntArray

    def __len__(self) -> int:
        return len(self.strip)

    def cut_alike(self, other: Keyframes) -> bool:
        """Return whether the strips that both hold have the same lines for keyframes."""
        strips, lines = min(len(self.starts), len(other.starts)), min(len(self), len(other))
        return np.array_equal(self.starts[:strips], other.starts[:strips]) and np.array_equal(
            self.line[:lines], other.line[:lines]
        )

    def nearest(self, strip: int, line: float) -> int:
        """Return the keyframe of `strip` that is nearest to `line`."""
        first, last = int(self.starts[strip]), int(self.starts[strip + 1])
        return first + int(np.argmin(np.abs(self.line[first:last] - line)))


def choose_keyframes(strips: Sequence[ElevationStrip], spacing_m: float) -> Keyframes:
    """Choose the first and last line of every strip and one about every `spacing_m` between.

    Between two strips the vehicle's way is unknown (a turn, a transit): its length is taken as the time
    between them at the passes' usual speed, and never less than the distance. Strips hours apart, or
    whose clocks run backwards, are not connected.
    """
    parts: dict[str, list[npt.NDArray[Any]]] = {
        name: [] for name in ("strip", "line", "e", "n", "h", "t", "way", "jump")
    }
    starts = [0]
    before: tuple[float, float, float] | None = None
    for index, strip in enumerate(strips):
        travelled, step, usual = _travelled(strip)
        count = max(2, round(travelled[-1] / spacing_m) + 1) if len(travelled) > 1 else 1
        marks = np.linspace(0.0, travelled[-1], count)
        lines = np.unique(np.clip(np.searchsorted(travelled, marks), 0, len(travelled) - 1))
        way = np.diff(travelled[lines], prepend=0.0)
        excess = np.where(step > _JUMP_FACTOR * max(usual, 1e-6), step, 0.0)
        jump = np.diff(np.cumsum(excess)[lines], prepend=0.0)
        way[0], jump[0] = _gap(before, strip, usual)
        rows = (*strip.sonar_positions(), strip.heading_rad, strip.time_s)
        for name, value in zip(("e", "n", "h", "t"), rows, strict=True):
            parts[name].append(value[lines])
        parts["strip"].append(np.full(len(lines), index))
        parts["line"].append(lines)
        parts["way"].append(way)
        parts["jump"].append(jump)
        starts.append(starts[-1] + len(lines))
        east, north = strip.sonar_positions()
        before = (float(east[-1]), float(north[-1]), float(strip.time_s[-1]))
    joined = {name: np.concatenate(values) for name, values in parts.items()}
    return Keyframes(
        strip=joined["strip"],
        line=joined["line"],
        easting_m=joined["e"],
        northing_m=joined["n"],
        heading_rad=joined["h"],
        time_s=joined["t"],
        way_m=joined["way"],
        jump_m=joined["jump"],
        starts=np.array(starts),
    )


def _travelled(strip: ElevationStrip) -> tuple[FloatArray, FloatArray, float]:
    """Return the way since the first line (n,), each line's step, and the usual step."""
    step = np.hypot(*(np.diff(place) for place in strip.sonar_positions()))
    step = np.concatenate([[0.0], np.nan_to_num(step)])
    usual = float(np.median(step[1:])) if len(step) > 1 else 0.0
    return np.cumsum(step), step, usual


def _gap(
    before: tuple[float, float, float] | None, strip: ElevationStrip, usual_step_m: float
) -> tuple[float, float]:
    """Return the way from the strip before, and its extra 1-sigma for a jump."""
    if before is None:
        return np.nan, 0.0
    east, north = strip.sonar_positions()
    distance = float(np.hypot(east[0] - before[0], north[0] - before[1]))
    seconds = float(strip.time_s[0] - before[2])
    if not 0.0 <= seconds <= _SEPARATE_DIVE_S:
        return np.nan, 0.0
    per_line = float(np.median(np.diff(strip.time_s))) if len(strip.time_s) > 1 else 0.0
    speed = usual_step_m / per_line if per_line > 0 else 0.0
    way = max(distance, seconds * speed)
    # Faster than the vehicle ever goes: the navigation was reset between the passes.
    jumped = speed > 0 and distance > _JUMP_FACTOR * max(seconds, per_line) * speed
    return way, distance if jumped else 0.0


@dataclass(frozen=True, slots=True)
class KeyframeFix:
    """An absolute fix tied to a keyframe: the correction that it asks for there.

    `correction_m` (2,) is fix minus navigation, `covariance_m2` (2, 2) includes the way between fix and
    keyframe.
    """

    keyframe: int
    correction_m: FloatArray
    covariance_m2: FloatArray


def tie_fixes(
    fixes: Sequence[PositionFix],
    strips: Sequence[ElevationStrip],
    keyframes: Keyframes,
    drift_m_per_sqrt_km: float,
    speed_m_s: float | None = None,
) -> list[KeyframeFix]:
    """Tie each accepted fix to the keyframe nearest in time.

    Inside a pass the navigation is interpolated to the fix's time, so only the drift between that
    time and the keyframe's adds to the covariance. A fix taken outside every pass (at the surface
    before the first line, in a turn) is carried to the pass's end with the vehicle's usual speed, as
    far as nothing better is known, and with the uncertainty of that way.
    """
    tied = []
    for fix in fixes:
        if not fix.accepted:
            continue
        k = int(np.argmin(np.abs(keyframes.time_s - fix.time_s)))
        strip = strips[int(keyframes.strip[k])]
        east, north, way_m, unknown_m = _navigation_at(strip, fix.time_s, speed_m_s)
        drift = drift_m_per_sqrt_km**2 * (way_m + abs(fix.time_s - keyframes.time_s[k])) / 1000.0
        tied.append(
            KeyframeFix(
                keyframe=k,
                correction_m=np.array([fix.easting_m - east, fix.northing_m - north]),
                covariance_m2=fix.covariance_m2 + (drift + unknown_m**2) * np.eye(2),
            )
        )
    return tied


def _navigation_at(
    strip: ElevationStrip, time_s: float, speed_m_s: float | None
) -> tuple[float, float, float, float]:
    """Return the navigation's position at a time, the way beyond the pass, and its 1-sigma there."""
    order = np.argsort(strip.time_s, kind="stable")
    times = strip.time_s[order]
    places = strip.sonar_positions()
    east, north = (float(np.interp(time_s, times, place[order])) for place in places)
    outside_s = max(times[0] - time_s, time_s - times[-1], 0.0)
    if outside_s == 0.0:
        return east, north, 0.0, 0.0
    edge = slice(0, 20) if time_s < times[0] else slice(-20, None)
    seconds = float(np.ptp(times[edge]))
    if seconds <= 0:
        return east, north, outside_s, outside_s
    velocity = np.array(
        [np.polyfit(times[edge] - times[edge][0], values[order][edge], 1)[0] for values in places]
    )
    speed = float(np.hypot(*velocity)) if speed_m_s is None else speed_m_s
    shift = velocity * (time_s - np.clip(time_s, times[0], times[-1]))
    # Straight on for a few seconds is a fair guess; after that the vehicle may be anywhere around.
    return east + shift[0], north + shift[1], speed * outside_s, 0.5 * speed * outside_s
