"""A match of two passes over a square turned into a constraint on their navigation, with an honest covariance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapping.keyframes import Keyframes
from mapping.overlaps import Window
from mapping.pose_graph import Blend, GraphConfig, Link, Solution, perpendicular
from mapping.registration import Match
from perception.records import ElevationStrip, FloatArray, Grid

# Steps in which a walk's difference from its mean is integrated over a square.
_STEPS = 64


@dataclass(frozen=True, slots=True)
class PassFacts:
    """What its links need of a pass: usual way between lines, and how uneven the floor is beneath its track."""

    step_m: float
    unevenness_m: float

    @classmethod
    def of(cls, strip: ElevationStrip) -> PassFacts:
        """Measure a strip."""
        beneath = -(strip.depth_m + strip.altitude_m)
        unevenness_m = float(np.nanstd(beneath)) if np.isfinite(beneath).any() else np.nan
        return cls(strip.step_m, unevenness_m)


def link_of(
    strips: Sequence[ElevationStrip],
    facts: Mapping[int, PassFacts],
    keyframes: Keyframes,
    solution: Solution,
    window: Window,
    result: Match,
    config: GraphConfig,
    floor: Grid | None,
) -> Link:
    """Turn a match of corrected strips into a constraint on corrections of the navigation.

    What a match tells of a pass is the mean of its correction over the way along which it saw the square. Two
    keyframes, about a quarter of the square before and after its middle, have nearly that mean.

    Parameters
    ----------
    facts : of the two strips at least, by their number.
    """
    centre = np.array([window.easting_m, window.northing_m])
    unknown_m = None if floor is None else _typical_sigma(floor, window)
    covariance = result.covariance_m2 + _LEFT_OVER_M**2 * np.eye(2)
    blends, offsets, ground = [], [], []
    for strip, line in ((window.first, window.first_line), (window.second, window.second_line)):
        blend, left_m = blended(facts[strip].step_m, strip, line, window.side_m, keyframes)
        correction = blend.of(solution.correction_m)
        place = blend.of(np.column_stack([keyframes.easting_m, keyframes.northing_m]))
        offset = centre - place - correction
        swing = solution.pass_errors[strip, 2] * perpendicular(offset)
        blends.append(blend)
        offsets.append(offset)
        ground.append(correction + swing)
        covariance = covariance + config.walk_m2_per_m * left_m * np.eye(2)
        nearest = keyframes.nearest(strip, line)
        covariance = covariance + _misplacement(
            strips[strip], facts[strip], keyframes, nearest, offset, unknown_m
        )
    return Link(
        first=keyframes.nearest(window.first, window.first_line),
        second=keyframes.nearest(window.second, window.second_line),
        first_offset_m=offsets[0],
        second_offset_m=offsets[1],
        shift_m=ground[1] - ground[0] - result.shift_m,
        covariance_m2=covariance,
        first_blend=blends[0],
        second_blend=blends[1],
    )


def blended(
    step_m: float, index: int, line: float, side_m: float, keyframes: Keyframes
) -> tuple[Blend, float]:
    """Return the two keyframes that stand for a pass's mean over a square, and what they miss of a walk.

    Parameters
    ----------
    step_m : usual way between lines of pass `index`.
    line : mean line of the pass that saw the square; `side_m` its width.

    Returns
    -------
    blend, and the variance by which a walk's mean over the square differs from the blend's, in metres of
    way (times q^2).
    """
    reach = 0.25 * side_m / step_m
    low, high = (keyframes.nearest(index, line + d) for d in (-reach, reach))
    if low == high:
        first, last = int(keyframes.starts[index]), int(keyframes.starts[index + 1]) - 1
        towards = 1 if line > keyframes.line[low] else -1
        low, high = sorted((low, int(np.clip(low + towards, first, last))))
    at = (keyframes.line[[low, high]] - line) * step_m
    share = 0.5 if low == high else float(np.clip(-at[0] / (at[1] - at[0]), 0.0, 1.0))
    return Blend(low, high, share), _missed(at, share, side_m)


def _missed(at_m: FloatArray, share: float, side_m: float) -> float:
    """Return the variance, per q^2, of a random walk's mean over a square less its blend of two places.

    Both weigh the walk's steps by how much of their weight lies beyond, and the variance is the integral of the
    squared difference: side / 12 for one place in the middle, side / 48 for two a quarter in.
    """
    low, high = min(at_m.min(), -0.5 * side_m), max(at_m.max(), 0.5 * side_m)
    width = (high - low) / _STEPS
    u = low + (np.arange(_STEPS) + 0.5) * width
    mean = np.clip(0.5 - u / side_m, 0.0, 1.0)
    blend = (1.0 - share) * (u < at_m[0]) + share * (u < at_m[1])
    return float(((mean - blend) ** 2).sum() * width)


# The part of the floor's unevenness along a track that stays unknown beside it.
_UNKNOWN_RELIEF = 0.6
# What the width of beams and unmeasured rocking leave of any registration, 1-sigma an axis.
_LEFT_OVER_M = 0.2


def _typical_sigma(floor: Grid, window: Window) -> float | None:
    """Return the mean sigma (m) of a floor over a window; None where it has none there."""
    if floor.sigma_m is None:
        return None
    half = 0.5 * window.side_m
    row, col = floor.fractional_index(
        np.array([window.easting_m - half, window.easting_m + half]),
        np.array([window.northing_m + half, window.northing_m - half]),
    )
    rows = slice(max(int(row[0]), 0), max(int(row[1]) + 1, 0))
    cols = slice(max(int(col[0]), 0), max(int(col[1]) + 1, 0))
    sigma = floor.sigma_m[rows, cols]
    known = sigma[np.isfinite(sigma)]
    return float(known.mean()) if known.size else None


def _misplacement(
    strip: ElevationStrip,
    facts: PassFacts,
    keyframes: Keyframes,
    keyframe: int,
    offset_m: FloatArray,
    unknown_m: float | None,
) -> FloatArray:
    """Return the (2, 2) covariance by which unknown relief misplaces a square of ground.

    Ground that lies h above the floor beneath the track is drawn h a / x towards it (`placed_across`). What
    is unknown of h is told by the floor map's sigma, or else by how uneven the floor is along the track.
    """
    heading = float(keyframes.heading_rad[keyframe])
    starboard = np.array([np.cos(heading), -np.sin(heading)])
    line = int(keyframes.line[keyframe])
    altitude = float(np.nan_to_num(strip.altitude_m[line]))
    unevenness = facts.unevenness_m if np.isfinite(facts.unevenness_m) else 0.1 * altitude
    away = max(abs(float(offset_m @ starboard)), altitude, 1e-6)
    unknown_m = _UNKNOWN_RELIEF * unevenness if unknown_m is None else unknown_m
    sigma = unknown_m * altitude / away
    return sigma**2 * np.outer(starboard, starboard)
