"""Currents: how much water a metre of ground costs, by the direction it is passed in.

A vehicle of speed V through the water that keeps its track against a current c (as a share of V, along
the track ``c_a``, across it ``c_x``) heads into the current and makes good ``g = c_a + sqrt(1 - c_x^2)``
of V over the ground. With a current the cost's ds is the way through the water, ``ds / g``, which is V
times the time it takes: against the current it is dear, with it cheap.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.records import FloatArray, Grid

# Speed made good never falls below this share of V: the price of water that no headway is made in.
LEAST_GOOD = 0.05
# Water that runs this fast, as a share of the vehicle's speed, is barred: some headings make no headway.
STRONGEST = 0.9


@dataclass(frozen=True, slots=True)
class Currents:
    """A field of currents, the same at all depths and for the whole route.

    Attributes
    ----------
    at : function of easting and northing (n,) that returns the current (m/s) towards east and north (of
        the map's grid); zero where nothing is known.
    source : where it comes from.
    """

    at: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
    source: str = ""

    def on(self, grid: Grid) -> tuple[FloatArray, FloatArray]:
        """Return (rows, cols) currents towards east and north (m/s) at the cells' centres."""
        easting, northing = np.meshgrid(*grid.centres())
        east, north = self.at(easting.ravel(), northing.ravel())
        return east.reshape(grid.shape), north.reshape(grid.shape)


def steady(east_m_s: float, north_m_s: float) -> Currents:
    """Return the same current everywhere."""

    def at(easting_m: FloatArray, northing_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.full(easting_m.shape, east_m_s), np.full(easting_m.shape, north_m_s)

    return Currents(at, f"{east_m_s:g},{north_m_s:g}")


@njit(cache=True)
def through_water(dx, dy, ux, uy):  # type: ignore[no-untyped-def]
    """Return metres of water per metre of ground along (dx, dy) in a current (ux, uy), a share of V.

    Parameters
    ----------
    dx, dy : direction, of any length; 1 is returned for none.
    """
    length = math.hypot(dx, dy)
    if length <= 0.0 or (ux == 0.0 and uy == 0.0):
        return 1.0
    along = (ux * dx + uy * dy) / length
    across2 = ux * ux + uy * uy - along * along
    good = along + math.sqrt(max(0.0, 1.0 - across2)) if across2 < 1.0 else 0.0
    return 1.0 / max(good, LEAST_GOOD)
