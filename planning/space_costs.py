"""Compiled costs of motions in the spaces that plan without a guide: straight lines, and curves."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from perception.records import FloatArray
from planning.polish import HEIGHT_RESERVE_M, RADIUS_RESERVE, rules_of
from planning.profile import make_work, path_cost, sample_stack, water_per_ground
from planning.surface import WEIGHT, Surface

# A motion breaks a limit by more than this (m^2) or not at all: grid lines between samples.
_TINY = 1e-6
# Curves are traced this many cells apart; what lies between is the proof's business.
_STEP_CELLS = 2.0
# A shortest curve longer than this many turning circles plus the map's diagonal is a loop worth nothing.
_CIRCLES = 4.0


class _Costs:
    """What both kinds share."""

    def __init__(self, surface: Surface) -> None:
        self._surface = surface
        self._rules = rules_of(surface)
        self.least_rate = float(surface.stack[..., WEIGHT].min())
        if surface.drifts:
            self.least_rate /= 2.0
        rows, cols = surface.shape
        self._extent = ((cols - 1) * surface.cell_m[0], (rows - 1) * surface.cell_m[1])
        self.calls = 0

    def _heights(self) -> tuple[float, float]:
        """Return the lowest and highest height that any route may have."""
        surface = self._surface
        low = np.nanmin(np.where(surface.barred, np.nan, surface.lower_m))
        high = np.nanmax(np.where(surface.barred, np.nan, surface.bottom_m))
        high = min(float(high) + surface.limits.ceiling_m, surface.top_m)
        return float(max(low, surface.bottom_most_m)), float(high)

    def at_floor(self, end: FloatArray) -> float:
        """Return the least height at a local position, a reserve above."""
        cell = self._surface.cell_m
        least = sample_stack(self._surface.stack, cell[0], cell[1], end[0], end[1])[0]
        return float(max(least, self._surface.bottom_most_m)) + HEIGHT_RESERVE_M


class StraightCosts(_Costs):
    """Straight motions in local x, y and height, or height above the least: pitch and turns are free."""

    def __init__(self, surface: Surface, above_least: bool) -> None:
        super().__init__(surface)
        self.above_least = above_least
        band = surface.limits.ceiling_m - surface.limits.floor_m
        heights = (0.0, band) if above_least else self._heights()
        self.bounds = ((0.0, self._extent[0]), (0.0, self._extent[1]), heights)

    def at_floor(self, end: FloatArray) -> float:
        return HEIGHT_RESERVE_M if self.above_least else super().at_floor(end)

    def cost(self, a: tuple[float, ...], b: tuple[float, ...]) -> float:
        """Return the cost of a motion; infinite where floor, ceiling or barred ground is broken."""
        self.calls += 1
        s = self._surface
        return float(
            _straight_cost(
                s.stack, s.cell_m[0], s.cell_m[1], a[0], a[1], a[2], b[0], b[1], b[2],
                min(s.cell_m), self._rules, self.above_least,
            )
        )  # fmt: skip


@njit(cache=True)
def _straight_cost(  # type: ignore[no-untyped-def]
    stack, width, height, x0, y0, z0, x1, y1, z1, step, rules, above_least
):
    n = max(1, math.ceil(math.hypot(x1 - x0, y1 - y0) / step))
    water = water_per_ground(stack, width, height, x0, y0, x1, y1)
    cost = px = py = pz = rate_before = 0.0
    for i in range(n + 1):
        v = i / n
        x, y, z = x0 + v * (x1 - x0), y0 + v * (y1 - y0), z0 + v * (z1 - z0)
        lower, bottom, w, bar = sample_stack(stack, width, height, x, y)
        lower = max(lower, rules[5])
        if above_least:
            z += lower
        if bar > 0.0 or z < lower or z > min(bottom + rules[4], rules[6]):
            return np.inf
        rate = w + rules[0] * max(0.0, z - bottom - rules[3])
        if i > 0:
            leg = math.sqrt((x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2)
            cost += 0.5 * (rate + rate_before) * leg
        px, py, pz, rate_before = x, y, z, rate
    return cost * water


class CurveCosts(_Costs):
    """Curves traced by OMPL: with their own heights (Owen), or given their best profile (Dubins)."""

    def __init__(self, surface: Surface, owen: bool) -> None:
        super().__init__(surface)
        self.owen = owen
        cell = min(surface.cell_m)
        # A radius of nothing has no curve: half a cell turns on the spot as far as a map can tell.
        self.radius_m = max(surface.limits.turn_radius_m * RADIUS_RESERVE, 0.5 * cell)
        self.pitch_rad = math.atan(min(self._rules[1], self._rules[2]))
        self.step_m = min(_STEP_CELLS * cell, max(cell, 0.25 * self.radius_m))
        flat = ((0.0, self._extent[0]), (0.0, self._extent[1]))
        self.bounds: tuple[tuple[float, float], ...] = (*flat, self._heights()) if owen else flat
        circle = 2.0 * math.pi * self.radius_m
        self.longest_m = math.hypot(*self._extent) + _CIRCLES * circle
        self._work = make_work(int(2.0 * self.longest_m / self.step_m) + 64)

    def cost(self, trace: list[tuple[float, ...]]) -> float:
        """Return the cost of a traced curve; infinite where a limit or barred ground is broken."""
        self.calls += 1
        path = np.array(trace)
        s = self._surface
        if self.owen:
            return float(_polyline_cost(s.stack, s.cell_m[0], s.cell_m[1], path, self._rules))
        if len(path) > len(self._work[0]):
            return math.inf
        x, y = np.ascontiguousarray(path[:, 0]), np.ascontiguousarray(path[:, 1])
        cost, breach = path_cost(
            s.stack, s.cell_m[0], s.cell_m[1], x, y, len(path), self._rules, *self._work
        )
        return float(cost) if breach < _TINY else math.inf


@njit(cache=True)
def _polyline_cost(stack, width, height, path, rules):  # type: ignore[no-untyped-def]
    cost = 0.0
    for i in range(len(path) - 1):
        leg = _straight_cost(
            stack, width, height, path[i, 0], path[i, 1], path[i, 2],
            path[i + 1, 0], path[i + 1, 1], path[i + 1, 2], 1e9, rules, False,
        )  # fmt: skip
        if not np.isfinite(leg):
            return np.inf
        cost += leg
    return cost
