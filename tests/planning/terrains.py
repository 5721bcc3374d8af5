"""Terrains with known answers, and an independent brute-force check of a route."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.interpolate import RegularGridInterpolator

from perception.records import Grid
from planning.route import Route

WEST, NORTH = 500_000.0, 4_100_000.0


def grid_of(elevation_m: np.ndarray, cell_m: float = 1.0, **more: object) -> Grid:
    return Grid(np.asarray(elevation_m, float), WEST, NORTH, cell_m, crs="EPSG:32632", **more)


def at(grid: Grid, row: float, col: float) -> tuple[float, float]:
    """Return easting and northing of a fractional index."""
    return WEST + (col + 0.5) * grid.cell_m, NORTH - (row + 0.5) * grid.cell_north_m


def flat(rows: int = 120, cols: int = 120, depth_m: float = 40.0) -> np.ndarray:
    return np.full((rows, cols), -depth_m)


def canyon(n: int = 240, seed: int = 0, wall_m: float = 30.0) -> np.ndarray:
    """A meandering canyon with rough ground; walls of at most about 45 deg."""
    rng = np.random.default_rng(seed)
    row, col = np.mgrid[:n, :n].astype(float)
    middle = n / 2 + 0.25 * n * np.sin(2 * np.pi * row / n * 1.2 + rng.uniform(0, 6))
    z = -70.0 + wall_m / (1.0 + np.exp(-(np.abs(col - middle) - 0.1 * n) / 8.0))
    z += 20.0 * ndimage.gaussian_filter(rng.normal(size=(n, n)), 12)
    return z + 3.0 * ndimage.gaussian_filter(rng.normal(size=(n, n)), 3)


def brute_force(grid: Grid, route: Route, parts: int = 40) -> dict[str, float]:
    """Recompute what the limits are about with scipy, densely sampled; shares no code with planning."""
    rows, cols = grid.shape
    height = RegularGridInterpolator((np.arange(rows), np.arange(cols)), grid.elevation_m)
    row = (NORTH - route.northing_m) / grid.cell_north_m - 0.5
    col = (route.easting_m - WEST) / grid.cell_m - 0.5
    v = np.linspace(0.0, 1.0, parts + 1)

    def dense(a: np.ndarray) -> np.ndarray:
        return (a[:-1, None] + np.diff(a)[:, None] * v).ravel()

    altitude = -dense(route.depth_m) - height(np.column_stack([dense(row), dense(col)]))
    de, dn, dd = (np.diff(a) for a in (route.easting_m, route.northing_m, route.depth_m))
    leg = np.hypot(de, dn)
    turn = np.abs(np.diff(np.unwrap(np.arctan2(de, dn))))
    radius = 0.5 * (leg[1:] + leg[:-1]) / np.maximum(turn, 1e-12)
    pitch = np.degrees(np.arctan2(-dd, leg))
    return {
        "least_m": float(altitude.min()),
        "greatest_m": float(altitude.max()),
        "radius_m": float(radius.min()) if len(radius) else np.inf,
        "up_deg": float(pitch.max()),
        "down_deg": float(-pitch.min()),
    }
