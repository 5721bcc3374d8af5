"""An independent, exact check of a written route: what route.csv says against the map as stored.

Shares no code with `planning`: it reads the printed digits and the raster itself, cuts every segment at
the grid lines that it crosses, and finds the least and greatest height over each bilinear patch from
the patch's own coefficients. It is what the tests and the benchmarks believe.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from rasterio.windows import Window

from perception.records import FloatArray


@dataclass(frozen=True, slots=True)
class Checked:
    """What a route keeps, found anew.

    Attributes
    ----------
    least_margin_m : exact least of height over bottom + floor + k sigma along the route; NaN where it
        meets no data.
    least_altitude_m, greatest_altitude_m : exact extremes of height over the bottom.
    least_radius_m : of the circles through three waypoints that follow one another.
    steepest_up_deg, steepest_down_deg : of its segments.
    deepest_m, shallowest_m : depths below the surface.
    """

    least_margin_m: float
    least_altitude_m: float
    greatest_altitude_m: float
    least_radius_m: float
    steepest_up_deg: float
    steepest_down_deg: float
    deepest_m: float
    shallowest_m: float


def check_route(
    route: Path,
    chart: Path,
    floor_m: float = 5.0,
    k: float = 0.0,
    elevation_band: int = 1,
    sigma_band: int | None = None,
) -> Checked:
    """Check a `route.csv` against a GeoTIFF of heights; reads only the windows that the route crosses."""
    with route.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    e, n, d = (
        np.array([float(r[c]) for r in rows]) for c in ("easting_m", "northing_m", "depth_m")
    )
    margin, low, high = np.inf, np.inf, -np.inf
    with rasterio.open(chart) as source:
        t = source.transform
        col, row = (e - t.c) / t.a - 0.5, (n - t.f) / t.e - 0.5
        for first in range(0, len(e) - 1, 500):
            part = slice(first, min(first + 501, len(e)))
            r0, c0 = int(np.floor(row[part].min())), int(np.floor(col[part].min()))
            r1, c1 = int(np.ceil(row[part].max())), int(np.ceil(col[part].max()))
            window = Window(c0, r0, c1 - c0 + 2, r1 - r0 + 2)
            bottom = _read(source, elevation_band, window)
            least = bottom + floor_m
            if sigma_band is not None and k > 0:
                least = least + k * _read(source, sigma_band, window)
            path = (row[part] - r0, col[part] - c0, -d[part])
            above = extremes(bottom, *path)
            low, high = np.minimum(low, above[0]), np.maximum(high, above[1])
            margin = np.minimum(margin, extremes(least, *path)[0])
    leg, rise = np.hypot(np.diff(e), np.diff(n)), -np.diff(d)
    pitch = np.degrees(np.arctan2(rise, leg))
    return Checked(
        float(margin), float(low), float(high), _least_circle(e, n), float(pitch.max()),
        float(-pitch.min()), float(d.max()), float(d.min()),
    )  # fmt: skip


def _read(source: rasterio.DatasetReader, band: int, window: Window) -> FloatArray:
    values = source.read(band, window=window, boundless=True, masked=True, fill_value=np.nan)
    return np.asarray(values.astype(np.float64).filled(np.nan))


def extremes(
    surface: FloatArray, row: FloatArray, col: FloatArray, z: FloatArray
) -> tuple[float, float]:
    """Return exact (least, greatest) of ``z - surface`` along a polyline of fractional indices.

    In the square with corners a, b (right), c (below), d the surface is ``a + p x + q y + r x y`` with
    ``p = b - a``, ``q = c - a``, ``r = a + d - b - c``; along a piece with x, y, z linear in t the
    difference is ``A + B t + C t^2``.
    """
    low, high = np.inf, -np.inf
    for i in range(len(row) - 1):
        ends = np.array([[row[i], col[i], z[i]], [row[i + 1], col[i + 1], z[i + 1]]])
        cuts = [0.0, 1.0]
        for axis in (0, 1):
            a, b = ends[0, axis], ends[1, axis]
            lines = np.arange(np.floor(min(a, b)) + 1, np.ceil(max(a, b)))
            cuts += list((lines - a) / (b - a)) if a != b else []
        t = np.unique(np.clip(cuts, 0.0, 1.0))
        at = ends[0] + t[:, None] * (ends[1] - ends[0])
        middle = 0.5 * (at[1:] + at[:-1])
        j, k = np.floor(middle[:, 0]).astype(int), np.floor(middle[:, 1]).astype(int)
        low_i, high_i = _over_patches(surface, at, j, k)
        low, high = np.minimum(low, low_i), np.maximum(high, high_i)
    return float(low), float(high)


def _over_patches(
    surface: FloatArray, at: FloatArray, j: FloatArray, k: FloatArray
) -> tuple[float, float]:
    j1, k1 = np.minimum(j + 1, surface.shape[0] - 1), np.minimum(k + 1, surface.shape[1] - 1)
    y0, x0 = at[:-1, 0] - j, at[:-1, 1] - k
    dy, dx, dz = (at[1:] - at[:-1]).T
    a, b, c, d = surface[j, k], surface[j, k1], surface[j1, k], surface[j1, k1]
    # On a grid line the corners across it have no weight; their values must not matter, NaN or not.
    on_row, on_col = (y0 == 0) & (dy == 0), (x0 == 0) & (dx == 0)
    c, d = np.where(on_row, a, c), np.where(on_row, b, d)
    b, d = np.where(on_col, a, b), np.where(on_col, c, d)
    p, q, r = b - a, c - a, a + d - b - c
    A = at[:-1, 2] - (a + p * x0 + q * y0 + r * x0 * y0)
    B = dz - (p * dx + q * dy + r * (x0 * dy + y0 * dx))
    C = -r * dx * dy
    with np.errstate(invalid="ignore", divide="ignore"):
        v = np.where(C != 0, -B / (2.0 * C), 0.0)
    v = np.where((v > 0) & (v < 1), v, 0.0)
    values = np.stack([A, A + B + C, A + v * (B + v * C)])
    return float(values.min()), float(values.max())


def _least_circle(e: FloatArray, n: FloatArray) -> float:
    """Return the least radius of a circle through three neighbouring waypoints."""
    if len(e) < 3:
        return float("inf")
    a, b = np.hypot(np.diff(e)[:-1], np.diff(n)[:-1]), np.hypot(np.diff(e)[1:], np.diff(n)[1:])
    c = np.hypot(e[2:] - e[:-2], n[2:] - n[:-2])
    twice_area = np.abs(np.diff(e)[:-1] * np.diff(n)[1:] - np.diff(n)[:-1] * np.diff(e)[1:])
    with np.errstate(divide="ignore"):
        radius = a * b * c / (2.0 * twice_area)
    return float(np.nanmin(np.where(twice_area > 0, radius, np.inf)))
