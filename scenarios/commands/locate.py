"""`bathynav locate`: position from terrain."""

from __future__ import annotations

from pathlib import Path

import click

from scenarios.commands.console import (
    common_options,
    out_option,
    prepare_out,
    print_table,
    progress_bars,
    set_verbosity,
)


@click.command()
@click.option("--map", "prior", required=True, type=click.Path(path_type=Path), help="Prior map: any elevation raster GDAL reads, in metres.")  # fmt: skip
@click.option("--nav", type=click.Path(path_type=Path), help="Navigation with ranges: nav.csv.")
@click.option("--sensors", type=click.Path(path_type=Path), help="Beam directions and noise (TOML).")  # fmt: skip
@click.option("--map-sigma", type=click.FloatRange(min=0, min_open=True), help="1-sigma of the map, m; else its band, else IHO S-44 Order 1a.")  # fmt: skip
@click.option("--map-error-length", type=click.FloatRange(min=0), help="Correlation length of the map's error, m; else what its spectrum tells.")  # fmt: skip
@click.option("--particles", type=click.IntRange(200, 200_000), default=4000, show_default=True, help="Particles of the search.")  # fmt: skip
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the search.")
@out_option
@common_options
def command(
    prior: Path,
    nav: Path | None,
    sensors: Path | None,
    map_sigma: float | None,
    map_error_length: float | None,
    particles: int,
    seed: int,
    out: Path,
    quiet: bool,
    verbose: bool,
) -> None:
    """Find the vehicle's position by comparing its ranges with a prior map.

    \b
    Examples:
      bathynav locate --map prior.tif --nav nav.csv --out runs/locate
      bathynav locate --map chart.bag --map-sigma 0.3 --nav nav.csv --sensors dvl.toml --out runs/locate
    """
    set_verbosity(quiet, verbose)
    if nav is None:
        raise click.UsageError("give --nav NAV.csv")
    from scenarios.locating import LocateOptions, locate

    options = LocateOptions(prior, nav, sensors, map_sigma, map_error_length, particles, seed)
    prepare_out(out)
    with progress_bars(quiet) as progress:
        metrics = locate(options, out, progress)
    if not quiet:
        rows = [(k, f"{v:.4g}" if isinstance(v, float) else str(v)) for k, v in metrics.items()]
        print_table(f"{out}", rows)
