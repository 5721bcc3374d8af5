"""The planner's summary: guide, seed, polish, proof."""

from __future__ import annotations

import logging
import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from perception.records import BoolArray, FloatArray, Grid, InputError, Progress, silent
from planning.bound import lower_bound
from planning.corridor import make_corridor
from planning.cost import CostTerms
from planning.currents import Currents
from planning.curve import waypoints
from planning.ends import end_node
from planning.failure import Blockage, explain_barrier, explain_limits
from planning.finish import POSITION_DIGITS, finish
from planning.layers import layered_path
from planning.limits import VehicleLimits
from planning.polish import RADIUS_RESERVE, Candidate, control_spacing, polish, smooth_guide
from planning.problem import Problem
from planning.pyramid import guided_search
from planning.route import Route, route_of
from planning.surface import Surface, cautious
from planning.thinning import cost_to_go, thinned

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class PlanConfig:
    """How a route is looked for.

    Attributes
    ----------
    planner : OMPL's planner: rrtstar, informed, sorrt, bitstar, fmt, or none.
    space : that it plans in: corridor (around the best guide), or without a guide depth, altitude,
        dubins or owen.
    iterations : of OMPL; on iterations, not on time, so that runs repeat; None about a second's.
    seed : of OMPL.
    risk : probability that the floor is broken anywhere along the route.
    correlation_m : distance over which the map's errors are independent; NaN 10 cells.
    neighbours : of the grid search.
    layers : whether the second guide (place and altitude) is asked.
    """

    planner: str = "bitstar"
    space: str = "corridor"
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
    patches : independent patches of map error along the route, from which k follows.
    stages_s : seconds per stage; `costs` the cost of each candidate after polishing.
    """

    route: Route | None
    reason: str
    grid_cost: float
    lower_bound: float
    surface: Surface
    grid_path: FloatArray
    patches: float = 1.0
    stages_s: dict[str, float] = field(default_factory=dict)
    costs: dict[str, float] = field(default_factory=dict)
    blockage: Blockage | None = None

    @property
    def solved(self) -> bool:
        return self.route is not None

    @property
    def k(self) -> float:
        """How many sigmas the route keeps above its floor."""
        return self.surface.k

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
    currents: Currents | None = None,
    progress: Progress = silent,
) -> Plan:
    """Plan a low route from start to goal (easting, northing) and prove its clearance.

    Parameters
    ----------
    weight : (rows, cols) `w` of the cost; 1 everywhere without.
    forbidden : (rows, cols) True in no-go areas.
    position_sigma_m : (rows, cols) expected position error, 1-sigma per axis.
    currents : of the water; None still.

    Raises
    ------
    InputError
        Start or goal is off the map, on no data, or where the limits leave no water.
    """
    config = config or PlanConfig()
    problem = Problem(
        grid, limits or VehicleLimits(), terms or CostTerms(), weight, forbidden, position_sigma_m,
        currents, config.risk, config.correlation_m,
    )  # fmt: skip
    return solve(problem, start, goal, config, progress)


def solve(
    problem: Problem,
    start: tuple[float, float],
    goal: tuple[float, float],
    config: PlanConfig,
    progress: Progress = silent,
) -> Plan:
    """Plan from start to goal; k sigma is set anew where the route comes out longer than thought."""
    straight = float(np.hypot(goal[0] - start[0], goal[1] - start[1]))
    if straight < 10.0**-POSITION_DIGITS:
        raise InputError(
            f"start and goal are the same place ({start[0]:.2f},{start[1]:.2f}); move one of them"
        )
    sigma = problem.clearance_sigma_m()
    length = 1.3 * straight
    while True:
        k, patches = problem.factor(length)
        surface = problem.surface(sigma, 0.0 if sigma is None else k)
        plan = plan_on_surface(surface, problem.grid.crs, start, goal, config, progress)
        plan = replace(plan, patches=patches)
        if sigma is None or plan.route is None or plan.route.length_m <= length:
            return plan
        # The route came out longer than the risk was shared out for: share it anew.
        length = 1.05 * plan.route.length_m


class _Laps:
    """Seconds per stage, and what is told of them."""

    def __init__(self, progress: Progress) -> None:
        self.stages: dict[str, float] = {}
        self._clock, self._progress = time.perf_counter(), progress

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.stages[stage] = self.stages.get(stage, 0.0) + now - self._clock
        self._clock = now
        self._progress("planning", min(len(self.stages), _STAGES), _STAGES)


# Stages of a plan that is found: grid, bound, guides, OMPL, polish, proof.
_STAGES = 6


def plan_on_surface(
    surface: Surface,
    crs: str,
    start: tuple[float, float],
    goal: tuple[float, float],
    config: PlanConfig,
    progress: Progress = silent,
) -> Plan:
    """Plan on a surface whose clearance is settled; arguments and errors of `plan_route`."""
    laps = _Laps(progress)
    node_a = end_node(surface, start, "start")
    node_b = end_node(surface, goal, "goal")
    least = surface.at_least_height()
    grid_cost, nodes = guided_search(least, node_a, node_b, config.neighbours)
    laps.lap("grid_s")
    bound = lower_bound(least, start, goal)
    laps.lap("bound_s")
    del least
    ends = np.array([surface.local(np.array(p[0]), np.array(p[1])) for p in (start, goal)])
    if not np.isfinite(grid_cost):
        parted = explain_barrier(surface, node_a, node_b)
        return Plan(
            None, parted.reason, math.nan, bound, surface, np.zeros((0, 2)), stages_s=laps.stages,
            blockage=parted,
        )  # fmt: skip
    guide = np.column_stack([nodes[:, 1] * surface.cell_m[0], nodes[:, 0] * surface.cell_m[1]])
    guide = np.concatenate([ends[:1], guide[1:-1], ends[1:]])
    candidates = _candidates(surface, guide, ends, config, laps)
    route, problem = _best_proved(surface, candidates, crs)
    if route is None:
        candidates += _second_tries(surface, candidates, ends)
        route, problem = _best_proved(surface, candidates, crs)
    laps.lap("proof_s")
    blocked: Blockage | None = None
    if route is None:
        blocked = explain_limits(surface, candidates, guide, problem)
        laps.lap("explain_s")
    return Plan(
        route, "" if blocked is None else blocked.reason, grid_cost, bound, surface, guide,
        stages_s=laps.stages, costs={c.source: c.cost for c in candidates}, blockage=blocked,
    )  # fmt: skip


def _candidates(
    surface: Surface, guide: FloatArray, ends: FloatArray, config: PlanConfig, laps: _Laps
) -> list[Candidate]:
    """Return the polished guides, what OMPL makes of the best of them, and that polished in full."""
    # Barred ground a cell wider while looking: samples cannot miss its corners then.
    careful = cautious(surface, ends) if surface.barred.any() else surface
    candidates = _from_guides(careful, guide, ends, config)
    if careful is not surface and all(c.breach > 0 for c in candidates):
        careful = surface
        candidates += _from_guides(careful, guide, ends, config)
    laps.lap("guides_s")
    if config.planner != "none":
        found = _ompl(careful, min(candidates, key=_merit), ends, config)
        if found is not None:
            candidates.append(_polished(careful, found, "ompl"))
        laps.lap("ompl_s")
    best = min(candidates, key=_merit)
    candidates.append(polish(careful, best.points, _SWEEPS, rounds=2, source="final"))
    laps.lap("polish_s")
    return candidates


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
    """Return the path that OMPL finds: in the corridor around the best candidate so far, or on its own."""
    from planning.ompl_planner import plan_in_corridor, plan_unguided

    if config.space != "corridor":
        headings = end_headings(surface, seed.points)
        found = plan_unguided(
            surface, ends, headings, config.space, config.planner, config.seed, config.iterations
        )
    else:
        thin = thinned(surface)
        to_go = cost_to_go(thin, thin.node((ends[1, 0], ends[1, 1])))
        radius = surface.limits.turn_radius_m * RADIUS_RESERVE
        guide = waypoints(seed.points, radius, 2.0 * min(surface.cell_m))
        corridor = make_corridor(surface, guide, to_go, thin.cell_m, thin.shift_m)
        found = plan_in_corridor(corridor, config.planner, config.seed, config.iterations)
    return None if found is None else found.points


def end_headings(surface: Surface, points: FloatArray) -> tuple[float, float]:
    """Return the headings (rad) at the ends: those asked for, else those of a guide."""
    legs = np.diff(points, axis=0)[[0, -1]]
    asked = (surface.limits.start_heading_deg, surface.limits.goal_heading_deg)
    free = [math.atan2(leg[0], -leg[1]) for leg in legs]
    start, goal = (
        math.radians(a) if math.isfinite(a) else f for a, f in zip(asked, free, strict=True)
    )
    return start, goal


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
            return route_of(surface, w, crs), ""
        problem = problem or w.problem
        if candidate.breach == 0:
            # The plan kept its limits at its samples; a little more in reserve keeps them between.
            careful = polish(surface, candidate.points, sweeps=20, rounds=1, reserve_m=_CAUTION_M)
            w = finish(surface, careful.points)
            if not w.problem:
                return route_of(surface, w, crs), ""
    return None, problem
