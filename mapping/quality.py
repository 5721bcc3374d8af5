"""Survey quality: crossing-line statistics, uncertainty against the IHO S-44 orders, coverage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import shapely

from perception.records import ElevationStrip, FloatArray, Grid, Trajectory

# IHO S-44 edition 6.1.0, table 1: total vertical uncertainty sqrt(a^2 + (b depth)^2) and total horizontal
# uncertainty c + d depth, both at 95 %, in metres.
S44_ORDERS = {
    "exclusive": (0.15, 0.0075, 1.0, 0.0),
    "special": (0.25, 0.0075, 2.0, 0.0),
    "1a": (0.5, 0.013, 5.0, 0.05),
    "1b": (0.5, 0.013, 5.0, 0.05),
    "2": (1.0, 0.023, 20.0, 0.10),
}
# 95 % of a normal error in one dimension lies within 1.96 sigma, of a circular one within 2.45.
ONE_D_95, TWO_D_95 = 1.96, 2.45


def crossings(strips: Sequence[ElevationStrip]) -> FloatArray:
    """Return where tracks cross: (k, 6) first strip, second strip, easting, northing, depth of each line.

    The last two are the lines' indices (fractional lines are rounded). Tracks that only touch or run
    along each other give none.
    """
    tracks = [
        shapely.LineString(np.column_stack([s.easting_m, s.northing_m]))
        if len(s.time_s) > 1
        else None
        for s in strips
    ]
    present = [i for i, t in enumerate(tracks) if t is not None]
    tree = shapely.STRtree([tracks[i] for i in present])
    found = []
    for position, i in enumerate(present):
        for other in tree.query(tracks[i], predicate="crosses"):
            if other <= position:
                continue
            j = present[int(other)]
            for point in shapely.get_parts(shapely.intersection(tracks[i], tracks[j])):
                if point.geom_type == "Point":
                    lines = [_nearest_line(strips[k], point.x, point.y) for k in (i, j)]
                    found.append((i, j, point.x, point.y, *lines))
    return np.array(found, float).reshape(-1, 6)


def _nearest_line(strip: ElevationStrip, easting_m: float, northing_m: float) -> int:
    return int(np.argmin(np.hypot(strip.easting_m - easting_m, strip.northing_m - northing_m)))


def crossing_differences(strips: Sequence[ElevationStrip]) -> tuple[FloatArray, FloatArray]:
    """Return the height under the second track less that under the first at each crossing, and its sigma.

    The height is the strip's own nearest the track. Crossings without it are left out.
    """
    difference, sigma = [], []
    for i, j, _, _, line_i, line_j in crossings(strips):
        heights = [_under(strips[int(s)], int(line)) for s, line in ((i, line_i), (j, line_j))]
        if all(np.isfinite(h[0]) for h in heights):
            difference.append(heights[1][0] - heights[0][0])
            sigma.append(float(np.hypot(heights[0][1], heights[1][1])))
    return np.array(difference), np.array(sigma)


def _under(strip: ElevationStrip, line: int) -> tuple[float, float]:
    seen = np.flatnonzero(np.isfinite(strip.elevation_m[line]))
    if not len(seen):
        return np.nan, np.nan
    column = seen[np.argmin(np.abs(strip.across_m[seen]))]
    return float(strip.elevation_m[line, column]), float(strip.sigma_m[line, column])


def survey_quality(
    strips: Sequence[ElevationStrip], grid: Grid, trajectory: Trajectory | None = None
) -> dict[str, float | int | str | None]:
    """Return the figures of a survey's quality, flat, with units in the names, for `metrics.json`.

    Crossings: number, mean, rms and the part within two sigma. Map: the part of cells that meets each S-44
    order vertically; the strictest order that 95 % of cells meet vertically and the track horizontally.
    Coverage: mapped area, part of the bounding rectangle, data per cell. The tables of S-44 ask for
    feature detection and coverage too, which a number cannot promise: the order here is of uncertainty alone.
    """
    figures = crossing_figures(strips)
    mapped = np.isfinite(grid.elevation_m)
    area = grid.cell_m * grid.cell_north_m
    figures["mapped_m2"] = float(mapped.sum() * area)
    figures["coverage_of_rectangle"] = float(mapped.mean())
    if grid.count is not None and mapped.any():
        figures["median_data_per_cell"] = float(np.nanmedian(grid.count[mapped]))
    horizontal = horizontal_95(trajectory)
    figures["track_horizontal_95_m"] = horizontal
    figures.update(_orders(grid, horizontal))
    return figures


def crossing_figures(strips: Sequence[ElevationStrip]) -> dict[str, float | int | str | None]:
    """Return the figures of the tracks' crossings alone."""
    difference, sigma = crossing_differences(strips)
    figures: dict[str, float | int | str | None] = {"crossings": len(difference)}
    if len(difference):
        figures["crossing_bias_m"] = float(difference.mean())
        figures["crossing_rms_m"] = float(np.sqrt((difference**2).mean()))
        figures["crossing_within_2_sigma"] = float((np.abs(difference) <= 2 * sigma).mean())
    return figures


def horizontal_95(trajectory: Trajectory | None) -> float | None:
    """Return the horizontal uncertainty that 95 % of the track's poses keep, at 95 % each."""
    if trajectory is None:
        return None
    variance = 0.5 * (trajectory.sigma_easting_m**2 + trajectory.sigma_northing_m**2)
    known = variance[np.isfinite(variance)]
    return float(TWO_D_95 * np.sqrt(np.percentile(known, 95))) if len(known) else None


def _orders(grid: Grid, horizontal_m: float | None) -> dict[str, float | int | str | None]:
    figures: dict[str, float | int | str | None] = {}
    if grid.sigma_m is None:
        return figures
    known = np.isfinite(grid.elevation_m) & np.isfinite(grid.sigma_m)
    if not known.any():
        return figures
    depth = np.maximum(-grid.elevation_m[known], 0.0)
    vertical = ONE_D_95 * grid.sigma_m[known]
    shares = {
        order: float((vertical <= np.hypot(a, b * depth)).mean())
        for order, (a, b, _, _) in S44_ORDERS.items()
    }
    figures |= {f"s44_{order}_vertical_share": share for order, share in reversed(shares.items())}
    figures["s44_order_of_uncertainty"] = order_met(shares, float(np.median(depth)), horizontal_m)
    return figures


def order_met(shares: Mapping[str, float], depth_m: float, horizontal_m: float | None) -> str:
    """Return the strictest order that 95 % of cells meet vertically and the track horizontally.

    Parameters
    ----------
    shares : part of the cells that meets each of `S44_ORDERS` vertically.
    depth_m : typical depth, for the horizontal limit.
    horizontal_m : the track's horizontal uncertainty at 95 %; None unknown.
    """
    if horizontal_m is None:
        return "none"
    for order, (_, _, c, d) in S44_ORDERS.items():
        if shares[order] >= 0.95 and horizontal_m <= c + d * depth_m:
            return order
    return "none"
