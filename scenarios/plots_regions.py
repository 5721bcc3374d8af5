"""Pictures of a region map: the map over shaded relief, and its legend."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mapping.region_style import CLASS_COLOURS
from perception.files import whole_file
from perception.records import REGION_CLASSES, Grid, RegionMap

# Arrangement of the legend: columns K > 0, K = 0, K < 0; rows H < 0, H = 0, H > 0.
_LEGEND = ((1, 3, 5), (None, 7, 8), (2, 4, 6))
# More pixels than this on a side are not seen in a picture of a page's width.
_MOST_PIXELS = 1400


def class_image(regions: RegionMap) -> npt.NDArray[np.float64]:
    """Return the classes' colours, (rows, cols, 3) in 0..1; no data is white."""
    colours = np.ones((len(REGION_CLASSES), 3))
    for code, text in CLASS_COLOURS.items():
        for channel, start in enumerate((1, 3, 5)):
            colours[code, channel] = int(text[start : start + 2], 16) / 255
    return colours[regions.class_code]


def draw_regions(axes: Any, grid: Grid, regions: RegionMap) -> None:
    """Draw the classes over shaded relief, with the regions' borders, on matplotlib axes."""
    from matplotlib.colors import LightSource

    step = max(1, -(-max(grid.shape) // _MOST_PIXELS))
    z = grid.elevation_m[::step, ::step]
    known = np.isfinite(z)
    relief = float(np.nanpercentile(z, 98) - np.nanpercentile(z, 2))
    # Exaggerated so that relief is a sixth of the map's width, whatever its true height.
    exaggeration = 0.15 * max(grid.shape) * grid.cell_m / max(relief, 1e-9)
    shade = np.ones(z.shape)
    if min(z.shape) > 1:  # one row has no slope across itself to shade
        shade = LightSource(315, 45).hillshade(
            np.where(known, z, np.nanmedian(z)),
            vert_exag=min(exaggeration, 1e4),
            dx=grid.cell_m * step,
            dy=grid.cell_north_m * step,
        )
    image = class_image(regions)[::step, ::step] * (0.45 + 0.55 * shade[..., None])
    image[~known] = 1.0
    label = regions.region[::step, ::step]
    border = np.zeros(label.shape, bool)
    border[:, 1:] |= label[:, 1:] != label[:, :-1]
    border[1:] |= label[1:] != label[:-1]
    image[border & known] *= 0.6
    axes.imshow(image, extent=(grid.west_m, grid.east_m, grid.south_m, grid.north_m))
    axes.set_xlabel("easting (m)")
    axes.set_ylabel("northing (m)")
    axes.ticklabel_format(style="plain", useOffset=False)
    axes.set_aspect("equal")


def draw_legend(axes: Any) -> None:
    """Draw the table of the classes by the signs of H and K on matplotlib axes."""
    for row, classes in enumerate(_LEGEND):
        for col, code in enumerate(classes):
            if code is None:
                continue
            patch = dict(facecolor=CLASS_COLOURS[code], edgecolor="0.3", transform=axes.transData)
            axes.fill([col, col + 1, col + 1, col], [-row, -row, -row - 1, -row - 1], **patch)
            dark = code in (1, 2)
            axes.text(
                col + 0.5,
                -row - 0.5,
                REGION_CLASSES[code].replace(" ", "\n"),
                ha="center",
                va="center",
                color="white" if dark else "black",
            )
    axes.set_xticks([0.5, 1.5, 2.5], ["K > 0", "K = 0", "K < 0"])
    axes.set_yticks([-0.5, -1.5, -2.5], ["H < 0\n(up)", "H = 0", "H > 0\n(down)"])
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.set_xlim(0, 3)
    axes.set_ylim(-3, 0)
    axes.set_aspect("equal")
    for side in axes.spines.values():
        side.set_visible(False)


def plot_regions(path: Path, grid: Grid, regions: RegionMap, title: str = "") -> None:
    """Write a picture of the region map with its legend beside it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 7), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=[3.2, 1])
    draw_regions(left, grid, regions)
    left.set_title(title)
    draw_legend(right)
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=110)


def plot_legend(path: Path) -> None:
    """Write the legend alone."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4, 4), layout="constrained")
    FigureCanvasAgg(figure)
    draw_legend(figure.subplots())
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=110)
