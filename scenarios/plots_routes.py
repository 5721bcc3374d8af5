"""Pictures of routes: the map with the route and its worst point, and the profile of depths."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LightSource, Normalize
from matplotlib.patheffects import withStroke

from perception.files import whole_file
from perception.records import FloatArray
from planning.coverage import Survey
from planning.failure import Blockage
from planning.ground import SurfaceGround
from planning.planner import Plan
from planning.route import Route
from planning.surface import Surface
from scenarios.route_outputs import clearance_told

# Pixels along the longer side of the map; a larger map is thinned.
_PIXELS = 900
_DPI = 110
# Least width of a map's picture over its height, where the map is as wide.
_LEAST_ASPECT = 0.7
# Ground that no route may pass.
_BARRED = (0.75, 0.75, 0.75, 1.0)
# White lines are lost on pale ground and in a legend without an edge.
_OUTLINED = (withStroke(linewidth=2.0, foreground="0.25"),)


def picture_plan(path: Path, plan: Plan) -> None:
    """Draw a plan: its route with the worst point, or the place that blocks."""
    if plan.route is not None:
        _picture_route(path, plan, plan.route)
    elif plan.blockage is not None:
        _picture_blockage(path, plan.surface, plan.blockage)


def _picture_route(path: Path, plan: Plan, route: Route) -> None:
    surface = plan.surface
    figure, (upper, lower) = _figure()
    box = _box(surface, route.easting_m, route.northing_m)
    _draw_map(upper, surface, box)
    if len(plan.grid_path):
        e, n = surface.world(plan.grid_path[:, 0], plan.grid_path[:, 1])
        upper.plot(
            e, n, color="white", lw=1.0, ls=":", label="grid search at the floor, no limits",
            path_effects=_OUTLINED,
        )  # fmt: skip
    upper.plot(route.easting_m, route.northing_m, color="crimson", lw=1.6, label="route")
    upper.plot(*route.worst[:2], "o", mfc="none", mec="gold", ms=9, mew=2, label="least clearance")
    upper.plot(
        route.easting_m[0], route.northing_m[0], "^", color="white", mec="black", label="start"
    )
    upper.plot(
        route.easting_m[-1], route.northing_m[-1], "s", color="white", mec="black", label="goal"
    )
    upper.set_title(
        f"cost {route.cost:.0f} = {plan.ratio:.3f} of the grid search; "
        f"length {route.length_m:.0f} m, mean altitude {route.mean_altitude_m:.2f} m",
        fontsize=9,
    )
    s = np.concatenate(
        [[0.0], np.cumsum(np.hypot(np.diff(route.easting_m), np.diff(route.northing_m)))]
    )
    z = -route.depth_m
    bottom = z - route.altitude_m
    limits = surface.limits
    _draw_profile(lower, s, bottom, z, limits.floor_m, limits.ceiling_m)
    least, _, _ = SurfaceGround(surface, weighted=False).at(route.easting_m, route.northing_m)
    lower.fill_between(
        s, bottom + limits.floor_m, least, color="orange", alpha=0.5, lw=0,
        label=f"kept clear besides: {plan.k:.2f} sigma, objects",
    )  # fmt: skip
    _legends(figure, upper, lower)
    at = int(
        np.argmin(np.hypot(route.easting_m - route.worst[0], route.northing_m - route.worst[1]))
    )
    lower.plot(s[at], -route.worst[2], "o", mfc="none", mec="goldenrod", ms=9, mew=2)
    lower.set_title(
        f"{clearance_told(route, limits.floor_m, plan.k)} (circle); "
        f"least slant distance to the ground {route.min_stand_off_m:.2f} m",
        fontsize=8,
    )
    _save(path, figure)


def _picture_blockage(path: Path, surface: Surface, blockage: Blockage) -> None:
    figure, (upper, lower) = _figure()
    e, n = blockage.path[:, 0], blockage.path[:, 1]
    _draw_map(upper, surface, _box(surface, e, n))
    upper.plot(e, n, color="orange", lw=1.3, label="the path that breaks least")
    upper.plot(*blockage.place, "x", color="crimson", ms=11, mew=2.5, label="what blocks")
    upper.set_title("no route: " + _wrapped(blockage.reason, 95), fontsize=7.5)
    s = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(e), np.diff(n)))])
    _draw_profile(
        lower,
        s,
        blockage.bottom_m,
        blockage.height_m,
        surface.limits.floor_m,
        surface.limits.ceiling_m,
    )
    at = int(np.argmin(np.hypot(e - blockage.place[0], n - blockage.place[1])))
    lower.axvline(s[at], color="crimson", lw=1.0)
    _legends(figure, upper, lower)
    _save(path, figure)


def picture_survey(path: Path, surface: Surface, survey: Survey, area: Any) -> None:
    """Draw survey lines over the area asked for, and the depth profile of the whole."""
    import shapely

    figure, (upper, lower) = _figure()
    w = survey.path
    _draw_map(upper, surface, _box(surface, w.easting_m, w.northing_m))
    upper.plot(*shapely.get_coordinates(area.exterior).T, color="gold", lw=1.5, label="area")
    upper.plot(w.easting_m, w.northing_m, color="crimson", lw=0.8, label="track with turns")
    for i, (begin, end) in enumerate(survey.lines):
        upper.plot(
            [begin[0], end[0]], [begin[1], end[1]], color="white", lw=1.2,
            label="lines" if i == 0 else None, path_effects=_OUTLINED,
        )  # fmt: skip
    upper.set_title(
        f"{len(survey.lines)} lines cover {100 * survey.covered:.1f} % of the area", fontsize=9
    )
    if np.isfinite(w.depth_m).all():
        s = np.concatenate(
            [[0.0], np.cumsum(np.hypot(np.diff(w.easting_m), np.diff(w.northing_m)))]
        )
        z = -w.depth_m
        _draw_profile(
            lower, s, z - w.altitude_m, z, surface.limits.floor_m, surface.limits.ceiling_m
        )
    _legends(figure, upper, lower)
    _save(path, figure)


def _figure() -> tuple[Any, Any]:
    return plt.subplots(2, 1, figsize=(8.5, 9.5), height_ratios=(2.4, 1.0), constrained_layout=True)


def _box(surface: Surface, easting_m: FloatArray, northing_m: FloatArray) -> tuple[int, ...]:
    """Return rows and columns around a path, with a margin, and not too narrow to read."""
    x, y = surface.local(easting_m, northing_m)
    rows, cols = surface.shape
    extent = max(float(np.ptp(x)), float(np.ptp(y)))
    out: list[int] = []
    for values, cell, n in ((y, surface.cell_m[1], rows), (x, surface.cell_m[0], cols)):
        margin = 0.15 * extent + 10 * cell
        half = max(0.5 * float(np.ptp(values)) + margin, _LEAST_ASPECT * (0.65 * extent))
        middle = 0.5 * float(values.max() + values.min())
        # Near the map's edge the box slides inside rather than being cut.
        wide = min(n, int(2.0 * half / cell) + 2)
        first = min(max(0, int((middle - half) / cell)), n - wide)
        out += [first, first + wide]
    return tuple(out)


def _draw_map(axes: Any, surface: Surface, box: tuple[int, ...]) -> None:
    r0, r1, c0, c1 = box
    thin = max(1, max(r1 - r0, c1 - c0) // _PIXELS)
    z = surface.bottom_m[r0:r1:thin, c0:c1:thin]
    width, height = surface.cell_m[0] * thin, surface.cell_m[1] * thin
    filled = np.where(np.isfinite(z), z, np.nanmin(z) if np.isfinite(z).any() else 0.0)
    low, high = np.percentile(filled, [1, 99])
    shaded = LightSource(315, 45).shade(
        filled, plt.get_cmap("viridis"), vmin=low, vmax=max(high, low + 1e-6), dx=width, dy=height,
        blend_mode="soft", vert_exag=1.5,
    )  # fmt: skip
    barred = surface.barred[r0:r1:thin, c0:c1:thin]
    shaded[barred] = _BARRED
    if barred.any():
        axes.plot(
            [],
            [],
            "s",
            color=_BARRED,
            mec="0.4",
            label="barred: no map, too shallow, no-go, or least heights",
        )
    west, north = surface.world(
        np.array((c0 - 0.5) * surface.cell_m[0]), np.array((r0 - 0.5) * surface.cell_m[1])
    )
    rows, cols = z.shape
    axes.imshow(
        shaded,
        extent=(west, west + cols * width, north - rows * height, north),
        interpolation="nearest",
    )
    scale = ScalarMappable(Normalize(low, max(high, low + 1e-6)), "viridis")
    axes.figure.colorbar(scale, ax=axes, label="height of the bottom (m)", shrink=0.8, pad=0.01)
    axes.set_xlabel("easting (m)")
    axes.set_ylabel("northing (m)")
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.tick_params(labelsize=7)
    axes.locator_params(axis="x", nbins=4)
    axes.locator_params(axis="y", nbins=6)


def _draw_profile(
    axes: Any, s: FloatArray, bottom: FloatArray, z: FloatArray, floor_m: float, ceiling_m: float
) -> None:
    axes.fill_between(s, bottom, np.nanmin(bottom) - 3.0, color="0.55", label="bottom")
    axes.plot(s, bottom + floor_m, color="black", lw=0.6, ls="--", label=f"floor {floor_m:g} m")
    axes.plot(
        s, bottom + ceiling_m, color="steelblue", lw=0.6, ls="--", label=f"ceiling {ceiling_m:g} m"
    )
    axes.plot(s, z, color="crimson", lw=1.3, label="vehicle")
    axes.set_xlabel("distance (m)")
    axes.set_ylabel("height (m)")
    axes.set_xlim(s[0], max(s[-1], s[0] + 1e-6))


def _legends(figure: Any, upper: Any, lower: Any) -> None:
    """Put both legends outside the axes: inside, they would cover the route somewhere."""
    for axes, place in ((upper, "outside upper center"), (lower, "outside lower center")):
        handles, labels = axes.get_legend_handles_labels()
        if handles:
            figure.legend(
                handles, labels, loc=place, fontsize=7, ncols=5, facecolor="0.93", frameon=True
            )


def _wrapped(text: str, width: int) -> str:
    import textwrap

    return "\n".join(textwrap.wrap(text, width))


def _save(path: Path, figure: Any) -> None:
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=_DPI)
    plt.close(figure)
