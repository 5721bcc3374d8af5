"""Missions of several goals as one route: order, legs that meet with one heading, one proof."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np

from perception.records import FloatArray, InputError
from planning.ends import end_node
from planning.finish import POSITION_DIGITS, prove
from planning.planner import Plan, PlanConfig, plan_on_surface
from planning.problem import Problem
from planning.route import route_of
from planning.surface import Surface
from planning.tour import best_order, leg_costs

Place = tuple[float, float]


def solve_mission(
    problem: Problem, stops: list[Place], config: PlanConfig | None = None
) -> tuple[Plan, list[int]]:
    """Visit all stops, the first first and the last last, the others in the cheapest order.

    The risk is shared out over the whole mission.

    Parameters
    ----------
    stops : (easting, northing) of start, goals between, and goal.

    Returns
    -------
    The plan of the whole (its `reason` names the leg that failed) and the order of the stops.

    Raises
    ------
    InputError
        Fewer than two stops, one that no vehicle can stand on, or two in one place.
    """
    config = config or PlanConfig()
    if len(stops) < 2:
        raise InputError("a mission needs a start and a goal")
    for (i, a), (j, b) in itertools.combinations(enumerate(stops), 2):
        if math.dist(a, b) < 10.0**-POSITION_DIGITS:
            raise InputError(f"stops {i} and {j} are the same place ({a[0]:.2f},{a[1]:.2f})")
    sigma = problem.clearance_sigma_m()
    length = 1.3 * sum(math.dist(a, b) for a, b in itertools.pairwise(stops))
    while True:
        k, patches = problem.factor(length)
        surface = problem.surface(sigma, 0.0 if sigma is None else k)
        nodes = [end_node(surface, stop, f"stop {i}") for i, stop in enumerate(stops)]
        order = best_order(leg_costs(surface.at_least_height(), nodes))
        plan = replace(
            _along(surface, [stops[i] for i in order], order, problem.grid.crs, config),
            patches=patches,
        )
        if sigma is None or plan.route is None or plan.route.length_m <= length:
            return plan, order
        length = 1.05 * plan.route.length_m


def _along(
    surface: Surface, stops: list[Place], names: list[int], crs: str, config: PlanConfig
) -> Plan:
    """Plan the legs one after the other; each sets off the way the last one came in."""
    limits = surface.limits
    legs: list[Plan] = []
    heading_deg = limits.start_heading_deg
    for i, (a, b) in enumerate(itertools.pairwise(stops)):
        eased = replace(
            limits,
            start_heading_deg=heading_deg,
            goal_heading_deg=limits.goal_heading_deg if i == len(stops) - 2 else math.nan,
        )
        leg = plan_on_surface(replace(surface, limits=eased), crs, a, b, config)
        if leg.route is None:
            reason = f"leg from stop {names[i]} to stop {names[i + 1]}: {leg.reason}"
            return replace(leg, reason=reason)
        legs.append(leg)
        east = float(np.diff(leg.route.easting_m[-2:])[0])
        north = float(np.diff(leg.route.northing_m[-2:])[0])
        heading_deg = math.degrees(math.atan2(east, north))
    return _joined(surface, legs, crs)


def _joined(surface: Surface, legs: list[Plan], crs: str) -> Plan:
    """Join the legs' positions and prove the whole."""
    routes = [leg.route for leg in legs if leg.route is not None]

    def chain(name: str) -> FloatArray:
        parts = [getattr(r, name)[(1 if i else 0) :] for i, r in enumerate(routes)]
        return np.concatenate(parts)

    w = prove(surface, chain("easting_m"), chain("northing_m"))
    stages: dict[str, float] = {}
    for leg in legs:
        for key, value in leg.stages_s.items():
            stages[key] = stages.get(key, 0.0) + value
    total = replace(
        legs[0],
        grid_cost=sum(leg.grid_cost for leg in legs),
        lower_bound=sum(leg.lower_bound for leg in legs),
        stages_s=stages,
        costs={},
        grid_path=np.concatenate([leg.grid_path for leg in legs]),
    )
    if w.problem:
        return replace(total, route=None, reason=f"where two legs meet: {w.problem}")
    return replace(total, route=route_of(surface, w, crs))
