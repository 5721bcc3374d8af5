"""What `bathynav plan` does: a route from start to goal, survey lines over an area, a route replanned."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from perception.files import read_toml
from perception.records import InputError, NoPathError
from scenarios.commands.console import print_table
from scenarios.outputs import write_metrics
from scenarios.route_inputs import Given, from_true_north, read_around, read_asked
from scenarios.route_outputs import (
    clearance_told,
    figures,
    tell_route,
    write_plan,
    write_route_files,
    write_unsolved,
)

if TYPE_CHECKING:
    from perception.records import Progress
    from planning.limits import VehicleLimits
    from planning.planner import Plan

logger = logging.getLogger(__name__)

# What a route was held by, and what a plan of its rest may need again.
_HELD_BY = {
    "objects": "--objects", "avoid": "--avoid", "position_sigma": "--position-sigma", "currents": "--currents",
    "cost_path": "--cost", "map_sigma": "--map-sigma", "error_correlation": "--error-correlation",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Run:
    """One run of the command: what was given, where it goes, and how it is told."""

    given: Given
    limits: VehicleLimits
    out: Path
    config: dict[str, Any]
    quiet: bool
    picture: bool
    progress: Progress
    began: float

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self.began


def route(run: Run) -> None:
    """Plan from start to goal, through the goals between where there are any.

    Raises
    ------
    NoPathError
        There is no route within the limits; metrics and picture say why.
    """
    plan, more = _planned(run)
    more["seconds"] = run.seconds
    if run.picture:
        from scenarios.plots_routes import picture_plan

        picture_plan(run.out / ("route.png" if plan.solved else "blocked.png"), plan)
    if plan.route is not None:
        write_route_files(run.out, plan.route, run.limits)
    # Last: who finds "solved" finds the route too.
    write_plan(run.out, plan, run.given, run.config, more)
    if plan.route is None:
        raise NoPathError(f"{run.given.map_path}: no route: {plan.reason}")
    if not run.quiet:
        tell_route(plan, run.seconds, run.out, more)


def _planned(run: Run) -> tuple[Plan, dict[str, Any]]:
    from planning.full_resolution import plan_large
    from planning.mission import solve_mission
    from planning.planner import PlanConfig, solve

    given = run.given
    assert given.start is not None and given.goal is not None
    asked = read_asked(given, run.limits, run.progress)
    more = dict(asked.more)
    config = PlanConfig(given.planner, given.space, seed=given.seed)
    stops = [given.start, *given.via, given.goal]
    order = list(range(len(stops)))
    if asked.full is not None:
        if given.via:
            raise InputError(
                f"{given.map_path}: a mission of several goals needs a map that can be held; cut it "
                "to the area (gdal_translate -projwin) or coarsen it (-r average -tr)"
            )
        plan, repairs = plan_large(asked.full, asked.problem, stops[0], stops[-1], config)
        more["stretches_replanned"] = repairs
    elif given.via:
        plan, order = solve_mission(asked.problem, stops, config)
    else:
        plan = solve(asked.problem, stops[0], stops[-1], config, run.progress)
    if given.via:
        # Flat keys: the order as one text, 0 the start, then the goals between as they were given.
        more |= {"order": " ".join(map(str, order)), "stops": len(stops)}
    return plan, more


def survey(run: Run) -> None:
    """Cover an area with survey lines.

    Raises
    ------
    NoPathError
        The track breaks a limit somewhere.
    """
    import shapely

    from mapping.vectors import read_polygons
    from planning.coverage import SurveyConfig, plan_survey
    from planning.large import map_crs
    from planning.route import route_of

    given = run.given
    settings = SurveyConfig(given.swath, given.overlap, given.crossings)
    assert given.survey is not None
    area = shapely.union_all(read_polygons(given.survey, map_crs(given.map_path)))
    if area.geom_type != "Polygon":
        raise InputError(
            f"{given.survey}: holds {len(getattr(area, 'geoms', ()))} separate areas; survey one at a time"
        )
    # Room for run-ins and for turns that swing out beyond the lines' ends.
    margin = 4.0 * run.limits.turn_radius_m + 2.0 * given.swath
    problem = read_around(given, run.limits, area.bounds, margin)
    surface, _ = problem.surface_for(_track_length(area, given))
    found = plan_survey(surface, area, settings)
    w = found.path
    more = {
        "lines": len(found.lines), "covered_share": found.covered, "area_m2": found.area_m2,
        "k_sigma": surface.k, "grid_cost": None, "lower_bound": None,
    }  # fmt: skip
    if w.problem:
        where = f"{w.worst[0]:.1f},{w.worst[1]:.1f}"
        reason = f"the survey's track breaks a limit at {where}: {w.problem}"
        write_unsolved(run.out, reason, run.config, given.seed, {**more, "seconds": run.seconds})
        raise NoPathError(f"{given.map_path}: {reason}; raise the limit or make the area smaller")
    route = route_of(surface, w, problem.grid.crs)
    figured = {**figures(route), "solved": True, "reason": "", **more, "seconds": run.seconds}
    if run.picture:
        from scenarios.plots_routes import picture_survey

        picture_survey(run.out / "route.png", surface, found, area)
    write_route_files(run.out, route, run.limits)
    write_metrics(run.out, figured, run.config, given.seed)
    if not run.quiet:
        covering = f"{100 * found.covered:.2f} % of {found.area_m2:.0f} m2"
        hours = route.travel_time_s / 3600
        rows = [
            ("lines", f"{len(found.lines)} covering {covering}"),
            ("track", f"{route.length_m:.0f} m with turns, {hours:.2f} h"),
            ("clearance", clearance_told(route, surface.limits.floor_m, surface.k)),
            ("stand-off", f"{route.min_stand_off_m:.2f} m"),
            ("written", str(run.out / "route.csv")),
        ]
        print_table("survey", rows)


def _track_length(area: Any, given: Given) -> float:
    """Return about how long the track over an area is: it decides k."""
    spacing = given.swath * (1.0 - given.overlap)
    across = area.length * (given.crossings + 1) / 4.0
    return float(1.3 * (area.area / max(spacing, 1e-6) + across))


def replanned(run: Run) -> None:
    """Plan the rest of a route anew, from where the vehicle is.

    Raises
    ------
    NoPathError
        There is no way on within the limits.
    """
    from planning.replan import read_route, replan

    given = run.given
    assert given.old_route is not None
    old = read_route(given.old_route)
    _tell_of_forgotten(run, given.old_route)
    state = old.state_at(given.travelled)
    rest = old.rest(given.travelled)
    left = float(old.distance_m[-1] - given.travelled)
    e, n = (float(v) for v in (state.easting_m, state.northing_m))
    box = (
        min(e, rest[:, 0].min()), min(n, rest[:, 1].min()),
        max(e, rest[:, 0].max()), max(n, rest[:, 1].max()),
    )  # fmt: skip
    problem = read_around(given, run.limits, box, 0.5 * left + 20.0 * run.limits.turn_radius_m)
    goal = (float(rest[-1, 0]), float(rest[-1, 1]))
    limits = from_true_north(problem.limits, problem.grid, None, goal)
    surface, _ = replace(problem, limits=limits).surface_for(1.5 * left + 1.0)
    clock = time.perf_counter()
    found, trouble = replan(surface, state, rest, problem.grid.crs)
    more = {
        "grid_cost": None, "lower_bound": None, "k_sigma": surface.k,
        "replan_s": time.perf_counter() - clock, "seconds": run.seconds,
    }  # fmt: skip
    if found is None:
        write_unsolved(run.out, trouble, run.config, given.seed, more)
        raise NoPathError(f"{given.map_path}: no way on: {trouble}; stop or climb")
    figured = {**figures(found), "solved": True, "reason": "", **more}
    write_route_files(run.out, found, run.limits)
    write_metrics(run.out, figured, run.config, given.seed)
    if not run.quiet:
        rows = [
            ("length", f"{found.length_m:.1f} m"),
            ("cost", f"{found.cost:.1f}"),
            ("altitude", f"mean {found.mean_altitude_m:.2f} m, least {found.min_altitude_m:.2f} m"),
            ("clearance", clearance_told(found, surface.limits.floor_m, surface.k)),
            ("stand-off", f"{found.min_stand_off_m:.2f} m"),
            ("written", str(run.out / "route.csv")),
        ]
        print_table("replanned", rows)


def _tell_of_forgotten(run: Run, old_route: Path) -> None:
    """Say what the old route was held by and this run is not: nothing of it is taken over by itself."""
    path = old_route.parent / "config.toml"
    if not path.is_file():
        return
    try:
        old = read_toml(path)
    except InputError as error:
        logger.warning("cannot tell what the old route was held by: %s", error)
        return
    for key, option in _HELD_BY.items():
        if old.get(key) and not getattr(run.given, key):
            logger.warning(
                "%s was planned with %s %s and this run is without: give it again if it still holds",
                old_route, option, old[key],
            )  # fmt: skip
    limits = run.config["vehicle"]
    changed = [k for k, v in old.get("vehicle", {}).items() if k in limits and limits[k] != v]
    if changed and run.given.vehicle is None:
        logger.warning(
            "%s was planned for a vehicle of other limits (%s): give its --vehicle again",
            old_route, ", ".join(changed),
        )  # fmt: skip
