"""`bathynav map SURVEY...`: the passes of a survey fused into one map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from scenarios.commands.console import (
    common_options,
    out_option,
    prepare_out,
    print_table,
    progress_bars,
    set_verbosity,
)

_FIX_REACH_S = 3600.0  # fixes further from every ping say nothing of the survey

if TYPE_CHECKING:
    from mapping.fixes import PositionFix
    from perception.readers import Survey
    from perception.records import FloatArray, Grid
    from scenarios.survey_map import SurveyMap


@click.command()
@click.argument("surveys", nargs=-1, required=True, type=click.Path(path_type=Path))
@out_option
@click.option("--cell", type=click.FloatRange(min=0, min_open=True), help="Cell of the map, m.")
@click.option("--crs", help="Projected CRS in metres (EPSG:N); default the data's UTM zone.")
@click.option("--prior", type=click.Path(path_type=Path), help="A map to tie the heights to.")
@click.option("--fixes", type=click.Path(path_type=Path), help="Absolute fixes, a CSV file.")
@click.option("--install", type=click.Path(path_type=Path), help="Lever arms and mounting, TOML.")
@click.option("--tide", type=click.Path(path_type=Path), help="Tide, a CSV file.")
@click.option("--sound-speed", metavar="M_S|PROFILE.csv", help="Sound speed, or its profile.")
@click.option(
    "--method",
    type=click.Choice(["joint", "shadow"]),
    default="joint",
    show_default=True,
    help="All echoes jointly, or heights from shadows alone.",
)
@common_options
def command(
    surveys: tuple[Path, ...],
    out: Path,
    cell: float | None,
    crs: str | None,
    prior: Path | None,
    fixes: Path | None,
    install: Path | None,
    tide: Path | None,
    sound_speed: str | None,
    method: str,
    quiet: bool,
    verbose: bool,
) -> None:
    """Turn the passes in SURVEY files into one map with sigma and a corrected track.

    \b
    bathynav map survey.xtf --out map --fixes surface-fixes.csv
    """
    import time

    from mapping.fixes import read_fixes
    from mapping.rasters import read_map
    from perception.installation import read_installation
    from perception.readers import open_survey
    from scenarios.survey_map import map_survey

    set_verbosity(quiet, verbose)
    prepare_out(out)
    absolute = read_fixes(fixes) if fixes is not None else []
    old = read_map(prior) if prior is not None else None
    installation = read_installation(install, tide, sound_speed)
    began = time.perf_counter()
    with progress_bars(quiet) as progress:
        survey = open_survey(surveys, crs=crs, installation=installation, progress=progress)
        if not quiet:
            for warning in survey.warnings:
                click.echo(f"note: {warning}", err=True)
        if absolute:
            check_fixes(fixes, absolute, survey)
        result = map_survey(survey, fixes=absolute, cell_m=cell, method=method, progress=progress)
        metrics = _write(out, survey, result)
        if old is not None:
            metrics |= tie_to_prior(out, result.grid, old)
    config = {
        "surveys": [str(p) for p in surveys], "cell_m": cell, "crs": survey.crs, "method": method,
        "prior": prior, "fixes": fixes, "install": install, "tide": tide,
        "sound_speed": sound_speed,
    }  # fmt: skip
    from scenarios.outputs import write_metrics

    metrics["seconds"] = time.perf_counter() - began
    write_metrics(out, metrics, config)
    if not quiet:
        _tell(metrics, out)


def _write(out: Path, survey: Survey, result: SurveyMap) -> dict[str, Any]:
    """Write the folder's files and return its metrics."""
    from mapping.mosaic import echo_mosaic, write_mosaic
    from mapping.rasters import write_map
    from mapping.trajectories import from_true_north, write_trajectory
    from scenarios.plots_survey import plot_layer, plot_map

    write_map(out / "map.tif", result.grid)
    write_trajectory(out / "trajectory.csv", from_true_north(result.track))
    write_trajectory(out / "trajectory-navigated.csv", from_true_north(result.raw_track))
    _write_soundings(out / "soundings.csv", result)
    plot_map(out / "map.png", result.grid, result.raw_track, result.track)
    if result.grid.sigma_m is not None:
        plot_layer(out / "sigma.png", result.grid, result.grid.sigma_m, "1-sigma, m", "magma")
    mosaic = echo_mosaic(result.corrected.strips, result.grid.cell_m, survey.crs)
    write_mosaic(out / "mosaic.tif", mosaic)
    plot_layer(out / "mosaic.png", mosaic, mosaic.elevation_m, "echo over nominal, dB", "gray")
    return _metrics(survey, result) | _write_objects(out, result)


def _write_objects(out: Path, result: SurveyMap) -> dict[str, Any]:
    """Write the objects of every pass, and those that several passes share as one."""
    import numpy as np

    from mapping.objects import merge_objects, write_objects
    from perception.objects import ObjectTable, write_objects_csv

    tables = result.objects
    write_objects_csv(out / "objects.csv", ObjectTable.joined(list(tables)))
    sigma_m = []
    for summary in result.passes:
        rows = summary.strip.ping
        place_m2 = (
            result.track.sigma_easting_m[rows] ** 2 + result.track.sigma_northing_m[rows] ** 2
        )
        # Between passes of one survey half a metre is what beam width and layover leave at least.
        sigma_m.append(max(0.5, float(np.sqrt(0.5 * np.nanmean(place_m2)))))
    merged = merge_objects(tables, sigma_m)
    write_objects(out / "objects.gpkg", merged, result.grid.crs)
    return {
        "objects": sum(len(t) for t in tables),
        "objects_merged": len(merged.height_m),
        "objects_disputed": int(merged.disputed.sum()),
    }


def _metrics(survey: Survey, result: SurveyMap) -> dict[str, Any]:
    import numpy as np

    from mapping.quality import survey_quality

    grid, said = result.grid, result.corrected.diagnostics
    seen = np.isfinite(grid.elevation_m)
    last = said.rounds[-1] if said.rounds else None
    return {
        "pings": survey.n_pings,
        "pings_used": int((survey.pings.pass_index >= 0).sum()),
        "passes": survey.n_passes,
        "cell_m": grid.cell_m,
        "cells": int(seen.sum()),
        "area_m2": float(seen.sum() * grid.cell_m * grid.cell_north_m),
        "elevation_min_m": float(np.min(grid.elevation_m[seen])),
        "elevation_max_m": float(np.max(grid.elevation_m[seen])),
        "sigma_median_m": None if grid.sigma_m is None else float(np.median(grid.sigma_m[seen])),
        "registrations_compared": 0 if last is None else last.compared,
        "registrations_accepted": 0 if last is None else last.accepted,
        "registrations_used": 0 if last is None else last.used,
        "rounds": len(said.rounds),
        "fixes_used": said.fixes_used,
        "fixes_refused": said.fixes_refused,
        "largest_correction_m": said.largest_correction_m,
        "track_indeterminate": said.indeterminate,
        "track_worsened": said.worsened,
        **survey_quality(result.corrected.strips, grid, result.track),
    }


def check_fixes(path: Path | None, fixes: list[PositionFix], survey: Survey) -> None:
    """Refuse fixes that no ping's time can meet: they would be taken for what they are not."""
    import numpy as np

    from perception.records import InputError

    if not survey.utc:
        raise InputError(
            f"{path}: the survey's clock has no date, so no fix can be placed; leave --fixes out"
        )
    first, last = np.nanmin(survey.pings.time_s), np.nanmax(survey.pings.time_s)
    if not any(first - _FIX_REACH_S <= fix.time_s <= last + _FIX_REACH_S for fix in fixes):
        raise InputError(
            f"{path}: no fix lies within an hour of the survey "
            f"({np.datetime64(int(first), 's')} to {np.datetime64(int(last), 's')} UTC); "
            "is it of another day, or in local time?"
        )


def tie_to_prior(out: Path, grid: Grid, old: Grid) -> dict[str, Any]:
    """Shift the map's heights onto a prior map's, say by how much, and how the two still differ.

    The shift is the median difference: tide and depth bias are common to a survey, changes of the
    floor are not.
    """
    from mapping.compare import difference, write_changes
    from mapping.rasters import write_map

    shift_m = _prior_shift(difference(grid, old).grid.elevation_m)
    tied = replace(grid, elevation_m=grid.elevation_m + shift_m, datum=old.datum or grid.datum)
    left = difference(tied, old)
    write_map(out / "map.tif", tied)
    write_changes(out / "prior-changes.gpkg", left)
    return {"prior_shift_m": shift_m} | {f"prior_{k}": v for k, v in left.statistics.items()}


def _prior_shift(difference_m: FloatArray) -> float:
    import numpy as np

    return float(np.nanmedian(difference_m))


def _write_soundings(path: Path, result: SurveyMap) -> None:
    """Write what the first returns alone say of the floor below the corrected track."""
    import numpy as np

    from perception.files import whole_file

    strips = result.corrected.strips
    columns = [
        np.concatenate([s.easting_m for s in strips]),
        np.concatenate([s.northing_m for s in strips]),
        np.concatenate(
            [
                -(s.depth_m + s.altitude_m) + offset_m
                for s, offset_m in zip(strips, result.corrected.height_m, strict=True)
            ]
        ),
        np.concatenate([s.altitude_sigma_m for s in strips]),
    ]
    with whole_file(path) as temporary:
        np.savetxt(
            temporary,
            np.column_stack(columns),
            fmt="%.3f",
            delimiter=",",
            header="easting_m,northing_m,elevation_m,sigma_m",
            comments="",
        )


def _tell(metrics: dict[str, Any], out: Path) -> None:
    from scenarios.report.page import format_value
    from scenarios.report.units import label_and_unit

    rows = []
    for key, value in metrics.items():
        label, unit = label_and_unit(key)
        rows.append((label, f"{format_value(value)} {unit}".rstrip()))
    print_table("map", rows)
    click.echo(f"written to {out / 'map.tif'}")
