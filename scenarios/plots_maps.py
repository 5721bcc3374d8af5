"""Pictures that compare maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mapping.compare import Difference
from perception.files import whole_file
from perception.records import Grid


def plot_difference(path: Path, first: Grid, result: Difference) -> None:
    """Draw the first map, the difference with the changed places outlined, and its histogram."""
    from matplotlib.figure import Figure

    grid = result.grid
    extent = (grid.west_m, grid.east_m, grid.south_m, grid.north_m)
    d = grid.elevation_m
    values = d[np.isfinite(d)]
    limit = max(float(np.percentile(np.abs(values), 98)), 1e-6)
    figure = Figure(figsize=(14.0, 5.0), layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 0.7))
    image = left.imshow(first.elevation_m, extent=extent, cmap="viridis", interpolation="nearest")
    figure.colorbar(image, ax=left, label="elevation of A, m", shrink=0.8)
    image = middle.imshow(
        d, extent=extent, cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest"
    )
    figure.colorbar(image, ax=middle, label="B minus A, m", shrink=0.8)
    if result.changed.any():
        easting_m, northing_m = grid.centres()
        middle.contour(
            easting_m, northing_m, result.changed.astype(float), [0.5], colors="k", linewidths=0.8
        )
    for axes in (left, middle):
        axes.set_aspect("equal")
        axes.ticklabel_format(useOffset=False, style="plain")
        axes.tick_params(labelsize=7)
        axes.set_xlabel("easting, m")
    left.set_ylabel("northing, m")
    right.hist(np.clip(values, -3 * limit, 3 * limit), bins=80, color="0.4")
    right.set_xlabel("B minus A, m")
    right.set_ylabel("cells")
    s = result.statistics
    right.set_title(
        f"bias {s['bias_m']:.3f} m, MAE {s['mae_m']:.3f} m, rms {s['rms_m']:.3f} m", fontsize=9
    )
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=110)
