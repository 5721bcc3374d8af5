"""What `bathynav map` leaves in its folder, of a map in one piece or in tiles."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mapping.cog import Frame, Slices, write_cog
from mapping.compare import write_changes
from mapping.fill import fill_map
from mapping.flag_layer import (
    FLAGS_KIND,
    NO_FLAGS,
    flag_figures,
    flag_tags,
    flagged_cells,
    map_flags,
    write_flags,
)
from mapping.height_tie import HeightTie
from mapping.mosaic import echo_mosaic, write_mosaic
from mapping.objects import MergedObjects, merge_objects, write_objects
from mapping.overruled import overruled
from mapping.pose_graph_files import write_graph
from mapping.quality import (
    S44_ORDERS,
    crossing_figures,
    horizontal_95,
    order_met,
    survey_quality,
)
from mapping.rasters import write_map
from mapping.round_files import write_rounds
from mapping.survey_records import CorrectedSurvey
from mapping.tile_figures import map_figures, tile_figures
from mapping.tile_fill import with_fill
from mapping.tile_store import FILL_LAYERS
from mapping.tracks import write_tracks
from mapping.trajectories import from_true_north, write_trajectory
from perception.files import whole_file
from perception.objects import ObjectTable, write_objects_csv
from perception.readers import Survey
from perception.records import ElevationStrip, Grid, Progress, Trajectory, silent
from scenarios.plots_survey import plot_layer, plot_map
from scenarios.report.contacts import moved, write_contacts
from scenarios.survey_map import SurveyMap
from scenarios.survey_tiles import TiledSurvey


def write_whole(
    out: Path,
    survey: Survey,
    result: SurveyMap,
    tie: HeightTie | None = None,
    fill_m: float | None = None,
) -> dict[str, Any]:
    """Write the folder of a map in one piece, gaps filled up to `fill_m` from data; return its metrics."""
    grid = result.grid if tie is None else tie.tied(result.grid)
    drawn, filled = (grid, None) if fill_m is None else fill_map(grid, fill_m)
    write_map(out / "map.tif", drawn, filled=filled)
    flags = map_flags(result.corrected.strips, grid)
    write_flags(out / "flags.tif", flags, grid)
    mosaic = echo_mosaic(result.corrected.strips, grid.cell_m, survey.crs)
    write_mosaic(out / "mosaic.tif", mosaic)
    _write_pictures(out, drawn, mosaic, result.raw_track, result.track)
    pings = [summary.strip.ping for summary in result.passes]
    shared = _write_shared(out, survey, result, pings, tie, result.grid)
    seen = np.isfinite(grid.elevation_m)
    number = None if filled is None else int(filled.sum())
    return (
        shared
        | _fill_figures(number, grid.cell_m * grid.cell_north_m)
        | {
            "cell_m": grid.cell_m,
            "cells": int(seen.sum()),
            "area_m2": float(seen.sum() * grid.cell_m * grid.cell_north_m),
            "elevation_min_m": float(np.min(grid.elevation_m[seen])),
            "elevation_max_m": float(np.max(grid.elevation_m[seen])),
            "sigma_median_m": None
            if grid.sigma_m is None
            else float(np.median(grid.sigma_m[seen])),
        }
        | survey_quality(result.corrected.strips, grid, result.track)
        | flag_figures(flagged_cells(flags), int(seen.sum()))
    )


def _fill_figures(cells: int | None, cell_m2: float) -> dict[str, Any]:
    """Return how much was filled; nothing where that was not asked for. All other figures are of data."""
    return {} if cells is None else {"filled_cells": cells, "filled_m2": cells * cell_m2}


def write_tiled(
    out: Path,
    survey: Survey,
    result: TiledSurvey,
    tie: HeightTie | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Write the folder of a map in tiles, a window at a time; return its metrics."""
    plan = result.plan
    datum = plan.datum if tie is None else tie.datum
    frame = Frame(plan.west_m, plan.north_m, plan.cell_m, plan.shape, plan.crs, datum)

    tied: list[dict[str, Any]] = []
    # Depths are not what they were when the tiles were made: what depends on them is counted anew.
    count = None if tie is None else tied.append
    bands = ("elevation", "sigma", "count")
    extra = () if result.filled is None else ("filled",)
    write_cog(out / "map.tif", frame, (*bands, *extra), _heights(result, tie, count, progress))
    echoes = ((where, {"echo_db": x["echo"]}) for where, x in _windows(result, ("echo",), progress))
    write_cog(out / "mosaic.tif", frame, ("echo_db",), echoes)
    flags = ((where, _bits(x)) for where, x in _windows(result, ("flags",), progress))
    write_cog(out / "flags.tif", frame, ("flags",), flags, flag_tags(), kind=FLAGS_KIND)
    grid = result.overview() if tie is None else tie.tied(result.overview())
    _write_pictures(out, grid, result.overview("echo"), result.raw_track, result.track)
    pings = [strip.ping for strip in result.strips]
    shared = _write_shared(out, survey, result, pings, tie)
    figures = map_figures(tied, plan.shape[0] * plan.shape[1], plan.cell_m) if tied else None
    filled = _fill_figures(result.filled, plan.cell_m**2)
    return shared | filled | _tiled_figures(result, figures or result.figures)


Windows = Iterator[tuple[Slices, dict[str, npt.NDArray[Any]]]]


def _windows(result: TiledSurvey, names: Sequence[str], progress: Progress) -> Windows:
    """Yield each tile's slices and layers."""
    tiles = result.plan.tiles()
    for done, tile in enumerate(tiles, start=1):
        where = result.plan.slices(tile)
        yield where, {name: result.store.read(name, where) for name in names}
        progress("tiles to raster", done, len(tiles))


def _heights(
    result: TiledSurvey,
    tie: HeightTie | None,
    count: Callable[[dict[str, Any]], None] | None,
    progress: Progress,
) -> Windows:
    """Yield each tile's heights, tied to the prior map, with what was filled; `count` gets its figures."""
    shift_m, sigma_m = (0.0, 0.0) if tie is None else (tie.shift_m, tie.sigma_m)
    names = ("elevation", "sigma", "count", *(("flags",) if count is not None else ()))
    for where, layers in _windows(result, names, progress):
        layers["elevation"] = layers["elevation"] + np.float32(shift_m)
        if tie is not None:
            layers["sigma"] = np.hypot(layers["sigma"], np.float32(sigma_m))
        if count is not None:
            count(tile_figures(layers))
        if result.filled is not None:
            fill, fill_sigma = (result.store.read(name, where) for name in FILL_LAYERS)
            wider = np.hypot(fill_sigma, np.float32(sigma_m))
            layers = with_fill(layers, fill + np.float32(shift_m), wider)
        yield where, layers


def _bits(layers: dict[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[np.uint8]]:
    """Return a tile's flags as they stand in the file."""
    return {"flags": np.nan_to_num(layers["flags"], nan=NO_FLAGS).astype(np.uint8)}


def _tiled_figures(result: TiledSurvey, figures: dict[str, Any]) -> dict[str, Any]:
    """Return the map's figures from its tiles', named as those of a map in one piece."""
    horizontal_m = horizontal_95(result.track)
    shares = {order: figures[f"s44_{order}_vertical_share"] for order in S44_ORDERS}
    met = order_met(shares, figures["depth_median_m"], horizontal_m)
    tiles = len(result.plan.tiles())
    return (
        {"cell_m": result.plan.cell_m}
        | figures
        | crossing_figures(result.strips)
        | {"track_horizontal_95_m": horizontal_m, "s44_order_of_uncertainty": met}
        | {"tiles": tiles, "tiles_made": result.made, "tile_cells": result.plan.tile_cells}
    )


def _write_pictures(
    out: Path, grid: Grid, mosaic: Grid, raw: Trajectory, track: Trajectory
) -> None:
    plot_map(out / "map.png", grid, raw, track)
    if grid.sigma_m is not None:
        plot_layer(out / "sigma.png", grid, grid.sigma_m, "1-sigma, m", "magma")
    plot_layer(out / "mosaic.png", mosaic, mosaic.elevation_m, "echo over nominal, dB", "gray")


def _write_shared(
    out: Path,
    survey: Survey,
    result: SurveyMap | TiledSurvey,
    pings: Sequence[npt.NDArray[Any]],
    tie: HeightTie | None,
    grid: Grid | None = None,
) -> dict[str, Any]:
    """Write tracks, soundings, objects and the prior map's changes; return what is known of the survey.

    `grid` : the map whose floor the objects stand on; None of a map in tiles, where each pass takes its own.
    """
    write_trajectory(out / "trajectory.csv", from_true_north(result.track))
    write_trajectory(out / "trajectory-navigated.csv", from_true_north(result.raw_track))
    write_tracks(out / "tracks.gpkg", result.track, result.raw_track)
    write_soundings(out / "soundings.csv", result.corrected, tie)
    write_graph(out, result.corrected)
    write_rounds(out / "rounds.csv", result.corrected.diagnostics.rounds)
    changes = out / "prior-changes.gpkg"
    changes.unlink(missing_ok=True)  # an earlier run's
    if tie is not None:
        write_changes(changes, tie.left)
    merged = _merged(result, pings, grid)
    # The looks as they were seen, and the objects that they are of.
    write_objects_csv(out / "objects.csv", ObjectTable.joined(list(result.objects)))
    write_objects(out / "objects.gpkg", merged, survey.crs)
    first = np.cumsum([0, *(len(table) for table in result.objects)])
    looks = [
        look
        for contacts, table, start in zip(result.contacts, result.objects, first, strict=False)
        for look in moved(contacts, table, merged.look[start : start + len(table)] + 1)
    ]
    unseen = {int(k) + 1 for k in np.flatnonzero(merged.overruled)}
    names = [file.path.name for file in survey.files]
    title = ", ".join(names[:3]) + (" ..." if len(names) > 3 else "")
    write_contacts(out / "contacts.html", looks, title, survey.crs, unseen)
    return _survey_metrics(survey, result.corrected) | {
        "objects": sum(len(t) for t in result.objects),
        "objects_merged": len(merged.height_m),
        "objects_disputed": int(merged.disputed.sum()),
        "objects_overruled": int(merged.overruled.sum()),
        "objects_on_map_floor": grid is not None and grid.sigma_m is not None,
    }


def _survey_metrics(survey: Survey, corrected: CorrectedSurvey) -> dict[str, Any]:
    said = corrected.diagnostics
    last = said.rounds[-1] if said.rounds else None
    return {
        "pings": survey.n_pings,
        "pings_used": int((survey.pings.pass_index >= 0).sum()),
        "passes": survey.n_passes,
        "registrations_compared": 0 if last is None else last.compared,
        "registrations_accepted": 0 if last is None else last.accepted,
        "registrations_used": 0 if last is None else last.used,
        "rounds": len(said.rounds),
        "fixes_used": said.fixes_used,
        "fixes_refused": said.fixes_refused,
        "largest_correction_m": said.largest_correction_m,
        "prior_squares_compared": said.prior_compared,
        "prior_squares_used": said.prior_used,
        "prior_shift_east_m": said.prior_shift_m[0],
        "prior_shift_north_m": said.prior_shift_m[1],
        "track_indeterminate": said.indeterminate,
        "track_worsened": said.worsened,
    }


def _merged(
    result: SurveyMap | TiledSurvey, pings: Sequence[npt.NDArray[Any]], grid: Grid | None
) -> MergedObjects:
    """Return the objects that the passes' looks are of, marked where the map of all overrules one."""
    track, sigma_m = result.track, []
    for rows in pings:
        place_m2 = track.sigma_easting_m[rows] ** 2 + track.sigma_northing_m[rows] ** 2
        # Between passes of one survey half a metre is what beam width and layover leave at least.
        sigma_m.append(max(0.5, float(np.sqrt(0.5 * np.nanmean(place_m2)))))
    merged = merge_objects(result.objects, sigma_m, one_floor=grid is not None)
    if grid is None:
        return merged
    owner = np.repeat(np.arange(len(result.objects)), [len(table) for table in result.objects])
    strips = result.corrected.strips
    return replace(merged, overruled=overruled(merged, owner, grid, strips))


def write_soundings(path: Path, corrected: CorrectedSurvey, tie: HeightTie | None = None) -> None:
    """Write what the first returns alone say of the floor below the corrected track.

    Parameters
    ----------
    tie : the map's tie to a prior one is the soundings' as well.
    """
    shift_m, tie_sigma_m = (0.0, 0.0) if tie is None else (tie.shift_m, tie.sigma_m)

    def heights(strip: ElevationStrip, offset_m: float) -> npt.NDArray[Any]:
        return -(strip.depth_m + strip.altitude_m) + offset_m + shift_m

    strips = corrected.strips
    columns = [
        np.concatenate([s.easting_m for s in strips]),
        np.concatenate([s.northing_m for s in strips]),
        np.concatenate([heights(s, o) for s, o in zip(strips, corrected.height_m, strict=True)]),
        np.hypot(np.concatenate([s.altitude_sigma_m for s in strips]), tie_sigma_m),
    ]
    with whole_file(path) as temporary:
        np.savetxt(
            temporary, np.column_stack(columns), fmt="%.3f", delimiter=",", comments="",
            header="easting_m,northing_m,elevation_m,sigma_m",
        )  # fmt: skip
