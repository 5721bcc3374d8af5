"""`bathynav strips SURVEY...`: one elevation strip per pass, and the objects found."""

from __future__ import annotations

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
from scenarios.outputs import write_metrics

if TYPE_CHECKING:
    from perception.objects import ObjectTable
    from perception.readers import Survey
    from perception.records import Progress
    from perception.strips import PassResult, StripConfig
    from scenarios.report.contacts import Contact


@click.command()
@click.argument("surveys", nargs=-1, required=True, type=click.Path(path_type=Path))
@out_option
@click.option("--crs", help="Projected CRS in metres (EPSG:N); default the data's UTM zone.")
@click.option(
    "--cell",
    type=FiniteRange(min=0, min_open=True),
    help="Columns of a strip, m; default two samples.",
)
@click.option("--install", type=click.Path(path_type=Path), help="Lever arms and mounting, TOML.")
@click.option("--tide", type=click.Path(path_type=Path), help="Tide, a CSV file.")
@click.option("--sound-speed", metavar="M_S|PROFILE.csv", help="Sound speed, or its profile.")
@click.option(
    "--bottom", type=click.Path(path_type=Path), help="Bottom track to use: a bottom.csv, edited."
)
@common_options
def command(
    surveys: tuple[Path, ...],
    out: Path,
    crs: str | None,
    cell: float | None,
    install: Path | None,
    tide: Path | None,
    sound_speed: str | None,
    bottom: Path | None,
    quiet: bool,
    verbose: bool,
) -> None:
    """Turn each pass in SURVEY files into an elevation strip: strip-NNN.nc and a picture.

    objects.csv lists hills and craters of all passes with heights and 1-sigma, contacts.html shows
    them; bottom.csv is the bottom track, which may be edited and given back by --bottom.

    \b
    bathynav strips survey.xtf --out strips
    """
    from perception.bottom_files import read_bottom
    from perception.installation import read_installation
    from perception.readers import open_survey
    from perception.strips import StripConfig

    set_verbosity(quiet, verbose)
    prepare_out(out)
    given = None if bottom is None else read_bottom(bottom)
    # The mission's map reuses strips made with the default settings, which are told by None.
    config = (
        None if cell is None and given is None else StripConfig(cell_m=cell, given_bottom=given)
    )
    installation = read_installation(install, tide, sound_speed)
    with progress_bars(quiet) as progress:
        survey = open_survey(surveys, crs=crs, installation=installation, progress=progress)
        if not quiet:
            tell_of(survey)
        # Not before all inputs are read: a mistyped name must not cost the strips that are there.
        _clear(out)
        metrics = _write_passes(out, survey, config, _title(surveys), progress)
    settings = {"surveys": [str(p) for p in surveys], "crs": survey.crs, "cell_m": cell}
    write_metrics(out, metrics, {**settings, "bottom": bottom})
    if not quiet:
        print_table("strips", [(name, _shown(value)) for name, value in metrics.items()])
        click.echo(f"written to {out}")


def _write_passes(
    out: Path, survey: Survey, config: StripConfig | None, title: str, progress: Progress
) -> dict[str, Any]:
    """Write every pass's strip and picture, then what is told of all: objects, contacts, bottom; return metrics."""
    import time

    from perception.bottom_files import bottom_rows, write_bottom_csv
    from perception.objects import ObjectTable, write_objects_csv
    from perception.strip_files import write_strip
    from scenarios.passes import strips_of
    from scenarios.plots_strips import plot_pass
    from scenarios.report.contacts import contacts_of, pictured, write_contacts
    from scenarios.survey_map import PassSummary, keep_passes

    began = time.perf_counter()
    given = config is not None and config.given_bottom is not None
    measured: dict[str, float] = {}
    # A survey may be larger than memory: a pass is let go once it is written, but for a mission, whose map
    # comes next.
    keep = bool((click.get_current_context().obj or {}).get("keep_passes"))
    tables: list[ObjectTable] = []
    kept: list[PassSummary] = []
    contacts: list[Contact] = []
    bottoms: list[str] = []
    for index, result in strips_of(survey, config, progress):
        strip = result.strip
        write_strip(out / f"strip-{index:03d}.nc", strip, survey.utc)
        plot_pass(out / f"strip-{index:03d}.png", result)
        contacts = pictured([*contacts, *contacts_of(result)])
        bottoms.extend(bottom_rows(strip.time_s, strip.ping, strip.pass_index, result.tracked,
                                   survey.utc, given))  # fmt: skip
        _add_up(measured, result)
        tables.append(result.objects)
        if keep:
            kept.append(PassSummary.of(result))
        # Not until the next pass is there: the two together would take twice the room.
        del result, strip
    if keep:
        keep_passes(survey, config, tuple(kept))
    objects = ObjectTable.joined(tables)
    write_objects_csv(out / "objects.csv", objects)
    write_bottom_csv(out / "bottom.csv", bottoms)
    write_contacts(out / "contacts.html", contacts, title, survey.crs)
    return _metrics(measured, objects, len(tables), time.perf_counter() - began)


def _title(surveys: tuple[Path, ...]) -> str:
    return ", ".join(path.name for path in surveys[:3]) + (" ..." if len(surveys) > 3 else "")


def _clear(out: Path) -> None:
    """Remove the strips of an earlier run: a shorter survey must not leave the longer one's behind."""
    for pattern in ("strip-[0-9]*.nc", "strip-[0-9]*.png"):
        for path in out.glob(pattern):
            path.unlink()


def _add_up(measured: dict[str, float], result: PassResult) -> None:
    """Add one pass to the sums that the metrics are means of."""
    import numpy as np

    lines = len(result.along_m)
    found: dict[str, float] = {
        "pings": lines,
        "length_m": float(result.along_m[-1] - result.along_m[0]),
        "bottom": float(result.bottom.valid.sum()),
        "altitude": float(result.bottom.altitude_m.sum()),
        "sigma": float(np.nansum(result.strip.sigma_m)),
        "cells": float(np.isfinite(result.strip.sigma_m).sum()),
        "shadow": float(result.strip.shadow.sum()),
    }
    for name, value in found.items():
        measured[name] = measured.get(name, 0.0) + value


def _metrics(
    measured: dict[str, float], objects: ObjectTable, passes: int, seconds: float
) -> dict[str, Any]:
    pings, cells = measured["pings"], max(measured["cells"], 1.0)
    return {
        "passes": passes,
        "pings": int(pings),
        "length_m": measured["length_m"],
        "bottom_found_percent": 100 * measured["bottom"] / pings,
        "mean_altitude_m": measured["altitude"] / pings,
        "mean_sigma_m": measured["sigma"] / cells,
        "shadow_percent": 100 * measured["shadow"] / cells,
        "hills": objects.kind.count("hill"),
        "craters": objects.kind.count("crater"),
        "seconds": seconds,
        "pings_per_minute": 60 * pings / max(seconds, 1e-9),
    }


def _shown(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
