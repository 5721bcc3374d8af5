"""Survey lines that cover an area with a side-scan sonar: spacing, crossings, turns, terrain-following."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from perception.records import FloatArray, InputError
from planning.dubins import dubins
from planning.finish import POSITION_DIGITS, Waypoints, prove
from planning.polish import RADIUS_RESERVE
from planning.surface import Surface


@dataclass(frozen=True, slots=True)
class SurveyConfig:
    """How an area is covered.

    Attributes
    ----------
    swath_m : ground covered across the track by one pass, both sides together.
    overlap : share of a swath that the next line covers again.
    crossings : number of lines square to the others, which tie them for registration.
    run_in_m : straight and level stretch before and after each line.
    """

    swath_m: float = 60.0
    overlap: float = 0.2
    crossings: int = 2
    run_in_m: float = 5.0

    def __post_init__(self) -> None:
        if not self.swath_m > 0:
            raise InputError(f"the swath must be wider than 0 m, got {self.swath_m:g}")
        if not 0 <= self.overlap < 0.9:
            raise InputError(f"the overlap must lie in [0, 0.9), got {self.overlap:g}")
        if self.crossings < 0:
            raise InputError(
                f"the number of crossing lines must be 0 or more, got {self.crossings}"
            )


@dataclass(frozen=True, slots=True)
class Survey:
    """A survey: lines in the order they are run, and the path that joins them.

    Attributes
    ----------
    lines : (n, 2, 2) easting, northing of each line's begin and end.
    path : the proved waypoints of the whole, turns included.
    covered : share of the area that the lines cover.
    """

    lines: FloatArray
    path: Waypoints
    covered: float
    area_m2: float


def plan_survey(surface: Surface, area: Any, config: SurveyConfig | None = None) -> Survey:
    """Cover a polygon with parallel lines, crossing lines and shortest turns, and prove the clearance.

    Parameters
    ----------
    area : shapely polygon in the map's CRS.

    Raises
    ------
    InputError
        The area is empty.
    """
    config = config or SurveyConfig()
    if area.is_empty or not area.area > 0:
        raise InputError("the survey area is empty; draw a polygon")
    angle = _long_axis(area)
    lines = _lines(area, angle, config.swath_m * (1.0 - config.overlap), config.swath_m)
    covered = _covered(area, lines, config.swath_m)
    ordered = _run_order(lines, 2.0 * surface.limits.turn_radius_m * RADIUS_RESERVE)
    if config.crossings > 0:
        across = _crossings(area, angle, config.crossings)
        ordered = np.concatenate([ordered, _nearest_end(ordered[-1, 1], across)])
    spacing = float(min(surface.cell_m))
    if surface.limits.turn_radius_m > 0:
        spacing = min(spacing, surface.limits.turn_radius_m / 8.0)
    xy = _join(ordered, surface.limits.turn_radius_m * RADIUS_RESERVE, config.run_in_m, spacing)
    digits = np.round(xy, POSITION_DIGITS)
    return Survey(ordered, prove(surface, digits[:, 0], digits[:, 1]), covered, float(area.area))


def _long_axis(area: Any) -> float:
    """Return the direction (rad, from east) of the least rectangle's long side: fewest turns."""
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(area))
    edges = np.diff(corners, axis=0)
    longest = edges[int(np.argmax(np.hypot(*edges.T)))]
    return math.atan2(longest[1], longest[0])


def _lines(area: Any, angle: float, spacing: float, swath: float) -> FloatArray:
    """Return (n, 2, 2) lines; the first and last lie half a swath inside the area's edges."""
    along = np.array([math.cos(angle), math.sin(angle)])
    across = np.array([-along[1], along[0]])
    corners = shapely.get_coordinates(area)
    v = corners @ across
    width = float(v.max() - v.min())
    n = max(1, math.ceil((width - swath) / spacing) + 1)
    middle = 0.5 * (v.max() + v.min())
    offsets = middle + (np.arange(n) - 0.5 * (n - 1)) * (
        min(spacing, max(width - swath, 0.0) / max(n - 1, 1)) if n > 1 else 0.0
    )
    lines = []
    for offset in offsets:
        # A line covers the strip beside it: it must run wherever that strip meets the area.
        strip = _strip(along, across, offset - 0.5 * swath, offset + 0.5 * swath, corners)
        part = shapely.get_coordinates(shapely.intersection(area, strip))
        if len(part):
            u = part @ along
            lines.append([offset * across + u.min() * along, offset * across + u.max() * along])
    return np.array(lines)


def _strip(
    along: FloatArray, across: FloatArray, low: float, high: float, corners: FloatArray
) -> Any:
    u = corners @ along
    begin, end = u.min() - 1.0, u.max() + 1.0
    return shapely.Polygon(
        [begin * along + low * across, end * along + low * across,
         end * along + high * across, begin * along + high * across]
    )  # fmt: skip


def _covered(area: Any, lines: FloatArray, swath: float) -> float:
    strips = shapely.buffer(shapely.linestrings(lines), 0.5 * swath, cap_style="flat")
    return float(shapely.intersection(area, shapely.union_all(strips)).area / area.area)


def _crossings(area: Any, angle: float, n: int) -> FloatArray:
    along = np.array([math.cos(angle), math.sin(angle)])
    across = np.array([-along[1], along[0]])
    corners = shapely.get_coordinates(area)
    u = corners @ along
    lines = []
    for k in range(n):
        offset = u.min() + (k + 1) / (n + 1) * (u.max() - u.min())
        v = corners @ across
        cut = shapely.LineString(
            [offset * along + (v.min() - 1) * across, offset * along + (v.max() + 1) * across]
        )
        part = shapely.get_coordinates(shapely.intersection(area, cut))
        if len(part) >= 2:
            w = part @ across
            lines.append([offset * along + w.min() * across, offset * along + w.max() * across])
    return np.array(lines)


def _run_order(lines: FloatArray, least_m: float) -> FloatArray:
    """Return the lines in running order, to and fro, skipping lines nearer than a turning circle.

    A turn between lines nearer than two radii needs a loop; taking every m-th line in turn makes it a
    plain half circle.
    """
    n = len(lines)
    if n < 2:
        return lines
    spacing = float(np.hypot(*np.diff(lines.mean(axis=1), axis=0)[0]))
    skip = min(max(1, math.ceil(least_m / max(spacing, 1e-9) - 1e-9)), n)
    order = [i for first in range(skip) for i in range(first, n, skip)]
    turned = [lines[i] if k % 2 == 0 else lines[i][::-1] for k, i in enumerate(order)]
    return np.array(turned)


def _nearest_end(here: FloatArray, lines: FloatArray) -> FloatArray:
    """Return lines in nearest-first order from `here`, each begun at its nearer end."""
    left, out = list(lines), []
    while left:
        ends = [
            (float(np.hypot(*(line[e] - here))), i, e)
            for i, line in enumerate(left)
            for e in (0, 1)
        ]
        _, i, e = min(ends)
        line = left.pop(i)
        line = line if e == 0 else line[::-1]
        out.append(line)
        here = line[1]
    return np.array(out).reshape(-1, 2, 2)


def _join(lines: FloatArray, radius: float, run_in: float, spacing: float) -> FloatArray:
    """Return waypoints along the lines, extended by the run-in, with shortest turns between them."""
    pieces: list[FloatArray] = []
    poses = []
    # Chords of chords would tighten the arcs: trace them finely before they are spaced evenly.
    fine = 0.05 * spacing
    for begin, end in lines:
        unit = (end - begin) / max(float(np.hypot(*(end - begin))), 1e-9)
        heading = math.atan2(unit[0], unit[1])
        poses.append((begin - run_in * unit, end + run_in * unit, heading))
    for k, (begin, end, heading) in enumerate(poses):
        if k > 0:
            last = poses[k - 1]
            if radius > 0:
                turn = dubins(
                    (last[1][0], last[1][1], last[2]),
                    (begin[0], begin[1], heading),
                    radius,
                    fine,
                )
                pieces.append(turn[1:-1])
        n = max(1, math.ceil(float(np.hypot(*(end - begin))) / spacing))
        pieces.append(begin + (end - begin) * (np.arange(n + 1) / n)[:, None])
    return _even(np.concatenate(pieces), spacing)


def _even(points: FloatArray, spacing: float) -> FloatArray:
    """Return the path at equal distances; chords this short leave the radius where it was."""
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at = np.linspace(0.0, s[-1], max(1, math.ceil(s[-1] / spacing)) + 1)
    return np.column_stack([np.interp(at, s, points[:, i]) for i in (0, 1)])
