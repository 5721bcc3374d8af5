"""OMPL in the corridor: the one module that imports it.

Its traps, met and kept out (each measured): a subclass of StateCostIntegralObjective is ignored, so the
objective subclasses OptimizationObjective with all four costs; validity is a MotionValidator's matter,
not the default resolution's; the seed is set before any sampler exists; planners end on a count of
iterations, never on time, so that the same seed gives the same path to the bit.
"""

from __future__ import annotations

import itertools
import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from perception.records import FloatArray, InputError
from planning.corridor import U_EXTENT_M, Corridor, MotionCosts

logger = logging.getLogger(__name__)

# The estimate of the cost to go comes from a thinned, floor-following grid; this share of it is taken,
# so that the planners do not prune what is better than the grid thinks.
_TRUST = 0.97

# Iterations that take about a second on one core of 2024: an iteration is an edge for BIT*, a sample
# for the others.
ITERATIONS = {"bitstar": 12000, "rrtstar": 400, "informed": 400, "sorrt": 400, "fmt": 250}


@dataclass(frozen=True, slots=True)
class Found:
    """What a planner found: (n, 3) states of its path in the corridor, and its cost there."""

    states: FloatArray
    cost: float
    calls: int


class _Objective(ob.OptimizationObjective):
    """The planning cost of corridor motions, with the grid's cost to go as heuristic."""

    def __init__(self, si: ob.SpaceInformation, costs: MotionCosts) -> None:
        super().__init__(si)
        self.costs = costs

    def stateCost(self, s: ob.State) -> ob.Cost:
        return ob.Cost(0.0)

    def motionCost(self, a: ob.State, b: ob.State) -> ob.Cost:
        return ob.Cost(self.costs.cost((a[0], a[1], a[2]), (b[0], b[1], b[2])))

    def motionCostHeuristic(self, a: ob.State, b: ob.State) -> ob.Cost:
        gain = self.costs.to_go(a[0], a[1]) - self.costs.to_go(b[0], b[1])
        return ob.Cost(_TRUST * abs(gain))

    def motionCostBestEstimate(self, a: ob.State, b: ob.State) -> ob.Cost:
        return self.motionCostHeuristic(a, b)


class _Validator(ob.MotionValidator):
    """A motion is valid if its cost is finite and breaks no limit worth a price."""

    def __init__(self, si: ob.SpaceInformation, costs: MotionCosts) -> None:
        super().__init__(si)
        self.costs = costs

    def checkMotion(self, a: ob.State, b: ob.State) -> bool:
        return math.isfinite(self.costs.cost((a[0], a[1], a[2]), (b[0], b[1], b[2])))


def _planner(name: str, si: ob.SpaceInformation, iterations: int) -> ob.Planner:
    if name == "fmt":
        planner = og.FMT(si)
        planner.setNumSamples(iterations)
        planner.setNearestK(True)
        return planner
    makers: dict[str, Callable[[ob.SpaceInformation], ob.Planner]] = {
        "rrtstar": og.RRTstar,
        "informed": og.InformedRRTstar,
        "sorrt": og.SORRTstar,
        "bitstar": og.BITstar,
    }
    if name not in makers:
        raise InputError(f"no planner {name!r}; there are {', '.join([*makers, 'fmt'])}")
    planner = makers[name](si)
    if name == "bitstar":
        planner.setSamplesPerBatch(100)
    return planner


def plan_in_corridor(
    corridor: Corridor,
    planner: str,
    seed: int,
    iterations: int | None = None,
    seconds: float = math.inf,
) -> Found | None:
    """Let an OMPL planner improve on the guide; None where it finds nothing.

    Parameters
    ----------
    planner : bitstar, rrtstar, informed, sorrt or fmt.
    seed : non-negative; the path depends on it and on `iterations` alone.
    iterations : None takes what lasts about a second.
    seconds : stop by the clock as well, for comparisons; such a run does not repeat to the bit.
    """
    n = ITERATIONS.get(planner, 1000) if iterations is None else iterations
    ou.setLogLevel(ou.LogLevel.LOG_NONE)
    ou.RNG.setSeed(seed + 1)  # OMPL refuses 0
    space = ob.RealVectorStateSpace(3)
    bounds = ob.RealVectorBounds(3)
    for i, (low, high) in enumerate(
        (
            (0.0, corridor.length_m),
            (-corridor.half_width_m, corridor.half_width_m),
            (0.0, U_EXTENT_M),
        )
    ):
        bounds.setLow(i, low)
        bounds.setHigh(i, high)
    space.setBounds(bounds)
    si = ob.SpaceInformation(space)
    costs = MotionCosts(corridor)
    si.setStateValidityChecker(lambda state: True)
    si.setMotionValidator(_Validator(si, costs))
    si.setup()
    problem = ob.ProblemDefinition(si)
    start, goal = space.allocState(), space.allocState()
    start[0], start[1], start[2] = 0.0, 0.0, corridor.start_u
    goal[0], goal[1], goal[2] = corridor.length_m, 0.0, corridor.goal_u
    problem.setStartAndGoalStates(start, goal)
    problem.setOptimizationObjective(_Objective(si, costs))
    solver = _planner(planner, si, n)
    solver.setProblemDefinition(problem)
    solver.setup()
    # FMT* asks once per sample before it begins; its own end is when its tree is grown.
    left = [20 * n if planner == "fmt" else n]

    until = time.perf_counter() + seconds

    def enough() -> bool:
        left[0] -= 1
        return left[0] < 0 or time.perf_counter() > until

    solver.solve(ob.PlannerTerminationCondition(enough))
    if not problem.hasExactSolution():
        return None
    path = problem.getSolutionPath()
    states = np.array([[s[0], s[1], s[2]] for s in path.getStates()])
    # OMPL's own figure is not taken on trust.
    cost = sum(costs.cost(tuple(a), tuple(b)) for a, b in itertools.pairwise(states))
    return Found(states, float(cost), costs.calls)
