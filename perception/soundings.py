"""Soundings: what the bottom track says of the surface, and how rough it says the sea floor is.

The first return comes from the *nearest* point of the sea floor in the ping's plane, not from below
the sonar; a sounding therefore is an equation on the surface's nearest point, found anew whenever
the surface changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy import optimize, sparse, special

from perception.posterior import Spectrum
from perception.rays import Soundings
from perception.records import FloatArray, IntArray, bilinear


@dataclass(frozen=True, slots=True)
class Equations:
    """Linear equations ``matrix @ heights = value`` with weight 1 / sigma^2 each."""

    matrix: sparse.csr_matrix
    weight: FloatArray
    value: FloatArray


# The floor's nearest point is searched within this part of the range to either side: a slope of 35
# degrees.
_REACH = 0.7


def sounding_equations(
    surface: FloatArray, west_m: float, south_m: float, cell_m: float, bottom: Soundings, below: bool
) -> Equations:
    """Return the bottom track as equations on the surface.

    The slant range to the surface's nearest point equals the first return. With `below` the point is
    taken below the sonar, as a surface not yet known is.
    """
    if below:
        across = np.zeros(len(bottom.range_m))
        height = bottom.up_m - bottom.range_m
    else:
        across, height = nearest_points(surface, west_m, south_m, cell_m, bottom)
    east = bottom.easting_m + np.cos(bottom.heading_rad) * across
    north = bottom.northing_m - np.sin(bottom.heading_rad) * across
    drop = bottom.up_m - height
    slant = np.hypot(across, drop)
    factor = -drop / slant
    matrix = bilinear_rows(
        (north - south_m) / cell_m, (east - west_m) / cell_m, factor, surface.shape
    )
    return Equations(matrix, 1 / bottom.sigma_m**2, bottom.range_m - slant + factor * height)


def nearest_points(
    surface: FloatArray, west_m: float, south_m: float, cell_m: float, bottom: Soundings
) -> tuple[FloatArray, FloatArray]:
    """Return (across, height) of the surface's nearest point in each ping's plane."""
    across = _REACH * bottom.range_m[:, None] * np.linspace(-1, 1, 81)
    east = bottom.easting_m[:, None] + np.cos(bottom.heading_rad)[:, None] * across
    north = bottom.northing_m[:, None] - np.sin(bottom.heading_rad)[:, None] * across
    z = bilinear(surface, (north - south_m) / cell_m, (east - west_m) / cell_m)
    slant = np.hypot(across, bottom.up_m[:, None] - z)
    best = np.argmin(np.where(np.isfinite(slant), slant, np.inf), axis=1)
    row = np.arange(len(best))
    return across[row, best], z[row, best]


def join(parts: Sequence[Soundings]) -> Soundings:
    """Return the soundings of all passes as one record."""
    return Soundings(
        *(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Soundings))
    )


def bilinear_rows(
    row: FloatArray, col: FloatArray, factor: FloatArray, shape: tuple[int, int]
) -> sparse.csr_matrix:
    """Return the matrix that reads `factor` times the surface at fractional (row, col)."""
    rows, cols = shape
    r0 = np.clip(np.floor(row).astype(np.int64), 0, rows - 2)
    c0 = np.clip(np.floor(col).astype(np.int64), 0, cols - 2)
    fr, fc = row - r0, col - c0
    index: list[IntArray] = []
    value: list[FloatArray] = []
    for dr, dc, weight in (
        (0, 0, (1 - fr) * (1 - fc)),
        (0, 1, (1 - fr) * fc),
        (1, 0, fr * (1 - fc)),
        (1, 1, fr * fc),
    ):
        index.append((r0 + dr) * cols + c0 + dc)
        value.append(weight * factor)
    line = np.tile(np.arange(len(row)), 4)
    return sparse.csr_matrix(
        (np.concatenate(value), (line, np.concatenate(index))), shape=(len(row), rows * cols)
    )


def learn_roughness(
    passes: Sequence[Soundings], noise_m: float, cell_m: float
) -> Spectrum:
    """Fit the precision spectrum of the sea floor to the soundings' structure function.

    Parameters
    ----------
    passes : the bottom tracks.
    noise_m : 1-sigma of the noise of a sounding that is independent from one to the next.
    """
    lines = [(p.easting_m, p.northing_m, p.up_m - p.range_m) for p in passes]
    lag, value, count = structure_function(lines, cell_m)
    value = np.maximum(value - 2 * noise_m**2, 0.02 * value + 1e-8)
    k = np.geomspace(2 * np.pi / (40 * lag[-1]), 2 * np.pi / cell_m, 400)
    # D(h) = 1/pi * integral of k P(k) (1 - J0(k h)) dk for an isotropic spectrum P.
    kernel = (1 - special.j0(np.outer(lag, k))) * k * np.gradient(k) / np.pi

    def spectrum(parameters: FloatArray) -> FloatArray:
        p0, p1, p2 = np.exp(parameters)
        return p0 + p1 * k**2 + p2 * k**4

    def misfit(parameters: FloatArray) -> FloatArray:
        model = kernel @ (1 / spectrum(parameters))
        return np.sqrt(count) * (np.log(model) - np.log(value))

    level = float(value.max())
    scale = float(lag[len(lag) // 2])
    start = np.log([1 / (level * scale**2), 1 / level, scale**2 / level])
    bounds = (start - 14, start + 14)
    fit = optimize.least_squares(misfit, start, bounds=bounds, loss="soft_l1")
    p0, p1, p2 = np.exp(fit.x)
    return Spectrum(float(p0), float(p1), float(p2))


def structure_function(
    lines: Sequence[tuple[FloatArray, FloatArray, FloatArray]], cell_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return (lag, mean squared height difference, weight) at about logarithmic lags."""
    longest = max(
        float(np.sum(np.hypot(np.diff(e), np.diff(n)))) if len(e) > 1 else 0.0 for e, n, _ in lines
    )
    top = max(0.4 * longest, 8 * cell_m)
    edges = np.geomspace(1.5 * cell_m, top, 13)
    total = np.zeros(len(edges) - 1)
    number = np.zeros(len(edges) - 1)
    for easting_m, northing_m, height_m in lines:
        good = np.isfinite(height_m)
        if good.sum() < 8:
            continue
        e, n, h = easting_m[good], northing_m[good], height_m[good]
        distance = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(e), np.diff(n)))])
        spacing = max(float(np.median(np.diff(distance))), 1e-3)
        for shift in np.unique(np.round(np.geomspace(1, max(top / spacing, 2), 80)).astype(int)):
            if shift >= len(h):
                continue
            # Straight separation, so that turns and gaps do not masquerade as along-line lags.
            lag = np.hypot(e[shift:] - e[:-shift], n[shift:] - n[:-shift])
            square = (h[shift:] - h[:-shift]) ** 2
            total += np.histogram(lag, edges, weights=square)[0]
            number += np.histogram(lag, edges)[0]
    used = number > 0
    centre = np.sqrt(edges[1:] * edges[:-1])[used]
    value = np.maximum(total[used] / number[used], 1e-8)
    # Few independent stretches at long lags: weigh a lag by how often it fits into the lines.
    return centre, value, np.minimum(longest / centre, 50.0)
