"""One picture of a whole mission: echoes, truth, map and tracks, regions, position, route."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mapping.rasters import read_map
from mapping.trajectories import read_trajectory
from perception.files import whole_file
from perception.records import FloatArray, Grid, Trajectory
from scenarios.plots_survey import shaded_relief

# The part of the altitude that is water for certain, whatever slope the first return comes from.
_WATER_PART = 0.6


def plot_overview(out: Path, path: Path) -> None:
    """Draw the mission in `out` (all stages done) into `path`."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 9), layout="constrained")
    axes: dict[str, Any] = figure.subplot_mosaic(
        [
            ["echoes", "truth", "map"],
            ["regions", "position", "route"],
            ["regions", "position", "profile"],
        ],
        height_ratios=(1.0, 0.72, 0.28),
    )
    truth = read_map(out / "simulate" / "truth" / "elevation.tif")
    grid = read_map(out / "map" / "map.tif")
    limits = tuple(np.nanpercentile(grid.elevation_m, [1, 99]))
    _echoes(axes["echoes"], out)
    _relief(
        axes["truth"], _cut(truth, grid), limits, "the true sea floor (kept from every estimate)"
    )
    _relief(axes["map"], grid, limits, "the map from echoes, track before and after")
    _tracks(axes["map"], out / "map")
    _regions(axes["regions"], out / "regions", grid)
    _position(axes["position"], out)
    _route(axes["route"], axes["profile"], out / "plan", grid, limits)
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=90)


def _cut(truth: Grid, frame: Grid) -> Grid:
    """Return the truth's part under the map."""
    e, n = truth.centres()
    cols = (e > frame.west_m) & (e < frame.east_m)
    rows = (n > frame.south_m) & (n < frame.north_m)
    return Grid(
        truth.elevation_m[np.ix_(rows, cols)],
        float(e[cols][0] - truth.cell_m / 2),
        float(n[rows][0] + truth.cell_m / 2),
        truth.cell_m,
        truth.crs,
    )


def _extent_from(grid: Grid, origin: Grid) -> tuple[float, float, float, float]:
    """Return imshow's extent in metres from the south-west corner of `origin`."""
    return (
        grid.west_m - origin.west_m, grid.east_m - origin.west_m,
        grid.south_m - origin.south_m, grid.north_m - origin.south_m,
    )  # fmt: skip


def _echoes(axes: Any, out: Path) -> None:
    from perception.readers import open_survey

    survey = open_survey(sorted((out / "simulate").glob("survey*.xtf")))
    swath = survey.swath(min(1, survey.n_passes - 1))
    slant_m = (np.arange(swath.n_samples) + 0.5) * swath.sample_m[:, None]
    # The pulse itself rings on in the water column, brighter than any ground: it is no echo.
    with np.errstate(invalid="ignore"):
        water = slant_m < _WATER_PART * swath.altitude_hint_m[:, None]
    sides = [np.where(water, 0.0, side) for side in (swath.port, swath.starboard)]
    image = np.concatenate([sides[0][:, ::-1], sides[1]], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        level = np.log10(np.where(image > 0, image, np.nan))
    low, high = np.nanpercentile(level, [5, 99])
    reach_m = swath.n_samples * float(np.median(swath.sample_m))
    axes.set_facecolor("black")
    axes.imshow(
        level, cmap="copper", vmin=low, vmax=high, aspect="auto",
        extent=(-reach_m, reach_m, swath.n_pings, 0),
    )  # fmt: skip
    axes.set(title="echoes of one pass", xlabel="slant range, m", ylabel="ping")


def _relief(axes: Any, grid: Grid, limits: tuple[float, ...], title: str) -> None:
    axes.imshow(
        shaded_relief(grid, limits[0], limits[1]),
        extent=_extent_from(grid, grid),
        interpolation="nearest",
    )
    axes.set(title=title, xlabel="m", ylabel="m")


def _tracks(axes: Any, folder: Path) -> None:
    grid = read_map(folder / "map.tif")
    for name, style, colour in (
        ("trajectory-navigated.csv", "--", "#ff5a3c"),
        ("trajectory.csv", "-", "white"),
    ):
        track = read_trajectory(folder / name)
        numbers = np.zeros(len(track.time_s)) if track.pass_index is None else track.pass_index
        for number in np.unique(numbers[numbers >= 0]):
            rows = numbers == number
            axes.plot(
                track.easting_m[rows] - grid.west_m,
                track.northing_m[rows] - grid.south_m,
                style,
                color=colour,
                lw=1,
            )


def _regions(axes: Any, folder: Path, grid: Grid) -> None:
    import rasterio
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    from mapping.region_files import CLASS_COLOURS
    from perception.records import REGION_CLASSES

    with rasterio.open(folder / "regions.tif") as source:
        classes = source.read(1)
    axes.imshow(
        classes, cmap=ListedColormap(["#ffffff", *CLASS_COLOURS.values()]), vmin=-0.5, vmax=8.5,
        extent=_extent_from(grid, grid), interpolation="nearest",
    )  # fmt: skip
    handles = [
        Patch(color=colour, label=REGION_CLASSES[code]) for code, colour in CLASS_COLOURS.items()
    ]
    axes.legend(
        handles=handles,
        fontsize=7,
        ncols=4,
        loc="upper center",
        bbox_to_anchor=(0.5, -0.12),
        frameon=False,
    )
    axes.set(title="regions by mean and Gaussian curvature", xlabel="m", ylabel="m")


def _position(axes: Any, out: Path) -> None:
    truth = read_trajectory(out / "simulate" / "truth" / "nav.csv")
    found = read_trajectory(out / "locate" / "trajectory.csv")
    raw = np.genfromtxt(out / "simulate" / "nav.csv", delimiter=",", names=True)
    minutes = (found.time_s - found.time_s[0]) / 60.0

    def error(easting_m: FloatArray, northing_m: FloatArray) -> FloatArray:
        return np.hypot(
            easting_m - np.interp(found.time_s, truth.time_s, truth.easting_m),
            northing_m - np.interp(found.time_s, truth.time_s, truth.northing_m),
        )

    axes.semilogy(minutes, error(raw["easting_m"], raw["northing_m"]), "--", label="dead reckoning")
    axes.semilogy(minutes, error(found.easting_m, found.northing_m), label="with terrain fixes")
    axes.semilogy(minutes, _claimed(found), color="0.6", lw=1, label="claimed 1-sigma")
    axes.legend(fontsize=8)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set(
        title="position error of the run back over the ground",
        xlabel="minutes",
        ylabel="horizontal error, m",
    )


def _claimed(track: Trajectory) -> FloatArray:
    return np.hypot(track.sigma_easting_m, track.sigma_northing_m)


def _route(axes: Any, profile: Any, folder: Path, grid: Grid, limits: tuple[float, ...]) -> None:
    _relief(axes, grid, limits, "a route near the bottom, proved clear")
    path = folder / "route.csv"
    if not path.exists():
        axes.set_title("no route: the report says why")
        profile.set_axis_off()
        return
    route = np.genfromtxt(path, delimiter=",", names=True)
    e, n = route["easting_m"] - grid.west_m, route["northing_m"] - grid.south_m
    axes.plot(e, n, color="white", lw=2)
    axes.plot(e[[0, -1]], n[[0, -1]], "o", color="#ff5a3c", ms=5)
    floor = -(route["depth_m"] + route["altitude_m"])
    profile.fill_between(route["distance_m"], floor, floor.min() - 1, color="#7a6a55")
    profile.plot(route["distance_m"], -route["depth_m"], color="#14507a")
    profile.set(xlabel="along the route, m", ylabel="elevation, m")
    profile.margins(x=0)
