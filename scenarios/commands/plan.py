"""`bathynav plan`: a low route within the vehicle's limits, proved clear, or the reason why not."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import click

from perception.records import InputError, NoOverlapError
from scenarios.commands.console import (
    FiniteRange,
    common_options,
    out_option,
    prepare_out,
    progress_bars,
    set_verbosity,
)
from scenarios.route_inputs import Given

PLANNERS = ("bitstar", "rrtstar", "informed", "sorrt", "fmt", "none")
SPACES = ("corridor", "altitude", "depth", "dubins", "owen")


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
        if not (math.isfinite(easting) and math.isfinite(northing)):
            self.fail(f"{value!r} is not a place on a map", param, ctx)
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
    "--objects", type=click.Path(path_type=Path),
    help="objects.gpkg of `map` (its .csv holds single looks): boulders that the map smooths are held clear of too.",
)  # fmt: skip
@click.option(
    "--regions", type=click.Path(path_type=Path), help="regions.tif to take weights from."
)
@click.option(
    "--region-weights",
    default="",
    help="'none', or a TOML file with [weights]; without: H-K weights.",
)
@click.option(
    "--map-sigma", type=FiniteRange(min=0), help="1-sigma of the map, m, instead of its band."
)
@click.option(
    "--risk",
    type=FiniteRange(0, 1, min_open=True, max_open=True),
    default=0.01,
    show_default=True,
    help="Of breaking the floor.",
)
@click.option(
    "--error-correlation",
    type=FiniteRange(min=0, min_open=True),
    help="Length over which map errors hold, m.",
)
@click.option(
    "--position-sigma",
    type=click.Path(path_type=Path),
    help="Raster of expected position error, m.",
)
@click.option(
    "--currents",
    default="",
    help="EAST,NORTH in m/s, a NetCDF, or a raster of two bands: cost by metres of water.",
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
@click.option(
    "--swath",
    type=FiniteRange(min=0, min_open=True),
    default=60.0,
    show_default=True,
    help="Of a survey line, m.",
)
@click.option(
    "--overlap",
    type=FiniteRange(0, 1, max_open=True),
    default=0.2,
    show_default=True,
    help="Of neighbouring swaths.",
)
@click.option(
    "--crossings",
    type=click.IntRange(min=0),
    default=2,
    show_default=True,
    help="Survey lines square to the others.",
)
@click.option("--replan", "old_route", type=click.Path(path_type=Path), help="route.csv under way.")
@click.option(
    "--travelled", type=FiniteRange(min=0), default=0.0, help="Metres of it behind the vehicle."
)
@click.option("--planner", type=click.Choice(PLANNERS), default="bitstar", show_default=True)
@click.option(
    "--space",
    type=click.Choice(SPACES),
    default="corridor",
    show_default=True,
    help="That OMPL plans in: along the best guide, or without one.",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of OMPL.")
@click.option("--picture/--no-picture", default=True, show_default=True, help="Draw route.png.")
@common_options
def command(out: Path, quiet: bool, verbose: bool, picture: bool, **options: Any) -> None:
    """Plan a route that stays near the bottom and is proved clear of it.

    Writes route.csv, .geojson, .gpkg, .gpx, .plan and .png, and metrics.json; without a route, blocked.png
    and the reason.

    \b
    bathynav plan --map map.tif --start 512340,4101200 --goal 513020,4101950 --out plan
    bathynav plan --map map.tif --start E,N --goal E,N --via E,N --via E,N --out tour
    bathynav plan --map map.tif --survey area.gpkg --swath 60 --out lines
    bathynav plan --map new.tif --replan plan/route.csv --travelled 240 --out plan2
    """
    set_verbosity(quiet, verbose)
    given = Given(**options)
    _refuse_mixed(given)
    if given.old_route is not None and given.old_route.resolve().parent == out.resolve():
        raise click.UsageError(
            f"--replan {given.old_route} lies in --out itself and would be written over; give another --out"
        )
    out = prepare_out(out)
    from planning.limits import VehicleLimits, read_vehicle
    from scenarios.route_outputs import clear, resolved, write_unsolved
    from scenarios.route_runs import Run, replanned, route, survey

    clear(out)
    began = time.perf_counter()
    config = resolved(options, VehicleLimits())
    with progress_bars(quiet) as progress:
        try:
            limits = read_vehicle(given.vehicle)
            config = resolved(options, limits)
            run = Run(given, limits, out, config, quiet, picture, progress, began)
            if given.survey is not None:
                survey(run)
            elif given.old_route is not None:
                replanned(run)
            else:
                route(run)
        except (InputError, NoOverlapError) as error:
            more = {"seconds": time.perf_counter() - began}
            # Of a route that could not be written whole, nothing is left.
            clear(out)
            write_unsolved(out, str(error), config, given.seed, more)
            raise


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
    if given.planner == "fmt" and given.space != "corridor":
        raise click.UsageError("--planner fmt plans in --space corridor only")
