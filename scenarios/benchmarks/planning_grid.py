"""The grid stage on 4,000 x 4,000 cells: seconds of processor time, memory, and cost beside peers."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import ndimage

from perception.records import FloatArray, Grid, Progress
from planning.cost import CostTerms
from planning.field import search
from planning.limits import VehicleLimits
from planning.polish import control_spacing, polish, smooth_guide
from planning.pyramid import guided_search
from planning.surface import Surface, build_surface
from scenarios.benchmarks import Row, Table

_GRID_N, _PEER_N = 4000, 2000


def _weights(kind: str, n: int) -> FloatArray:
    """Return costs per metre of three kinds: smooth hills, patches of 20 m, noise from cell to cell."""
    rng = np.random.default_rng(5)
    noise = rng.normal(size=(n, n)).astype(np.float32)
    if kind == "smooth":
        return np.exp(0.5 * _unit(ndimage.gaussian_filter(noise, 60)))
    if kind == "patches":
        return 1.0 + (ndimage.gaussian_filter(noise, 8) > 0)
    return 1.0 + rng.random((n, n), dtype=np.float32)


def _unit(values: FloatArray) -> FloatArray:
    return (values - values.mean()) / values.std()


def _surface(weight: FloatArray) -> Surface:
    grid = Grid(np.full(weight.shape, -60.0), 0.0, 0.0, 1.0)
    return build_surface(grid, VehicleLimits(turn_radius_m=0.0), CostTerms(), weight)


def _timed(work: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    began = time.process_time()
    found = work(*arguments)
    return found, time.process_time() - began


def _resident_mb() -> float:
    """Return the memory that the process holds now, in MB."""
    with open("/proc/self/statm", encoding="ascii") as stream:
        return int(stream.read().split()[1]) * resource.getpagesize() / 1e6


def _ours(kind: str, weight: FloatArray, fine: float | None) -> list[Row]:
    surface = _surface(weight)
    n = len(weight)
    a, b = (20, 30), (n - 31, n - 21)
    name = f"{n} x {n}, {kind}"
    rows = []
    nodes: Any = None
    before = _resident_mb()
    for neighbours in (16, 32):
        (cost, nodes), seconds = _timed(guided_search, surface, a, b, neighbours)
        method = f"ours, {neighbours} neighbours"
        rows.append(Row(name, method, "processor time", seconds, "s", "<= 3"))
        if fine is not None:
            rows.append(Row(name, method, "cost / second-order fast marching", cost / fine, "1"))
    rows.append(Row(name, "ours", "held after the search", _resident_mb() - before, "MB", "",
                    f"beside {before:.0f} MB of map, surface and libraries"))  # fmt: skip
    guide = nodes[:, ::-1].astype(float)
    length = float(np.hypot(*np.diff(guide, axis=0).T).sum())
    points = smooth_guide(guide, control_spacing(surface, length))
    found, seconds = _timed(lambda: polish(surface, points, sweeps=25, step_cells=2.0))
    if fine is not None:
        rows.append(Row(name, "ours, polished", "cost / second-order fast marching",
                        found.cost / fine, "1", "<= 1.005", f"{seconds:.2f} s more"))  # fmt: skip
    if n <= _PEER_N:
        whole = float(search(surface, a, b, 32).cost[b])
        rows.append(
            Row(name, "ours, 32 neighbours", "cost / search of the whole", cost / whole, "1")
        )
    return rows


def _fast_marching(weight: FloatArray, a: tuple[int, int], b: tuple[int, int]) -> Any:
    """Return (cost, seconds) of scikit-fmm's second order; None where it is not installed."""
    try:
        import skfmm
    except ImportError:
        return None
    # The source is a circle of two cells, whose own cost is added: a point's first cells are of first order.
    away = np.ogrid[-a[0] : weight.shape[0] - a[0], -a[1] : weight.shape[1] - a[1]]
    phi = np.hypot(away[0], away[1]) - 2.0
    times, seconds = _timed(lambda: skfmm.travel_time(phi, 1.0 / weight, order=2))
    return float(times[b]) + 2.0 * float(weight[a]), seconds


def run(progress: Progress) -> Table:
    """Measure the grid stage and its peers in one run."""
    rows: list[Row] = []
    _ours("warm-up", _weights("noise", 1300), None)  # compiles
    kinds = ("smooth", "patches", "noise")
    sizes = [(kind, _PEER_N) for kind in kinds] + [("smooth", _GRID_N), ("patches", _GRID_N)]
    for i, (kind, n) in enumerate(sizes):
        progress("grids", i, len(sizes))
        weight = _weights(kind, n)
        a, b = (20, 30), (n - 31, n - 21)
        marched = _fast_marching(weight, a, b)
        rows += _ours(kind, weight, None if marched is None else marched[0])
        name = f"{n} x {n}, {kind}"
        rows.append(Row(name, "scikit-fmm, second order", "processor time",
                        None if marched is None else marched[1], "s", "",
                        "" if marched else "not installed (no wheel)"))  # fmt: skip
        if kind == "patches" and n == _PEER_N:
            from skimage.graph import MCP_Geometric

            cost = np.ascontiguousarray(weight, dtype=np.float64)
            (costs, _), seconds = _timed(MCP_Geometric(cost).find_costs, [a], [b])
            rows.append(Row(name, "MCP_Geometric, 8 neighbours", "processor time", seconds, "s"))
            if marched is not None:
                rows.append(Row(name, "MCP_Geometric, 8 neighbours",
                                "cost / second-order fast marching", float(costs[b]) / marched[0],
                                "1"))  # fmt: skip
    return Table("planning-grid", tuple(rows), {"n": _GRID_N})
