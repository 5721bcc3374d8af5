"""`bathynav plan`: a low route within the vehicle's limits, proved clear, or the reason why not."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from perception.records import InputError, NoOverlapError, NoPathError
from scenarios.commands.console import (
    common_options,
    out_option,
    prepare_out,
    print_table,
    progress_bars,
    set_verbosity,
)

if TYPE_CHECKING:
    from perception.records import FloatArray, Grid, Progress
    from planning.limits import VehicleLimits
    from planning.planner import Plan
    from planning.route import Route
    from planning.surface import Surface

logger = logging.getLogger(__name__)

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
@click.option("--start", type=Position(), help="Start, in the map's CRS.")
@click.option("--goal", type=Position(), help="Goal, in the map's CRS.")
@click.option(
    "--via", multiple=True, type=Position(), help="Goals between, visited in the best order."
)
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
@click.option(
    "--position-sigma",
    type=click.Path(path_type=Path),
    help="Raster of expected position error, m.",
)
@click.option(
    "--cost",
    "cost_path",
    type=click.Path(path_type=Path),
    help="Cost terms, a TOML file with [cost].",
)
@click.option(
    "--survey", type=click.Path(path_type=Path), help="Cover this area (vector file) with lines."
)
@click.option("--swath", type=float, default=60.0, show_default=True, help="Of a survey line, m.")
@click.option(
    "--overlap", type=float, default=0.2, show_default=True, help="Of neighbouring swaths."
)
@click.option(
    "--crossings", type=int, default=2, show_default=True, help="Survey lines square to the others."
)
@click.option("--replan", "old_route", type=click.Path(path_type=Path), help="route.csv under way.")
@click.option("--travelled", type=float, default=0.0, help="Metres of it behind the vehicle.")
@click.option("--planner", type=click.Choice(PLANNERS), default="bitstar", show_default=True)
@click.option("--seed", type=int, default=0, show_default=True, help="Of OMPL.")
@click.option("--picture/--no-picture", default=True, show_default=True, help="Draw route.png.")
@common_options
def command(out: Path, quiet: bool, verbose: bool, picture: bool, **options: Any) -> int:
    """Plan a route that stays near the bottom and is proved clear of it.

    \b
    bathynav plan --map map.tif --start 512340,4101200 --goal 513020,4101950 --out plan
    bathynav plan --map map.tif --start E,N --goal E,N --via E,N --via E,N --out tour
    bathynav plan --map map.tif --survey area.gpkg --swath 60 --out lines
    bathynav plan --map new.tif --replan plan/route.csv --travelled 240 --out plan2
    """
    set_verbosity(quiet, verbose)
    given = Given(**options)
    _refuse_mixed(given)
    out = prepare_out(out)
    _clear(out)
    config: dict[str, Any] = {k: v for k, v in options.items() if v not in (None, ())}
    began = time.perf_counter()
    with progress_bars(quiet) as progress:
        try:
            limits = read_limits(given)
            config["vehicle"] = _table(limits)
            if given.survey is not None:
                return _survey(given, limits, out, config, began, quiet, picture)
            if given.old_route is not None:
                return _replan(given, limits, out, config, began, quiet)
            plan, more = _route(given, limits, progress)
        except (InputError, NoOverlapError) as error:
            _write_unsolved(out, str(error), config, given.seed, time.perf_counter() - began)
            raise
        seconds = time.perf_counter() - began
    _write_metrics(out, plan, config, given, seconds, more)
    if picture:
        from scenarios.plots_routes import picture_plan

        picture_plan(out / ("route.png" if plan.solved else "blocked.png"), plan)
    if plan.route is None:
        raise NoPathError(f"{given.map_path}: no route: {plan.reason}")
    _write_route(out, plan.route, limits)
    if not quiet:
        _tell(plan, seconds, out)
    return 0


@dataclass(frozen=True)
class Given:
    """The options as they came; names are those of the command line."""

    map_path: Path
    start: tuple[float, float] | None
    goal: tuple[float, float] | None
    via: tuple[tuple[float, float], ...]
    vehicle: Path | None
    avoid: Path | None
    regions: Path | None
    region_weights: str
    map_sigma: float | None
    risk: float
    error_correlation: float | None
    position_sigma: Path | None
    cost_path: Path | None
    survey: Path | None
    swath: float
    overlap: float
    crossings: int
    old_route: Path | None
    travelled: float
    planner: str
    seed: int


def _refuse_mixed(given: Given) -> None:
    modes = [given.survey is not None, given.old_route is not None]
    if sum(modes) > 1 or (any(modes) and (given.start or given.goal or given.via)):
        raise click.UsageError(
            "--survey, --replan and --start/--goal are three different things; give one"
        )
    if not any(modes) and (given.start is None or given.goal is None):
        raise click.UsageError(
            "give --start E,N and --goal E,N (or --survey AREA, or --replan ROUTE)"
        )
    if given.seed < 0:
        raise click.UsageError(f"--seed must be 0 or more, got {given.seed}")
    if not 0 < given.risk < 1:
        raise click.UsageError(f"--risk must lie between 0 and 1, got {given.risk:g}")
    if given.map_sigma is not None and not given.map_sigma >= 0:
        raise click.UsageError(f"--map-sigma must be 0 or more, got {given.map_sigma:g}")


def read_limits(given: Given) -> VehicleLimits:
    """Read the vehicle's limits, or the defaults."""
    from planning.limits import read_vehicle

    return read_vehicle(given.vehicle)


def _route(given: Given, limits: VehicleLimits, progress: Progress) -> tuple[Plan, dict[str, Any]]:
    """Plan from start to goal, through the goals between where there are any."""
    from planning.cost import read_terms
    from planning.large import MOST_CELLS, prove_at_full_resolution, raster_cells
    from planning.mission import plan_mission
    from planning.planner import PlanConfig, plan_route

    assert given.start is not None and given.goal is not None
    large = raster_cells(given.map_path) > MOST_CELLS
    grid = _read(given, large)
    began = time.perf_counter()
    weight = _weights(grid, given.regions, given.region_weights)
    more: dict[str, Any] = {"regions_s": time.perf_counter() - began}
    nan = float("nan")
    config = PlanConfig(
        planner=given.planner, seed=given.seed, risk=given.risk,
        correlation_m=nan if given.error_correlation is None else given.error_correlation,
    )  # fmt: skip
    common: dict[str, Any] = {
        "terms": read_terms(given.cost_path), "weight": weight, "config": config,
        "forbidden": _no_go(grid, given.avoid), "progress": progress,
        "position_sigma_m": _position_sigma(given.position_sigma, grid),
    }  # fmt: skip
    if given.via:
        stops = [given.start, *given.via, given.goal]
        plan, order = plan_mission(grid, stops, limits, **common)
        more["order"] = order
    else:
        plan = plan_route(grid, given.start, given.goal, limits, **common)
    if large:
        plan = prove_at_full_resolution(given.map_path, plan, grid)
        more["reduced_cell_m"] = grid.cell_m
    return plan, more


def _read(given: Given, large: bool) -> Grid:
    from mapping.rasters import read_map

    if not large:
        return read_map(given.map_path, given.map_sigma)
    from planning.large import raster_cells, read_reduced

    began = time.perf_counter()
    grid, block = read_reduced(given.map_path)
    logger.warning(
        "%s: %d million cells; planned on blocks of %d x %d cells (%.1f m, read in %.0f s), the clearance "
        "proved at full resolution; gaps narrower than a block are not used",
        given.map_path, raster_cells(given.map_path) // 1_000_000, block, block, grid.cell_m,
        time.perf_counter() - began,
    )  # fmt: skip
    return grid


def _position_sigma(path: Path | None, grid: Grid) -> FloatArray | None:
    if path is None:
        return None
    import numpy as np

    from mapping.rasters import read_map

    raster = read_map(path)
    easting, northing = np.meshgrid(*grid.centres())
    sampled = raster.sample(easting, northing)
    if not np.isfinite(sampled).any():
        raise InputError(f"{path}: does not cover the map; give a raster of the same area")
    # Where nothing is known of the position, the worst that is known holds.
    return np.where(np.isfinite(sampled), sampled, np.nanmax(sampled))


def _write_route(out: Path, route: Route, limits: VehicleLimits) -> None:
    from planning.exports import write_exports
    from planning.route import write_route

    write_route(out, route)
    if not write_exports(out, route, limits.speed_m_s):
        logger.warning("the map has no CRS: route.gpx and route.plan need one and are left out")


def _surface(given: Given, limits: VehicleLimits, length_m: float) -> tuple[Surface, str]:
    """Return the surface for a survey or a replanning, k for a route of that length."""
    from mapping.rasters import read_map
    from planning.cost import read_terms
    from planning.risk import clearance_factor, clearance_sigma, patches_crossed
    from planning.surface import build_surface

    grid = read_map(given.map_path, given.map_sigma)
    sigma = clearance_sigma(
        grid.elevation_m, (grid.cell_m, grid.cell_north_m), grid.sigma_m,
        limits.sigma_position_m, limits.sigma_depth_m,
    )  # fmt: skip
    correlation = given.error_correlation or 10.0 * max(grid.cell_m, grid.cell_north_m)
    patches = patches_crossed(length_m, correlation)
    k = 0.0 if sigma is None else clearance_factor(given.risk, patches)
    surface = build_surface(
        grid, limits, read_terms(given.cost_path),
        None if given.old_route is None else _weights(grid, given.regions, given.region_weights),
        sigma, k, _no_go(grid, given.avoid),
    )  # fmt: skip
    return surface, grid.crs


def _survey(
    given: Given,
    limits: VehicleLimits,
    out: Path,
    config: dict[str, Any],
    began: float,
    quiet: bool,
    picture: bool,
) -> int:
    import shapely

    from mapping.vectors import read_polygons
    from planning.coverage import SurveyConfig, plan_survey
    from planning.finish import exact_cost
    from planning.route import route_of

    settings = SurveyConfig(given.swath, given.overlap, given.crossings)
    assert given.survey is not None
    surface, crs = _surface(given, limits, 10_000.0)
    area = shapely.union_all(read_polygons(given.survey, crs))
    if area.geom_type != "Polygon":
        raise InputError(
            f"{given.survey}: holds {len(area.geoms)} separate areas; survey one at a time"
        )
    survey = plan_survey(surface, area, settings)
    w = survey.path
    more = {
        "lines": len(survey.lines), "covered_share": survey.covered, "area_m2": survey.area_m2,
        "k_sigma": surface.k, "seconds": time.perf_counter() - began, "grid_cost": None, "lower_bound": None,
    }  # fmt: skip
    from scenarios.outputs import write_metrics

    if w.problem:
        reason = (
            f"the survey's track breaks a limit at {w.worst[0]:.1f},{w.worst[1]:.1f}: {w.problem}"
        )
        write_metrics(out, {"solved": False, "reason": reason, **more}, config, given.seed)
        raise NoPathError(f"{given.map_path}: {reason}; raise the limit or make the area smaller")
    route = route_of(w, exact_cost(surface, w), crs)
    write_metrics(
        out, {**_figures(route), "solved": True, "reason": "", **more}, config, given.seed
    )
    _write_route(out, route, limits)
    if picture:
        from scenarios.plots_routes import picture_survey

        picture_survey(out / "route.png", surface, survey, area)
    if not quiet:
        rows = [
            (
                "lines",
                f"{len(survey.lines)} covering {100 * survey.covered:.2f} % of {survey.area_m2:.0f} m2",
            ),
            (
                "track",
                f"{route.length_m:.0f} m with turns, {route.length_m / limits.speed_m_s / 3600:.2f} h",
            ),
            ("least margin", f"{route.min_clearance_margin_m:.4f} m, proved"),
            ("written", str(out / "route.csv")),
        ]
        print_table("survey", rows)
    return 0


def _replan(
    given: Given,
    limits: VehicleLimits,
    out: Path,
    config: dict[str, Any],
    began: float,
    quiet: bool,
) -> int:
    from planning.replan import read_route, replan
    from scenarios.outputs import write_metrics

    assert given.old_route is not None
    old = read_route(given.old_route)
    state = old.state_at(given.travelled)
    surface, crs = _surface(given, limits, 1.5 * float(old.distance_m[-1] - given.travelled) + 1.0)
    clock = time.perf_counter()
    route, problem = replan(surface, state, old.rest(given.travelled), crs)
    more = {
        "grid_cost": None, "lower_bound": None, "k_sigma": surface.k,
        "replan_s": time.perf_counter() - clock, "seconds": time.perf_counter() - began,
    }  # fmt: skip
    if route is None:
        write_metrics(out, {"solved": False, "reason": problem, **more}, config, given.seed)
        raise NoPathError(f"{given.map_path}: no way on: {problem}; stop or climb")
    write_metrics(
        out, {**_figures(route), "solved": True, "reason": "", **more}, config, given.seed
    )
    _write_route(out, route, limits)
    if not quiet:
        rows = [
            ("length", f"{route.length_m:.1f} m"),
            ("cost", f"{route.cost:.1f}"),
            ("written", str(out / "route.csv")),
        ]
        print_table("replanned", rows)
    return 0


def _figures(route: Route | None) -> dict[str, Any]:
    """Return a route's figures for metrics.json, nulls without a route."""
    names = (
        "cost",
        "length_m",
        "mean_altitude_m",
        "min_altitude_m",
        "max_altitude_m",
        "min_clearance_margin_m",
    )
    out: dict[str, Any] = {name: None if route is None else getattr(route, name) for name in names}
    for i, name in enumerate(("worst_easting_m", "worst_northing_m", "worst_depth_m")):
        out[name] = None if route is None else route.worst[i]
    return out


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
        "route.png",
        "blocked.png",
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

    nothing = {**_figures(None), "grid_cost": None, "lower_bound": None}
    write_metrics(
        out, {**nothing, "solved": False, "reason": reason, "seconds": seconds}, config, seed
    )


def _write_metrics(
    out: Path,
    plan: Plan,
    config: dict[str, Any],
    given: Given,
    seconds: float,
    more: dict[str, Any],
) -> None:
    from scenarios.outputs import write_metrics

    route, blocked = plan.route, plan.blockage
    stand_off = None if route is None else _stand_off(plan, route)
    metrics: dict[str, Any] = {
        **_figures(route),
        "grid_cost": plan.grid_cost,
        "lower_bound": plan.lower_bound,
        "cost_over_grid": plan.ratio,
        "gap_to_bound": None
        if route is None or not plan.lower_bound > 0
        else route.cost / plan.lower_bound - 1.0,
        "min_stand_off_m": stand_off,
        "solved": plan.solved,
        "reason": plan.reason,
        "blocked_by": None if blocked is None else blocked.limit,
        "blocked_easting_m": None if blocked is None else blocked.place[0],
        "blocked_northing_m": None if blocked is None else blocked.place[1],
        **(
            {}
            if blocked is None
            else {f"opens_{key}": value for key, value in blocked.opens.items()}
        ),
        "seconds": seconds,
        "risk": given.risk,
        "k_sigma": plan.k,
        "independent_patches": plan.patches,
        **more,
        **plan.stages_s,
        **{f"cost_{name}": value for name, value in plan.costs.items()},
    }
    write_metrics(out, metrics, config, given.seed)


def _stand_off(plan: Plan, route: Route) -> float:
    """Return the least slant distance to the ground's cells, waypoint by waypoint."""
    from planning.clearance import least_stand_off

    surface = plan.surface
    x, y = surface.local(route.easting_m, route.northing_m)
    reach = min(2.0 * surface.limits.floor_m, 30.0 * max(surface.cell_m))
    distance, _ = least_stand_off(
        surface.bottom_m, surface.cell_m, y / surface.cell_m[1], x / surface.cell_m[0],
        -route.depth_m, reach,
    )  # fmt: skip
    return distance


def _tell(plan: Plan, seconds: float, out: Path) -> None:
    route = plan.route
    assert route is not None
    rows = [
        ("length", f"{route.length_m:.1f} m"),
        (
            "cost",
            f"{route.cost:.1f} ({plan.ratio:.3f} of the limit-free grid search)",
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
