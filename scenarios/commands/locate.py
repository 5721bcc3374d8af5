"""`bathynav locate`: position from terrain."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from scenarios.commands.console import (
    common_options,
    prepare_out,
    print_table,
    progress_bars,
    set_verbosity,
)


@click.command()
@click.option("--map", "prior", required=True, type=click.Path(path_type=Path), help="Prior map: any elevation raster GDAL reads, in metres.")  # fmt: skip
@click.option("--nav", type=click.Path(path_type=Path), help="Navigation with ranges: nav.csv.")
@click.option("--swath", multiple=True, type=click.Path(path_type=Path), help="Side-scan file of the same voyage; may be repeated.")  # fmt: skip
@click.option("--sensors", type=click.Path(path_type=Path), help="Beam directions and noise (TOML).")  # fmt: skip
@click.option("--map-sigma", type=click.FloatRange(min=0, min_open=True), help="1-sigma of the map, m; else its band, else IHO S-44 Order 1a.")  # fmt: skip
@click.option("--map-error-length", type=click.FloatRange(min=0), help="Correlation length of the map's error, m; else what its spectrum tells.")  # fmt: skip
@click.option("--particles", type=click.IntRange(200, 200_000), default=4000, show_default=True, help="Particles of the search.")  # fmt: skip
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of the search."
)
@click.option("--observability", is_flag=True, help="Map where terrain can fix a vehicle, and how well; needs --map only.")  # fmt: skip
@click.option("--altitude", type=click.FloatRange(min=0, min_open=True), default=50.0, show_default=True, help="Altitude for --observability, m.")  # fmt: skip
@click.option("--path", "path_m", type=click.FloatRange(min=1), default=300.0, show_default=True, help="Length of track for --observability, m.")  # fmt: skip
@click.option("--follow", is_flag=True, help="Read rows (CSV or JSON lines) from standard input, write estimates as they come.")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), help="Folder for the results.")
@common_options
def command(
    prior: Path,
    nav: Path | None,
    swath: tuple[Path, ...],
    sensors: Path | None,
    map_sigma: float | None,
    map_error_length: float | None,
    particles: int,
    seed: int,
    observability: bool,
    altitude: float,
    path_m: float,
    follow: bool,
    out: Path | None,
    quiet: bool,
    verbose: bool,
) -> None:
    """Find the vehicle's position by comparing its ranges with a prior map.

    \b
    Examples:
      bathynav locate --map prior.tif --nav nav.csv --out runs/locate
      bathynav locate --map chart.bag --map-sigma 0.3 --nav nav.csv --sensors dvl.toml --out runs/locate
      bathynav locate --map prior.tif --nav nav.csv --swath survey.xtf --out runs/locate
      bathynav locate --observability --map prior.tif --out runs/where
      tail -f nav.csv | bathynav locate --follow --map prior.tif
    """
    set_verbosity(quiet, verbose)
    _check_usage(nav, swath, observability, follow, out)
    from scenarios.locating import LocateOptions, locate, observe

    options = LocateOptions(
        prior, nav, sensors, map_sigma, map_error_length, particles, seed, swath
    )
    if follow:
        from scenarios.locating_live import follow_input

        follow_input(options, out, sys.stdin, click.echo)
        return
    assert out is not None
    prepare_out(out)
    with progress_bars(quiet) as progress:
        if observability:
            metrics = observe(
                prior, out, sensors, map_sigma, map_error_length, altitude, path_m, progress
            )
        else:
            metrics = locate(options, out, progress)
    if not quiet:
        rows = [(k, f"{v:.4g}" if isinstance(v, float) else str(v)) for k, v in metrics.items()]
        print_table(f"{out}", rows)


def _check_usage(
    nav: Path | None, swath: tuple[Path, ...], observability: bool, follow: bool, out: Path | None
) -> None:
    if observability and follow:
        raise click.UsageError("--observability and --follow exclude one another")
    if (nav or swath) and (observability or follow):
        raise click.UsageError("--nav and --swath go without --observability and --follow")
    if not (nav or swath or observability or follow):
        raise click.UsageError("give --nav NAV.csv, --swath SURVEY, --observability or --follow")
    if out is None and not follow:
        raise click.UsageError("give --out DIR")
