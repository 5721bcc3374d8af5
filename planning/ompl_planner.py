"""OMPL: the one module that imports it. Its planners, and the spaces they plan in.

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
from typing import Any, Protocol

import numpy as np
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from perception.records import FloatArray, InputError
from planning.corridor import U_EXTENT_M, Corridor, MotionCosts
from planning.space_costs import CurveCosts, StraightCosts
from planning.surface import Surface

logger = logging.getLogger(__name__)

# The estimate of the cost to go comes from a thinned, floor-following grid; this share of it is taken,
# so that the planners do not prune what is better than the grid thinks.
_TRUST = 0.97

# Price of a motion that cannot be flown: more than any path, and finite.
_DEAREST = 1e12

# Iterations that take about a second on one core of 2024, for BIT* half of one (twice as many gain less
# than a thousandth): an iteration is an edge for BIT*, a sample for the others.
ITERATIONS = {"bitstar": 6000, "rrtstar": 400, "informed": 400, "sorrt": 400, "fmt": 250}
PLANNERS = tuple(ITERATIONS)
# The spaces without a guide, and how many of those iterations take as long in them: short straight lines
# are cheap, curves are traced state by state.
SPACES = {"depth": 3.0, "altitude": 1.0, "dubins": 0.5, "owen": 1.0}


@dataclass(frozen=True, slots=True)
class Found:
    """What a planner found: (n, d) states of its path in its space, and its cost there.

    Attributes
    ----------
    points : (n, 2) local positions along the path.
    calls : motions whose cost was asked for.
    """

    states: FloatArray
    cost: float
    calls: int
    points: FloatArray


class Space(Protocol):
    """A state space with the cost of its motions; states are tuples of `reals` numbers outside OMPL."""

    @property
    def calls(self) -> int:
        """Motions whose cost was asked for."""

    def make(self) -> Any:
        """Return OMPL's space, bounds set."""

    def read(self, state: Any) -> tuple[float, ...]:
        """Return a state's numbers."""

    def write(self, state: Any, values: tuple[float, ...]) -> None:
        """Set a state's numbers."""

    def cost(self, a: Any, b: Any) -> float:
        """Return the cost of the motion between two states; infinite where there is none."""

    def estimate(self, a: Any, b: Any) -> float:
        """Return what the motion or any path between two states costs at least, about."""

    def points(self, states: FloatArray) -> FloatArray:
        """Return (n, 2) local positions along the motions between states."""


class _RealSpace:
    """Three real coordinates within bounds."""

    bounds: tuple[tuple[float, float], ...]

    def make(self) -> Any:
        space = ob.RealVectorStateSpace(3)
        space.setBounds(_bounds(self.bounds))
        return space

    def read(self, state: Any) -> tuple[float, ...]:
        return state[0], state[1], state[2]

    def write(self, state: Any, values: tuple[float, ...]) -> None:
        for i in range(3):
            state[i] = values[i]


class CorridorSpace(_RealSpace):
    """Distance along a guide, offset from it, altitude warped towards the floor."""

    def __init__(self, corridor: Corridor) -> None:
        self.corridor, self.costs = corridor, MotionCosts(corridor)
        wide = corridor.half_width_m
        self.bounds = ((0.0, corridor.length_m), (-wide, wide), (0.0, U_EXTENT_M))

    @property
    def calls(self) -> int:
        return self.costs.calls

    def cost(self, a: Any, b: Any) -> float:
        return self.costs.cost((a[0], a[1], a[2]), (b[0], b[1], b[2]))

    def estimate(self, a: Any, b: Any) -> float:
        gain = self.costs.to_go(a[0], a[1]) - self.costs.to_go(b[0], b[1])
        # A current makes the way back another's price: only what lies ahead is known then.
        return _TRUST * (max(0.0, gain) if self.corridor.surface.drifts else abs(gain))

    def points(self, states: FloatArray) -> FloatArray:
        return self.corridor.polyline(states)


class StraightSpace(_RealSpace):
    """Local x, y and height ("depth"), or height above the least allowed ("altitude"); straight motions."""

    def __init__(self, surface: Surface, above_least: bool) -> None:
        self.costs = StraightCosts(surface, above_least)
        self.bounds = self.costs.bounds

    @property
    def calls(self) -> int:
        return self.costs.calls

    def cost(self, a: Any, b: Any) -> float:
        return self.costs.cost(self.read(a), self.read(b))

    def estimate(self, a: Any, b: Any) -> float:
        return self.costs.least_rate * math.hypot(a[0] - b[0], a[1] - b[1])

    def points(self, states: FloatArray) -> FloatArray:
        return states[:, :2]


class CurveSpace:
    """Poses joined by shortest curves of the turning radius: Dubins', or Owen's, which climb as well.

    Dubins' poses have no depth: every motion gets its best profile in closed form. Owen's have one, and
    their curves keep the pitch limit by helices.
    """

    def __init__(self, surface: Surface, owen: bool) -> None:
        self.costs, self.owen = CurveCosts(surface, owen), owen
        self._radius = self.costs.radius_m
        self._between: Any = None
        self._space: Any = None
        self._calls = 0

    @property
    def calls(self) -> int:
        return self._calls

    def make(self) -> Any:
        if self.owen:
            space = ob.OwenStateSpace(self._radius, self.costs.pitch_rad)
        else:
            space = ob.DubinsStateSpace(self._radius)
        space.setBounds(_bounds(self.costs.bounds))
        self._space, self._between = space, space.allocState()
        return space

    def read(self, state: Any) -> tuple[float, ...]:
        if self.owen:
            return state[0], state[1], state[2], state.getYaw()
        return state.getX(), state.getY(), state.getYaw()

    def write(self, state: Any, values: tuple[float, ...]) -> None:
        if self.owen:
            for i in range(3):
                state[i] = values[i]
        else:
            state.setX(values[0])
            state.setY(values[1])
        state.setYaw(values[-1])

    def _trace(self, a: Any, b: Any, most: int) -> list[tuple[float, ...]]:
        n = max(1, min(most, math.ceil(self._space.distance(a, b) / self.costs.step_m)))
        out = []
        for i in range(n + 1):
            self._space.interpolate(a, b, i / n, self._between)
            out.append(self.read(self._between))
        return out

    def cost(self, a: Any, b: Any) -> float:
        self._calls += 1
        length = self._space.distance(a, b)
        if not math.isfinite(length) or length > self.costs.longest_m:
            return math.inf
        return self.costs.cost(self._trace(a, b, 10**6))

    def estimate(self, a: Any, b: Any) -> float:
        return self.costs.least_rate * self._space.distance(a, b)

    def points(self, states: FloatArray) -> FloatArray:
        a, b = self._space.allocState(), self._space.allocState()
        out: list[tuple[float, ...]] = []
        for one, other in itertools.pairwise(states):
            self.write(a, tuple(one))
            self.write(b, tuple(other))
            out += self._trace(a, b, 10**6)[1 if out else 0 :]
        return np.array(out)[:, :2]


def _bounds(limits: tuple[tuple[float, float], ...]) -> Any:
    bounds = ob.RealVectorBounds(len(limits))
    for i, (low, high) in enumerate(limits):
        bounds.setLow(i, low)
        bounds.setHigh(i, high)
    return bounds


class _Objective(ob.OptimizationObjective):
    """The planning cost of a space's motions, with the space's estimate as heuristic."""

    def __init__(self, si: ob.SpaceInformation, space: Space) -> None:
        super().__init__(si)
        self.space = space

    def stateCost(self, s: ob.State) -> ob.Cost:
        return ob.Cost(0.0)

    def motionCost(self, a: ob.State, b: ob.State) -> ob.Cost:
        # Some planners compare and add costs before they ask for validity: infinity would poison sums.
        return ob.Cost(min(self.space.cost(a, b), _DEAREST))

    def motionCostHeuristic(self, a: ob.State, b: ob.State) -> ob.Cost:
        return ob.Cost(self.space.estimate(a, b))

    def motionCostBestEstimate(self, a: ob.State, b: ob.State) -> ob.Cost:
        return self.motionCostHeuristic(a, b)


class _Validator(ob.MotionValidator):
    """A motion is valid if its cost is finite."""

    def __init__(self, si: ob.SpaceInformation, space: Space) -> None:
        super().__init__(si)
        self.space = space

    def checkMotion(self, a: ob.State, b: ob.State) -> bool:
        return math.isfinite(self.space.cost(a, b))


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


def plan_in(
    space: Space,
    start: tuple[float, ...],
    goal: tuple[float, ...],
    planner: str,
    seed: int,
    iterations: int | None = None,
    seconds: float = math.inf,
) -> Found | None:
    """Let an OMPL planner find a path between two states of a space; None where it finds nothing.

    Parameters
    ----------
    planner : bitstar, rrtstar, informed, sorrt or fmt.
    seed : non-negative; the path depends on it and on `iterations` alone.
    iterations : None takes what lasts about a second.
    seconds : of processor time, a further end, for comparisons; such a run does not repeat to the bit.
    """
    n = ITERATIONS.get(planner, 1000) if iterations is None else iterations
    ou.setLogLevel(ou.LogLevel.LOG_NONE)
    ou.RNG.setSeed(seed + 1)  # OMPL refuses 0
    states = space.make()
    si = ob.SpaceInformation(states)
    si.setStateValidityChecker(lambda state: True)
    si.setMotionValidator(_Validator(si, space))
    si.setup()
    problem = ob.ProblemDefinition(si)
    a, b = states.allocState(), states.allocState()
    space.write(a, start)
    space.write(b, goal)
    problem.setStartAndGoalStates(a, b)
    problem.setOptimizationObjective(_Objective(si, space))
    solver = _planner(planner, si, n)
    solver.setProblemDefinition(problem)
    solver.setup()
    # FMT* asks once per sample before it begins; its own end is when its tree is grown.
    left = [20 * n if planner == "fmt" else n]
    until = time.thread_time() + seconds

    def enough() -> bool:
        left[0] -= 1
        return left[0] < 0 or time.thread_time() > until

    solver.solve(ob.PlannerTerminationCondition(enough))
    if not problem.hasExactSolution():
        return None
    path = list(problem.getSolutionPath().getStates())
    # OMPL's own figure is not taken on trust.
    cost = sum(space.cost(one, other) for one, other in itertools.pairwise(path))
    numbers = np.array([space.read(s) for s in path])
    return Found(numbers, float(cost), space.calls, space.points(numbers))


def plan_in_corridor(
    corridor: Corridor,
    planner: str,
    seed: int,
    iterations: int | None = None,
    seconds: float = math.inf,
) -> Found | None:
    """Let an OMPL planner improve on the guide; arguments of `plan_in`."""
    start, goal = (0.0, 0.0, corridor.start_u), (corridor.length_m, 0.0, corridor.goal_u)
    return plan_in(CorridorSpace(corridor), start, goal, planner, seed, iterations, seconds)


def plan_unguided(
    surface: Surface,
    ends: FloatArray,
    headings_rad: tuple[float, float],
    space: str,
    planner: str,
    seed: int,
    iterations: int | None = None,
    seconds: float = math.inf,
) -> Found | None:
    """Let an OMPL planner find its own way in one of `SPACES`; arguments of `plan_in`.

    Parameters
    ----------
    ends : (2, 2) local positions.
    headings_rad : at the ends, clockwise from grid north; for curves.
    """
    if space not in SPACES:
        raise InputError(f"no space {space!r}; there are corridor, {', '.join(SPACES)}")
    if planner == "fmt":
        # Where OMPL 2.0.1's FMT* finds no way its destructor ends the process; in the corridor the guide
        # itself is a way.
        raise InputError("fmt plans in the corridor only; give another planner or --space corridor")
    made: Space
    states: list[tuple[float, ...]]
    if space in ("depth", "altitude"):
        made = straight = StraightSpace(surface, space == "altitude")
        states = [(end[0], end[1], straight.costs.at_floor(end)) for end in ends]
    else:
        made = curves = CurveSpace(surface, space == "owen")
        # Local y runs south: a heading turns clockwise from -y.
        yaws = [math.atan2(-math.cos(h), math.sin(h)) for h in headings_rad]
        heights = [(curves.costs.at_floor(end),) if curves.owen else () for end in ends]
        states = [
            (end[0], end[1], *height, yaw)
            for end, height, yaw in zip(ends, heights, yaws, strict=True)
        ]
    n = ITERATIONS[planner] if iterations is None else iterations
    if iterations is None:
        n = max(100, int(n * SPACES[space]))
    return plan_in(made, states[0], states[1], planner, seed, n, seconds)
