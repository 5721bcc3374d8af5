"""Pictures of `locate`: the track on the prior map, its uncertainty and status against time."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm

from localization.navfile import NavTable
from localization.observability import Observability
from localization.placing import Placing
from perception.files import whole_file
from perception.records import Grid, Trajectory

STATUS_COLOURS = {
    "converged": "#1b7f3b",
    "searching": "#e08a00",
    "dead-reckoning": "#5a6b7b",
    "lost": "#c81e1e",
}


def draw_navigation(
    path: Path, prior: Grid, nav: NavTable, causal: Trajectory, smoothed: Trajectory
) -> None:
    """Draw `locate.png`: map with tracks on the left, sigma and offset against time on the right."""
    figure = plt.figure(figsize=(13, 6.5), constrained_layout=True)
    panels = figure.add_gridspec(2, 2, width_ratios=[1.25, 1])
    _draw_map(figure.add_subplot(panels[:, 0]), prior, nav, causal, smoothed)
    _draw_sigma(figure.add_subplot(panels[0, 1]), causal, smoothed)
    _draw_offset(figure.add_subplot(panels[1, 1]), nav, causal, smoothed)
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=110)
    plt.close(figure)


def _window(prior: Grid, *tracks: Trajectory) -> tuple[float, float, float, float]:
    east = np.concatenate([t.easting_m[np.isfinite(t.easting_m)] for t in tracks])
    north = np.concatenate([t.northing_m[np.isfinite(t.northing_m)] for t in tracks])
    margin = 0.1 * max(np.ptp(east), np.ptp(north), 20 * prior.cell_m)
    return (
        max(east.min() - margin, prior.west_m),
        min(east.max() + margin, prior.east_m),
        max(north.min() - margin, prior.south_m),
        min(north.max() + margin, prior.north_m),
    )


def _draw_map(
    axes: Axes, prior: Grid, nav: NavTable, causal: Trajectory, smoothed: Trajectory
) -> None:
    # Large maps are thinned for the picture: no screen shows more than some 1,000 cells a side.
    every = max(1, max(prior.shape) // 1200)
    image = axes.imshow(
        prior.elevation_m[::every, ::every],
        extent=(prior.west_m, prior.east_m, prior.south_m, prior.north_m),
        cmap="viridis",
        interpolation="nearest",
    )
    axes.figure.colorbar(image, ax=axes, label="elevation (m)", shrink=0.8)
    axes.plot(nav.easting_m, nav.northing_m, color="white", lw=1.0, ls="--", label="dead reckoning")
    axes.plot(smoothed.easting_m, smoothed.northing_m, color="black", lw=1.0, label="smoothed")
    status = np.array(causal.status)
    for name, colour in STATUS_COLOURS.items():
        chosen = status == name
        if chosen.any():
            axes.plot(
                causal.easting_m[chosen], causal.northing_m[chosen], ".", ms=3, color=colour,
                label=f"causal, {name}",
            )  # fmt: skip
    west, east, south, north = _window(prior, causal)
    if west < east and south < north:
        axes.set_xlim(west, east)
        axes.set_ylim(south, north)
    axes.set_xlabel("easting (m)")
    axes.set_ylabel("northing (m)")
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.tick_params(axis="x", labelrotation=30)
    # Below the picture: anywhere inside it would lie over the track sooner or later.
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.24), ncols=3, fontsize=8, facecolor="0.75"
    )
    axes.set_title("Track on the prior map")


def _sigma(t: Trajectory) -> np.ndarray:
    return np.hypot(t.sigma_easting_m, t.sigma_northing_m)


def _minutes(t: Trajectory) -> np.ndarray:
    return (t.time_s - np.nanmin(t.time_s)) / 60.0


def _draw_sigma(axes: Axes, causal: Trajectory, smoothed: Trajectory) -> None:
    minutes = _minutes(causal)
    axes.semilogy(minutes, _sigma(causal), color="black", lw=1, label="causal sigma")
    axes.semilogy(minutes, _sigma(smoothed), color="black", lw=1, ls=":", label="smoothed sigma")
    axes.semilogy(minutes, causal.protection_m, color="tab:purple", lw=1, label="protection level")
    status = np.array(causal.status)
    low, high = axes.get_ylim()
    for name, colour in STATUS_COLOURS.items():
        axes.fill_between(
            minutes, low, high, where=status == name, color=colour, alpha=0.12, lw=0, label=name
        )
    axes.set_ylim(low, high)
    axes.set_ylabel("metres")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xlabel("minutes")
    axes.legend(fontsize=7, ncol=2)
    axes.set_title("How well the position is known")


def _draw_offset(axes: Axes, nav: NavTable, causal: Trajectory, smoothed: Trajectory) -> None:
    minutes = _minutes(causal)
    for t, style in ((causal, "-"), (smoothed, ":")):
        axes.plot(minutes, t.easting_m - nav.easting_m, style, color="tab:blue", lw=1,
                  label="east" if style == "-" else None)  # fmt: skip
        axes.plot(minutes, t.northing_m - nav.northing_m, style, color="tab:red", lw=1,
                  label="north" if style == "-" else None)  # fmt: skip
    axes.set_xlabel("minutes")
    axes.set_ylabel("offset (m)")
    axes.legend(fontsize=8)
    axes.set_title("Offset from dead reckoning (dotted: smoothed)")


def draw_observability(path: Path, prior: Grid, found: Observability) -> None:
    """Draw `observability.png`: the ground, the bound on a fix's error, and the best heading."""
    figure, axes = plt.subplots(1, 3, figsize=(15, 5), constrained_layout=True)
    every = max(1, max(prior.shape) // 800)
    extent = (prior.west_m, prior.east_m, prior.south_m, prior.north_m)
    bound = found.mean_m[::every, ::every]
    # Rounded to halves of a decade, so that the scale reads.
    known = bound[np.isfinite(bound)]
    low, high = (np.percentile(known, [1, 99])) if known.size else (1.0, 10.0)
    layers = (
        (prior.elevation_m[::every, ::every], "viridis", None, "elevation (m)"),
        (bound, "magma_r", LogNorm(max(low, 1e-3), max(high, low * 1.5)), "1-sigma of a fix (m)"),
        (np.degrees(found.best_heading_rad[::every, ::every]), "twilight", None,
         "heading of least sigma (deg)"),
    )  # fmt: skip
    for panel, (values, colours, norm, label) in zip(axes, layers, strict=True):
        image = panel.imshow(
            values, extent=extent, cmap=colours, norm=norm, interpolation="nearest"
        )
        bar = figure.colorbar(image, ax=panel, label=label, shrink=0.75)
        if norm is not None:
            _plain_ticks(bar.ax, float(low), float(high))
        panel.set_xlabel("easting (m)")
        panel.ticklabel_format(useOffset=False, style="plain")
        panel.tick_params(axis="x", labelrotation=30)
    axes[0].set_ylabel("northing (m)")
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=110)
    plt.close(figure)


def _plain_ticks(axes: Axes, low: float, high: float) -> None:
    """Tick a logarithmic scale at 1, 2 and 5 of each decade, in plain numbers."""
    decades = range(int(np.floor(np.log10(max(low, 1e-3)))), int(np.ceil(np.log10(high))) + 1)
    ticks = [m * 10.0**d for d in decades for m in (1, 2, 5) if low <= m * 10.0**d <= high]
    # Within less than an octave there may be no such tick: then the ends are told.
    axes.set_yticks(ticks if len(ticks) > 1 else [low, *ticks, high])
    axes.set_yticks([], minor=True)
    axes.yaxis.set_major_formatter("{x:.3g}")


def draw_placing(path: Path, prior: Grid, patch: Grid, placing: Placing) -> None:
    """Draw `patch.png`: the map with every place kept outlined, and the patch beside it."""
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(12, 6), constrained_layout=True, width_ratios=(1.6, 1)
    )
    every = max(1, max(prior.shape) // 1200)
    image = left.imshow(
        prior.elevation_m[::every, ::every],
        extent=(prior.west_m, prior.east_m, prior.south_m, prior.north_m),
        cmap="viridis", interpolation="nearest",
    )  # fmt: skip
    figure.colorbar(image, ax=left, label="elevation (m)", shrink=0.75)
    left.set_facecolor("0.75")
    half_e = 0.5 * (patch.east_m - patch.west_m)
    half_n = 0.5 * (patch.north_m - patch.south_m)
    corners = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1], [-1, -1]]) * (half_e, half_n)
    for rank, place in reversed(list(enumerate(placing.places))):
        c, s = np.cos(place.turn_rad), np.sin(place.turn_rad)
        east = place.easting_m + c * corners[:, 0] + s * corners[:, 1]
        north = place.northing_m + c * corners[:, 1] - s * corners[:, 0]
        best = rank == 0
        colour = ("#c81e1e" if placing.accepted else "#e08a00") if best else "white"
        words = f"{'placed' if placing.accepted else 'likeliest, no fix'}" if best else "rival"
        left.plot(
            east, north, color=colour, lw=2 if best else 1, ls="-" if best else "--",
            label=words if best or rank == 1 else None,
        )  # fmt: skip
        # Where the patch's own north lies.
        left.plot(
            [place.easting_m, place.easting_m + s * half_n],
            [place.northing_m, place.northing_m + c * half_n], color=colour, lw=1,
        )  # fmt: skip
    left.set_xlabel("easting (m)")
    left.set_ylabel("northing (m)")
    left.ticklabel_format(useOffset=False, style="plain")
    left.tick_params(axis="x", labelrotation=30)
    if placing.places:
        figure.legend(loc="outside lower left", ncols=2, fontsize=8, facecolor="0.75")
    right.imshow(
        patch.elevation_m, extent=(-half_e, half_e, -half_n, half_n), cmap="viridis",
        interpolation="nearest",
    )  # fmt: skip
    right.set_title("the patch")
    right.set_xlabel("its own east (m)")
    right.set_ylabel("its own north (m)")
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=110)
    plt.close(figure)
