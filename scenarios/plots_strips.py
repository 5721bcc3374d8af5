"""Picture of one pass: the equalised echo with its levels and objects, and the strip made of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from perception.files import whole_file
from perception.records import BoolArray, ElevationStrip, FloatArray
from perception.strips import PassResult

# A picture needs no more lines and columns than it has dots.
_MOST_LINES, _MOST_COLUMNS = 1600, 900


def plot_pass(path: Path, result: PassResult) -> None:
    """Draw echo (with bottom, levels and objects) above the strip's elevation and its sigma."""
    from matplotlib.figure import Figure

    strip = result.strip
    figure = Figure(figsize=(12, 12), layout="constrained")
    echo, level, height, sigma = figure.subplots(4, 1, sharex=True)
    along = result.along_m
    _draw_echo(figure, echo, result, levels=False)
    _draw_echo(figure, level, result, levels=True)
    for axes, values, name, colours in (
        (height, strip.elevation_m, "elevation, m", "viridis"),
        (sigma, strip.sigma_m, "sigma, m", "magma"),
    ):
        thin, extent = _thinned(strip, values, along)
        finite = thin[np.isfinite(thin)]
        low, high = np.percentile(finite, [1, 99]) if finite.size else (0.0, 1.0)
        image = axes.imshow(
            thin.T, extent=extent, origin="lower", aspect="auto", cmap=colours, vmin=low, vmax=high
        )
        figure.colorbar(image, ax=axes, label=name, pad=0.01)
        axes.set_ylabel("across, m")
    sigma.set_xlabel("along the pass, m")
    figure.suptitle(
        f"{strip.source} pass {strip.pass_index}: {len(along)} pings, {len(result.objects)} objects"
    )
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=90)


def _draw_echo(figure: Any, axes: Any, result: PassResult, levels: bool) -> None:
    """Draw the echo in slant range, port downwards; with `levels` shadows and highlights in colour."""
    port, starboard = result.levels if levels else result.echo
    lines = max(1, -(-len(port) // _MOST_LINES))
    columns = max(1, -(-port.shape[1] // (_MOST_COLUMNS // 2)))
    whole = np.concatenate([port[::lines, ::-1], starboard[::lines]], axis=1)[:, ::columns]
    reach = port.shape[1] * result.sample_m
    extent = (result.along_m[0], result.along_m[-1], -reach, reach)
    if levels:
        from matplotlib.colors import ListedColormap

        colours = ListedColormap(["#20304a", "#101010", "#9a9a9a", "#ffd75e"])
        axes.imshow(whole.T, extent=extent, origin="lower", aspect="auto", cmap=colours,
                    vmin=-2.5, vmax=1.5, interpolation="nearest")  # fmt: skip
        _draw_objects(axes, result)
        axes.set_title("levels: shadow black, nominal grey, highlight yellow; ring hill, cross crater",
                       fontsize=9)  # fmt: skip
    else:
        decibels = 10 * np.log10(np.maximum(whole, 1e-3))
        image = axes.imshow(decibels.T, extent=extent, origin="lower", aspect="auto", cmap="gray",
                            vmin=-15, vmax=10)  # fmt: skip
        figure.colorbar(image, ax=axes, label="echo over nominal, dB", pad=0.01)
    for sign in (-1, 1):
        axes.plot(result.along_m, sign * result.bottom.altitude_m, color="#d03030", lw=0.7)
    axes.set_ylabel("slant range, m")


def _draw_objects(axes: Any, result: PassResult) -> None:
    table = result.objects
    if len(table) == 0:
        return
    altitude = np.interp(table.along_m, result.along_m, result.bottom.altitude_m)
    slant = np.sign(table.across_m) * np.hypot(table.across_m, altitude)
    hill: BoolArray = np.array([kind == "hill" for kind in table.kind])
    axes.scatter(table.along_m[hill], slant[hill], s=60, facecolors="none", edgecolors="#d03030")
    axes.scatter(table.along_m[~hill], slant[~hill], s=50, marker="x", color="#2060d0")


def _thinned(
    strip: ElevationStrip, values: FloatArray, along: FloatArray
) -> tuple[FloatArray, tuple[float, float, float, float]]:
    lines = max(1, -(-values.shape[0] // _MOST_LINES))
    columns = max(1, -(-values.shape[1] // _MOST_COLUMNS))
    across = strip.across_m
    return values[::lines, ::columns], (along[0], along[-1], across[0], across[-1])
