"""The planner's summary: guide, seed, polish, proof."""

from __future__ import annotations

import logging
import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from perception.records import BoolArray, FloatArray, Grid, InputError, Progress, silent
from planning.bound import lower_bound
from planning.corridor import make_corridor
from planning.cost import CostTerms
from planning.curve import waypoints
from planning.failure import Blockage, explain_barrier, explain_limits
from planning.finish import POSITION_DIGITS, exact_cost, finish
from planning.layers import cost_to_go, layered_path, thinned
from planning.limits import VehicleLimits
from planning.polish import RADIUS_RESERVE, Candidate, control_spacing, polish, smooth_guide
from planning.pyramid import guided_search
from planning.risk import clearance_factor, clearance_sigma, patches_crossed
from planning.route import Route, route_of
from planning.surface import Surface, build_surface, cautious

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class PlanConfig:
    """How a route is looked for.

    Attributes
    ----------
    planner : OMPL's planner: rrtstar, informed, sorrt, bitstar, fmt, or none.
    iterations : of OMPL; on iterations, not on time, so that runs repeat; None about a second's.
    seed : of OMPL.
    risk : probability that the floor is broken anywhere along the route.
    correlation_m : distance over which the map's errors are independent; NaN 10 cells.
    neighbours : of the grid search.
    layers : whether the second guide (place and altitude) is asked.
    """

    planner: str = "bitstar"
    iterations: int | None = None
    seed: int = 0
    risk: float = 0.01
    correlation_m: float = float("nan")
    neighbours: int = 32
    layers: bool = True


@dataclass(frozen=True, slots=True)
class Plan:
    """The answer: a route or the reason why there is none, and how good it is.

    Attributes
    ----------
    route : None where unsolved.
    reason : empty where solved; else which limit blocks, where, and the way out.
    grid_cost : limit-free grid search at the floor; NaN where even that finds no way.
    lower_bound : certified: no route within the limits costs less.
    stages_s : seconds per stage; `costs` the cost of each candidate after polishing.
    """

    route: Route | None
    reason: str
    grid_cost: float
    lower_bound: float
    k: float
    patches: float
    surface: Surface
    grid_path: FloatArray
    stages_s: dict[str, float] = field(default_factory=dict)
    costs: dict[str, float] = field(default_factory=dict)
    blockage: Blockage | None = None

    @property
    def solved(self) -> bool:
        return self.route is not None

    @property
    def ratio(self) -> float:
        """Cost over the limit-free grid search; NaN without a route or between ends of one cell."""
        if self.route is None or not self.grid_cost > 0:
            return math.nan
        return self.route.cost / self.grid_cost


def plan_route(
    grid: Grid,
    start: tuple[float, float],
    goal: tuple[float, float],
    limits: VehicleLimits | None = None,
    terms: CostTerms | None = None,
    weight: FloatArray | None = None,
    config: PlanConfig | None = None,
    forbidden: BoolArray | None = None,
    position_sigma_m: FloatArray | None = None,
    progress: Progress = silent,
) -> Plan:
    """Plan a low route from start to goal (easting, northing) and prove its clearance.

    Parameters
    ----------
    weight : (rows, cols) `w` of the cost; 1 everywhere without.
    forbidden : (rows, cols) True in no-go areas.
    position_sigma_m : (rows, cols) expected position error, 1-sigma per axis.

    Raises
    ------
    InputError
        Start or goal is off the map, on no data, or where the limits leave no water.
    """
    limits, terms, config = limits or VehicleLimits(), terms or CostTerms(), config or PlanConfig()
    sigma = clearance_sigma(
        grid.elevation_m, (grid.cell_m, grid.cell_north_m), grid.sigma_m,
        limits.sigma_position_m if position_sigma_m is None else position_sigma_m,
        limits.sigma_depth_m,
    )  # fmt: skip
    correlation = config.correlation_m
    if not np.isfinite(correlation):
        correlation = 10.0 * max(grid.cell_m, grid.cell_north_m)
    if terms.position_per_m > 0 and position_sigma_m is not None:
        dear = terms.position_per_m * np.nan_to_num(position_sigma_m)
        weight = dear + (1.0 if weight is None else weight)
    submerged = not _dry(grid, start, goal)
    straight = float(np.hypot(goal[0] - start[0], goal[1] - start[1]))
    if straight < 10.0**-POSITION_DIGITS:
        raise InputError(
            f"start and goal are the same place ({start[0]:.2f},{start[1]:.2f}); move one of them"
        )
    length = 1.3 * straight
    while True:
        patches = patches_crossed(length, correlation)
        k = 0.0 if sigma is None else clearance_factor(config.risk, patches)
        surface = build_surface(grid, limits, terms, weight, sigma, k, forbidden, submerged)
        plan = _plan_on(surface, grid, start, goal, config, k, patches, progress)
        if sigma is None or plan.route is None or plan.route.length_m <= length:
            return plan
        # The route came out longer than the risk was shared out for: share it anew.
        length = 1.05 * plan.route.length_m


def _dry(grid: Grid, start: tuple[float, float], goal: tuple[float, float]) -> bool:
    """Tell whether the map is no sea floor at all: both ends stand above its zero.

    A dry terrain model stands in for a sea floor then, and its zero is no water's surface.
    """
    ends = grid.sample(np.array([start[0], goal[0]]), np.array([start[1], goal[1]]))
    return bool(np.nanmin(grid.elevation_m) > 0 and (ends > 0).all())


def _plan_on(
    surface: Surface,
    grid: Grid,
    start: tuple[float, float],
    goal: tuple[float, float],
    config: PlanConfig,
    k: float,
    patches: float,
    progress: Progress,
) -> Plan:
    stages: dict[str, float] = {}
    clock = time.perf_counter()

    def lap(stage: str) -> None:
        nonlocal clock
        now = time.perf_counter()
        stages[stage] = stages.get(stage, 0.0) + now - clock
        clock = now

    node_a = end_node(surface, start, "start")
    node_b = end_node(surface, goal, "goal")
    grid_cost, nodes = guided_search(surface, node_a, node_b, config.neighbours)
    lap("grid_s")
    bound = lower_bound(surface, start, goal)
    lap("bound_s")
    ends = np.array([surface.local(np.array(p[0]), np.array(p[1])) for p in (start, goal)])
    if not np.isfinite(grid_cost):
        parted = explain_barrier(surface, node_a, node_b)
        return Plan(
            None, parted.reason, math.nan, bound, k, patches, surface, np.zeros((0, 2)), stages,
            blockage=parted,
        )  # fmt: skip
    guide = np.column_stack([nodes[:, 1] * surface.cell_m[0], nodes[:, 0] * surface.cell_m[1]])
    guide = np.concatenate([ends[:1], guide[1:-1], ends[1:]])
    # Barred ground a cell wider while looking: samples cannot miss its corners then.
    careful = cautious(surface, ends) if surface.barred.any() else surface
    candidates = _from_guides(careful, guide, ends, config)
    if careful is not surface and all(c.breach > 0 for c in candidates):
        careful = surface
        candidates += _from_guides(careful, guide, ends, config)
    lap("guides_s")
    if config.planner != "none":
        found = _ompl(careful, min(candidates, key=_merit), ends, config)
        if found is not None:
            candidates.append(_polished(careful, found, "ompl"))
        lap("ompl_s")
    best = min(candidates, key=_merit)
    candidates.append(polish(careful, best.points, _SWEEPS, rounds=2, source="final"))
    lap("polish_s")
    route, problem = _best_proved(surface, candidates, grid.crs)
    if route is None:
        candidates += _second_tries(surface, candidates, ends)
        route, problem = _best_proved(surface, candidates, grid.crs)
    lap("proof_s")
    costs = {c.source: c.cost for c in candidates}
    blocked: Blockage | None = None
    if route is None:
        blocked = explain_limits(surface, candidates, guide, problem)
        lap("explain_s")
    return Plan(
        route, "" if blocked is None else blocked.reason, grid_cost, bound, k, patches, surface,
        guide, stages, costs, blocked,
    )  # fmt: skip


# Sweeps of the polish: a first look at every guide with samples two cells apart, then the best in full.
_FIRST_SWEEPS, _FIRST_STEP_CELLS, _SWEEPS = 25, 2.0, 40


def _from_guides(
    surface: Surface, guide: FloatArray, ends: FloatArray, config: PlanConfig
) -> list[Candidate]:
    """Return the polished guides: the grid's, and that which knows pitch and ceiling.

    They are made side by side: the kernels let go of the interpreter, and neither waits for the other.
    """
    if not config.layers:
        return [_polished(surface, guide, "grid")]

    def second() -> Candidate | None:
        layered = layered_path(surface, tuple(ends[0]), tuple(ends[1]))
        return _polished(surface, layered.points, "layers") if len(layered.points) > 2 else None

    with ThreadPoolExecutor(2) as pool:
        other = pool.submit(second)
        first = _polished(surface, guide, "grid")
        found = other.result()
    return [first] if found is None else [first, found]


def _merit(candidate: Candidate) -> tuple[bool, float]:
    return candidate.breach > 0, candidate.cost


def _polished(surface: Surface, guide: FloatArray, source: str) -> Candidate:
    length = float(np.hypot(*np.diff(guide, axis=0).T).sum())
    return polish(
        surface,
        smooth_guide(guide, control_spacing(surface, length)),
        _FIRST_SWEEPS,
        source=source,
        step_cells=_FIRST_STEP_CELLS,
    )


def _ompl(
    surface: Surface, seed: Candidate, ends: FloatArray, config: PlanConfig
) -> FloatArray | None:
    """Return the path that OMPL finds in the corridor around the best candidate so far."""
    from planning.ompl_planner import plan_in_corridor

    thin = thinned(surface)
    to_go = cost_to_go(thin, thin.node((ends[1, 0], ends[1, 1])))
    radius = surface.limits.turn_radius_m * RADIUS_RESERVE
    guide = waypoints(seed.points, radius, 2.0 * min(surface.cell_m))
    corridor = make_corridor(surface, guide, to_go, thin.cell_m, thin.shift_m)
    found = plan_in_corridor(corridor, config.planner, config.seed, config.iterations)
    return None if found is None else corridor.polyline(found.states)


# Height in reserve, and samples per cell, of a second polish for what the proof refused.
_CAUTION_M, _CAUTION_FINENESS = 0.25, 2.0


def _second_tries(
    surface: Surface, candidates: list[Candidate], ends: FloatArray
) -> list[Candidate]:
    """Try harder before giving up: finer polish with more in reserve, from three guides.

    A route can fail the proof by centimetres between samples, and a guide that breaks a limit can
    lie a bend away from one that does not.
    """
    best = min(candidates, key=_merit).points
    guides = [best]
    for nodes, soft in ((200_000, False), (60_000, True)):
        layered = layered_path(surface, tuple(ends[0]), tuple(ends[1]), soft=soft, nodes=nodes)
        if len(layered.points) > 2:
            length = float(np.hypot(*np.diff(layered.points, axis=0).T).sum())
            spacing = control_spacing(surface, length) / _CAUTION_FINENESS
            guides.append(smooth_guide(layered.points, spacing))
    tries = []
    for i, guide in enumerate(guides):
        careful = cautious(surface, ends) if surface.barred.any() else surface
        tried = polish(careful, guide, source=f"wide {i}", reserve_m=_CAUTION_M)
        if tried.breach > 0:
            tried = polish(
                surface, guide, source=f"fine {i}", reserve_m=_CAUTION_M, fineness=_CAUTION_FINENESS
            )
        tries.append(tried)
        if tried.breach == 0:
            break
    return tries


def _best_proved(
    surface: Surface, candidates: list[Candidate], crs: str
) -> tuple[Route | None, str]:
    """Return the cheapest candidate that passes the proof, or what broke the best of them."""
    problem = ""
    for candidate in sorted(candidates, key=_merit):
        w = finish(surface, candidate.points)
        if not w.problem:
            return route_of(w, exact_cost(surface, w), crs), ""
        problem = problem or w.problem
        if candidate.breach == 0:
            # The plan kept its limits at its samples; a little more in reserve keeps them between.
            careful = polish(surface, candidate.points, sweeps=20, rounds=1, reserve_m=_CAUTION_M)
            w = finish(surface, careful.points)
            if not w.problem:
                return route_of(w, exact_cost(surface, w), crs), ""
    return None, problem


def end_node(surface: Surface, end: tuple[float, float], name: str) -> tuple[int, int]:
    """Return the node nearest to start or goal that a route may use; say why there is none.

    Raises
    ------
    InputError
        Off the map, on no data, on land, too deep, or within a no-go area.
    """
    rows, cols = surface.shape
    x, y = surface.local(np.array(end[0]), np.array(end[1]))
    col, row = float(x) / surface.cell_m[0], float(y) / surface.cell_m[1]
    at = f"{name} {end[0]:.2f},{end[1]:.2f}"
    if not (0 <= row <= rows - 1 and 0 <= col <= cols - 1):
        west, north = surface.origin_m
        raise InputError(
            f"{at} lies off the map, whose cell centres span easting {west:.2f} to "
            f"{west + (cols - 1) * surface.cell_m[0]:.2f} and northing "
            f"{north - (rows - 1) * surface.cell_m[1]:.2f} to {north:.2f}; move it inside"
        )
    square = {
        (i, j)
        for i in (int(np.floor(row)), int(np.ceil(row)))
        for j in (int(np.floor(col)), int(np.ceil(col)))
    }
    for i, j in sorted(square):
        if surface.barred[i, j]:
            raise InputError(f"{at} {_why_barred(surface, i, j)}")
    return round(row), round(col)


def _why_barred(surface: Surface, row: int, col: int) -> str:
    bottom, lower = surface.bottom_m[row, col], surface.lower_m[row, col]
    limits = surface.limits
    if not np.isfinite(bottom):
        return "lies on or beside a cell without data; move it to mapped ground"
    if not np.isfinite(lower):
        return "lies where the map has a height but no sigma; move it or give --map-sigma"
    if lower > surface.top_m:
        return (
            f"lies in rock or too shallow: the bottom at {bottom:.2f} m needs the vehicle at "
            f"{lower:.2f} m, above the water's surface; move it to deeper water"
        )
    if bottom + limits.ceiling_m < -limits.depth_max_m:
        return (
            f"is too deep: {limits.ceiling_m:g} m above the bottom at {bottom:.2f} m is still below "
            f"depth_max_m {limits.depth_max_m:g}; raise depth_max_m or ceiling_m"
        )
    if bottom + limits.ceiling_m < lower:
        return (
            f"lies where floor and k sigma need {lower - bottom:.2f} m of altitude, above the "
            f"ceiling of {limits.ceiling_m:g} m; raise ceiling_m or --risk"
        )
    return "lies in a no-go area; move it out"
