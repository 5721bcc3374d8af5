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
    """The ground of a surface held whole."""

    def __init__(self, surface: Surface) -> None:
        self.surface = surface
        self._least = np.where(surface.barred, np.nan, surface.lower_m)
        self._bottom = np.where(surface.barred, np.nan, surface.bottom_m)

    def _index(
        self, easting_m: FloatArray, northing_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        x, y = self.surface.local(easting_m, northing_m)
        return y / self.surface.cell_m[1], x / self.surface.cell_m[0]

    def at(
        self, easting_m: FloatArray, northing_m: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return least height, bottom and weight at each waypoint; NaN where barred."""
        row, col = self._index(easting_m, northing_m)
        return (
            bilinear(self._least, row, col),
            bilinear(self._bottom, row, col),
            bilinear(self.surface.stack[..., WEIGHT], row, col),
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
    """The ground of consecutive stretches of one route; neighbours share a waypoint."""

    stretches: list[slice]
    parts: list[SurfaceGround]

    def at(
        self, easting_m: FloatArray, northing_m: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return least height, bottom and weight at each waypoint; NaN where barred."""
        out = np.empty((3, len(easting_m)))
        for part, where in zip(self.parts, self.stretches, strict=True):
            out[:, where] = part.at(easting_m[where], northing_m[where])
        return out[0], out[1], out[2]

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
