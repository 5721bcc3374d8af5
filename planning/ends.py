"""Start and goal: the node of the map that each stands on, or why none will do."""

from __future__ import annotations

import numpy as np

from perception.records import InputError
from planning.bars import bar_of
from planning.surface import Surface


def end_node(surface: Surface, end: tuple[float, float], name: str) -> tuple[int, int]:
    """Return the node nearest to start or goal that a route may use; say why there is none.

    Raises
    ------
    InputError
        Off the map, on no data, on land, too deep, or within a no-go area.
    """
    rows, cols = surface.shape
    x, y = surface.local(np.array(end[0]), np.array(end[1]))
    col, row = float(x) / surface.cell_m[0], float(y) / surface.cell_m[1]
    at = f"{name} {end[0]:.2f},{end[1]:.2f}"
    if not (0 <= row <= rows - 1 and 0 <= col <= cols - 1):
        west, north = surface.origin_m
        raise InputError(
            f"{at} lies off the map, whose cell centres span easting {west:.2f} to "
            f"{west + (cols - 1) * surface.cell_m[0]:.2f} and northing "
            f"{north - (rows - 1) * surface.cell_m[1]:.2f} to {north:.2f}; move it inside"
        )
    square = {
        (i, j)
        for i in (int(np.floor(row)), int(np.ceil(row)))
        for j in (int(np.floor(col)), int(np.ceil(col)))
    }
    for i, j in sorted(square):
        if surface.barred[i, j]:
            raise InputError(f"{at} {_why_barred(surface, i, j)}")
    return round(row), round(col)


def _why_barred(surface: Surface, row: int, col: int) -> str:
    bottom, lower = surface.bottom_m[row, col], surface.lower_m[row, col]
    limits = surface.limits
    return {
        "no data": "lies on or beside a cell without data; move it to mapped ground",
        "no sigma": "lies where the map has a height but no sigma; move it or give --map-sigma",
        "shallow": f"lies in rock or too shallow: the bottom at {bottom:.2f} m needs the vehicle at "
        f"{lower:.2f} m, above the water's surface; move it to deeper water",
        "deep": f"is too deep: {limits.ceiling_m:g} m above the bottom at {bottom:.2f} m is still below "
        f"depth_max_m {limits.depth_max_m:g}; raise depth_max_m or ceiling_m",
        "ceiling": f"lies where floor and k sigma need {lower - bottom:.2f} m of altitude, above the "
        f"ceiling of {limits.ceiling_m:g} m; raise ceiling_m or --risk",
        "current": "lies where the current is as strong as the vehicle; raise speed_m_s or move it",
        "no-go": "lies in a no-go area, or on an object whose height no look gives; move it out",
    }[bar_of(surface, row, col)]
