"""The state space that OMPL plans in: distance along a guide, offset from it, altitude above it all.

A point is (s, o, u): s metres along a guide curve, o metres to its right, and a height above the least
allowed one that grows with a high power of u, so that most of the space lies near the floor, where
good routes are. In these coordinates the guide is the straight line o = 0: a planner's first straight
motion from start to goal *is* the seed, and everything it finds later can only be better.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from perception.records import FloatArray
from planning.polish import respace, rules_of
from planning.profile import (
    BAR_PRICE,
    EXCESS_PRICE,
    cone_envelope,
    make_work,
    sample_stack,
    water_per_ground,
)
from planning.surface import Surface

# Extent of the third coordinate: u in [0, U_EXTENT_M], so that its scale is like that of the offsets.
U_EXTENT_M = 30.0
# Height of u as a share of the band between floor and ceiling: (u / U_EXTENT_M) to this power.
_POWER = 5.0
# A motion's ends are pinned at their heights. Where the pitch limits would lift a pin, the jump is priced
# like a breach, but for this much (m), which two slopes that meet at a point need.
_PIN_M = 0.05


@dataclass(frozen=True, slots=True)
class Corridor:
    """A guide with its normals, on a surface.

    Attributes
    ----------
    line, normal : (n, 2) guide points `spacing_m` apart, and unit normals to the right.
    half_width_m : greatest offset.
    to_go : (rows, cols) lower estimate of the cost to the goal, over `go_cell_m` cells.
    start_u, goal_u : third coordinate of the ends.
    """

    line: FloatArray
    normal: FloatArray
    spacing_m: float
    half_width_m: float
    surface: Surface
    to_go: FloatArray
    go_cell_m: tuple[float, float]
    go_shift_m: FloatArray
    start_u: float
    goal_u: float

    @property
    def length_m(self) -> float:
        return self.spacing_m * (len(self.line) - 1)

    def place(self, s: FloatArray, o: FloatArray) -> FloatArray:
        """Return (n, 2) local positions of corridor coordinates."""
        at = np.arange(len(self.line)) * self.spacing_m
        x = [np.interp(s, at, self.line[:, i]) for i in (0, 1)]
        n = [np.interp(s, at, self.normal[:, i]) for i in (0, 1)]
        return np.column_stack([x[0] + o * n[0], x[1] + o * n[1]])

    def polyline(self, states: FloatArray) -> FloatArray:
        """Return local positions along the motions between (n, 3) states, `spacing_m` apart."""
        pieces = []
        for a, b in itertools.pairwise(states):
            k = max(1, math.ceil(float(np.hypot(*(b[:2] - a[:2]))) / self.spacing_m))
            v = np.arange(k) / k
            pieces.append(self.place(a[0] + v * (b[0] - a[0]), a[1] + v * (b[1] - a[1])))
        pieces.append(self.place(states[-1:, 0], states[-1:, 1]))
        return np.concatenate(pieces)


def make_corridor(
    surface: Surface,
    guide: FloatArray,
    to_go: FloatArray,
    go_cell_m: tuple[float, float],
    go_shift_m: FloatArray,
) -> Corridor:
    """Make the corridor around a guide (n, 2) in local coordinates."""
    length = float(np.hypot(*np.diff(guide, axis=0).T).sum())
    line = respace(guide, max(4.0 * max(surface.cell_m), length / 2000.0))
    spacing = float(np.hypot(*(line[1] - line[0])))
    # Normals of a strongly smoothed guide cross later, and a wide corridor stays one to one for longer.
    tangent = np.gradient(line, axis=0)
    window = max(3, 2 * (len(line) // 40) + 1)
    kernel = np.hanning(window + 2)[1:-1]
    padded = np.pad(tangent, ((window // 2, window // 2), (0, 0)), mode="edge")
    tangent = np.column_stack([np.convolve(padded[:, i], kernel, "valid") for i in (0, 1)])
    tangent /= np.maximum(np.hypot(*tangent.T), 1e-9)[:, None]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    half_width = max(4.0 * surface.limits.turn_radius_m, 0.04 * length, 10.0 * max(surface.cell_m))
    corridor = Corridor(
        line, normal, spacing, half_width, surface, np.asarray(to_go, np.float32), go_cell_m,
        go_shift_m, 0.0, 0.0,
    )  # fmt: skip
    start_u, goal_u = MotionCosts(corridor).seed_ends()
    return replace(corridor, start_u=start_u, goal_u=goal_u)


class MotionCosts:
    """Compiled cost of straight motions in corridor coordinates, infinite where a limit breaks."""

    def __init__(self, corridor: Corridor) -> None:
        self.corridor = corridor
        surface = corridor.surface
        n = int(8.0 * corridor.length_m / min(surface.cell_m)) + 64
        self._work, _ = make_work(n)
        self._rules = rules_of(surface)
        self._to_go = np.where(np.isfinite(corridor.to_go), corridor.to_go, 1e9)
        self.calls = 0

    def cost(self, a: tuple[float, float, float], b: tuple[float, float, float]) -> float:
        """Return the cost of the motion from a to b, prices of breaches included."""
        c = self.corridor
        self.calls += 1
        return float(
            _motion_cost(
                c.surface.stack, c.surface.cell_m[0], c.surface.cell_m[1], c.line, c.normal,
                c.spacing_m, min(c.surface.cell_m), a[0], a[1], a[2], b[0], b[1], b[2],
                self._rules, self._work,
            )
        )  # fmt: skip

    def seed_ends(self) -> tuple[float, float]:
        """Return the third coordinates at which the guide itself begins and ends."""
        c = self.corridor
        self.cost((0.0, 0.0, 0.0), (c.length_m, 0.0, 0.0))
        n = max(2, math.ceil(c.length_m / min(c.surface.cell_m)) + 1)
        band = c.surface.limits.ceiling_m - c.surface.limits.floor_m
        above = self._work[[0, n - 1], 3] - self._work[[0, n - 1], 1]
        share = np.clip(above / band, 0.0, 1.0) ** (1.0 / _POWER)
        return float(U_EXTENT_M * share[0]), float(U_EXTENT_M * share[1])

    def to_go(self, s: float, o: float) -> float:
        """Return the limit-free grid cost from (s, o) to the goal."""
        c = self.corridor
        return float(
            _at_place(c.line, c.normal, c.spacing_m, s, o, self._to_go, *c.go_cell_m, c.go_shift_m)
        )


@njit(cache=True)
def _place(line, normal, spacing, s, o):  # type: ignore[no-untyped-def]
    at = min(max(s / spacing, 0.0), len(line) - 1.0)
    i = min(int(at), len(line) - 2)
    f = at - i
    nx = normal[i, 0] + f * (normal[i + 1, 0] - normal[i, 0])
    ny = normal[i, 1] + f * (normal[i + 1, 1] - normal[i, 1])
    return (
        line[i, 0] + f * (line[i + 1, 0] - line[i, 0]) + o * nx,
        line[i, 1] + f * (line[i + 1, 1] - line[i, 1]) + o * ny,
    )


@njit(cache=True)
def _at_place(line, normal, spacing, s, o, field, width, height, shift):  # type: ignore[no-untyped-def]
    x, y = _place(line, normal, spacing, s, o)
    c = min(max(round((x - shift[0]) / width), 0), field.shape[1] - 1)
    r = min(max(round((y - shift[1]) / height), 0), field.shape[0] - 1)
    return field[r, c]


@njit(cache=True)
def _motion_cost(  # type: ignore[no-untyped-def]
    stack, width, height, line, normal, spacing, step, s0, o0, u0, s1, o1, u1, rules, work
):
    a, up, down, band = rules[0], rules[1], rules[2], rules[4] - rules[3]
    reach = math.hypot(s1 - s0, o1 - o0)
    n = max(2, math.ceil(reach / step) + 1)
    if n > len(work):
        return np.inf
    s, lower, upper, z, density = work[:, 0], work[:, 1], work[:, 2], work[:, 3], work[:, 4]
    water = work[:, 5]
    px = py = 0.0
    bar_total = 0.0
    drifts = stack.shape[2] > 4
    for i in range(n):
        v = i / (n - 1)
        x, y = _place(line, normal, spacing, s0 + v * (s1 - s0), o0 + v * (o1 - o0))
        lo, bottom, w, bar = sample_stack(stack, width, height, x, y)
        lower[i] = max(lo, rules[5]) + rules[7]
        upper[i] = min(bottom + rules[4], rules[6]) - rules[7]
        density[i] = w - a * (bottom + rules[3])
        leg = math.hypot(x - px, y - py) if i > 0 else 0.0
        water[i] = water_per_ground(stack, width, height, px, py, x, y) if drifts and i > 0 else 1.0
        s[i] = s[i - 1] + leg if i > 0 else 0.0
        bar_total += bar * leg
        px, py = x, y
    pin0 = lower[0] + band * (u0 / U_EXTENT_M) ** _POWER
    pin1 = lower[n - 1] + band * (u1 / U_EXTENT_M) ** _POWER
    lower[0], lower[n - 1] = pin0, pin1
    cone_envelope(s, lower, n, up, down, z)
    cost, excess = 0.0, 0.0
    jump = max(0.0, z[0] - pin0 - _PIN_M) + max(0.0, z[n - 1] - pin1 - _PIN_M)
    for i in range(1, n):
        ds, dz = s[i] - s[i - 1], z[i] - z[i - 1]
        rate = 0.5 * (density[i] + density[i - 1] + a * (z[i] + z[i - 1])) * water[i]
        cost += rate * math.sqrt(ds * ds + dz * dz)
        excess += max(0.0, z[i] - upper[i]) * ds
    return cost + EXCESS_PRICE * (excess + jump) + BAR_PRICE * bar_total
