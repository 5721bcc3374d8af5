"""`bathynav map SURVEY...`: the passes of a survey fused into one map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from scenarios.commands.console import (
    FiniteRange,
    common_options,
    out_option,
    prepare_out,
    print_table,
    progress_bars,
    set_verbosity,
    tell_of,
)

_FIX_REACH_S = 3600.0  # fixes further from every ping say nothing of the survey

if TYPE_CHECKING:
    from mapping.fixes import PositionFix
    from perception.bottom_files import GivenBottom
    from perception.installation import Installation
    from perception.readers import Survey
    from perception.records import Grid, Progress


@dataclass(frozen=True, slots=True)
class _Options:
    """What the command line asks for, by the options' own names."""

    cell: float | None
    crs: str | None
    prior: Path | None
    fixes: Path | None
    install: Path | None
    tide: Path | None
    sound_speed: str | None
    bottom: Path | None
    method: str | None
    fill_m: float | None
    also: tuple[str, ...]
    incremental: bool
    tiles: bool
    tile_cells: int
    scheduler: str | None
    workers: int | None

    @property
    def tiling(self) -> _Tiling:
        return _Tiling(self.tiles, self.tile_cells, self.scheduler, self.workers)


@dataclass(frozen=True, slots=True)
class _Files:
    """The files that the options name, read before any work is done."""

    fixes: list[PositionFix]
    prior: Grid | None
    bottom: GivenBottom | None


@dataclass(frozen=True, slots=True)
class _Tiling:
    """How a map in tiles is made, as the options say."""

    asked: bool
    tile_cells: int
    scheduler: str | None
    workers: int | None


@click.command()
@click.argument("surveys", nargs=-1, required=True, type=click.Path(path_type=Path))
@out_option
@click.option(
    "--cell",
    type=FiniteRange(min=0, min_open=True),
    help="Cell of the map, m.",
)
@click.option("--crs", help="Projected CRS in metres (EPSG:N); default the data's UTM zone.")
@click.option("--prior", type=click.Path(path_type=Path), help="A map to tie track and heights to.")
@click.option("--fixes", type=click.Path(path_type=Path), help="Absolute fixes, a CSV file.")
@click.option("--install", type=click.Path(path_type=Path), help="Lever arms and mounting, TOML.")
@click.option("--tide", type=click.Path(path_type=Path), help="Tide, a CSV file.")
@click.option("--sound-speed", metavar="M_S|PROFILE.csv", help="Sound speed, or its profile.")
@click.option(
    "--bottom", type=click.Path(path_type=Path), help="Bottom track to use: a bottom.csv of strips."
)
@click.option(
    "--method",
    type=click.Choice(["joint", "shadow"]),
    help="All echoes jointly (default), or heights from shadows alone (always so in tiles).",
)
@click.option(
    "--fill",
    "fill_m",
    type=FiniteRange(min=0, min_open=True, max=1000),
    help="Fill gaps up to so many metres from data, marked in a band `filled`.",
)
@click.option(
    "--also",
    multiple=True,
    metavar="NAME.nc|.grd|.bag|.asc",
    help="The map in another format as well, beside map.tif.",
)
@click.option(
    "--incremental",
    is_flag=True,
    help="Correct the track pass by pass, each as it comes: the end is that of all at once, in about "
    "twice the time; rounds.csv tells every arrival.",
)
@click.option(
    "--tiles", is_flag=True, help="Make the map in tiles; the default beyond 25 million cells."
)
@click.option(
    "--tile-cells",
    type=click.IntRange(min=16, max=8192),
    default=1024,
    show_default=True,
    help="Cells on a tile's side.",
)
@click.option("--scheduler", help="Dask scheduler (tcp://HOST:PORT) whose workers make the tiles.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes that make tiles here.")
@common_options
def command(surveys: tuple[Path, ...], out: Path, quiet: bool, verbose: bool, **given: Any) -> None:
    """Turn the passes in SURVEY files into one map with sigma and a corrected track.

    Writes map.tif (elevation, sigma, count), trajectory.csv, mosaic.tif (echo), flags.tif, objects.gpkg and
    contacts.html, tracks.gpkg, rounds.csv and graph files, pictures and metrics.json.

    \b
    bathynav map survey.xtf --out map --fixes surface-fixes.csv
    bathynav map lines/*.xtf --out map --tiles --cell 0.25 --also map.nc
    """
    import time

    from perception.readers import open_survey
    from scenarios.outputs import write_metrics

    options = _Options(**given)
    set_verbosity(quiet, verbose)
    _check_formats(options.also)
    prepare_out(out)
    files = _read(options)
    installation = _installation(options)
    began = time.perf_counter()
    with progress_bars(quiet) as progress:
        survey = open_survey(surveys, crs=options.crs, installation=installation, progress=progress)
        if not quiet:
            tell_of(survey)
        _check_frames(options, files, survey)
        tiling = options.tiling
        method, in_tiles = _choose(survey, options.cell, options.method, tiling, quiet)
        if in_tiles:
            _refuse_in_tiles(options)
            metrics = _in_tiles(out, survey, files, options, progress)
        else:
            if not quiet:
                _tell_unused(tiling)
            metrics = _in_one_piece(out, survey, files, options, method, progress)
        _export(out, options.also)
    metrics["seconds"] = time.perf_counter() - began
    write_metrics(out, metrics, _config(surveys, survey, options, method, in_tiles))
    if not quiet:
        _tell(metrics, out)


def _read(options: _Options) -> _Files:
    from mapping.fixes import read_fixes
    from mapping.rasters import read_map
    from perception.bottom_files import read_bottom

    return _Files(
        fixes=read_fixes(options.fixes) if options.fixes is not None else [],
        prior=read_map(options.prior) if options.prior is not None else None,
        bottom=read_bottom(options.bottom) if options.bottom is not None else None,
    )


def _installation(options: _Options) -> Installation | None:
    from perception.installation import read_installation

    return read_installation(options.install, options.tide, options.sound_speed)


def _check_frames(options: _Options, files: _Files, survey: Survey) -> None:
    """Refuse what does not fit the survey's time, coordinate system or datum, before any work is done."""
    from mapping.exports import check_frame
    from scenarios.map_loop import check_prior

    if files.fixes:
        check_fixes(options.fixes, files.fixes, survey)
    check_prior(files.prior, survey.crs, survey.datum)
    check_frame(options.also, survey.crs)


def _config(
    surveys: tuple[Path, ...], survey: Survey, options: _Options, method: str, in_tiles: bool
) -> dict[str, Any]:
    """Return the settings as `config.toml` keeps them."""
    return {
        "surveys": [str(p) for p in surveys], "cell_m": options.cell, "crs": survey.crs,
        "method": method, "prior": options.prior, "fixes": options.fixes,
        "install": options.install, "tide": options.tide, "sound_speed": options.sound_speed,
        "bottom": options.bottom, "tile_cells": options.tile_cells if in_tiles else None,
        "also": list(options.also) or None, "fill_m": options.fill_m,
        "incremental": options.incremental or None,
    }  # fmt: skip


def _check_formats(also: tuple[str, ...]) -> None:
    """Refuse a format before any work is done."""
    from mapping.exports import FORMATS

    for name in also:
        if Path(name).suffix not in FORMATS or Path(name).name != name:
            raise click.UsageError(
                f"--also {name}: give a file's name (no folder) that ends in {', '.join(FORMATS)}"
            )


def _choose(
    survey: Survey, cell_m: float | None, method: str | None, tiling: _Tiling, quiet: bool
) -> tuple[str, bool]:
    """Return the method, and whether the map is made in tiles; refuse cells as large as the survey."""
    import numpy as np

    from perception.records import InputError
    from scenarios.survey_tiles import (
        MOST_CELLS_AT_ONCE,
        MOST_JOINT_CELLS,
        expected_cells,
        expected_size,
    )

    size_m = expected_size(survey)
    if cell_m is not None and cell_m > min(size_m) / 4:
        raise InputError(
            f"--cell {cell_m:g} m: the survey is {size_m[0]:.0f} x {size_m[1]:.0f} m, so there would "
            f"be no map to speak of; give {min(size_m) / 40:.2g} or less"
        )
    pings = survey.pings
    sample_m = float(np.median(pings.sample_m[pings.pass_index >= 0]))
    if cell_m is not None and cell_m < sample_m / 10:
        raise InputError(
            f"--cell {cell_m:g} m: the echoes are {sample_m:.2g} m apart, so a map of "
            f"{size_m[0]:.0f} x {size_m[1]:.0f} m would hold nothing as fine; give {sample_m:.2g} or more"
        )
    cells = expected_cells(survey, cell_m, method or "joint")
    most = MOST_CELLS_AT_ONCE if method or cell_m is None else MOST_JOINT_CELLS
    if not tiling.asked and cells <= most:
        return method or "joint", False
    if method == "joint":
        raise InputError(
            f"--method joint: a map of about {cells / 1e6:.3g} million cells is made in tiles, and the "
            "joint method knows none (docs/any-size.md); give --method shadow, or a larger --cell "
            "without --tiles"
        )
    if not tiling.asked and method is None and not quiet:
        click.echo(
            f"note: about {cells / 1e6:.0f} million cells: made in tiles, from shadow heights",
            err=True,
        )
    return "shadow", True


def _tell_unused(tiling: _Tiling) -> None:
    """Say which options a map in one piece has no use for."""
    source = click.get_current_context().get_parameter_source("tile_cells")
    given = {
        "--scheduler": tiling.scheduler is not None,
        "--workers": tiling.workers is not None,
        "--tile-cells": source is click.core.ParameterSource.COMMANDLINE,
    }
    unused = [name for name, used in given.items() if used]
    if unused:
        click.echo(
            f"note: {', '.join(unused)}: of no effect, the map is made in one piece; give --tiles",
            err=True,
        )


def _refuse_in_tiles(options: _Options) -> None:
    from perception.records import InputError

    if options.bottom is not None:
        raise InputError(
            f"--bottom {options.bottom}: a map in tiles tracks its own bottom; leave --tiles out, or "
            "--bottom"
        )
    if options.incremental:
        raise InputError(
            "--incremental: a map in tiles is made of all passes at once; leave --tiles out, or "
            "--incremental"
        )


def _in_one_piece(
    out: Path, survey: Survey, files: _Files, options: _Options, method: str, progress: Progress
) -> dict[str, Any]:
    from mapping.height_tie import tie_heights
    from perception.strips import StripConfig
    from scenarios.map_files import write_whole
    from scenarios.survey_map import build_passes, map_survey

    passes = None
    if files.bottom is not None:
        passes = build_passes(survey, progress, StripConfig(given_bottom=files.bottom))
    result = map_survey(
        survey,
        fixes=files.fixes,
        cell_m=options.cell,
        method=method,
        passes=passes,
        prior=files.prior,
        incremental=options.incremental,
        progress=progress,
    )
    # Tied before anything is written: every file of the folder is of one height.
    tie = None if files.prior is None else tie_heights(result.grid, files.prior)
    written = write_whole(out, survey, result, tie, options.fill_m)
    return written | ({} if tie is None else tie.metrics())


def _in_tiles(
    out: Path, survey: Survey, files: _Files, options: _Options, progress: Progress
) -> dict[str, Any]:
    from mapping.height_tie import tie_heights
    from scenarios.map_files import write_tiled
    from scenarios.survey_tiles import map_tiles

    result = map_tiles(
        survey, out / "tiles", fixes=files.fixes, prior=files.prior, cell_m=options.cell,
        tile_cells=options.tile_cells, fill_m=options.fill_m, scheduler=options.scheduler,
        workers=options.workers, progress=progress,
    )  # fmt: skip
    tie = None if files.prior is None else tie_heights(result.overview(), files.prior)
    written = write_tiled(out, survey, result, tie, progress)
    return written | ({} if tie is None else tie.metrics())


def _export(out: Path, also: tuple[str, ...]) -> None:
    from mapping.exports import export_map

    for name in also:
        export_map(out / "map.tif", out / name)


def check_fixes(path: Path | None, fixes: list[PositionFix], survey: Survey) -> None:
    """Refuse fixes that no ping's time can meet: they would be taken for what they are not."""
    import numpy as np

    from perception.records import InputError

    if not survey.utc and path is not None and _dated(path):
        raise InputError(
            f"{path}: the survey's clock has no date, so a `time` in UTC cannot be placed; give "
            "`time_s`, seconds of the survey's clock, or leave --fixes out"
        )
    first, last = np.nanmin(survey.pings.time_s), np.nanmax(survey.pings.time_s)
    if any(first - _FIX_REACH_S <= fix.time_s <= last + _FIX_REACH_S for fix in fixes):
        return
    if survey.utc:
        span = f"{np.datetime64(int(first), 's')} to {np.datetime64(int(last), 's')} UTC"
        doubt = "is it of another day, or in local time?"
    else:
        span = f"{first:.0f} to {last:.0f} s of its clock, which has no date"
        doubt = "give `time_s` by that clock"
    raise InputError(f"{path}: no fix lies within an hour of the survey ({span}); {doubt}")


def _dated(path: Path) -> bool:
    """Return whether any row of a fixes file has its time as a date, as `read_fixes` takes it."""
    import csv

    with path.open(newline="", encoding="utf-8-sig", errors="replace") as stream:
        return any(row.get("time") for row in csv.DictReader(stream))


def _tell(metrics: dict[str, Any], out: Path) -> None:
    from scenarios.report.page import format_value
    from scenarios.report.units import label_and_unit

    rows = []
    for key, value in metrics.items():
        label, unit = label_and_unit(key)
        rows.append((label, f"{format_value(value)} {unit}".rstrip()))
    print_table("map", rows)
    click.echo(f"written to {out / 'map.tif'}")
