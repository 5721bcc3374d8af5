"""Soundings: what the bottom track says of the surface.

The first return comes from the *nearest* point of the sea floor in the ping's plane, not from below
the sonar; a sounding therefore is an equation on the surface's nearest point, found anew whenever
the surface changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy import sparse

from perception.rays import Soundings
from perception.records import FloatArray, IntArray, bilinear


@dataclass(frozen=True, slots=True)
class Equations:
    """Linear equations ``matrix @ heights = value`` with weight 1 / sigma^2 each."""

    matrix: sparse.csr_matrix
    weight: FloatArray
    value: FloatArray


def both(first: Equations, second: Equations) -> Equations:
    """Return two sets of equations as one."""
    return Equations(
        sparse.csr_matrix(sparse.vstack([first.matrix, second.matrix])),
        np.concatenate([first.weight, second.weight]),
        np.concatenate([first.value, second.value]),
    )


# The floor's nearest point is searched within this part of the range to either side: a slope of 35
# degrees.
_REACH = 0.7


def sounding_equations(
    surface: FloatArray,
    west_m: float,
    south_m: float,
    cell_m: float,
    bottom: Soundings,
    below: bool = False,
    lead_m: FloatArray | float = 0.0,
    lead_sigma_m: float = 0.0,
) -> Equations:
    """Return the bottom track as equations on the surface.

    The slant range to the surface's nearest point equals the first return. With `below` the point is
    taken below the sonar, as a surface not yet known is. `lead_m` and `lead_sigma_m` tell by how
    much the first return precedes that of the smooth surface, see `perception.first_return`.
    """
    if below:
        across: FloatArray = np.zeros(len(bottom.range_m))
        height: FloatArray = bottom.up_m - bottom.range_m
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
    return Equations(
        matrix,
        1 / (bottom.sigma_m**2 + lead_sigma_m**2),
        bottom.range_m + lead_m - slant + factor * height,
    )


# Soundings of this length of track share one mean. A bottom track is early or late by centimetres throughout,
# beside what its first returns lead.
_MEAN_LENGTH_M = 150.0
_MEAN_SIGMA_M = 0.03


def mean_soundings(found: Equations, bottom: Soundings, lead_m: float = 0.0) -> Equations:
    """Return the means of sounding equations over stretches of track, to be held firmly.

    A sounding alone is uncertain by what first returns lead; their mean is so by half of that lead, which is learned
    of a random floor. What is left of it echoes of one feature from two sides settle.
    """
    step = np.hypot(np.diff(bottom.easting_m), np.diff(bottom.northing_m))
    usual = float(np.median(step)) if len(step) else 1.0
    apart = step > 10 * max(usual, 1e-6)
    along = np.concatenate([[0.0], np.cumsum(np.where(apart, 0.0, step))])
    line = np.concatenate([[0], np.cumsum(apart)])
    start = np.array([along[line == k].min() for k in range(line[-1] + 1)])
    length = np.array([np.ptp(along[line == k]) for k in range(line[-1] + 1)])
    parts = np.maximum(np.rint(length / _MEAN_LENGTH_M), 1).astype(np.int64)
    within = (along - start[line]) / np.maximum(length[line], 1e-9) * parts[line]
    stretch = np.minimum(within.astype(np.int64), parts[line] - 1)
    group = np.concatenate([[0], np.cumsum(parts)])[line] + stretch
    number = np.bincount(group)
    mean = sparse.csr_matrix(
        (1.0 / number[group], (group, np.arange(len(group)))), shape=(len(number), len(group))
    )
    matrix = sparse.csr_matrix(mean @ found.matrix)
    variance = _MEAN_SIGMA_M**2 + (0.5 * lead_m) ** 2
    return Equations(matrix, np.full(len(number), 1 / variance), mean @ found.value)


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
