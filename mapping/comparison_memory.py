"""Comparisons of squares kept from one correction of a survey to the next: what has not moved is not compared again.

A comparison is a function of where its two passes lay, of the floor that placed their echoes, and of the shift
expected beforehand. When another pass has come, most of a survey lies where it lay before; a square is compared
again where one of those has changed by more than the comparison could tell. So a survey that grows pass by pass ends
as if all its passes had come at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapping.keyframes import Keyframes
from mapping.overlaps import Window
from mapping.placing import at_lines
from mapping.pose_graph import Link, Solution, perpendicular
from mapping.registration import Match
from perception.records import ElevationStrip, FloatArray, Grid

# Parts of a match's 1-sigma by which its ground may have moved before it is compared again: while a survey grows, and
# where its answer is asked for. Links are chosen by their covariances and believed by thresholds, so that a tenth of
# a metre may tip a few of them, and those move the whole by up to 0.3 of its sigma.
QUICK, SETTLED = 3.0, 0.1
# What is expected of a shift may have changed by as much (in log-likelihood at most by this), and its search's width
# by this factor.
_EXPECTED, _SEARCH = 1.0, 1.4
# The floor is looked at in so many places along each side of a square.
_LOOKS = 3


@dataclass(frozen=True, slots=True)
class _Seen:
    """Under what a square was compared, and what came of it.

    Attributes
    ----------
    ground_m : (2, 2, 2) by pass, before and after the middle, east and north: how far the ground had been moved.
    expected_m2 : (2, 2) covariance of the shift, beforehand.
    floor_m : heights of the floor that placed the echoes; None no floor.
    link : the constraint that was made of it; None not yet.
    """

    ground_m: FloatArray
    expected_m2: FloatArray
    floor_m: FloatArray | None
    match: Match
    link: Link | None = None


@dataclass(frozen=True, slots=True)
class Circumstances:
    """What the comparisons of one round are made under.

    `strips` are on the track of `solution`; `expected` (windows, 2, 2) as in `mapping.rounds.register`.
    """

    windows: Sequence[Window]
    strips: Sequence[ElevationStrip]
    keyframes: Keyframes
    solution: Solution
    expected: FloatArray
    floor: Grid | None
    cell_m: float


class ComparisonMemory:
    """The comparisons of a survey so far; `mapping.survey.correct_survey` asks it before it compares.

    Attributes
    ----------
    tolerance : in sigmas of a match, how far its ground may have moved before it is compared again. A square that did
        not match tells no sigma: a cell of the comparison stands for it.
    compared : squares compared since it was begun; what it recalled is not counted.
    """

    def __init__(self, tolerance: float = SETTLED) -> None:
        self.tolerance = tolerance
        self.compared = 0
        self._seen: dict[tuple[float, ...], _Seen] = {}
        self._now: list[_Seen] = []
        self._keyframes: Keyframes | None = None

    def recall(self, given: Circumstances) -> dict[int, Match]:
        """Return the matches that hold still, by the number of their window, at the passes' present places."""
        self._use(given.keyframes)
        self._now = _states(given)
        found = {}
        for number, (window, now) in enumerate(zip(given.windows, self._now, strict=True)):
            then = self._seen.get(_key(window, given.cell_m))
            if then is not None and _unchanged(then, now, given.cell_m, self.tolerance):
                found[number] = _carried(then, now)
        return found

    def _use(self, keyframes: Keyframes) -> None:
        """Forget the constraints, which name keyframes by number, where earlier passes are cut otherwise now."""
        if self._keyframes is not None and not self._keyframes.cut_alike(keyframes):
            self._seen = {key: replace(seen, link=None) for key, seen in self._seen.items()}
        self._keyframes = keyframes

    def keep(
        self,
        given: Circumstances,
        recalled: dict[int, Match],
        matches: Sequence[Match],
    ) -> None:
        """Keep the comparisons that were made under the same circumstances as `recall` was asked."""
        for number, (window, now) in enumerate(zip(given.windows, self._now, strict=True)):
            if number not in recalled:
                self.compared += 1
                self._seen[_key(window, given.cell_m)] = replace(now, match=matches[number])

    def link(self, window: Window, cell_m: float, make: Callable[[], Link]) -> Link:
        """Return the constraint kept with a comparison, made now where it was compared anew."""
        key = _key(window, cell_m)
        known = self._seen[key].link
        if known is None:
            known = make()
            self._seen[key] = replace(self._seen[key], link=known)
        return known


_NONE = Match(np.zeros(2), np.full((2, 2), np.nan), 0.0, 0.0, {}, -np.inf, False, "")


def _key(window: Window, cell_m: float) -> tuple[float, ...]:
    return (
        window.first, window.second, window.easting_m, window.northing_m, window.side_m, cell_m
    )  # fmt: skip


def _states(given: Circumstances) -> list[_Seen]:
    """Return the circumstances of each window, without a match."""
    moved = []
    for index, strip in enumerate(given.strips):
        correction = at_lines(strip, index, given.keyframes, given.solution.correction_m)
        turn = given.solution.pass_errors[index, 2]
        place = np.column_stack([strip.easting_m, strip.northing_m])
        moved.append((correction, strip.step_m, turn, place))
    out = []
    for window, expected in zip(given.windows, given.expected, strict=True):
        ground = np.empty((2, 2, 2))
        ends = ((window.first, window.first_line), (window.second, window.second_line))
        for number, (index, line) in enumerate(ends):
            correction, step, turn, place = moved[index]
            reach = 0.25 * window.side_m / step
            lines = np.clip(np.round([line - reach, line + reach]), 0, len(place) - 1).astype(int)
            centre = np.array([window.easting_m, window.northing_m])
            ground[number] = correction[lines] + turn * perpendicular(
                centre - place[lines].mean(axis=0)
            )
        out.append(_Seen(ground, np.asarray(expected), _heights(given.floor, window), _NONE))
    return out


def _heights(floor: Grid | None, window: Window) -> FloatArray | None:
    """Return the floor's heights over a window, as they stand in its nearest cells; NaN where it has none."""
    if floor is None:
        return None
    aside = window.side_m * (np.arange(_LOOKS) - 0.5 * (_LOOKS - 1)) / _LOOKS
    east, north = np.meshgrid(window.easting_m + aside, window.northing_m + aside)
    row, col = (np.round(v).astype(int) for v in floor.fractional_index(east, north))
    rows, cols = floor.elevation_m.shape
    inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    height = np.full(row.shape, np.nan)
    height[inside] = floor.elevation_m[row[inside], col[inside]]
    return height


def _unchanged(then: _Seen, now: _Seen, cell_m: float, tolerance: float) -> bool:
    """Return whether a comparison made `then` would come out the same `now`, as far as it can tell."""
    wide_then, wide_now = (float(np.linalg.eigvalsh(s.expected_m2)[-1]) ** 0.5 for s in (then, now))
    search = min(_SEARCH, 1.0 + tolerance)
    if not 1.0 / search <= wide_now / wide_then <= search:
        return False
    match = then.match
    known = match.accepted and bool(np.isfinite(match.covariance_m2).all())
    sigma_m = float(np.trace(match.covariance_m2)) ** 0.5 if known else cell_m
    least_m = tolerance * sigma_m
    move = now.ground_m - then.ground_m
    # The square holds the first pass's ground; the second is looked for about it.
    if np.hypot(*move[0].T).max() > tolerance * max(sigma_m, cell_m):
        return False
    apart = move[1] - move[0]
    bend_m, shift_m = np.hypot(*(apart[1] - apart[0])), np.hypot(*apart.mean(axis=0))
    if bend_m > least_m or not _same_floor(then, now, least_m):
        return False
    if not known:
        return bool(shift_m < least_m)
    # Where a match was found it would be found again; what was expected had a say in choosing it.
    before, after = (_cost(m.shift_m, s) for m, s in ((match, then), (_carried(then, now), now)))
    return abs(after - before) < min(_EXPECTED, tolerance)


def _same_floor(then: _Seen, now: _Seen, least_m: float) -> bool:
    """Return whether the floor moves no echo by `least_m`; beside the nadir it moves one by its own change at most."""
    if then.floor_m is None or now.floor_m is None:
        return then.floor_m is now.floor_m
    change = np.abs(now.floor_m - then.floor_m)
    known = np.isfinite(change)
    return not known.any() or float(change[known].mean()) < least_m


def _cost(shift_m: FloatArray, state: _Seen) -> float:
    return 0.5 * float(shift_m @ np.linalg.solve(state.expected_m2, shift_m))


def _carried(then: _Seen, now: _Seen) -> Match:
    """Return a match as it would be found with the passes where they are now."""
    apart = [s.ground_m[1].mean(axis=0) - s.ground_m[0].mean(axis=0) for s in (then, now)]
    return replace(then.match, shift_m=then.match.shift_m + apart[1] - apart[0])
