"""Which comparisons are worth making, which of their results to believe, and which of those go into the graph."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from mapping.overlaps import Window
from mapping.pose_graph import Link
from mapping.registration import Match
from perception.records import ElevationStrip, FloatArray

# Small surveys compare every square; large ones, in the last round, about one in two keyframes: twice as many
# would narrow the track by a few per cent only (docs/pose-graph.md).
_ALL_SQUARES = 2000
# However many squares match, so much evidence (log-likelihood ratio) is asked of each: the most that can be let off.
_MOST_RELIEF = 3.0
# Pairs of passes are kept apart by more than any survey is wide.
_APART_M = 1e9


def enough(
    windows: Sequence[Window], wanted: int, before: Sequence[tuple[Window, Match]] = ()
) -> list[Window]:
    """Return the windows that are worth their time: all of a small survey's, the promising ones of a large one's.

    Of each group of neighbours in the windows' order one is taken, so that the choice is spread evenly.

    Parameters
    ----------
    before : comparisons of an earlier round. The one of a group is taken for which the same two passes had most
        in common nearby; without them the middle one.
    """
    most = max(_ALL_SQUARES, wanted)
    if len(windows) <= most:
        return list(windows)
    edges = np.linspace(0, len(windows), most + 1).round().astype(int)
    groups = np.split(np.arange(len(windows)), edges[1:-1])
    promise = _promise(windows, before)
    if promise is None:
        return [windows[g[len(g) // 2]] for g in groups]
    return [windows[g[np.argmax(promise[g])]] for g in groups]


def _promise(
    windows: Sequence[Window], before: Sequence[tuple[Window, Match]]
) -> FloatArray | None:
    """Return the evidence per area that the same two passes had nearest to each window; 0 where none."""
    if not before:
        return None
    pairs = {(w.first, w.second) for w, _ in before} | {(w.first, w.second) for w in windows}
    number = {pair: i for i, pair in enumerate(sorted(pairs))}

    def places(chosen: Sequence[Window]) -> FloatArray:
        return np.array(
            [(_APART_M * number[w.first, w.second], w.easting_m, w.northing_m) for w in chosen]
        )

    density = np.array([m.evidence / w.side_m**2 for w, m in before])
    distance, index = cKDTree(places([w for w, _ in before])).query(places(windows))
    return np.where(distance < 0.5 * _APART_M, density[index], 0.0)


def without(
    windows: Sequence[Window], held: Sequence[Window], strips: Sequence[ElevationStrip]
) -> list[Window]:
    """Return the windows of which no held one shows the same two passes at nearly the same lines.

    Half a square along both tracks counts as the same, wherever the tracks have been moved in between.
    """
    if not held:
        return list(windows)
    step_m = [strip.step_m for strip in strips]
    pairs = {(w.first, w.second) for w in (*held, *windows)}
    number = {pair: i for i, pair in enumerate(sorted(pairs))}

    def lines(chosen: Sequence[Window]) -> FloatArray:
        return np.array(
            [
                (
                    _APART_M * number[w.first, w.second],
                    w.first_line * step_m[w.first],
                    w.second_line * step_m[w.second],
                )
                for w in chosen
            ]
        ).reshape(-1, 3)

    distance, _ = cKDTree(lines(held)).query(lines(windows), p=np.inf)
    return [w for w, d in zip(windows, distance, strict=True) if d > 0.5 * w.side_m]


def believed(matches: Sequence[Match]) -> list[Match]:
    """Return the matches of a round, those accepted too that fall short by less than the round itself makes up for.

    The evidence that is asked of a match by itself is that against chance on ground of which nothing is known.
    Where a part p of the squares matches anyhow, the odds beforehand are p / (1 - p), and that much less
    is needed for the same odds afterwards; where hardly any matches, nothing is let off.
    """
    if not matches:
        return []
    share = sum(m.accepted for m in matches) / len(matches)
    odds = float(np.log(share / (1.0 - share))) if 0.0 < share < 1.0 else np.inf * (share - 0.5)
    relief = float(np.clip(_MOST_RELIEF + odds, 0.0, _MOST_RELIEF))
    return [
        replace(m, accepted=True, reason="") if not m.accepted and m.spare >= -relief else m
        for m in matches
    ]


def apart(pool: Sequence[tuple[Window, Link]]) -> list[tuple[Window, Link]]:
    """Return registrations of which no two are of the same ground and passes, the best known ones first.

    Squares of several widths over one place see the same echoes: both together would count them twice. A wide
    square holds more and bends more with the drift; which of the two tells more, their covariances say.
    """
    return [pool[i] for i in apart_numbers(pool)]


def apart_numbers(pool: Sequence[tuple[Window, Link]]) -> list[int]:
    """Return which registrations `apart` returns, by their place in the pool."""
    kept: dict[tuple[int, int], list[Window]] = defaultdict(list)
    chosen = []
    order = sorted(range(len(pool)), key=lambda i: float(np.trace(pool[i][1].covariance_m2)))
    for index in order:
        window, _ = pool[index]
        there = kept[window.first, window.second]
        if not any(_overlap(window, other) for other in there):
            there.append(window)
            chosen.append(index)
    return sorted(chosen)


def _overlap(one: Window, other: Window) -> bool:
    reach = 0.5 * (one.side_m + other.side_m)
    east, north = one.easting_m - other.easting_m, one.northing_m - other.northing_m
    # Neighbours on one lattice touch, and rounding must not make them overlap.
    return max(abs(east), abs(north)) < reach - 1e-6
