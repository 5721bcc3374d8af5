"""`bathynav locate`: position from terrain."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from scenarios.commands.console import (
    FiniteRange,
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
@click.option("--map-sigma", type=FiniteRange(min=0, min_open=True), help="1-sigma of the map, m; else its band, else IHO S-44 Order 1a.")  # fmt: skip
@click.option("--map-error-length", type=FiniteRange(min=0), help="Correlation length of the map's error, m; else what its spectrum tells.")  # fmt: skip
@click.option("--particles", type=click.IntRange(200, 200_000), default=4000, show_default=True, help="Particles of the search.")  # fmt: skip
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of the search."
)
@click.option("--observability", is_flag=True, help="Map where terrain can fix a vehicle, and how well; needs --map only.")  # fmt: skip
@click.option("--altitude", type=FiniteRange(min=0, min_open=True), default=50.0, show_default=True, help="Altitude for --observability, m.")  # fmt: skip
@click.option("--path", "path_m", type=FiniteRange(min=1), default=300.0, show_default=True, help="Length of track for --observability, m.")  # fmt: skip
@click.option("--patch", type=click.Path(path_type=Path), help="Raster of sea floor to place anywhere in the map, in its own axes.")  # fmt: skip
@click.option("--heading", type=FiniteRange(-360.0, 360.0), help="Azimuth of the patch's own north, degrees, where it is known (to 0.5 degrees); else every heading is tried.")  # fmt: skip
@click.option("--compact", is_flag=True, help="Place --patch by a hundredth of the map's bytes: its hills, hollows and a thumbnail.")  # fmt: skip
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
    patch: Path | None,
    heading: float | None,
    compact: bool,
    follow: bool,
    out: Path | None,
    quiet: bool,
    verbose: bool,
) -> None:
    """Find the vehicle's position by comparing its ranges with a prior map.

    Writes trajectory.csv, trajectory-smoothed.csv, fixes.csv, locate.png and metrics.json.

    \b
    Examples:
      bathynav locate --map prior.tif --nav nav.csv --out runs/locate
      bathynav locate --map chart.bag --map-sigma 0.3 --nav nav.csv --sensors dvl.toml --out runs/locate
      bathynav locate --map prior.tif --nav nav.csv --swath survey.xtf --out runs/locate
      bathynav locate --observability --map prior.tif --out runs/where
      bathynav locate --patch survey/map.tif --map prior.tif --out runs/patch
      tail -f nav.csv | bathynav locate --follow --map prior.tif
    """
    set_verbosity(quiet, verbose)
    _check_usage(nav, swath, observability, patch, heading, compact, follow, out)
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
        if patch is not None:
            from scenarios.locating_patch import place_patch

            metrics = place_patch(prior, patch, heading, compact, out, map_sigma, progress)
        elif observability:
            metrics = observe(options, out, altitude, path_m, progress)
        else:
            metrics = locate(options, out, progress)
    if not quiet:
        print_table(f"{out}", in_words(metrics))


def _told(key: str, value: object) -> str:
    if not isinstance(value, float):
        return str(value)
    # A coordinate has more figures than an error.
    return f"{value:.2f}" if key in ("easting_m", "northing_m") else f"{value:.4g}"


# Names of figures as people say them.
_WORDS = {
    "verdict": "verdict",
    "converged_after_s": "converged after (s)",
    "share_converged": "part of the rows converged",
    "share_searching": "part searching",
    "share_dead_reckoning": "part on dead reckoning",
    "share_lost": "part lost",
    "sigma_last_m": "1-sigma at the end, both axes together (m)",
    "sigma_median_m": "1-sigma, median (m)",
    "protection_last_m": "protection level at the end (m)",
    "heading_bias_deg": "heading error found (deg)",
    "scale_error": "scale error found",
    "depth_bias_m": "depth error found (m)",
    "fixes_accepted": "fixes issued",
    "fixes_refused": "fixes refused",
    "map_sigma_m": "1-sigma of the map as stated (m)",
    "map_sigma_filtered_m": "1-sigma of the map as used (m)",
    "map_relief_m": "relief of the map (m)",
    "map_sigma_source": "sigma of the map from",
    "rows": "rows of navigation",
    "beams": "beams",
    "events": "events",
    "easting_m": "easting (m)",
    "northing_m": "northing (m)",
    "heading_deg": "heading of the patch's north (deg)",
    "sigma_easting_m": "1-sigma of the easting (m)",
    "sigma_northing_m": "1-sigma of the northing (m)",
    "sigma_heading_deg": "1-sigma of the heading (deg)",
    "protection_m": "protection level (m)",
    "offset_easting_m": "east of where its file has it (m)",
    "offset_northing_m": "north of where its file has it (m)",
    "ambiguity": "probability of the other places",
    "hypotheses": "places kept",
    "map_carried_percent": "map used, % of the raster's bytes",
    "sigma_best_median_m": "1-sigma on the best heading, median (m)",
    "sigma_mean_median_m": "1-sigma over all headings, median (m)",
    "sigma_worst_median_m": "1-sigma on the worst heading, median (m)",
    "over_bound_median": "the same over the linear bound, median (times)",
    "share_below_10_m": "part of the map known to 10 m",
    "seconds": "time taken (s)",
}


def in_words(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """Figures worth printing, named in words; the others are in metrics.json."""
    return [
        (words, _told(key, metrics[key]))
        for key, words in _WORDS.items()
        if metrics.get(key) is not None and metrics[key] != ""
    ]


def _check_usage(
    nav: Path | None,
    swath: tuple[Path, ...],
    observability: bool,
    patch: Path | None,
    heading: float | None,
    compact: bool,
    follow: bool,
    out: Path | None,
) -> None:
    if sum((observability, follow, patch is not None)) > 1:
        raise click.UsageError("--observability, --patch and --follow exclude one another")
    if (nav or swath) and (observability or follow or patch):
        raise click.UsageError("--nav and --swath go without --observability, --patch and --follow")
    if not (nav or swath or observability or follow or patch):
        raise click.UsageError(
            "give --nav NAV.csv, --swath SURVEY, --patch PATCH.tif, --observability or --follow"
        )
    if (compact or heading is not None) and patch is None:
        raise click.UsageError("--heading and --compact go with --patch PATCH.tif")
    if patch is not None:
        _refuse_unused_by_patch()
    if out is None and not follow:
        raise click.UsageError("give --out DIR")


def _refuse_unused_by_patch() -> None:
    """Refuse what the user gave and a patch's placing has no use for: silence would pass for heed."""
    context = click.get_current_context()
    for name in ("sensors", "map_error_length", "particles", "seed"):
        if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
            option = "--" + name.replace("_", "-")
            raise click.UsageError(f"{option} goes without --patch: nothing there depends on it")
