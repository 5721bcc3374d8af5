"""Whether files lie in one place: recordings of different waters are no survey, whatever their formats say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from perception.readers.raw import spread_rows
from perception.records import BoolArray, FloatArray, InputError, IntArray

# Files with so much empty sea between them make no map of one piece.
_FAR_M = 100_000.0
# Positions of a file that stand for its whole track.
_FEW = 64


def refuse_two_places(
    names: Sequence[str],
    file: IntArray,
    easting_m: FloatArray,
    northing_m: FloatArray,
    usable: BoolArray,
) -> None:
    """Refuse files of which some lie further than 100 km from all the others.

    Parameters
    ----------
    names : of the files; `file` (n,) says which of them each ping is of.
    easting_m, northing_m : (n,) in one frame; `usable` where they count.

    Raises
    ------
    InputError
        Naming a file and how far it lies from the first.
    """
    tracks = [_some(file == number, easting_m, northing_m, usable) for number in range(len(names))]
    placed = [number for number, track in enumerate(tracks) if len(track)]
    if not placed:
        return
    left, reached = set(placed[1:]), placed[:1]
    while reached:
        here = tracks[reached.pop()]
        near = [number for number in left if _apart_m(here, tracks[number]) <= _FAR_M]
        left.difference_update(near)
        reached += near
    if left:
        other = min(left)
        apart_km = _apart_m(tracks[placed[0]], tracks[other]) / 1000
        raise InputError(
            f"{names[other]} lies {apart_km:,.0f} km from {names[placed[0]]}; "
            "map surveys of different places (or UTM zones) each by itself"
        )


def _some(
    mine: BoolArray, easting_m: FloatArray, northing_m: FloatArray, usable: BoolArray
) -> FloatArray:
    """Return a few positions (k, 2) of one file."""
    rows = np.flatnonzero(mine & usable & np.isfinite(easting_m + northing_m))
    rows = rows[spread_rows(len(rows), _FEW)]
    return np.stack([easting_m[rows], northing_m[rows]], axis=1)


def _apart_m(one: FloatArray, other: FloatArray) -> float:
    """Return the least distance between two tracks."""
    return float(np.hypot(*(one[:, None] - other[None]).transpose(2, 0, 1)).min())
