"""What a proof asks of the ground: heights at waypoints, exact extremes along segments.

One answer holds a whole surface; the other holds only windows along a route, for maps too large to
hold. Both answer over the raster as stored, bilinear between cell centres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from perception.records import FloatArray, bilinear
from planning.clearance import Extremes, polyline_extremes
from planning.surface import WEIGHT, Surface


class Ground(Protocol):
    """Heights and extremes below a path given by (easting, northing)."""

    def at(
        self, easting_m: FloatArray, northing_m: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return least height, bottom and weight at each waypoint; NaN where barred."""
        ...

    def extremes(
        self, easting_m: FloatArray, northing_m: FloatArray, z: FloatArray
    ) -> tuple[Extremes, Extremes]:
        """Return extremes of height over the least height, and over the bottom."""
        ...


class SurfaceGround:
    """The ground of a surface held whole, or of a window: of it only the two heights are kept."""

    def __init__(self, surface: Surface, weighted: bool = True) -> None:
        self._origin_m, self._cell_m = surface.origin_m, surface.cell_m
        self._least = np.where(surface.barred, np.nan, surface.lower_m)
        self._bottom = np.where(surface.barred, np.nan, surface.bottom_m)
        self._weight = surface.stack[..., WEIGHT] if weighted else None

    def _index(
        self, easting_m: FloatArray, northing_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        row = (self._origin_m[1] - np.asarray(northing_m, float)) / self._cell_m[1]
        return row, (np.asarray(easting_m, float) - self._origin_m[0]) / self._cell_m[0]

    def at(
        self, easting_m: FloatArray, northing_m: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return least height, bottom and weight at each waypoint; NaN where barred."""
        row, col = self._index(easting_m, northing_m)
        return (
            bilinear(self._least, row, col),
            bilinear(self._bottom, row, col),
            np.ones(row.shape) if self._weight is None else bilinear(self._weight, row, col),
        )

    def extremes(
        self, easting_m: FloatArray, northing_m: FloatArray, z: FloatArray
    ) -> tuple[Extremes, Extremes]:
        """Return extremes of height over the least height, and over the bottom."""
        row, col = self._index(easting_m, northing_m)
        return (
            polyline_extremes(self._least, row, col, z),
            polyline_extremes(self._bottom, row, col, z),
        )


@dataclass(frozen=True, slots=True)
class WindowedGround:
    """The ground of consecutive stretches of one route; neighbours share a waypoint.

    Attributes
    ----------
    weights : the ground whose weights count: windows have none of their own.
    """

    stretches: list[slice]
    parts: list[SurfaceGround]
    weights: SurfaceGround

    def at(
        self, easting_m: FloatArray, northing_m: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return least height, bottom and weight at each waypoint; NaN where barred."""
        least, bottom = (np.empty(len(easting_m)) for _ in range(2))
        for part, where in zip(self.parts, self.stretches, strict=True):
            least[where], bottom[where], _ = part.at(easting_m[where], northing_m[where])
        weight = self.weights.at(easting_m, northing_m)[2]
        return least, bottom, np.where(np.isfinite(weight), weight, 1.0)

    def extremes(
        self, easting_m: FloatArray, northing_m: FloatArray, z: FloatArray
    ) -> tuple[Extremes, Extremes]:
        """Return extremes of height over the least height, and over the bottom."""
        found = [
            part.extremes(easting_m[where], northing_m[where], z[where])
            for part, where in zip(self.parts, self.stretches, strict=True)
        ]
        return _chain([f[0] for f in found]), _chain([f[1] for f in found])


def _chain(parts: list[Extremes]) -> Extremes:
    return Extremes(
        np.concatenate([p.least_m for p in parts]),
        np.concatenate([p.greatest_m for p in parts]),
        np.concatenate([p.least_at for p in parts]),
        np.concatenate([p.greatest_at for p in parts]),
    )
