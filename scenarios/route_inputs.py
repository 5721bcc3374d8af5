"""What `bathynav plan` is given: options as they came, and the files they name, read and checked."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from perception.records import InputError, NoOverlapError

if TYPE_CHECKING:
    from perception.records import BoolArray, FloatArray, Grid, Progress
    from planning.full_resolution import FullMap
    from planning.large import Reduced
    from planning.limits import VehicleLimits
    from planning.obstacles import Obstacles
    from planning.problem import Problem

logger = logging.getLogger(__name__)

# The band of `locate --observability` that planning takes.
_EXPECTED = "sigma_mean"


@dataclass(frozen=True, slots=True)
class Given:
    """The options as they came; names are those of the command line."""

    map_path: Path
    start: tuple[float, float] | None
    goal: tuple[float, float] | None
    via: tuple[tuple[float, float], ...]
    vehicle: Path | None
    avoid: Path | None
    objects: Path | None
    regions: Path | None
    region_weights: str
    map_sigma: float | None
    risk: float
    error_correlation: float | None
    position_sigma: Path | None
    currents: str
    cost_path: Path | None
    survey: Path | None
    swath: float
    overlap: float
    crossings: int
    old_route: Path | None
    travelled: float
    planner: str
    space: str
    seed: int


@dataclass(frozen=True, slots=True)
class Asked:
    """The problem that the options pose.

    Attributes
    ----------
    full : the map as stored, where it is too large to hold and the problem's is reduced; else None.
    more : figures of the reading, for metrics.json.
    """

    problem: Problem
    full: FullMap | None
    more: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Beside:
    """What else bears on the ground, read once and asked of any grid of the map; each gives None without a file.

    `standing` is how many objects on the map stand up, and of how many of them only the least height is known, whose
    ground is barred; None without a file.
    """

    forbidden: Callable[[Grid], BoolArray | None]
    position_sigma: Callable[[Grid], FloatArray | None]
    obstacles: Callable[[Grid], Obstacles | None]
    standing: tuple[int, int] | None


def read_asked(given: Given, limits: VehicleLimits, progress: Progress) -> Asked:
    """Read the map and all that bears on it, for a route from start to goal."""
    from mapping.rasters import read_map
    from planning.full_resolution import FullMap
    from planning.large import MOST_CELLS, raster_cells

    cells = raster_cells(given.map_path)
    reduced: Reduced | None = None
    if cells > MOST_CELLS:
        reduced = _reduce(given, cells, progress)
        grid = reduced.grid
    else:
        grid = read_map(given.map_path, given.map_sigma)
    _tell_of_sigma(given, grid, limits)
    beside = read_beside(given, grid)
    limits = from_true_north(limits, grid, given.start, given.goal)
    problem = posed(given, grid, limits, None, beside)
    _tell_of_dry_ground(given, problem)
    if reduced is None and given.regions is None and given.region_weights != "none":
        # Before the segmentation, which takes longest. Of block means the ends are judged at full resolution, later.
        check_ends(problem, (given.start, *given.via, given.goal))
    began = time.perf_counter()
    problem = replace(problem, weight=_weights(grid, given, reduced))
    more: dict[str, Any] = {"regions_s": time.perf_counter() - began}
    if beside.standing is not None:
        more["standing_objects"], more["barring_objects"] = beside.standing
    if reduced is None:
        return Asked(problem, None, more)
    problem = replace(problem, submerged=not reduced.lowest_m > 0)
    if given.error_correlation is None:
        # Ten cells as stored, not ten blocks: fewer patches would take k for smaller than it is.
        problem = replace(problem, correlation_m=10.0 * max(reduced.cell_m))
    more |= {"reduced_cell_m": grid.cell_m, "map_cells": cells}
    full = FullMap(
        given.map_path, given.map_sigma, reduced, beside.forbidden, beside.position_sigma,
        beside.obstacles,
    )  # fmt: skip
    return Asked(problem, full, more)


def check_ends(problem: Problem, stops: tuple[tuple[float, float] | None, ...]) -> None:
    """Refuse ends where no route can be before the work that takes time; k is still unknown and 0."""
    from planning.ends import end_node

    surface = problem.surface(problem.clearance_sigma_m(), 0.0)
    for number, stop in enumerate(stops):
        name = "start" if number == 0 else "goal" if number == len(stops) - 1 else f"--via {number}"
        if stop is not None:
            end_node(surface, stop, name)


def read_beside(given: Given, grid: Grid) -> Beside:
    """Read no-go areas, expected position error and objects; `grid` is the whole map or what is held of it."""
    return Beside(
        no_go(given.avoid, grid.crs),
        position_sigma(given.position_sigma, given.map_path),
        *standing(given.objects, grid),
    )


def posed(
    given: Given, grid: Grid, limits: VehicleLimits, weight: FloatArray | None, beside: Beside
) -> Problem:
    """Return the problem on a grid that is held."""
    from planning.cost import read_terms
    from planning.current_files import read_currents
    from planning.problem import Problem

    return Problem(
        grid=grid,
        limits=limits,
        terms=read_terms(given.cost_path),
        weight=weight,
        forbidden=beside.forbidden(grid),
        obstacles=beside.obstacles(grid),
        position_sigma_m=beside.position_sigma(grid),
        currents=read_currents(given.currents, grid) if given.currents else None,
        risk=given.risk,
        correlation_m=math.nan if given.error_correlation is None else given.error_correlation,
    )


def read_around(
    given: Given, limits: VehicleLimits, box: tuple[float, float, float, float], margin_m: float
) -> Problem:
    """Pose the problem of a survey or a replanning; of a large map only what lies around it is read."""
    from mapping.rasters import read_map
    from planning.large import MOST_CELLS, is_dry, raster_cells, read_window

    large = raster_cells(given.map_path) > MOST_CELLS
    if large:
        grid = read_window(given.map_path, box, margin_m, given.map_sigma)
        if grid.elevation_m.size > MOST_CELLS:
            raise InputError(
                f"{given.map_path}: {grid.elevation_m.size / 1e6:.0f} million cells lie around what is "
                f"asked for, more than {MOST_CELLS / 1e6:.0f}; divide it, or coarsen the map: "
                "gdal_translate -r average -tr"
            )
        if grid.sigma_m is not None and not (grid.sigma_m >= 0).any():
            # A band in name only here: the run must tell that it covers no error of the map.
            grid = replace(grid, sigma_m=None)
    else:
        grid = read_map(given.map_path, given.map_sigma)
    _tell_of_sigma(given, grid, limits)
    weight = None
    if given.old_route is not None:
        weight = _weights(grid, given, None)
    problem = posed(given, grid, limits, weight, read_beside(given, grid))
    if large and not problem.under_water():
        # What was read lies on dry ground; whether all of the map does, only the rest of it tells.
        problem = replace(problem, submerged=not is_dry(given.map_path))
    return problem


def _reduce(given: Given, cells: int, progress: Progress) -> Reduced:
    from planning.large import read_reduced, reading_seconds

    logger.warning(
        "%s: %.0f million cells, too many to hold; about %.0f s of reading, then the route is planned "
        "on block means and proved at full resolution; gaps narrower than a block are not looked for",
        given.map_path, cells / 1e6, reading_seconds(cells),
    )  # fmt: skip
    return read_reduced(given.map_path, given.map_sigma, progress)


def _tell_of_sigma(given: Given, grid: Grid, limits: VehicleLimits) -> None:
    """Warn where the clearance covers no error at all: the proof is then of the raster alone."""
    known = grid.sigma_m is not None or given.position_sigma is not None
    if not known and limits.sigma_depth_m == 0 and limits.sigma_position_m == 0:
        logger.warning(
            "%s: has no sigma, so the clearance holds over the raster as it stands (k = 0); "
            "give --map-sigma to cover the map's errors%s", given.map_path,
            "" if given.objects is None else " and the objects'",
        )  # fmt: skip


def _tell_of_dry_ground(given: Given, problem: Problem) -> None:
    """Warn where a map has no ground under water: heights may be depths, counted downwards."""
    if not problem.under_water():
        logger.warning(
            "%s: all its heights lie above zero, so it is taken for dry ground without a water surface; if they are "
            "depths, turn them: gdal_calc.py -A MAP.tif --calc=-A", given.map_path,
        )  # fmt: skip


def from_true_north(
    limits: VehicleLimits,
    grid: Grid,
    start: tuple[float, float] | None,
    goal: tuple[float, float] | None,
) -> VehicleLimits:
    """Return the limits with the headings at the ends, from true north in files, from grid north."""
    import numpy as np

    from perception.geodesy import convergence

    changed = {}
    for name, end in (("start_heading_deg", start), ("goal_heading_deg", goal)):
        value = getattr(limits, name)
        if math.isfinite(value) and end is not None:
            turn = convergence(np.array([end[0]]), np.array([end[1]]), grid.crs)
            changed[name] = value - math.degrees(float(np.nan_to_num(turn)[0]))
    return replace(limits, **changed)


def position_sigma(path: Path | None, map_path: Path) -> Callable[[Grid], FloatArray | None]:
    """Return what gives the expected position error on a grid; None where no file is given.

    Coverage is asked of the whole map, not of the grid: a window of it may lie beside the raster.
    """
    if path is None:
        return lambda grid: None
    import numpy as np

    from mapping.rasters import open_map
    from planning.large import map_bounds, map_crs

    with open_map(path) as opened:
        names = [name or "" for name in opened.source.descriptions]
        # An observability map has a band for every heading: what counts is their mean.
        band = names.index(_EXPECTED) + 1 if _EXPECTED in names else opened.elevation_band
        raster = replace(opened, elevation_band=band, down=False).read_whole()
    if np.nanmin(raster.elevation_m) < 0:
        raise InputError(f"{path}: holds a negative error ({np.nanmin(raster.elevation_m):g} m)")
    _refuse_other_crs(path, raster.crs, map_crs(map_path))
    if not _knows_within(raster, map_bounds(map_path)):
        raise NoOverlapError(f"{path}: does not cover the map; give a raster of the same area")
    worst = np.nanmax(raster.elevation_m)

    def on(grid: Grid) -> FloatArray | None:
        sampled = raster.sample(*np.meshgrid(*grid.centres()))
        # Where nothing is known of the position, the worst that is known holds.
        return np.where(np.isfinite(sampled), sampled, worst)

    return on


def _refuse_other_crs(path: Path, crs: str, of_map: str) -> None:
    if not crs or not of_map or crs == of_map:
        return
    from pyproj import CRS

    from perception.geodesy import short_name

    ours = CRS.from_user_input(of_map)
    # A map may name a vertical datum too, which places on it do not depend on.
    ours = ours.sub_crs_list[0] if ours.is_compound else ours
    if not ours.equals(CRS.from_user_input(crs), ignore_axis_order=True):
        raise InputError(
            f"{path}: lies in {short_name(CRS.from_user_input(crs))}, the map in {short_name(ours)}; warp it: "
            f"gdalwarp -t_srs {short_name(ours)}"
        )


def _knows_within(raster: Grid, box: tuple[float, float, float, float]) -> bool:
    """Tell whether a raster has a value in a box (west, south, east, north), to a cell of its own."""
    import numpy as np

    easting, northing = raster.centres()
    cols = (easting > box[0] - raster.cell_m) & (easting < box[2] + raster.cell_m)
    rows = (northing > box[1] - raster.cell_north_m) & (northing < box[3] + raster.cell_north_m)
    return bool(np.isfinite(raster.elevation_m[np.ix_(rows, cols)]).any())


def no_go(path: Path | None, crs: str) -> Callable[[Grid], BoolArray | None]:
    """Return what tells the cells of a grid that no-go areas bar; None where no file is given."""
    if path is None:
        return lambda grid: None
    from mapping.vectors import read_polygons
    from planning.nogo import forbidden_cells

    polygons = read_polygons(path, crs)
    return lambda grid: forbidden_cells(grid, polygons)


def standing(
    path: Path | None, whole: Grid
) -> tuple[Callable[[Grid], Obstacles | None], tuple[int, int] | None]:
    """Return what gives the objects that stand on a grid, and `Beside.standing`; None where no file is given.

    Parameters
    ----------
    whole : the map, which names the CRS, and on which at least one object must lie.
    """
    if path is None:
        return lambda grid: None, None
    import numpy as np

    from mapping.object_layer import read_objects
    from planning.obstacles import obstacles_on

    _tell_of_looks(path)
    objects = read_objects(path, whole)
    if len(objects.height_m) and not np.isfinite(objects.height_m).any():
        raise InputError(
            f"{path}: gives no object a height (column height_m); give the objects.gpkg or objects.csv "
            "of bathynav map or strips"
        )
    row, col = whole.fractional_index(objects.easting_m, objects.northing_m)
    rows, cols = whole.shape
    on_map = (row > -1) & (row < rows) & (col > -1) & (col < cols)
    if len(on_map) and not on_map.any():
        raise NoOverlapError(
            f"{path}: none of its {len(on_map)} objects lies on the map; give the list of the same "
            "survey, in the map's CRS"
        )
    hills = on_map & ~objects.crater & (objects.height_m > 0)
    counted = int(np.sum(hills)), int(np.sum(hills & objects.least))
    logger.info("%s: %d objects stand on the map, %d of them of unknown height", path, *counted)
    return lambda grid: obstacles_on(grid, objects), counted


def _tell_of_looks(path: Path) -> None:
    """Warn where single looks are given beside the objects that they are of."""
    merged = path.with_name("objects.gpkg")
    if path.suffix.lower() == ".csv" and merged.exists():
        logger.warning(
            "%s: holds single looks, several of one object and some that other passes overruled; %s beside it "
            "holds the objects: give that", path, merged.name,
        )  # fmt: skip


def _weights(grid: Grid, given: Given, reduced: Reduced | None) -> FloatArray | None:
    if given.region_weights == "none":
        return None
    from planning.cost import CLASS_WEIGHTS, read_class_weights, region_weights

    table = dict(CLASS_WEIGHTS)
    if given.region_weights:
        table = read_class_weights(Path(given.region_weights))
    if given.regions is None:
        from perception.regions import segment

        return region_weights(segment(grid).regions, table)
    if reduced is not None:
        from planning.large import reduced_weights

        return reduced_weights(given.regions, reduced, table)
    from mapping.region_files import read_regions

    regions = read_regions(given.regions)
    _refuse_other_crs(given.regions, regions.crs, grid.crs)
    near = 0.01 * grid.cell_m
    moved = max(
        abs(regions.west_m - grid.west_m),
        abs(regions.north_m - grid.north_m),
        abs(regions.cell_m - grid.cell_m) * grid.shape[1],
    )
    if regions.class_code.shape != grid.shape or moved > near:
        raise InputError(
            f"{given.regions}: {regions.class_code.shape} cells of {regions.cell_m:g} m from "
            f"{regions.west_m:.2f},{regions.north_m:.2f} are not the map's {grid.shape} of {grid.cell_m:g} m "
            f"from {grid.west_m:.2f},{grid.north_m:.2f}; make it from this map: bathynav regions MAP.tif"
        )
    return region_weights(regions, table)
