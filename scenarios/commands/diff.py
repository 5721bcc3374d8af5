"""`bathynav diff A B --out DIR`: how two maps differ, or the contacts of two surveys."""

from __future__ import annotations

from pathlib import Path

import click

from scenarios.commands.console import (
    FiniteRange,
    common_options,
    out_option,
    prepare_out,
    print_table,
    set_verbosity,
)


@click.command()
@click.argument("first", type=click.Path(path_type=Path))
@click.argument("second", type=click.Path(path_type=Path))
@out_option
@click.option(
    "--beyond",
    type=FiniteRange(min=0, min_open=True),
    default=3.0,
    show_default=True,
    help="Combined sigmas beyond which a patch of cells counts as changed.",
)
@click.option(
    "--position-sigma",
    type=FiniteRange(min=0),
    default=1.0,
    show_default=True,
    help="1-sigma of either survey's track, m (contacts of folders).",
)
@common_options
def command(
    first: Path,
    second: Path,
    out: Path,
    beyond: float,
    position_sigma: float,
    quiet: bool,
    verbose: bool,
) -> None:
    """Tell how SECOND differs from FIRST: two maps, or two output folders of strips or map.

    Of maps, on the cells of FIRST: difference.tif (second minus first, with the combined sigma),
    changes.gpkg (the places that changed), difference.png and metrics.json. Of folders that hold an
    objects.csv: contact-changes.csv and .gpkg, the contacts that appeared, vanished or changed height.
    Both must share their coordinate system.

    \b
    bathynav diff before/map.tif after/map.tif --out changes
    bathynav diff strips-may strips-june --out changes
    """
    set_verbosity(quiet, verbose)
    if first.is_dir() and second.is_dir():
        _contacts(first, second, out, position_sigma, beyond, quiet)
    else:
        _maps(first, second, out, beyond, quiet)


def _contacts(
    first: Path, second: Path, out: Path, position_sigma: float, beyond: float, quiet: bool
) -> None:
    from scenarios.contact_folders import compare_folders
    from scenarios.outputs import write_metrics

    prepare_out(out)
    metrics = compare_folders(first, second, out, position_sigma, beyond)
    config = {
        "first": str(first), "second": str(second), "beyond_sigma": beyond,
        "position_sigma_m": position_sigma,
    }  # fmt: skip
    write_metrics(out, metrics, config)
    if not quiet:
        rows = [(name.removeprefix("contacts_").replace("_", " "), str(number))
                for name, number in metrics.items()]  # fmt: skip
        print_table(f"contacts of {second} against {first}", rows)
        click.echo(f"written to {out}")


def _maps(first: Path, second: Path, out: Path, beyond: float, quiet: bool) -> None:
    from mapping.compare import difference, write_changes
    from mapping.rasters import read_map, write_bands
    from scenarios.outputs import write_metrics
    from scenarios.plots_maps import plot_difference

    before, after = read_map(first), read_map(second)
    result = difference(before, after, beyond_sigma=beyond)
    prepare_out(out)
    sigma = result.grid.sigma_m
    bands = {"difference": result.grid.elevation_m}
    if sigma is not None:
        bands["sigma"] = sigma
    write_bands(out / "difference.tif", bands, result.grid)
    places = write_changes(out / "changes.gpkg", result)
    plot_difference(out / "difference.png", before, result)
    metrics = {**result.statistics, "changed_places": places}
    config = {"first": str(first), "second": str(second), "beyond_sigma": beyond}
    write_metrics(out, metrics, config)
    if not quiet:
        print_table(f"{second} minus {first}", _rows(metrics))
        click.echo(f"written to {out}")


def _rows(metrics: dict[str, float | int | None]) -> list[tuple[str, str]]:
    shown = [
        ("cells compared", "cells_compared", "", 0),
        ("bias", "bias_m", " m", 3),
        ("mean absolute", "mae_m", " m", 3),
        ("rms", "rms_m", " m", 3),
        ("5 % and 95 %", "p05_m", " m", 3),
        ("beyond 2 sigma", "beyond_2_sigma", "", 3),
        ("changed places", "changed_places", "", 0),
        ("changed area", "changed_m2", " m2", 0),
    ]
    rows = []
    for label, key, unit, digits in shown:
        value = metrics[key]
        text = "no sigma stated" if value is None else f"{value:.{digits}f}{unit}"
        if key == "p05_m":
            text = f"{metrics['p05_m']:.3f} to {metrics['p95_m']:.3f} m"
        rows.append((label, text))
    return rows
