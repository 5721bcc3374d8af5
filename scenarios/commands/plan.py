"""`bathynav plan`: a low route within the vehicle's limits, proved clear, or the reason why not."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from perception.records import InputError, NoPathError
from scenarios.commands.console import (
    common_options,
    out_option,
    prepare_out,
    print_table,
    progress_bars,
    set_verbosity,
)

if TYPE_CHECKING:
    from perception.records import FloatArray, Grid
    from planning.planner import Plan

PLANNERS = ("bitstar", "rrtstar", "informed", "sorrt", "fmt", "none")


class Position(click.ParamType):  # type: ignore[type-arg]
    """EASTING,NORTHING in the map's CRS."""

    name = "E,N"

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        if isinstance(value, tuple):
            return value
        try:
            easting, northing = (float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not EASTING,NORTHING, e.g. 512340.5,4101200", param, ctx)
        return easting, northing


@click.command()
@click.option("--map", "map_path", required=True, type=click.Path(path_type=Path), help="Map.")
@click.option("--start", required=True, type=Position(), help="Start, in the map's CRS.")
@click.option("--goal", required=True, type=Position(), help="Goal, in the map's CRS.")
@out_option
@click.option("--vehicle", type=click.Path(path_type=Path), help="Limits, a TOML file.")
@click.option("--avoid", type=click.Path(path_type=Path), help="No-go areas, a vector file.")
@click.option(
    "--regions", type=click.Path(path_type=Path), help="regions.tif to take weights from."
)
@click.option("--region-weights", default="", help="'none', or a TOML file with [weights].")
@click.option("--map-sigma", type=float, help="1-sigma of the map, m, instead of its band.")
@click.option("--risk", type=float, default=0.01, show_default=True, help="Of breaking the floor.")
@click.option("--error-correlation", type=float, help="Length over which map errors hold, m.")
@click.option("--planner", type=click.Choice(PLANNERS), default="bitstar", show_default=True)
@click.option("--seed", type=int, default=0, show_default=True, help="Of OMPL.")
@common_options
def command(
    map_path: Path,
    start: tuple[float, float],
    goal: tuple[float, float],
    out: Path,
    vehicle: Path | None,
    avoid: Path | None,
    regions: Path | None,
    region_weights: str,
    map_sigma: float | None,
    risk: float,
    error_correlation: float | None,
    planner: str,
    seed: int,
    quiet: bool,
    verbose: bool,
) -> int:
    """Plan a route that stays near the bottom and is proved clear of it.

    \b
    bathynav plan --map map.tif --start 512340,4101200 --goal 513020,4101950 --out plan
    """
    set_verbosity(quiet, verbose)
    from mapping.rasters import read_map
    from planning.limits import read_vehicle
    from planning.planner import PlanConfig, plan_route
    from planning.route import write_route

    limits = read_vehicle(vehicle)
    if map_sigma is not None and not map_sigma >= 0:
        raise InputError(f"--map-sigma must be 0 or more, got {map_sigma:g}")
    grid = read_map(map_path, map_sigma)
    forbidden = _no_go(grid, avoid)
    out = prepare_out(out)
    _clear(out)
    config = {
        "map": str(map_path), "start": list(start), "goal": list(goal), "risk": risk,
        "planner": planner, "region_weights": region_weights or "default",
        "regions": None if regions is None else str(regions),
        "avoid": None if avoid is None else str(avoid), "vehicle": _table(limits),
    }  # fmt: skip
    with progress_bars(quiet) as progress:
        began = time.perf_counter()
        settings = PlanConfig(
            planner=planner,
            seed=seed,
            risk=risk,
            correlation_m=float("nan") if error_correlation is None else error_correlation,
        )
        try:
            weight = _weights(grid, regions, region_weights)
            region_seconds = time.perf_counter() - began
            plan = plan_route(
                grid, start, goal, limits, None, weight, settings, forbidden, progress=progress
            )
        except InputError as error:
            _write_unsolved(out, str(error), config, seed, time.perf_counter() - began)
            raise
        seconds = time.perf_counter() - began
    _write_metrics(out, plan, config, seed, seconds, region_seconds)
    if plan.route is None:
        raise NoPathError(f"{map_path}: no route: {plan.reason}")
    write_route(out, plan.route)
    if not quiet:
        _tell(plan, seconds, out)
    return 0


def _table(record: Any) -> dict[str, float]:
    from dataclasses import asdict

    return asdict(record)


def _clear(out: Path) -> None:
    """Remove an older route: what the folder holds is of this run alone."""
    for name in (
        "route.csv",
        "route.geojson",
        "route.gpkg",
        "route.gpx",
        "route.plan",
        "metrics.json",
    ):
        (out / name).unlink(missing_ok=True)


def _weights(grid: Grid, regions: Path | None, region_weights: str) -> FloatArray | None:
    if region_weights == "none":
        return None
    from planning.cost import CLASS_WEIGHTS, read_class_weights
    from planning.cost import region_weights as weights_of

    table = read_class_weights(Path(region_weights)) if region_weights else dict(CLASS_WEIGHTS)
    if regions is not None:
        from mapping.region_files import read_regions

        region_map = read_regions(regions)
        if region_map.class_code.shape != grid.shape:
            raise InputError(
                f"{regions}: {region_map.class_code.shape} cells where the map has {grid.shape}; "
                "make it from this map: bathynav regions MAP.tif"
            )
    else:
        from perception.regions import segment

        region_map = segment(grid).regions
    return weights_of(region_map, table)


def _no_go(grid: Grid, avoid: Path | None) -> Any:
    if avoid is None:
        return None
    from mapping.vectors import read_polygons
    from planning.nogo import forbidden_cells

    return forbidden_cells(grid, read_polygons(avoid, grid.crs))


def _write_unsolved(
    out: Path, reason: str, config: dict[str, Any], seed: int, seconds: float
) -> None:
    from scenarios.outputs import write_metrics

    nothing = dict.fromkeys(
        ("cost", "grid_cost", "lower_bound", "length_m", "mean_altitude_m", "min_altitude_m",
         "min_clearance_margin_m"),
    )  # fmt: skip
    write_metrics(
        out, {**nothing, "solved": False, "reason": reason, "seconds": seconds}, config, seed
    )


def _write_metrics(
    out: Path,
    plan: Plan,
    config: dict[str, Any],
    seed: int,
    seconds: float,
    region_seconds: float,
) -> None:
    from scenarios.outputs import write_metrics

    route = plan.route
    metrics: dict[str, Any] = {
        "cost": None if route is None else route.cost,
        "grid_cost": plan.grid_cost,
        "lower_bound": plan.lower_bound,
        "gap_to_bound": None if route is None else route.cost / plan.lower_bound - 1.0,
        "length_m": None if route is None else route.length_m,
        "mean_altitude_m": None if route is None else route.mean_altitude_m,
        "min_altitude_m": None if route is None else route.min_altitude_m,
        "max_altitude_m": None if route is None else route.max_altitude_m,
        "min_clearance_margin_m": None if route is None else route.min_clearance_margin_m,
        "worst_easting_m": None if route is None else route.worst[0],
        "worst_northing_m": None if route is None else route.worst[1],
        "worst_depth_m": None if route is None else route.worst[2],
        "solved": plan.solved,
        "reason": plan.reason,
        "blocked_by": None if plan.blockage is None else plan.blockage.limit,
        "blocked_easting_m": None if plan.blockage is None else plan.blockage.place[0],
        "blocked_northing_m": None if plan.blockage is None else plan.blockage.place[1],
        "seconds": seconds,
        "regions_s": region_seconds,
        "risk": config["risk"],
        "k_sigma": plan.k,
        "independent_patches": plan.patches,
        **plan.stages_s,
        **{f"cost_{name}": value for name, value in plan.costs.items()},
    }
    write_metrics(out, metrics, config, seed)


def _tell(plan: Plan, seconds: float, out: Path) -> None:
    route = plan.route
    assert route is not None
    rows = [
        ("length", f"{route.length_m:.1f} m"),
        (
            "cost",
            f"{route.cost:.1f} ({route.cost / plan.grid_cost:.3f} of the limit-free grid search)",
        ),
        ("lower bound", f"{plan.lower_bound:.1f}"),
        ("altitude", f"mean {route.mean_altitude_m:.2f} m, least {route.min_altitude_m:.2f} m"),
        (
            "least margin",
            f"{route.min_clearance_margin_m:.4f} m over floor + {plan.k:.2f} sigma, proved",
        ),
        ("time", f"{seconds:.2f} s"),
        ("written", str(out / "route.csv")),
    ]
    print_table("route", rows)
