"""No-go areas as barred cells."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely

from perception.records import BoolArray, Grid


def forbidden_cells(grid: Grid, polygons: list[Any]) -> BoolArray:
    """Return True at every cell that bars a route from touching the polygons.

    The polygons are widened by half a cell's diagonal: then every point of them has a barred corner
    among the four centres around it, and a route may not enter a square with a barred corner.
    """
    easting, northing = grid.centres()
    reach = 0.5 * float(np.hypot(grid.cell_m, grid.cell_north_m)) * 1.001
    forbidden = np.zeros(grid.shape, bool)
    for polygon in polygons:
        wide = shapely.buffer(polygon, reach)
        west, south, east, north = wide.bounds
        cols = np.flatnonzero((easting >= west) & (easting <= east))
        rows = np.flatnonzero((northing >= south) & (northing <= north))
        if len(cols) == 0 or len(rows) == 0:
            continue
        e, n = np.meshgrid(easting[cols], northing[rows])
        forbidden[np.ix_(rows, cols)] |= shapely.contains_xy(wide, e, n)
    return forbidden
