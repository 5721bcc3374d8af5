"""A patch placed by the constellation of its hills and hollows, its heading unknown, on a compact map.

The prior map is reduced to landmarks: the peaks and pits of its H-K region map (`localization.landmarks`),
eight bytes each, half a hundredth of the raster or less. A patch of sea floor is segmented at the same scale,
and its landmarks are looked for in the map's:

    pairs of landmarks alike in kind and distance vote for a turn and a shift
    the places with most votes are verified landmark by landmark, and refined by least squares
    a place is scored by the log likelihood ratio of its landmarks against landmarks strewn at random

A landmark that the patch shows and the map lacks costs something, not everything; where the patch
has a hole, or the map ends, nothing is expected. Distinct places are all kept as hypotheses; the
best is accepted when it beats chance over all places tried, and the second by as much as proves it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from localization.landmarks import KINDS, Landmarks
from perception.records import BoolArray, FloatArray, IntArray

# 1-sigma of a landmark's place, in smoothing scales, and of the logarithms of strength and size; from
# landmarks of noisy patches against the map's own (docs/terrain-navigation.md).
_PLACE_SCALES, _STRENGTH_SIGMA, _SIZE_SIGMA = 0.35, 0.35, 0.5
# Probability that a landmark of the patch is not in the map: noise makes some and merges others.
_MISSED = 0.3
# A pair votes if its landmarks are so far apart, in scales: nearer, its direction is uncertain.
_NEAREST_SCALES, _FARTHEST_SCALES = 3.0, 25.0
# Landmarks of a patch that vote, the strongest: the others join in the verification.
_VOTERS = 16
# Cells of the vote: degrees of turn, and scales of shift.
_TURN_BIN_RAD, _SHIFT_BIN_SCALES = float(np.radians(6.0)), 1.5
# Places verified, and hypotheses kept.
_VERIFIED, _KEPT = 60, 6
# Log likelihood ratio of the best place to the next that proves it, and of the best to chance beyond
# the logarithm of the number of places that could be told apart. Hills keep their distance from one
# another, so chance matches more of them than of points strewn at random: a margin beyond e^5 for it.
_DISTINCT, _CHANCE = 8.0, 8.0


@dataclass(frozen=True, slots=True)
class Placement:
    """One place where a patch's landmarks may belong.

    `easting_m`, `northing_m` is where the origin of the patch's coordinates lies; `turn_rad` turns its
    axes clockwise to the map's; `score` is the log likelihood ratio against chance; `matched` counts
    landmarks found; `covariance` (3, 3) is of easting, northing and turn.
    """

    easting_m: float
    northing_m: float
    turn_rad: float
    score: float
    matched: int
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class ConstellationMatch:
    """Hypotheses, best first; whether the best may be used, and why; by how much it passed the narrower bar."""

    hypotheses: tuple[Placement, ...]
    accepted: bool
    reason: str
    surplus: float = 0.0


class Constellation:
    """Landmarks of a prior map, ready to be searched.

    Parameters
    ----------
    marks : the map's landmarks.
    """

    def __init__(self, marks: Landmarks) -> None:
        self.marks = marks
        self.places = np.stack([marks.easting_m, marks.northing_m], axis=1)
        self.trees = {k: cKDTree(self.places[marks.kind == k]) for k in KINDS}
        self.of_kind = {k: np.flatnonzero(marks.kind == k) for k in KINDS}
        tree = cKDTree(self.places) if len(marks) else None
        reach = _FARTHEST_SCALES * marks.scale_m
        pairs = np.zeros((0, 2), int) if tree is None else tree.query_pairs(reach, output_type="ndarray")  # fmt: skip
        pairs = np.concatenate([pairs, pairs[:, ::-1]])
        apart = self.places[pairs[:, 1]] - self.places[pairs[:, 0]]
        distance = np.hypot(*apart.T)
        far = distance > _NEAREST_SCALES * marks.scale_m
        self.pairs, self.distance = pairs[far], distance[far]
        self.azimuth = np.arctan2(apart[far, 0], apart[far, 1])
        # Sorted by kind of both and distance: a pair's partners are one slice.
        code = self._code(marks.kind[self.pairs])
        order = np.lexsort((self.distance, code))
        self.pairs, self.distance, self.azimuth = (
            self.pairs[order], self.distance[order], self.azimuth[order],
        )  # fmt: skip
        self.key = code[order] * 1e7 + self.distance

    @staticmethod
    def _code(kinds: IntArray) -> IntArray:
        return np.asarray(kinds[:, 0] * 16 + kinds[:, 1])

    def match(
        self, patch: Landmarks, turn_rad: float | None = None, turn_sigma_rad: float = 0.02
    ) -> ConstellationMatch:
        """Place a patch's landmarks, given in the patch's own axes.

        Parameters
        ----------
        turn_rad, turn_sigma_rad : the patch's turn and its 1-sigma where it is known.
        """
        if len(patch) < 3 or len(self.marks) < 3:
            reason = f"too few landmarks: {len(patch)} in the patch, 3 needed"
            return ConstellationMatch((), False, reason)
        turn, shift = self._votes(patch, turn_rad, turn_sigma_rad)
        found = [self._verify(patch, t, s) for t, s in self._peaks(turn, shift, patch)]
        found.sort(key=lambda p: -p.score)
        kept = self._distinct(found, patch.scale_m)[:_KEPT]
        return self._judge(kept, patch, turn_rad is None)

    def _votes(
        self, patch: Landmarks, turn_rad: float | None, turn_sigma_rad: float
    ) -> tuple[FloatArray, FloatArray]:
        """Turns (n,) and shifts (n, 2) that pairs alike propose."""
        at = np.stack([patch.easting_m, patch.northing_m], axis=1)
        strong = np.argsort(-patch.strength_per_m * patch.size_m)[:_VOTERS]
        i, j = (strong[k] for k in np.triu_indices(len(strong), 1))
        apart = at[j] - at[i]
        distance = np.hypot(*apart.T)
        scale = patch.scale_m
        use = (distance > _NEAREST_SCALES * scale) & (distance < _FARTHEST_SCALES * scale)
        i, j, distance, apart = i[use], j[use], distance[use], apart[use]
        code = self._code(np.stack([patch.kind[i], patch.kind[j]], axis=1)) * 1e7
        # Two places of 0.35 scales each.
        slack = 2.0 * np.sqrt(2) * _PLACE_SCALES * scale
        first = np.searchsorted(self.key, code + np.maximum(distance - slack, 0))
        last = np.searchsorted(self.key, code + distance + slack)
        number = last - first
        mine = np.repeat(np.arange(len(i)), number)
        theirs = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number) + np.repeat(first, number)  # fmt: skip
        alike = self._alike(patch, i[mine], self.pairs[theirs, 0])
        alike &= self._alike(patch, j[mine], self.pairs[theirs, 1])
        mine, theirs = mine[alike], theirs[alike]
        turn = self.azimuth[theirs] - np.arctan2(apart[mine, 0], apart[mine, 1])
        turn = (turn + np.pi) % (2 * np.pi) - np.pi
        if turn_rad is not None:
            off = (turn - turn_rad + np.pi) % (2 * np.pi) - np.pi
            # A pair's direction errs by its places over its length.
            near = np.abs(off) < 3 * turn_sigma_rad + slack / distance[mine]
            mine, theirs = mine[near], theirs[near]
            turn = np.full(len(mine), turn_rad)
        middle = 0.5 * (at[i[mine]] + at[j[mine]])
        target = 0.5 * (self.places[self.pairs[theirs, 0]] + self.places[self.pairs[theirs, 1]])
        return turn, target - turned(middle, turn)

    def _alike(self, patch: Landmarks, mine: IntArray, theirs: IntArray) -> BoolArray:
        strength = np.log(patch.strength_per_m[mine] / self.marks.strength_per_m[theirs])
        size = np.log(patch.size_m[mine] / self.marks.size_m[theirs])
        square = (strength / _STRENGTH_SIGMA) ** 2 + (size / _SIZE_SIGMA) ** 2
        return np.asarray(square < 9.0)

    def _peaks(
        self, turn: FloatArray, shift: FloatArray, patch: Landmarks
    ) -> list[tuple[float, FloatArray]]:
        """The cells of turn and shift with most votes, neighbours counted."""
        if not len(turn):
            return []
        size = _SHIFT_BIN_SCALES * patch.scale_m
        turns = max(round(2 * np.pi / _TURN_BIN_RAD), 1)
        bins = np.stack(
            [
                np.round((turn + np.pi) / (2 * np.pi) * turns).astype(np.int64) % turns,
                *(np.round((shift - shift.min(axis=0)) / size).astype(np.int64).T + 1),
            ]
        )
        span = bins[2].max() + 3
        flat = (bins[0] * (bins[1].max() + 3) + bins[1]) * span + bins[2]
        cells, inverse, count = np.unique(flat, return_inverse=True, return_counts=True)
        around = count.astype(float)
        for step in (1, -1, span, -span):
            at = np.searchsorted(cells, cells + step)
            at = np.minimum(at, len(cells) - 1)
            around += 0.5 * np.where(cells[at] == cells + step, count[at], 0)
        best = np.argsort(-around)[:_VERIFIED]
        out = []
        for cell in best:
            rows = np.flatnonzero(inverse == cell)
            heading = float(np.angle(np.mean(np.exp(1j * turn[rows]))))
            out.append((heading, np.median(shift[rows], axis=0)))
        return out

    def _verify(self, patch: Landmarks, turn: float, shift: FloatArray) -> Placement:
        """Match landmark by landmark, refine by least squares, score."""
        at = np.stack([patch.easting_m, patch.northing_m], axis=1)
        sigma = _PLACE_SCALES * patch.scale_m
        for reach in (4.0, 3.0, 3.0):
            there = turned(at, np.full(len(at), turn)) + shift
            partner, distance = self._nearest(there, patch.kind)
            on = distance < reach * sigma
            if on.sum() < 3:
                break
            turn, shift = _rigid(at[on], self.places[partner[on]])
        there = turned(at, np.full(len(at), turn)) + shift
        partner, distance = self._nearest(there, patch.kind)
        score, on = self._score(patch, there, partner, distance)
        covariance = _rigid_covariance(at[on], turn, sigma)
        return Placement(
            float(shift[0]), float(shift[1]), float(turn % (2 * np.pi)), score, int(on.sum()),
            covariance,
        )  # fmt: skip

    def _nearest(self, places: FloatArray, kind: IntArray) -> tuple[IntArray, FloatArray]:
        partner = np.zeros(len(places), np.int64)
        distance = np.full(len(places), np.inf)
        for k in KINDS:
            rows = np.flatnonzero(kind == k)
            if len(rows) and len(self.of_kind[k]):
                distance[rows], nearest = self.trees[k].query(places[rows])
                partner[rows] = self.of_kind[k][nearest]
        return partner, distance

    def _score(
        self, patch: Landmarks, there: FloatArray, partner: IntArray, distance: FloatArray
    ) -> tuple[float, BoolArray]:
        """Log likelihood ratio against landmarks strewn at random, and which are found.

        A found landmark is Gaussian about its partner in place, strength and size; strewn ones have
        the map's density in place, and the map's own spread in strength and size.
        """
        marks, sigma = self.marks, _PLACE_SCALES * patch.scale_m
        total = 0.0
        found = np.zeros(len(there), bool)
        low, high = self.places.min(axis=0), self.places.max(axis=0)
        for k in KINDS:
            rows = np.flatnonzero(
                (patch.kind == k) & np.all((there > low) & (there < high), axis=1)
            )
            if not len(rows) or not len(self.of_kind[k]):
                continue
            density = len(self.of_kind[k]) / marks.area_m2
            mates = partner[rows]
            log = -np.log(2 * np.pi * sigma**2 * density) - 0.5 * (distance[rows] / sigma) ** 2
            for name, spread in (("strength_per_m", _STRENGTH_SIGMA), ("size_m", _SIZE_SIGMA)):
                ours, theirs = np.log(getattr(patch, name)[rows]), np.log(getattr(marks, name))
                mean, width = theirs[self.of_kind[k]].mean(), theirs[self.of_kind[k]].std() + spread
                log += np.log(width / spread) - 0.5 * ((ours - theirs[mates]) / spread) ** 2
                log += 0.5 * ((ours - mean) / width) ** 2
            gain = np.logaddexp(np.log(_MISSED), np.log(1 - _MISSED) + log)
            total += float(gain.sum())
            found[rows] = log > 0
        return total, found

    def _distinct(self, found: list[Placement], scale_m: float) -> list[Placement]:
        kept: list[Placement] = []
        for p in found:
            if all(
                np.hypot(p.easting_m - k.easting_m, p.northing_m - k.northing_m) > 4 * scale_m
                or abs((p.turn_rad - k.turn_rad + np.pi) % (2 * np.pi) - np.pi) > np.radians(15)
                for k in kept
            ):
                kept.append(p)
        return kept

    def _judge(
        self, kept: list[Placement], patch: Landmarks, free_turn: bool
    ) -> ConstellationMatch:
        if not kept:
            return ConstellationMatch((), False, "no two landmarks of the patch are in the map")
        turns = 2 * np.pi / _TURN_BIN_RAD if free_turn else 1.0
        places = turns * self.marks.area_m2 / patch.scale_m**2
        best = kept[0]
        margin = best.score - kept[1].score if len(kept) > 1 else np.inf
        where = f"{best.matched} of {len(patch)} landmarks, log likelihood ratio {best.score:.1f}"
        bar = float(np.log(places)) + _CHANCE
        if best.score < bar:
            reason = f"no better than chance: {where}, {bar:.1f} needed"
        elif margin < _DISTINCT:
            reason = f"ambiguous: {where}, {margin:.1f} above the next place, {_DISTINCT:g} needed"
        else:
            surplus = min(best.score - bar, margin - _DISTINCT)
            return ConstellationMatch(tuple(kept), True, where, surplus)
        return ConstellationMatch(tuple(kept), False, reason)


def turned(places_m: FloatArray, turn_rad: FloatArray) -> FloatArray:
    """Turn points (n, 2) of east and north clockwise about the origin by (n,) angles.

    >>> turned(np.array([[0.0, 1.0]]), np.array([np.pi / 2])).round(6) + 0.0
    array([[1., 0.]])
    """
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    east, north = places_m[:, 0], places_m[:, 1]
    return np.stack([c * east + s * north, c * north - s * east], axis=1)


def _rigid(here: FloatArray, there: FloatArray) -> tuple[float, FloatArray]:
    """Least-squares turn and shift that take points (n, 2) to their partners (Kabsch 1976)."""
    a, b = here - here.mean(axis=0), there - there.mean(axis=0)
    cross = np.sum(b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0])
    turn = float(np.arctan2(cross, np.sum(a * b)))
    shift = there.mean(axis=0) - turned(here.mean(axis=0)[None], np.array([turn]))[0]
    return turn, shift


def _rigid_covariance(here: FloatArray, turn: float, sigma_m: float) -> FloatArray:
    """Covariance (3, 3) of shift and turn from landmarks of place error `sigma_m` on both sides."""
    if len(here) < 2:
        return np.full((3, 3), np.nan)
    at = turned(here, np.full(len(here), turn))
    jacobian = np.zeros((2 * len(at), 3))
    jacobian[0::2, 0], jacobian[0::2, 2] = 1.0, at[:, 1]
    jacobian[1::2, 1], jacobian[1::2, 2] = 1.0, -at[:, 0]
    normal = jacobian.T @ jacobian
    if np.linalg.cond(normal) > 1e14:
        return np.full((3, 3), np.nan)
    return np.asarray(np.linalg.inv(normal) * sigma_m**2)
