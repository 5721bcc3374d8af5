"""Maps too large to hold: plan at reduced resolution, prove at full resolution.

The route is found on a map of block means; its clearance is then proved, and its depths are made, over
the raster as stored, read in windows along the route. What that gives up is said in docs/planning.md: a
detour between two obstacles narrower than a block is not found.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.windows import Window

from perception.files import existing_file
from perception.records import FloatArray, Grid, InputError
from planning.finish import prove
from planning.ground import SurfaceGround, WindowedGround
from planning.planner import Plan
from planning.risk import clearance_sigma
from planning.route import route_of
from planning.surface import Surface, build_surface

# Cells that planning holds at once: 40 bytes each in the surfaces and searches.
MOST_CELLS = 30_000_000
# Cells of the reduced map, for a search of seconds.
REDUCED_CELLS = 2_500_000
# Side of the windows, in cells, that a proof along a route reads.
_WINDOW_CELLS = 1000.0


def raster_cells(path: Path) -> int:
    """Return the number of cells of a raster without reading it; 0 where GDAL cannot open it."""
    try:
        with rasterio.open(existing_file(path)) as source:
            return int(source.width) * int(source.height)
    except rasterio.errors.RasterioError:
        return 0


def read_reduced(path: Path) -> tuple[Grid, int]:
    """Read a large map as block means, row band by row band.

    Returns
    -------
    The reduced grid (a block with a cell of no data is no data: NaN is impassable) and the number of cells per block side.

    Raises
    ------
    InputError
        The map has no square metres to plan in (geographic or without georeference).
    """
    with rasterio.open(path) as source:
        if source.crs is None or source.crs.is_geographic:
            raise InputError(
                f"{path}: a map of {source.width} x {source.height} cells needs a projected CRS in "
                "metres; warp it: gdalwarp -t_srs EPSG:<UTM zone> in.tif out.tif"
            )
        block = max(1, math.ceil(math.sqrt(source.width * source.height / REDUCED_CELLS)))
        rows, cols = source.height // block, source.width // block
        bands = [1]
        names = [(d or "").lower() for d in source.descriptions]
        if "sigma" in names:
            bands.append(names.index("sigma") + 1)
        out = np.full((len(bands), rows, cols), np.nan)
        step = max(1, 8_000_000 // (source.width * block))
        for first in range(0, rows, step):
            last = min(rows, first + step)
            window = Window(0, first * block, cols * block, (last - first) * block)
            values = (
                source.read(bands, window=window, masked=True).astype(np.float32).filled(np.nan)
            )
            shaped = values.reshape(len(bands), last - first, block, cols, block)
            # A mean with a NaN is NaN; the worst sigma of a block stands for it.
            out[0, first:last] = shaped[0].mean(axis=(1, 3))
            if len(bands) > 1:
                out[1, first:last] = shaped[1].max(axis=(1, 3))
        t = source.transform
        sigma = out[1] if len(bands) > 1 and np.isfinite(out[1]).any() else None
        grid = Grid(
            out[0], t.c, t.f, t.a * block, source.crs.to_string(), sigma,
            cell_height_m=-t.e * block,
        )  # fmt: skip
    return grid, block


def window_along(path: Path, easting_m: FloatArray, northing_m: FloatArray, like: Grid) -> Grid:
    """Read, at full resolution, the least window of the map that holds a stretch of a route.

    Parameters
    ----------
    like : a grid of the same map, for its CRS and datum.
    """
    with rasterio.open(path) as source:
        t = source.transform
        c0 = max(0, math.floor((easting_m.min() - t.c) / t.a) - 3)
        c1 = min(source.width, math.ceil((easting_m.max() - t.c) / t.a) + 3)
        r0 = max(0, math.floor((t.f - northing_m.max()) / -t.e) - 3)
        r1 = min(source.height, math.ceil((t.f - northing_m.min()) / -t.e) + 3)
        names = [(d or "").lower() for d in source.descriptions]
        window = Window(c0, r0, c1 - c0, r1 - r0)

        def read(band: int) -> FloatArray:
            values: Any = source.read(band, window=window, masked=True)
            return np.asarray(values.astype(np.float64).filled(np.nan))

        sigma = read(names.index("sigma") + 1) if "sigma" in names else None
        if sigma is not None and like.sigma_m is None:
            sigma = None
        return replace(
            like, elevation_m=read(1), sigma_m=sigma, count=None,
            west_m=t.c + c0 * t.a, north_m=t.f + r0 * t.e, cell_m=t.a, cell_height_m=-t.e,
        )  # fmt: skip


def stretches(easting_m: FloatArray, northing_m: FloatArray, most_m: float) -> list[slice]:
    """Divide a route into stretches whose bounding boxes are at most `most_m` on a side.

    Neighbouring stretches share a waypoint, so that every segment belongs to one.
    """
    out = []
    first = 0
    while first < len(easting_m) - 1:
        span = np.maximum(
            np.maximum.accumulate(easting_m[first:]) - np.minimum.accumulate(easting_m[first:]),
            np.maximum.accumulate(northing_m[first:]) - np.minimum.accumulate(northing_m[first:]),
        )
        last = first + max(1, int(np.searchsorted(span, most_m)) - 1)
        out.append(slice(first, min(last, len(easting_m) - 1) + 1))
        first = min(last, len(easting_m) - 1)
    return out


def prove_at_full_resolution(path: Path, plan: Plan, like: Grid) -> Plan:
    """Make the depths of a reduced plan's route anew over the raster as stored, and prove them.

    Parameters
    ----------
    plan : found on the reduced map.
    like : the reduced map, whose CRS and use of sigma count.

    Returns
    -------
    The plan with the proved route; its cost is of the reduced map's weights. Without a route and with
    the reason where the full resolution breaks a limit.
    """
    if plan.route is None:
        return plan
    easting, northing = plan.route.easting_m, plan.route.northing_m
    where = stretches(easting, northing, _WINDOW_CELLS * like.cell_m / plan_block(path, like))
    parts = [
        SurfaceGround(_part(window_along(path, easting[w], northing[w], like), plan.surface))
        for w in where
    ]
    w = prove(plan.surface, easting, northing, ground=WindowedGround(where, parts))
    if w.problem:
        reason = (
            f"at full resolution, near {w.worst[0]:.1f},{w.worst[1]:.1f}: {w.problem}; cut the map to the "
            "area of the route (gdal_translate -projwin) to plan at full resolution"
        )
        return replace(plan, route=None, reason=reason)
    middle = 0.5 * (w.altitude_m[1:] + w.altitude_m[:-1]) - plan.surface.limits.floor_m
    _, _, weight = SurfaceGround(plan.surface).at(easting, northing)
    rate = 0.5 * (weight[1:] + weight[:-1])
    rate = rate + plan.surface.terms.altitude_per_m * np.maximum(0.0, middle)
    cost = float((rate * np.diff(w.distance_m)).sum())
    return replace(plan, route=route_of(w, cost, like.crs))


def plan_block(path: Path, like: Grid) -> float:
    """Return the number of full-resolution cells along a side of a reduced cell."""
    with rasterio.open(path) as source:
        return like.cell_m / float(source.transform.a)


def _part(grid: Grid, surface: Surface) -> Surface:
    """Return a window's surface under the limits and k of the reduced one."""
    limits = surface.limits
    sigma = clearance_sigma(
        grid.elevation_m, (grid.cell_m, grid.cell_north_m), grid.sigma_m,
        limits.sigma_position_m, limits.sigma_depth_m,
    )  # fmt: skip
    return build_surface(
        grid, limits, surface.terms, None, sigma, surface.k, submerged=np.isfinite(surface.top_m)
    )
