"""Pictures of a survey's map: relief with the track before and after, sigma, echo mosaic."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from perception.files import whole_file
from perception.records import FloatArray, Grid, Trajectory

_LIGHT_AZIMUTH_DEG, _LIGHT_ALTITUDE_DEG = 315.0, 45.0


def plot_map(path: Path, grid: Grid, raw: Trajectory | None, track: Trajectory | None) -> None:
    """Draw shaded relief with the track as navigated (dashed) and as corrected (solid)."""
    figure, axes = _sheet(grid)
    low, high = np.nanpercentile(grid.elevation_m, [1, 99])
    axes.imshow(shaded_relief(grid, low, high), extent=_extent(grid), interpolation="nearest")
    _colour_bar(figure, axes, low, high, "viridis", "elevation, m")
    for poses, style, name in ((raw, "--", "as navigated"), (track, "-", "corrected")):
        if poses is not None:
            _draw_track(axes, poses, style, name)
    if track is not None or raw is not None:
        axes.legend(loc="upper right", fontsize=8, facecolor="#777777", labelcolor="white")
    _save(figure, path)


def plot_layer(path: Path, grid: Grid, values: FloatArray, label: str, colours: str) -> None:
    """Draw one layer on a grid's frame, its colours between the 1st and 99th percentile."""
    figure, axes = _sheet(grid)
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, [1, 99]) if finite.size else (0.0, 1.0)
    axes.imshow(
        values, extent=_extent(grid), cmap=colours, vmin=low, vmax=high, interpolation="nearest"
    )
    _colour_bar(figure, axes, low, high, colours, label)
    _save(figure, path)


def _sheet(grid: Grid) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    width_m, height_m = grid.east_m - grid.west_m, grid.north_m - grid.south_m
    # Long thin surveys get long thin sheets, within what a page shows.
    ratio = float(np.clip(height_m / width_m, 0.3, 1.6))
    figure = Figure(figsize=(9.5, 1.2 + 8.0 * ratio), layout="constrained")
    axes = figure.subplots()
    axes.set_aspect("equal")
    axes.set_xlabel("easting, m")
    axes.set_ylabel("northing, m")
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.tick_params(labelsize=8)
    return figure, axes


def _extent(grid: Grid) -> tuple[float, float, float, float]:
    return grid.west_m, grid.east_m, grid.south_m, grid.north_m


def shaded_relief(grid: Grid, low: float, high: float) -> FloatArray:
    """Return the (rows, cols, 3) picture of a grid: colours by height, shaded from the north-west."""
    from matplotlib import colormaps
    from matplotlib.colors import LightSource

    filled = np.where(np.isfinite(grid.elevation_m), grid.elevation_m, np.nan)
    level = np.clip((filled - low) / max(high - low, 1e-9), 0, 1)
    colours = colormaps["viridis"](np.nan_to_num(level))[..., :3]
    light = LightSource(_LIGHT_AZIMUTH_DEG, _LIGHT_ALTITUDE_DEG)
    # Relief is drawn three times as steep: sea floors are flat to the eye otherwise.
    shade = light.hillshade(
        np.nan_to_num(filled, nan=float(np.nanmedian(filled))),
        vert_exag=3.0,
        dx=grid.cell_m,
        dy=grid.cell_north_m,
    )
    picture = colours * (0.35 + 0.65 * shade[..., None])
    picture[~np.isfinite(grid.elevation_m)] = 1.0
    return np.asarray(picture)


def _draw_track(axes: Any, poses: Trajectory, style: str, name: str) -> None:
    numbers = poses.pass_index if poses.pass_index is not None else np.zeros(len(poses.time_s))
    colour = "white" if style == "-" else "#ff5a3c"
    for number in np.unique(numbers[numbers >= 0]):
        rows = numbers == number
        axes.plot(
            poses.easting_m[rows],
            poses.northing_m[rows],
            style,
            color=colour,
            lw=1.2,
            label=name,
        )
        name = "_nolegend_"


def _colour_bar(figure: Any, axes: Any, low: float, high: float, colours: str, label: str) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    bar = figure.colorbar(
        ScalarMappable(Normalize(low, high), colours), ax=axes, shrink=0.8, pad=0.02
    )
    bar.set_label(label)


def _save(figure: Any, path: Path) -> None:
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=120)
