"""What `bathynav plan` leaves: metrics.json, the route's files, and a table on the terminal."""

from __future__ import annotations

import logging
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenarios.commands.console import print_table
from scenarios.outputs import write_metrics

if TYPE_CHECKING:
    from planning.limits import VehicleLimits
    from planning.planner import Plan
    from planning.route import Route
    from scenarios.route_inputs import Given

logger = logging.getLogger(__name__)

_FILES = (
    "route.csv", "route.geojson", "route.gpkg", "route.gpx", "route.plan", "route.png",
    "blocked.png", "metrics.json",
)  # fmt: skip
_FIGURES = (
    "cost", "length_m", "mean_altitude_m", "min_altitude_m", "max_altitude_m",
    "min_clearance_margin_m", "min_stand_off_m", "travel_time_s",
)  # fmt: skip


def clear(out: Path) -> None:
    """Remove an older route: what the folder holds is of this run alone."""
    for name in _FILES:
        (out / name).unlink(missing_ok=True)


def resolved(options: dict[str, Any], limits: VehicleLimits) -> dict[str, Any]:
    """Return the config of a run: its options, and the vehicle's limits in full."""
    config = {k: v for k, v in options.items() if v not in (None, ())}
    return {**config, "vehicle": asdict(limits)}


def figures(route: Route | None) -> dict[str, Any]:
    """Return a route's figures for metrics.json, nulls without a route."""
    out: dict[str, Any] = {
        name: None if route is None else getattr(route, name) for name in _FIGURES
    }
    for i, name in enumerate(("worst_easting_m", "worst_northing_m", "worst_depth_m")):
        out[name] = None if route is None else route.worst[i]
    return out


def write_unsolved(
    out: Path, reason: str, config: dict[str, Any], seed: int, more: dict[str, Any]
) -> None:
    """Write the metrics of a run that found no route."""
    nothing = {**figures(None), "grid_cost": None, "lower_bound": None}
    write_metrics(out, {**nothing, "solved": False, "reason": reason, **more}, config, seed)


def write_plan(
    out: Path, plan: Plan, given: Given, config: dict[str, Any], more: dict[str, Any]
) -> None:
    """Write the metrics of a plan, solved or not."""
    route, blocked = plan.route, plan.blockage
    bounded = route is not None and plan.lower_bound > 0
    metrics: dict[str, Any] = {
        **figures(route),
        "grid_cost": plan.grid_cost,
        "lower_bound": plan.lower_bound,
        "cost_over_grid": plan.ratio,
        "gap_to_bound": route.cost / plan.lower_bound - 1.0 if route and bounded else None,
        "solved": plan.solved,
        "reason": plan.reason,
        "risk": given.risk,
        "k_sigma": plan.k,
        "independent_patches": plan.patches,
        **more,
        **plan.stages_s,
        **{f"cost_{name}": value for name, value in plan.costs.items()},
    }
    if blocked is not None:
        metrics |= {
            "blocked_by": blocked.limit,
            "blocked_easting_m": blocked.place[0],
            "blocked_northing_m": blocked.place[1],
            **{f"opens_{key}": value for key, value in blocked.opens.items()},
        }
    write_metrics(out, metrics, config, given.seed)


def write_route_files(out: Path, route: Route, limits: VehicleLimits) -> None:
    """Write the route in every format that its map allows."""
    from planning.exports import write_exports
    from planning.route import write_route

    write_route(out, route)
    if not write_exports(out, route, limits.speed_m_s):
        logger.warning("the map has no CRS: route.gpx and route.plan need one and are left out")


def clearance_told(route: Route, floor_m: float, k: float) -> str:
    """Return in words what is proved of the clearance, and how much of it is to spare."""
    over = f"{floor_m:g} m" + (f" + {k:.2f} sigma" if k > 0 else "")
    spare = max(route.min_clearance_margin_m, 0.0)
    more = f"{spare:.2f} m to spare" if spare >= 0.005 else "with nothing to spare"
    return f"nowhere less than {over}, proved, {more}"


def objects_told(standing: int | None, barring: int) -> list[tuple[str, str]]:
    """Return the row of objects: how many the route is held clear of, and how many it may not pass over at all."""
    if standing is None:
        return []
    told = f"{standing} standing on the map"
    if not barring:
        return [("objects", f"{told}, held clear of")]
    return [("objects", f"{told}, {barring} of them of least height only: their ground is barred")]


def tell_route(plan: Plan, seconds: float, out: Path, more: dict[str, Any]) -> None:
    """Print what the route is like; `more` may tell of objects."""
    route = plan.route
    assert route is not None
    rows = [
        ("length", f"{route.length_m:.1f} m in {route.travel_time_s / 60:.1f} min"),
        ("cost", f"{route.cost:.1f} ({plan.ratio:.3f} of the limit-free grid search)"),
        ("lower bound", f"{plan.lower_bound:.1f}"),
        ("altitude", f"mean {route.mean_altitude_m:.2f} m, least {route.min_altitude_m:.2f} m"),
        ("clearance", clearance_told(route, plan.surface.limits.floor_m, plan.k)),
        ("stand-off", f"{route.min_stand_off_m:.2f} m, the least slant distance to the ground"),
        *objects_told(more.get("standing_objects"), more.get("barring_objects", 0)),
        ("time", f"{seconds:.2f} s"),
        ("written", str(out / "route.csv")),
    ]
    print_table("route", rows)
