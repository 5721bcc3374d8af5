"""What can be one survey, and the lengths that its strips give: width of the swath, squares worth comparing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from perception.records import ElevationStrip, InputError

# Squares of fewer cells hold too little to tell one place from another.
_LEAST_CELLS = 24
# Large squares are compared on wider cells: more tell no more, and cost their square.
_MOST_CELLS = 64


def least_square_m(cell_m: float) -> float:
    """Return the width of the smallest square that is worth comparing."""
    return _LEAST_CELLS * cell_m


def square_cell_m(side_m: float, cell_m: float) -> float:
    """Return the cell on which squares `side_m` wide are compared, `cell_m` at least."""
    return max(cell_m, side_m / _MOST_CELLS)


def steady(length_m: float) -> float:
    """Return a length to two digits: a pass more must not move the lattice of all squares by a hair's breadth.

    >>> steady(95.996), steady(96.289), steady(0.4608)
    (96.0, 96.0, 0.46)
    """
    return float(f"{length_m:.2g}")


def check(strips: Sequence[ElevationStrip]) -> None:
    """Refuse strips that cannot be one survey.

    Raises
    ------
    InputError
        No strip, several coordinate systems, or places far apart.
    """
    if not strips:
        raise InputError("the survey holds no strip; was a pass of ten pings or more found?")
    names = sorted({strip.crs for strip in strips})
    if len(names) > 1:
        raise InputError(
            f"the strips lie in different coordinate systems ({', '.join(names)}); "
            "give one for all with --crs EPSG:N"
        )
    _refuse_two_places(strips)


# Surveys with so much empty sea between them make no map of one piece.
_FAR_M = 50_000.0


def _refuse_two_places(strips: Sequence[ElevationStrip]) -> None:
    """Refuse passes that lie in two places, squares of fifty kilometres having to touch."""
    squares: dict[tuple[int, int], ElevationStrip] = {}
    for strip in strips:
        for line in (0, -1):
            place = np.array([strip.easting_m[line], strip.northing_m[line]])
            if np.isfinite(place).all():
                east, north = np.floor(place / _FAR_M)
                squares.setdefault((int(east), int(north)), strip)
    left, reached = set(squares), list(squares)[:1]
    while reached:
        square = reached.pop()
        left.discard(square)
        reached += [s for s in left if max(abs(s[0] - square[0]), abs(s[1] - square[1])) <= 1]
    if left:
        first, other = next(iter(squares.values())), squares[min(left)]
        apart = np.hypot(
            first.easting_m[0] - other.easting_m[0], first.northing_m[0] - other.northing_m[0]
        )
        raise InputError(
            f"{other.source or 'a pass'} lies {apart / 1000:.0f} km from {first.source or 'the first'}"
            "; map surveys of different places (or UTM zones) each by itself"
        )


def swath_width(strips: Sequence[ElevationStrip]) -> float:
    """Return the median width of what the strips show."""
    widths = []
    for strip in strips:
        seen = (np.isfinite(strip.echo) | np.isfinite(strip.elevation_m)).any(axis=0)
        if seen.any():
            widths.append(float(np.ptp(strip.across_m[seen])))
    return max(float(np.median(widths)), 1.0) if widths else 50.0
