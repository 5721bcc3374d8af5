"""Missions of several goals as one route: order, legs that meet with one heading, one proof."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np

from perception.records import FloatArray, Grid, InputError
from planning.finish import exact_cost, prove
from planning.limits import VehicleLimits
from planning.planner import Plan, end_node, plan_route
from planning.route import route_of
from planning.tour import best_order, leg_costs


def plan_mission(
    grid: Grid,
    stops: list[tuple[float, float]],
    limits: VehicleLimits | None = None,
    **options: Any,
) -> tuple[Plan, list[int]]:
    """Visit all stops, the first first and the last last, the others in the cheapest order.

    Parameters
    ----------
    stops : (easting, northing) of start, goals between, and goal.
    options : of `plan_route`.

    Returns
    -------
    The plan of the whole (its `reason` names the leg that failed) and the order of the stops.
    """
    limits = limits or VehicleLimits()
    if len(stops) < 2:
        raise InputError("a mission needs a start and a goal")
    first = plan_route(grid, stops[0], stops[-1], limits, **options)
    nodes = [end_node(first.surface, stop, f"stop {i}") for i, stop in enumerate(stops)]
    order = best_order(leg_costs(first.surface, nodes))
    legs: list[Plan] = []
    for a, b in itertools.pairwise(order):
        heading_deg = limits.start_heading_deg
        if legs and legs[-1].route is not None:
            # The next leg sets off the way the last one came in: no kink where they meet.
            route = legs[-1].route
            east, north = np.diff(route.easting_m[-2:])[0], np.diff(route.northing_m[-2:])[0]
            heading_deg = math.degrees(math.atan2(east, north))
        eased = replace(
            limits,
            start_heading_deg=heading_deg,
            goal_heading_deg=limits.goal_heading_deg if b == order[-1] else math.nan,
        )
        leg = plan_route(grid, stops[a], stops[b], eased, **options)
        if leg.route is None:
            reason = f"leg from stop {a} to stop {b}: {leg.reason}"
            return replace(leg, route=None, reason=reason), order
        legs.append(leg)
    return _joined(legs, grid), order


def _joined(legs: list[Plan], grid: Grid) -> Plan:
    """Join the legs' positions and prove the whole with the safest of their surfaces."""
    surface = max((leg.surface for leg in legs), key=lambda s: s.k)
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
    return replace(total, route=route_of(w, exact_cost(surface, w), grid.crs))
