"""Routes: cost against the limit-free grid search, what each part gives, peers, grid speed.

Terrains force a detour: the straight line is nowhere nearly optimal. Those from real heights are used
where the files lie beside the repository.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from perception.records import FloatArray, Grid, Progress
from planning.corridor import make_corridor
from planning.field import search
from planning.finish import exact_cost, finish
from planning.limits import VehicleLimits
from planning.ompl_planner import plan_in_corridor
from planning.planner import Plan, PlanConfig, plan_route
from planning.polish import evaluate, smooth_guide
from planning.pyramid import guided_search
from planning.surface import Surface
from scenarios.benchmarks import Row, Table

_N = 1000
_GRID_N = 4000
_BIT_S = 10.0
_DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "bathymetry"


@dataclass(frozen=True, slots=True)
class Case:
    """A terrain with its ends."""

    name: str
    grid: Grid
    start: tuple[float, float]
    goal: tuple[float, float]


def _case(name: str, z: FloatArray, start: tuple[int, int], goal: tuple[int, int]) -> Case:
    grid = Grid(z, 500_000.0, 4_100_000.0, 1.0, crs="EPSG:32632")
    e, n = grid.centres()
    return Case(name, grid, (e[start[1]], n[start[0]]), (e[goal[1]], n[goal[0]]))


def canyon_terrain(seed: int, rim_m: float, n: int = _N, floor_m: float = -60.0) -> FloatArray:
    """Return a meandering canyon cut into a plateau, with rough ground; walls of 25 to 40 deg."""
    rng = np.random.default_rng(seed)
    row, col = np.mgrid[:n, :n].astype(float)
    middle = n / 2 + 0.3 * n * np.sin(2 * np.pi * (row / n * 1.4 + rng.uniform()))
    across = np.abs(col - middle)
    wall = (rim_m - floor_m) / (1 + np.exp(-(across - 0.055 * n) / 16.0))
    rough = 30.0 * ndimage.gaussian_filter(rng.normal(size=(n, n)), 20)
    return np.asarray(
        floor_m + wall + rough + 3.0 * ndimage.gaussian_filter(rng.normal(size=(n, n)), 4)
    )


def _lowest(z: FloatArray, rows: slice) -> tuple[int, int]:
    part = z[rows]
    r, c = np.unravel_index(int(np.nanargmin(part)), part.shape)
    return int(r) + rows.start, int(c)


def _real(name: str, z: FloatArray, cell_m: float) -> Case:
    """Return real heights as a sea floor of 1,000 x 1,000 cells of 1 m, slopes as they are."""
    scale = _N / min(z.shape)
    side = min(z.shape)
    fine = ndimage.zoom(z[:side, :side], scale, order=3)[:_N, :_N] / (cell_m / (1.0 / scale))
    fine = fine - np.nanmax(fine) - 10.0
    a, b = _lowest(fine, slice(40, 140)), _lowest(fine, slice(_N - 140, _N - 40))
    return _case(name, fine, a, b)


def cases() -> list[Case]:
    """Return the benchmark's terrains."""
    out = []
    for seed, rim in ((1, 20.0), (2, 20.0), (3, -25.0), (4, -35.0)):
        z = canyon_terrain(seed, rim)
        kind = "walls above water" if rim > 0 else f"walls of {rim + 60:.0f} m"
        out.append(
            _case(
                f"canyon {seed}, {kind}",
                z,
                _lowest(z, slice(8, 20)),
                _lowest(z, slice(_N - 20, _N - 8)),
            )
        )
    if (_DATA / "davosdorf.tif").exists():
        from mapping.rasters import read_map

        real = read_map(_DATA / "davosdorf.tif")
        out.append(_real("davosdorf (real)", real.elevation_m, real.cell_m))
    if (_DATA / "topobathy.npz").exists():
        heights = np.load(_DATA / "topobathy.npz")["topo"].astype(float)
        # 2 arc-minutes, some 2.5 km a cell: relief exaggerated tenfold to give slopes at all.
        out.append(_real("topobathy (real, x10)", heights * 10.0, 2500.0))
    return out


def _plan(case: Case, **changes: object) -> tuple[Plan, float]:
    began = time.perf_counter()
    limits = changes.pop("limits", None)
    weight = changes.pop("weight", None)
    config = replace(PlanConfig(), **changes)  # type: ignore[arg-type]
    plan = plan_route(case.grid, case.start, case.goal, limits, None, weight, config)  # type: ignore[arg-type]
    return plan, time.perf_counter() - began


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


def _bitstar(case: Case, plan: Plan) -> Row:
    """Return unseeded BIT* for ten seconds: along and across the straight line, and altitude."""
    surface: Surface = plan.surface
    ends = np.array(
        [surface.local(np.array(p[0]), np.array(p[1])) for p in (case.start, case.goal)]
    )
    rows, cols = surface.shape
    y, x = np.mgrid[:rows:4, :cols:4].astype(float)
    to_go = np.hypot(x - ends[1, 0], y - ends[1, 1]) * float(surface.stack[..., 2].min())
    corridor = replace(
        make_corridor(surface, ends, to_go, (4.0, 4.0), np.zeros(2)), half_width_m=0.45 * cols
    )
    found = plan_in_corridor(corridor, "bitstar", 0, 10**9, seconds=_BIT_S)
    value = None if found is None or plan.route is None else found.cost / plan.route.cost
    return Row(case.name, f"unseeded BIT*, {_BIT_S:g} s", "cost / our cost", value, "1", ">= 1.15",
               "prices of broken limits in it")  # fmt: skip


def _speed_rows() -> list[Row]:
    z = canyon_terrain(7, -25.0, 1000)
    z = np.tile(z, (_GRID_N // 1000, _GRID_N // 1000))
    from planning.cost import CostTerms
    from planning.surface import build_surface

    grid = Grid(z, 0.0, 0.0, 1.0)
    weight = 1.0 + np.abs(ndimage.uniform_filter(z, 25) - z) * 0.2
    surface = build_surface(grid, VehicleLimits(), CostTerms(), weight)
    name = f"grid stage, {_GRID_N} x {_GRID_N}"
    rows = []
    for neighbours in (8, 16, 32):
        began = time.perf_counter()
        cost, _ = guided_search(surface, (20, 20), (_GRID_N - 20, _GRID_N - 20), neighbours)
        rows.append(Row(name, f"ours, {neighbours} neighbours", "seconds", time.perf_counter() - began, "s",
                        "<= 3"))  # fmt: skip
        if neighbours == 32:
            whole = search(surface, (20, 20), (_GRID_N - 20, _GRID_N - 20), neighbours)
            ratio = cost / float(whole.cost[_GRID_N - 20, _GRID_N - 20])
            rows.append(
                Row(name, "ours, 32 neighbours", "cost / whole search", ratio, "1", "<= 1.005")
            )
    from skimage.graph import MCP_Geometric

    small = np.ascontiguousarray(weight[:2000, :2000])
    began = time.perf_counter()
    MCP_Geometric(small).find_costs([(20, 20)], [(1980, 1980)])
    rows.append(Row("grid stage, 2000 x 2000", "MCP_Geometric (8 neighbours)", "seconds",
                    time.perf_counter() - began, "s"))  # fmt: skip
    try:
        import skfmm
    except ImportError:
        rows.append(Row(name, "scikit-fmm", "seconds", None, "s", "", "not installed (no wheel)"))
        return rows
    phi = np.ones_like(weight)
    phi[20, 20] = -1
    began = time.perf_counter()
    skfmm.travel_time(phi, 1.0 / weight, order=2)
    rows.append(Row(name, "scikit-fmm", "seconds", time.perf_counter() - began, "s"))
    return rows


def run(progress: Progress) -> Table:
    """Plan every case with all parts and with parts off; measure peers."""
    rows: list[Row] = []
    everything = cases()
    _plan(everything[0])  # compiles
    for i, case in enumerate(everything):
        progress("terrains", i, len(everything))
        whole, seconds = _plan(case)
        rows.append(_row(case.name, "all limits", whole, "<= 1.05"))
        rows.append(Row(case.name, "all limits", "seconds", seconds, "s", "<= 5"))
        if whole.route is not None:
            rows.append(
                Row(
                    case.name,
                    "all limits",
                    "least margin",
                    whole.route.min_clearance_margin_m,
                    "m",
                    ">= 0",
                )
            )
            rows.append(
                Row(
                    case.name,
                    "all limits",
                    "cost / lower bound",
                    whole.route.cost / whole.lower_bound,
                    "1",
                )
            )
        rows.append(
            _row(
                case.name,
                "no turning limit",
                _plan(case, limits=VehicleLimits(turn_radius_m=0.0))[0],
                "<= 1.03",
            )
        )
        rows.append(_row(case.name, "without OMPL", _plan(case, planner="none")[0]))
        rows.append(_row(case.name, "without the second guide", _plan(case, layers=False)[0]))
        rows.append(
            _row(
                case.name,
                "grid guide and polish only",
                _plan(case, planner="none", layers=False)[0],
            )
        )
        rows.append(_unpolished(case, whole))
        rows.append(_bitstar(case, whole))
        rows += _region_rows(case, whole)
    rows += _speed_rows()
    return Table("planning", tuple(rows), {"n": _N, "seed": 0})


def _region_rows(case: Case, plain: Plan) -> list[Row]:
    """Return cost with region weights, and how far they steer the route off high ground."""
    from perception.regions import segment
    from planning.cost import region_weights

    regions = segment(case.grid).regions
    weighted, seconds = _plan(case, weight=region_weights(regions))
    rows = [
        _row(case.name, "region weights", weighted, "<= 1.05"),
        Row(case.name, "region weights", "seconds", seconds, "s", "<= 5"),
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
