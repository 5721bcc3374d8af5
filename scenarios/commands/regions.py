"""`bathynav regions MAP.tif --out DIR`: segment a map by the curvature of its surface."""

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
)

if TYPE_CHECKING:
    from perception.curvature import Operator
    from perception.records import Grid
    from perception.regions import RegionConfig, Segmentation


@click.command()
@click.argument("map_path", metavar="MAP.tif", type=click.Path(path_type=Path))
@out_option
@click.option(
    "--scale",
    "scale_m",
    type=FiniteRange(min=0),
    help="Smoothing for the whole map (Gaussian sigma, m); chosen per cell if left out.",
)
@click.option("--detail", "detail_m", type=FiniteRange(min=0),
              help="Least scale of the classes, m; 0 the finest, else chosen to give regions of use.")  # fmt: skip
@click.option("--window", "window_m", type=FiniteRange(min=0, min_open=True),
              help="Fit a quadratic over boxes of this width, m, instead of smoothing.")  # fmt: skip
@click.option("--method", type=click.Choice(["auto", "difference", "least-squares", "box"]),
              default="auto", show_default=True,
              help="Scale chosen per cell, bare 3 x 3 cells (two ways), or boxes (--window).")  # fmt: skip
@click.option(
    "--map-sigma", "map_sigma_m", type=FiniteRange(min=0), help="1-sigma of the heights, m."
)
@click.option("--levels", type=click.IntRange(1, 8), default=1, show_default=True,
              help="Levels of detail; each coarser one doubles the scale.")  # fmt: skip
@click.option("--objects", "objects_path", type=click.Path(path_type=Path),
              help="Objects (objects.gpkg or .csv) to lift off the surface first.")  # fmt: skip
@common_options
def command(
    map_path: Path,
    out: Path,
    scale_m: float | None,
    detail_m: float | None,
    window_m: float | None,
    method: str,
    map_sigma_m: float | None,
    levels: int,
    objects_path: Path | None,
    quiet: bool,
    verbose: bool,
) -> None:
    """Segment a map into peaks, pits, ridges, valleys, saddles and flats.

    Writes regions.tif, regions.gpkg, curvature.tif, pictures and metrics.json.

    \b
    bathynav regions map.tif --out regions
    bathynav regions map.tif --out regions --scale 10 --levels 3
    """
    from dataclasses import asdict
    from time import perf_counter

    import numpy as np

    from mapping.object_layer import read_objects, write_lifted
    from mapping.rasters import read_map
    from mapping.region_files import write_segmentation
    from perception.background import lift_objects
    from perception.regions import segment
    from scenarios.outputs import write_metrics
    from scenarios.plots_regions import plot_legend, plot_regions

    set_verbosity(quiet, verbose)
    grid = read_map(map_path, map_sigma_m)
    config = _config(grid, method, scale_m, detail_m, window_m, levels)
    prepare_out(out)
    if not quiet:
        _tell_of_compiling()
    start = perf_counter()
    objects = None if objects_path is None else read_objects(objects_path, grid)
    surface, lifted = grid, None
    if objects is not None:
        lifted = lift_objects(grid, objects.easting_m, objects.northing_m, objects.radius_m)
        surface = lifted.background
    with progress_bars(quiet) as progress:
        result = segment(surface, config, progress)
        seconds = perf_counter() - start
        write_segmentation(out, result)
        if objects is not None and lifted is not None:
            write_lifted(out / "objects.gpkg", objects, lifted, result.regions)
        plot_regions(out / "regions.png", grid, result.regions, map_path.name)
        plot_legend(out / "legend.png")
    metrics = _metrics(result, seconds)
    if lifted is not None:
        metrics["objects_lifted"] = int(np.isfinite(lifted.height_m).sum())
    write_metrics(out, metrics, {**asdict(config), "map": str(map_path)})
    if not quiet:
        _print(result, metrics, out)


def _config(
    grid: Grid,
    method: str,
    scale_m: float | None,
    detail_m: float | None,
    window_m: float | None,
    levels: int,
) -> RegionConfig:
    """Turn the method's name into what it stands for: a window of three cells, or no smoothing."""
    from perception.records import InputError
    from perception.regions import RegionConfig

    if window_m is not None and method not in ("auto", "box"):
        raise InputError(f"--window goes with --method box, not {method}; leave one of them out")
    if method == "box" and window_m is None:
        raise InputError("--method box needs a --window in metres")
    if method in ("auto", "box"):
        return RegionConfig(scale_m=scale_m, detail_m=detail_m, window_m=window_m, levels=levels)
    operator: Operator = "difference" if method == "difference" else "least-squares"
    # Three by three cells as they are, unless a scale asks for smoothing before.
    return RegionConfig(scale_m=scale_m or 0.0, operator=operator, levels=levels)


def _metrics(result: Segmentation, seconds: float) -> dict[str, Any]:
    import numpy as np

    from perception.records import REGION_CLASSES

    regions, curvature = result.regions, result.curvature
    known = regions.class_code > 0
    cells = max(int(known.sum()), 1)
    metrics: dict[str, Any] = {
        "cells": int(known.sum()),
        "regions": len(regions.table["area_m2"]),
        "borders": len(regions.border_m),
        "scale_median_m": float(np.median(curvature.scale_m[known])),
        "detail_m": result.detail_m,
        "noise_median_m": float(np.median(curvature.noise_m[known])),
        "class_probability_mean": float(
            np.average(regions.table["class_probability"], weights=regions.table["area_m2"])
        ),
        "seconds": seconds,
    }
    for code, name in enumerate(REGION_CLASSES[1:], start=1):
        share = np.count_nonzero(regions.class_code == code) / cells
        metrics[f"share_{name.replace(' ', '_')}"] = share
    for level, coarse in enumerate(result.coarser, start=2):
        metrics[f"regions_level_{level}"] = len(coarse.table["area_m2"])
    return metrics


def _print(result: Segmentation, metrics: dict[str, Any], out: Path) -> None:
    import numpy as np

    from perception.records import REGION_CLASSES

    rows = [
        ("regions", f"{metrics['regions']} ({metrics['borders']} borders)"),
        ("smoothing (median)", _length(metrics["scale_median_m"], "none")),
        ("classes read at", f"{result.detail_m:g} m" if result.detail_m > 0 else "that scale"),
        ("independent noise (median)", _length(metrics["noise_median_m"], "none seen")),
    ]
    codes = result.regions.table["class_code"]
    for code, name in enumerate(REGION_CLASSES[1:], start=1):
        share = metrics[f"share_{name.replace(' ', '_')}"]
        rows.append((name, f"{100 * share:5.1f} % in {np.count_nonzero(codes == code)} regions"))
    rows.extend(
        (f"level {level}", f"{len(coarse.table['area_m2'])} regions")
        for level, coarse in enumerate(result.coarser, start=2)
    )
    rows.append(("seconds", f"{metrics['seconds']:.2f}"))
    print_table(f"regions of {metrics['cells']} cells", rows)
    click.echo(f"written to {out}")


def _tell_of_compiling() -> None:
    """Say, on standard error, why the first run of an installation takes minutes."""
    from perception.curvature import differentiate

    if not _compiled(Path(differentiate.stats.cache_path)):
        click.echo("note: compiling for this machine, once: a minute or two", err=True)


def _compiled(cache: Path) -> bool:
    """Tell whether kernels of both modules that a map needs were compiled into a folder before."""
    return all(any(cache.glob(f"{name}.*.nbi")) for name in ("curvature", "scale"))


def _length(value_m: float, none: str) -> str:
    """Return a length in words: what is below a hundredth of a millimetre is rounding."""
    return f"{value_m:.3g} m" if value_m >= 1e-5 else none
