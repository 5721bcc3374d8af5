"""A picture of a simulation: the true floor with its tracks, and the echoes of one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from perception.files import whole_file
from perception.records import FloatArray
from scenarios.plots_survey import shaded_relief
from scenarios.simulation import Simulation
from scenarios.world.prior import block_mean


def plot_simulation(path: Path, simulation: Simulation, line: int = 0) -> None:
    """Draw the truth and the waterfall of `line` as a PNG; the first ping is on top."""
    figure = Figure(figsize=(14.0, 5.2), layout="constrained", dpi=80)
    truth, waterfall = figure.subplots(1, 2, width_ratios=(1.15, 1.0))
    _draw_truth(truth, simulation)
    sonar = simulation.scenario.sonar
    rows = simulation.survey.truth.line == line
    image = _waterfall(simulation.survey.counts[rows])
    waterfall.imshow(
        image,
        cmap="copper",
        aspect="auto",
        extent=(-sonar.range_m, sonar.range_m, len(image), 0),
        vmax=float(np.percentile(image, 99.7)),
    )
    waterfall.set(xlabel="slant range, m (port negative)", ylabel="ping", title=f"line {line + 1}")
    with whole_file(path) as temporary:
        figure.savefig(temporary, metadata={"Software": None})


def _draw_truth(axes, simulation: Simulation) -> None:  # type: ignore[no-untyped-def]
    scenario = simulation.scenario
    grid = block_mean(simulation.world.floor, scenario.world, max(1.0, scenario.world.cell_m))
    low, high = np.percentile(grid.elevation_m, (1, 99))
    extent = (grid.west_m, grid.east_m, grid.south_m, grid.north_m)
    axes.imshow(shaded_relief(grid, float(low), float(high)), extent=extent)
    for kind, marker in (("hill", "^"), ("crater", "v")):
        places = [(o.easting_m, o.northing_m) for o in simulation.world.objects if o.kind == kind]
        if places:
            axes.plot(*np.transpose(places), marker, mfc="none", mec="k", ms=4, label=kind)
    survey, back = simulation.survey.truth, simulation.nav.truth
    axes.plot(survey.easting_m, survey.northing_m, "w.", ms=0.7)
    axes.plot([], [], "w-", lw=1.5, label="survey")
    if scenario.locate.track == "return":
        axes.plot(back.easting_m, back.northing_m, "r-", lw=0.8, label="return")
    # The survey's line is white: no legend shows it on white.
    axes.legend(loc="upper right", fontsize=7, facecolor="0.6", framealpha=0.9)
    axes.set(xlabel="easting, m", ylabel="northing, m", title=f"{scenario.name}: the true floor")
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.locator_params(axis="x", nbins=5)


def _waterfall(counts: FloatArray) -> FloatArray:
    """Return port (far to near) and starboard side by side, in the square root of amplitude."""
    sides = np.concatenate([counts[:, 0, ::-1], counts[:, 1]], axis=1).astype(float)
    # Two samples make a dot: the picture is smaller than the record.
    width = sides.shape[1] // 2 * 2
    return np.sqrt(0.5 * (sides[:, :width:2] + sides[:, 1:width:2]))
