"""Proof and repair at full resolution of a route found on a reduced map.

The route's depths are made anew over the raster as stored, read in windows along it, and proved there.
Where the stored ground breaks a limit that the block means did not show (a boulder, a hole, a step),
the stretch around that place is planned again on its window at full resolution and spliced in.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mapping.rasters import OpenMap, open_map
from perception.records import BoolArray, FloatArray, Grid, InputError
from planning.finish import Waypoints, prove, travel_time_s, water_along
from planning.ground import SurfaceGround, WindowedGround
from planning.large import Reduced, window_of
from planning.obstacles import Obstacles
from planning.planner import Plan, PlanConfig, plan_on_surface, solve
from planning.problem import Problem
from planning.route import Route
from planning.stand_off import least_stand_off
from planning.surface import Surface

logger = logging.getLogger(__name__)

# Sides, in cells: of the windows that a proof reads along a route (a diagonal one holds 40 times the
# cells that the route crosses, so they are small), and of the stretch that a repair plans anew.
_WINDOW_CELLS, _REPAIR_CELLS = 250.0, 500.0
# Repairs per stretch of that length, at most.
_MOST_REPAIRS = 3.0


@dataclass(frozen=True, slots=True)
class FullMap:
    """The map as stored, and what else bars or loosens its ground, asked window by window."""

    path: Path
    sigma_m: float | None
    reduced: Reduced
    forbidden: Callable[[Grid], BoolArray | None] = lambda grid: None
    position_sigma: Callable[[Grid], FloatArray | None] = lambda grid: None
    obstacles: Callable[[Grid], Obstacles | None] = lambda grid: None


def stretches(easting_m: FloatArray, northing_m: FloatArray, most_m: float) -> list[slice]:
    """Divide a route into stretches whose bounding boxes are at most `most_m` on a side.

    Neighbouring stretches share a waypoint, so that every segment belongs to one.
    """
    out = []
    first = 0
    while first < len(easting_m) - 1:
        span = np.maximum(
            np.maximum.accumulate(easting_m[first:]) - np.minimum.accumulate(easting_m[first:]),
            np.maximum.accumulate(northing_m[first:]) - np.minimum.accumulate(northing_m[first:]),
        )
        last = first + max(1, int(np.searchsorted(span, most_m)) - 1)
        out.append(slice(first, min(last, len(easting_m) - 1) + 1))
        first = min(last, len(easting_m) - 1)
    return out


def plan_large(
    full: FullMap,
    problem: Problem,
    start: tuple[float, float],
    goal: tuple[float, float],
    config: PlanConfig,
) -> tuple[Plan, int]:
    """Plan on the reduced map and prove at full resolution.

    Where no way is left between blocks that lack a cell, a second try counts blocks that lack up to half
    of theirs; the repairs then go round the holes.

    Returns
    -------
    The plan, its cost by the reduced map's weights, and the number of stretches planned anew.
    """
    plan = solve(problem, start, goal, config)
    if plan.route is None and full.reduced.loose_has_more:
        looser = replace(problem, grid=full.reduced.loose)
        tried = solve(looser, start, goal, config)
        if tried.route is not None:
            plan, problem = tried, looser
    if plan.route is None:
        return plan, 0
    return prove_at_full_resolution(full, plan, problem)


def prove_at_full_resolution(full: FullMap, plan: Plan, problem: Problem) -> tuple[Plan, int]:
    """Prove a reduced plan's route over the raster as stored; plan the stretches that fail anew."""
    assert plan.route is not None
    easting, northing = plan.route.easting_m, plan.route.northing_m
    cell = max(full.reduced.cell_m)
    most = math.ceil(_MOST_REPAIRS * (1.0 + plan.route.length_m / (_REPAIR_CELLS * cell)))
    with ExitStack() as stack:
        windows = _Windows(stack.enter_context(open_map(full.path, full.sigma_m)), full, problem)
        for repairs in range(most + 1):
            w, ground = windows.prove(plan.surface, easting, northing)
            if not w.problem:
                return replace(plan, route=windows.route(plan, w, ground)), repairs
            if repairs == most:
                break
            spliced = windows.repair(plan, easting, northing, w)
            if isinstance(spliced, str):
                return _refused(plan, w, spliced), repairs
            easting, northing = spliced
    return _refused(plan, w, f"still broken after {most} stretches were planned anew"), most


def _refused(plan: Plan, w: Waypoints, more: str) -> Plan:
    reason = (
        f"at full resolution, near {w.worst[0]:.1f},{w.worst[1]:.1f}: {w.problem} ({more}); cut the map "
        "to the area of the route (gdal_translate -projwin) to plan all of it at full resolution"
    )
    return replace(plan, route=None, reason=reason)


class _Windows:
    """The stored raster along a route."""

    def __init__(self, opened: OpenMap, full: FullMap, problem: Problem) -> None:
        # Decided once, on the whole map: a window may lie on dry ground alone.
        self.problem = replace(problem, submerged=problem.under_water())
        self.opened, self.full = opened, full

    def surface(self, box: tuple[float, float, float, float], k: float, margin_m: float) -> Surface:
        """Return the surface of a window under the clearance of the whole route."""
        grid = window_of(self.opened, box, margin_m)
        if self.problem.grid.sigma_m is None:
            grid = replace(grid, sigma_m=None)
        elif grid.sigma_m is None or not np.isfinite(grid.sigma_m).any():
            # Sigma is known elsewhere: ground without one is barred here as on the whole map.
            grid = replace(grid, elevation_m=np.full(grid.shape, np.nan))
        problem = replace(
            self.problem, grid=grid, weight=self._weights(grid), forbidden=self.full.forbidden(grid),
            position_sigma_m=self.full.position_sigma(grid), obstacles=self.full.obstacles(grid),
        )  # fmt: skip
        return problem.surface(problem.clearance_sigma_m(), k)

    def _weights(self, grid: Grid) -> FloatArray | None:
        """Return the weights of the nearest blocks."""
        if self.problem.weight is None:
            return None
        like = self.problem.grid
        easting, northing = grid.centres()
        col = np.clip((easting - like.west_m) / like.cell_m, 0, like.shape[1] - 1).astype(int)
        row = np.clip((like.north_m - northing) / like.cell_north_m, 0, like.shape[0] - 1)
        return self.problem.weight[np.ix_(row.astype(int), col)]

    def prove(
        self, surface: Surface, easting: FloatArray, northing: FloatArray
    ) -> tuple[Waypoints, WindowedGround]:
        """Give the positions their best profile over the stored raster, and prove it."""
        where = stretches(easting, northing, _WINDOW_CELLS * max(self.full.reduced.cell_m))
        parts = [
            SurfaceGround(self.surface(_box(easting[w], northing[w]), surface.k, 0.0), False)
            for w in where
        ]
        ground = WindowedGround(where, parts, SurfaceGround(surface))
        return prove(surface, easting, northing, ground=ground), ground

    def route(self, plan: Plan, w: Waypoints, ground: WindowedGround) -> Route:
        """Return the proved waypoints as a route, with the cost of the reduced map's weights."""
        middle = 0.5 * (w.altitude_m[1:] + w.altitude_m[:-1]) - plan.surface.limits.floor_m
        _, _, weight = ground.at(w.easting_m, w.northing_m)
        rate = 0.5 * (weight[1:] + weight[:-1])
        rate = rate + plan.surface.terms.altitude_per_m * np.maximum(0.0, middle)
        water = water_along(plan.surface, w)
        return Route(
            w.easting_m, w.northing_m, w.depth_m, w.altitude_m, w.heading_rad, w.distance_m,
            float((rate * np.diff(w.distance_m) * water).sum()), w.least_margin_m,
            w.least_altitude_m, w.greatest_altitude_m, w.worst, self.problem.grid.crs,
            travel_time_s(plan.surface, w), self._stand_off(w),
        )  # fmt: skip

    def _stand_off(self, w: Waypoints) -> float:
        most = _WINDOW_CELLS * max(self.full.reduced.cell_m)
        least = math.inf
        for part in stretches(w.easting_m, w.northing_m, most):
            box = _box(w.easting_m[part], w.northing_m[part])
            grid = window_of(self.opened, box, w.least_altitude_m)
            row, col = grid.fractional_index(w.easting_m[part], w.northing_m[part])
            distance, _ = least_stand_off(
                grid.elevation_m, (grid.cell_m, grid.cell_north_m), row, col, -w.depth_m[part],
                w.least_altitude_m,
            )  # fmt: skip
            least = min(least, distance)
        return min(least, w.least_altitude_m)

    def repair(
        self, plan: Plan, easting: FloatArray, northing: FloatArray, w: Waypoints
    ) -> tuple[FloatArray, FloatArray] | str:
        """Plan the stretch around the worst place anew; return the spliced positions or the reason."""
        cell = max(self.full.reduced.cell_m)
        at = int(np.argmin(np.hypot(easting - w.worst[0], northing - w.worst[1])))
        s = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(easting), np.diff(northing)))])
        half = 0.5 * _REPAIR_CELLS * cell
        i = int(np.searchsorted(s, s[at] - half))
        j = min(int(np.searchsorted(s, s[at] + half)), len(s) - 1)
        i, j = _straightest(easting, northing, i, -1), _straightest(easting, northing, j, 1)
        surface = self.surface(_box(easting[i : j + 1], northing[i : j + 1]), plan.surface.k, half)
        limits = replace(
            surface.limits,
            start_heading_deg=_heading_deg(easting, northing, i) if i > 0 else surface.limits.start_heading_deg,
            goal_heading_deg=_heading_deg(easting, northing, j - 1)
            if j < len(s) - 1
            else surface.limits.goal_heading_deg,
        )  # fmt: skip
        ends = [(float(easting[m]), float(northing[m])) for m in (i, j)]
        config = PlanConfig(planner="none", neighbours=16)
        try:
            part = plan_on_surface(
                replace(surface, limits=limits), self.problem.grid.crs, ends[0], ends[1], config
            )
        except InputError as error:
            return str(error)
        if part.route is None:
            return part.reason
        logger.info("stretch at %.0f,%.0f planned anew at full resolution", *w.worst[:2])
        spliced = [
            np.concatenate([whole[:i], new, whole[j + 1 :]])
            for whole, new in ((easting, part.route.easting_m), (northing, part.route.northing_m))
        ]
        return spliced[0], spliced[1]


def _box(easting: FloatArray, northing: FloatArray) -> tuple[float, float, float, float]:
    return (
        float(easting.min()), float(northing.min()), float(easting.max()), float(northing.max())
    )  # fmt: skip


def _straightest(easting: FloatArray, northing: FloatArray, at: int, step: int) -> int:
    """Return the waypoint, at `at` or a few beyond, where the route bends least: a clean joint."""
    last = len(easting) - 1
    if at <= 0 or at >= last:
        return min(max(at, 0), last)
    places = [p for p in range(at, at + 40 * step, step) if 0 < p < last]
    bends = [
        abs(
            math.remainder(
                math.radians(
                    _heading_deg(easting, northing, p) - _heading_deg(easting, northing, p - 1)
                ),
                2 * math.pi,
            )
        )
        for p in places
    ]
    return places[int(np.argmin(bends))]


def _heading_deg(easting: FloatArray, northing: FloatArray, leg: int) -> float:
    return math.degrees(
        math.atan2(easting[leg + 1] - easting[leg], northing[leg + 1] - northing[leg])
    )
