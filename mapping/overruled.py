"""Least heights that other passes overrule: an open shadow at one swath's edge, and plain ground to all who saw it well.

At a swath's end the echo fades, and what fades may be taken for a shadow that runs out of the record. Nothing but
a least height is known of such a hill, so planning bars its ground. Where other passes heard that ground clearly, and
the map of all shows no such rise, the hill is not there. A true boulder is kept: by a look of another pass, by
the bump it leaves on the map, and, where it is narrower than the map resolves, in any case.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapping.flag_layer import mostly_clear, rows_of, vote
from mapping.gridding import Window
from mapping.objects import MergedObjects
from mapping.placed import PlacedStrip, boxes, placed
from perception.records import BoolArray, ElevationStrip, Grid, IntArray

# So many passes must have seen the footprint clearly, in so much of its cells: two against one.
_PASSES, _SEEN = 2, 0.7
# A footprint's least radius, in cells, that a map cannot smooth away.
_RESOLVED = 2.0
# A map leaves at least so much of the height of what it resolves, and must be as sure of its heights.
_LEFT = 0.5
# Width of the ring, outside the footprint and its uncertain place, that gives the floor. [m]
_RING_M = 4.0
# So much of the ground asked for must be mapped.
_MAPPED = 0.9


def overruled(
    objects: MergedObjects, owner: IntArray, grid: Grid, strips: Sequence[ElevationStrip]
) -> BoolArray:
    """Return which objects (n,) other passes overrule.

    Parameters
    ----------
    owner : (looks,) the strip that each look, `objects.look`, is of.
    grid : the map; without a sigma it overrules nothing.
    strips : the passes on the map, with flags; those without have no say.
    """
    out = np.zeros(len(objects), bool)
    if grid.sigma_m is None:
        return out
    hill = np.array([kind == "hill" for kind in objects.kind], dtype=bool)
    wide = np.nan_to_num(objects.radius_m) >= _RESOLVED * max(grid.cell_m, grid.cell_north_m)
    asked = np.flatnonzero(hill & wide & objects.least & (objects.passes == 1))
    asked = asked[[_plain(grid, objects, int(k)) for k in asked]] if len(asked) else asked
    if not len(asked):
        return out
    own = {int(k): int(owner[objects.look == k][0]) for k in asked}
    clear = np.zeros(len(objects), int)
    for number, strip in enumerate(strips):
        if strip.flags is None:
            continue
        one = placed(strip)
        blocks = boxes(one, grid.cell_m)
        for k in asked:
            if own[int(k)] != number:
                place = objects.easting_m[k], objects.northing_m[k], objects.radius_m[k]
                clear[k] += _saw(strip, one, blocks, grid.cell_m, place)
    out[asked] = clear[asked] >= _PASSES
    return out


def _plain(grid: Grid, objects: MergedObjects, k: int) -> bool:
    """Tell whether the map, sure enough of it, shows nothing like the least height where the object may stand."""
    assert grid.sigma_m is not None
    reach = float(objects.radius_m[k] + objects.position_sigma_m[k])
    east, north = grid.centres()
    east, north = east - objects.easting_m[k], north - objects.northing_m[k]
    far = reach + grid.cell_m + _RING_M
    rows, cols = np.flatnonzero(np.abs(north) <= far), np.flatnonzero(np.abs(east) <= far)
    if not (len(rows) and len(cols)):
        return False
    part = np.ix_(rows, cols)
    x, y = np.meshgrid(east[cols], north[rows])
    away, height, sigma = np.hypot(x, y), grid.elevation_m[part], grid.sigma_m[part]
    inside, known = away <= reach, np.isfinite(height) & np.isfinite(sigma)
    ring = (away > reach + grid.cell_m) & (away <= far)
    if not inside.any() or min(known[inside].mean(), known[ring].mean()) < _MAPPED:
        return False
    terms = np.column_stack([np.ones(x.size), x.ravel(), y.ravel()])
    floor = (ring & known).ravel()
    plane = np.linalg.lstsq(terms[floor], height.ravel()[floor], rcond=None)[0]
    rise = height - (terms @ plane).reshape(height.shape)
    inside &= known
    most = _LEFT * objects.height_m[k]
    return bool(rise[inside].max() < most and np.median(sigma[inside]) < most)


def _saw(
    strip: ElevationStrip, one: PlacedStrip, blocks: Sequence[tuple[int, int, Window]], cell_m: float,
    place: tuple[float, float, float],
) -> bool:  # fmt: skip
    """Tell whether a pass heard a disc (east, north, radius) clearly: neither folded nor in shadow."""
    east, north, radius = place
    row, col = (int(np.floor((c - radius) / cell_m)) for c in (north, east))
    side = int(np.ceil(2 * radius / cell_m)) + 1
    window = Window(row, col, side, side)
    votes = vote(one, rows_of(strip), blocks, cell_m, window)
    away = np.hypot(
        (col + np.arange(side) + 0.5) * cell_m - east,
        ((row + np.arange(side) + 0.5) * cell_m - north)[:, None],
    )
    return bool(mostly_clear(votes)[away <= radius].mean() >= _SEEN)
