"""Polish: move the control polygon until no shift of it, wide or narrow, lowers the exact cost.

Pattern search over bumps of several widths. Each trial re-samples the window of the curve that it
changes and gives it its best depth profile, so what falls is the very cost that is reported, pitch
limits, ceiling and turning radius included.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from perception.records import FloatArray
from planning.descent import curve_cost, descend
from planning.profile import EXCESS_PRICE, make_work
from planning.surface import Surface

# From round to round the price of breaking the ceiling rises by the inverse of this: at first a path may
# cut through what a harder price would fence off, and settles into the better valley.
_EASE = 0.25
# Pitch and radius are planned a little inside the limits: printed digits must keep them too.
PITCH_RESERVE = 0.995
RADIUS_RESERVE = 1.01
# Height kept in reserve while planning, at floor and ceiling (m): the samples lie a cell apart, the
# exact clearance between them is made good afterwards by lifting.
HEIGHT_RESERVE_M = 0.02


@dataclass(frozen=True, slots=True)
class Candidate:
    """A control polygon in local coordinates and what its rounded curve costs.

    Attributes
    ----------
    points : (n, 2) control polygon.
    cost : of the curve with its best profile, prices of breaches included.
    breach : integral of what it breaks; 0 keeps every limit.
    source : who proposed it.
    """

    points: FloatArray
    cost: float
    breach: float
    source: str = ""


def rules_of(surface: Surface, reserve_m: float = HEIGHT_RESERVE_M) -> FloatArray:
    """Return the rules of `path_cost` for a surface's limits and terms."""
    limits = surface.limits
    return np.array(
        [
            surface.terms.altitude_per_m,
            limits.slope_up * PITCH_RESERVE,
            limits.slope_down * PITCH_RESERVE,
            limits.floor_m,
            limits.ceiling_m,
            surface.bottom_most_m,
            surface.top_m,
            reserve_m,
            EXCESS_PRICE,
        ]
    )


def control_spacing(surface: Surface, length_m: float) -> float:
    """Return the distance of control points: about the radius, some cells, at most 400 of them."""
    cell = max(surface.cell_m)
    return max(surface.limits.turn_radius_m, 6.0 * cell, length_m / 400.0)


def respace(points: FloatArray, spacing: float) -> FloatArray:
    """Return a polygon of equal legs about `spacing` along the given one, ends kept."""
    legs = np.hypot(*np.diff(points, axis=0).T)
    s = np.concatenate([[0.0], np.cumsum(legs)])
    n = max(2, round(s[-1] / spacing))
    at = np.linspace(0.0, s[-1], n + 1)
    return np.column_stack([np.interp(at, s, points[:, 0]), np.interp(at, s, points[:, 1])])


def smooth_guide(points: FloatArray, spacing: float) -> FloatArray:
    """Return a guide's control polygon: the grid's zigzag averaged over one spacing, ends kept."""
    fine = respace(points, spacing / 8.0)
    half = min(4, (len(fine) - 1) // 2)
    if half > 0:
        padded = np.concatenate(
            [2 * fine[:1] - fine[half:0:-1], fine, 2 * fine[-1:] - fine[-2 : -half - 2 : -1]]
        )
        kernel = np.ones(2 * half + 1) / (2 * half + 1)
        fine = np.column_stack([np.convolve(padded[:, i], kernel, "valid") for i in (0, 1)])
    return respace(fine, spacing)


def evaluate(
    surface: Surface,
    points: FloatArray,
    source: str = "",
    step: float | None = None,
    rules: FloatArray | None = None,
) -> Candidate:
    """Cost a control polygon as it stands, sampled `step` apart (a cell without)."""
    step = min(surface.cell_m) if step is None else step
    rules = rules_of(surface) if rules is None else rules
    cost, breach = curve_cost(_scene(surface, points, step, rules), points, 0, len(points) - 1)
    return Candidate(points, float(cost), float(breach), source)


def polish(
    surface: Surface,
    points: FloatArray,
    sweeps: int = 60,
    rounds: int = 3,
    source: str = "",
    reserve_m: float = HEIGHT_RESERVE_M,
    fineness: float = 1.0,
    step_cells: float = 1.0,
) -> Candidate:
    """Lower the cost of a control polygon until it stops falling; ends stay.

    Parameters
    ----------
    points : (n, 2) control polygon in local coordinates.
    sweeps : most passes over all bumps in a round.
    rounds : after each but the last the control points are spaced evenly again.
    reserve_m : height kept in reserve at floor and ceiling.
    fineness : samples per usual sample, and control points per usual control point.
    step_cells : usual distance of samples, in cells; 2 for a first look at half the price.
    """
    spacing = control_spacing(surface, float(np.hypot(*np.diff(points, axis=0).T).sum())) / fineness
    step = step_cells * min(surface.cell_m) / fineness
    rules = rules_of(surface, reserve_m)
    points, locked = _lock_ends(surface, points.copy())
    best = evaluate(surface, points.copy(), source, step, rules)
    for turn in range(rounds):
        trial = rules.copy()
        trial[8] = EXCESS_PRICE * _EASE ** (rounds - 1 - turn)
        if turn > 0:
            points, locked = _lock_ends(surface, respace(points, spacing))
        scene = _scene(surface, points, step, trial)
        descend(scene, points, *locked, sweeps, _margin_m(surface))
        found = evaluate(surface, points.copy(), source, step, rules)
        if found.cost < best.cost or (best.breach > 0 and found.breach == 0):
            best = found
    return best


def _lock_ends(surface: Surface, points: FloatArray) -> tuple[FloatArray, tuple[int, int]]:
    """Lay the end legs along the headings asked for; return how many points stay at either end."""
    locked = [1, 1]
    limits = surface.limits
    for i, heading_deg in enumerate((limits.start_heading_deg, limits.goal_heading_deg)):
        if not math.isfinite(heading_deg) or len(points) < 4:
            continue
        heading = math.radians(heading_deg)
        ahead = np.array([math.sin(heading), -math.cos(heading)]) * (1 if i == 0 else -1)
        end, beside = (0, 1) if i == 0 else (-1, -2)
        leg = float(np.hypot(*(points[beside] - points[end])))
        points[beside] = points[end] + leg * ahead
        locked[i] = 2
    return points, (locked[0], locked[1])


def _margin_m(surface: Surface) -> float:
    """Return how far along the path a change of height can make itself felt."""
    band = surface.limits.ceiling_m - surface.limits.floor_m
    slope = min(surface.limits.slope_up, surface.limits.slope_down)
    return min(band / slope, 12.0 * band) + 4.0 * max(surface.cell_m)


def _scene(surface: Surface, points: FloatArray, step: float, rules: FloatArray) -> tuple[Any, ...]:
    """Return what the kernels need to cost a curve, scratch included."""
    length = float(np.hypot(*np.diff(points, axis=0).T).sum())
    # A path may grow while it is moved; twice its samples leaves room, and what does not fit is refused.
    n = int(2.0 * length / step) + 4 * len(points) + 256
    return (
        surface.stack, surface.cell_m[0], surface.cell_m[1],
        surface.limits.turn_radius_m * RADIUS_RESERVE, step, rules,
        np.empty(n), np.empty(n), *make_work(n),
    )  # fmt: skip
