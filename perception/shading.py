"""Shading: what a surface should have echoed, ray by ray, against what came back.

A ray is one line of echoes (pings close together, stacked) on one side. The surface under it is cut
into facets; each visible facet sends ``cos(incidence)^n`` times its length into the slant ranges it
covers, and facets at the same range add up (layover). The log of observed over predicted power,
averaged per cell of the map, is the datum; its derivative by the surface is taken *at fixed slant
range*, since that is where the echo was recorded:

    ln I(r) = G(phi) + T(r) + ln mu + h(t),   t = r dphi/dr = tan(grazing),
    h(t) = n ln t - (n - 1)/2 ln(1 + t^2)

with phi the ray's angle from the vertical. A height change dz at a point of ground range g, drop d
and outward slope p turns its ray by ``dz / (g - d p)``; hence the two coefficients of a datum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from perception.bands import in_threads
from perception.facets import trace_rays
from perception.rays import Rays
from perception.records import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Rows:
    """Data of the linear problem: one row per look and cell.

    Attributes
    ----------
    cell : index of the dual cell (the square between four nodes).
    c_east, c_north, c_level : derivative of the log power by the surface's gradient and height there.
    ratio : log of observed over predicted power.
    ground_m, drop_m, slope : mean geometry of the facets (g, d, p above).
    angle_rad : angle from the sonar's nadir in its rolled frame; `slant_m` the slant range.
    share : part of the echo that is the cell's own (less than 1 under layover).
    samples : number of echo samples averaged.
    side, look : where the row comes from.
    """

    cell: IntArray
    c_east: FloatArray
    c_north: FloatArray
    c_level: FloatArray
    ratio: FloatArray
    ground_m: FloatArray
    drop_m: FloatArray
    slope: FloatArray
    angle_rad: FloatArray
    slant_m: FloatArray
    share: FloatArray
    samples: FloatArray
    side: IntArray
    look: IntArray


# Columns of the weighted sums that `trace_rays` fills.
_COLUMNS = (
    "c_east", "c_north", "c_level", "ratio", "ground_m", "drop_m", "slope", "angle_rad", "slant_m",
    "share",
)  # fmt: skip
# Facets are half a cell long: shorter ones see no more of a surface that is bilinear between nodes.
_FACETS_PER_CELL = 2
# Least tangent of the grazing angle that a prediction may have: the model of power fails in grazing.
_LEAST_TANGENT = 0.02


def trace(
    surface: FloatArray,
    west_m: float,
    south_m: float,
    cell_m: float,
    rays: Sequence[Rays],
    exponent: float,
    dark: Sequence[BoolArray],
) -> tuple[Rows, BoolArray]:
    """Compare all rays' echoes with what the surface should have echoed.

    Parameters
    ----------
    surface : (rows, cols) heights of the nodes, south to north; node (0, 0) at (west_m, south_m).
    exponent : n of the angle law ``cos(incidence)^n``.
    dark : per rays (n, m) True where the sample is shadow and tells nothing of slope.

    Returns
    -------
    Rows
        One row per look and dual cell that echoed.
    (rows - 1, cols - 1) array
        True where a ray passed, lit or in shadow.
    """
    rows, cols = surface.shape
    law = np.array([exponent, cell_m / _FACETS_PER_CELL, _LEAST_TANGENT])
    frame = np.array([west_m, south_m, cell_m])

    def one(item: tuple[Rays, BoolArray]) -> tuple[dict[str, npt.NDArray[Any]], IntArray]:
        return _trace_one(surface, frame, law, *item)

    parts = in_threads(one, list(zip(rays, dark, strict=True)))
    passed = np.zeros((rows - 1) * (cols - 1), np.bool_)
    for _, crossed in parts:
        passed[crossed] = True
    columns = {
        name: np.concatenate([part[name] for part, _ in parts])
        for name in (*_COLUMNS, "cell", "samples", "side", "look")
    }
    return Rows(**columns), passed.reshape(rows - 1, cols - 1)


def _trace_one(
    surface: FloatArray, frame: FloatArray, law: FloatArray, ray: Rays, hidden: BoolArray
) -> tuple[dict[str, npt.NDArray[Any]], IntArray]:
    """Return one pass and side's columns, and the cells that its rays cross."""
    window = _window(surface.shape, frame, ray)
    weight = np.zeros(window[2] * window[3])
    sums = np.zeros((len(weight), len(_COLUMNS)))
    passed = np.zeros(len(weight), np.bool_)
    poses = np.stack(
        [ray.easting_m, ray.northing_m, ray.up_m, ray.azimuth_rad, ray.tilt_rad, ray.sample_m]
    )
    trace_rays(surface, frame, window, poses, ray.power, hidden, law, weight, sums, passed)

    def whole(place: IntArray) -> IntArray:
        row, col = np.divmod(place, window[3])
        return (row + window[0]) * (surface.shape[1] - 1) + col + window[1]

    lit = np.flatnonzero(weight > 0)
    means = (sums[lit] / weight[lit, None]).T.astype(np.float32)
    columns: dict[str, npt.NDArray[Any]] = dict(zip(_COLUMNS, means, strict=True))
    columns |= {
        "cell": whole(lit),
        "samples": weight[lit].astype(np.float32),
        "side": np.full(len(lit), ray.side, np.int8),
        "look": np.full(len(lit), ray.look, np.int16),
    }
    return columns, whole(np.flatnonzero(passed))


def _window(shape: tuple[int, ...], frame: FloatArray, ray: Rays) -> IntArray:
    """Return first row and column, rows and columns of the dual cells that the rays may reach."""
    span = []
    for start, turn, origin, cells in (
        (ray.northing_m, np.cos(ray.azimuth_rad), frame[1], shape[0] - 1),
        (ray.easting_m, np.sin(ray.azimuth_rad), frame[0], shape[1] - 1),
    ):
        ends = (np.concatenate([start, start + ray.reach_m * turn]) - origin) / frame[2]
        # A facet reaches half its length beyond the last sample.
        first = int(np.clip(np.floor(ends.min()) - 1, 0, cells))
        span.append((first, int(np.clip(np.ceil(ends.max()) + 2, first, cells)) - first))
    return np.array([span[0][0], span[1][0], span[0][1], span[1][1]])
