"""Routes: cost against the limit-free grid search, what each part gives, planners without a guide."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from perception.records import Progress
from planning.finish import exact_cost, finish
from planning.limits import VehicleLimits
from planning.ompl_planner import plan_unguided
from planning.planner import Plan, PlanConfig, plan_route
from planning.polish import evaluate, smooth_guide
from scenarios.benchmarks import Row, Table
from scenarios.benchmarks.planning_terrains import Case, N, cases

# Processor seconds that a planner without a guide is given.
_BIT_S = 10.0


def _plan(case: Case, **changes: object) -> tuple[Plan, float]:
    began = time.process_time()
    limits = changes.pop("limits", None)
    weight = changes.pop("weight", None)
    config = replace(PlanConfig(), **changes)  # type: ignore[arg-type]
    plan = plan_route(case.grid, case.start, case.goal, limits, None, weight, config)  # type: ignore[arg-type]
    return plan, time.process_time() - began


def _row(case: str, method: str, plan: Plan, goal: str = "") -> Row:
    ratio = None if plan.route is None else plan.route.cost / plan.grid_cost
    return Row(case, method, "cost / limit-free grid", ratio, "1", goal, plan.reason[:90])


def _unpolished(case: Case, plan: Plan) -> Row:
    """Return what the grid's path, smoothed but not polished, would cost."""
    surface = plan.surface
    length = float(np.hypot(*np.diff(plan.grid_path, axis=0).T).sum())
    points = smooth_guide(plan.grid_path, max(10.0, length / 400))
    candidate = evaluate(surface, points)
    w = finish(surface, points)
    value = None if w.problem else exact_cost(surface, w) / plan.grid_cost
    return Row(case.name, "grid path smoothed, no polish", "cost / limit-free grid", value, "1", "",
               w.problem or f"breach {candidate.breach:.1f}")  # fmt: skip


def _unguided(case: Case, plan: Plan, space: str) -> Row:
    """Return unseeded BIT*: in x, y and depth, as one would write it first, or in altitude."""
    surface = plan.surface
    ends = np.array(
        [surface.local(np.array(p[0]), np.array(p[1])) for p in (case.start, case.goal)]
    )
    found = plan_unguided(surface, ends, (0.0, 0.0), space, "bitstar", 0, 10**9, seconds=_BIT_S)
    solved = found is not None and plan.route is not None
    value = found.cost / plan.route.cost if solved and found and plan.route else None
    return Row(case.name, f"BIT* in x, y, {space}, {_BIT_S:g} s", "cost / our cost", value, "1",
               ">= 1.15", "no limit of pitch or turn" if solved else "no way found")  # fmt: skip


def _parts(case: Case) -> list[Row]:
    """Return what each part gives, by leaving it out."""
    without = (
        ("no turning limit", {"limits": VehicleLimits(turn_radius_m=0.0)}, "<= 1.03"),
        ("without OMPL", {"planner": "none"}, ""),
        ("without the second guide", {"layers": False}, ""),
        ("grid guide and polish only", {"planner": "none", "layers": False}, ""),
        ("16 neighbours instead of 32", {"neighbours": 16, "planner": "none"}, ""),
        ("OMPL in Dubins' space", {"space": "dubins"}, ""),
    )
    return [
        _row(case.name, name, _plan(case, **changes)[0], goal) for name, changes, goal in without
    ]


def run(progress: Progress) -> Table:
    """Plan every case with all parts and with parts off, and beside planners without a guide."""
    rows: list[Row] = []
    everything = cases()
    _plan(everything[0])  # compiles
    for i, case in enumerate(everything):
        progress("terrains", i, len(everything))
        whole, seconds = _plan(case)
        rows.append(_row(case.name, "all limits", whole, "<= 1.05"))
        rows.append(
            Row(case.name, "all limits", "processor time", seconds, "s", "", "two threads in part")
        )
        if whole.route is not None:
            margin = whole.route.min_clearance_margin_m
            gap = whole.route.cost / whole.lower_bound
            rows.append(Row(case.name, "all limits", "least margin", margin, "m", ">= 0"))
            rows.append(Row(case.name, "all limits", "cost / lower bound", gap, "1"))
        rows += _parts(case)
        rows.append(_unpolished(case, whole))
        rows += [_unguided(case, whole, space) for space in ("depth", "altitude")]
        rows += _region_rows(case, whole)
    return Table("planning", tuple(rows), {"n": N, "seed": 0})


def _region_rows(case: Case, plain: Plan) -> list[Row]:
    """Return cost with region weights, and how far they steer the route off high ground."""
    from perception.regions import segment
    from planning.cost import region_weights

    regions = segment(case.grid).regions
    weighted, seconds = _plan(case, weight=region_weights(regions))
    rows = [
        _row(case.name, "region weights", weighted, "<= 1.05"),
        Row(case.name, "region weights", "processor time", seconds, "s"),
    ]
    if weighted.route is None or plain.route is None:
        return rows
    shares = []
    for plan in (weighted, plain):
        assert plan.route is not None
        row, col = case.grid.fractional_index(plan.route.easting_m, plan.route.northing_m)
        code = regions.class_code[np.round(row).astype(int), np.round(col).astype(int)]
        # Peak, ridge and saddle ridge.
        shares.append(float(np.isin(code, (1, 3, 5)).mean()))
    value = shares[0] / shares[1] if shares[1] > 0 else None
    rows.append(Row(case.name, "region weights", "share on high ground / without", value, "1", "<= 0.6",
                    f"{100 * shares[0]:.1f} % against {100 * shares[1]:.1f} %"))  # fmt: skip
    return rows
