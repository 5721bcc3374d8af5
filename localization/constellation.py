"""A patch placed by the constellation of its hills and hollows, its heading unknown, on a compact map.

The prior map is reduced to landmarks: the peaks and pits of its H-K region map (`perception.regions`),
eight bytes each, a hundredth of the raster or less. A patch of sea floor is segmented at the same scale,
and its landmarks are looked for in the map's:

    pairs of landmarks alike in kind and distance vote for a turn and a shift
    the places with most votes are verified landmark by landmark, and refined by least squares
    a place is scored by the log likelihood ratio of its landmarks against landmarks strewn at random

A landmark that the patch shows and the map lacks costs something, not everything; where the patch
has a hole, or the map ends, nothing is expected. Distinct places are all kept as hypotheses; the
best is accepted when it beats chance over all places tried, and the second by as much as proves it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from perception.records import REGION_CLASSES, BoolArray, FloatArray, Grid, IntArray, RegionMap
from perception.regions import RegionConfig, segment

# Smoothing in cells: a map's landmarks are then some 0.4 % of its bytes, and noise of a third of the
# relief leaves most of them in place.
_SCALE_CELLS = 4.0
_KINDS = tuple(REGION_CLASSES.index(name) for name in ("peak", "pit"))
# A landmark nearer to the border of the data than this many smoothing scales may be cut by it.
_BORDER_SCALES = 1.0
# Part of a landmark's region that must have been sounded, not filled.
_LEAST_SOUNDED = 0.7
# 1-sigma of a landmark's place, in smoothing scales, and of the logarithms of strength and size; from
# landmarks of noisy patches against the map's own (docs/terrain-navigation.md).
_PLACE_SCALES, _STRENGTH_SIGMA, _SIZE_SIGMA = 0.35, 0.35, 0.5
# Largest number of the two bytes that a packed place and strength have each.
_WORD = 65_535
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
class Landmarks:
    """Peaks and pits of a surface, (n,) each.

    Attributes
    ----------
    easting_m, northing_m : centroids.
    kind : index into `REGION_CLASSES`.
    strength_per_m : size of the mean curvature.
    size_m : square root of the area.
    scale_m : smoothing that they were found at; only equal scales compare.
    area_m2 : of the surface they were found on.
    """

    easting_m: FloatArray
    northing_m: FloatArray
    kind: IntArray
    strength_per_m: FloatArray
    size_m: FloatArray
    scale_m: float
    area_m2: float

    def __len__(self) -> int:
        return len(self.kind)

    def packed(self) -> bytes:
        """Return the landmarks as eight bytes each: what a vehicle has to carry.

        Places are kept to a tenth of the scale, or on wider maps to what 16 bits tell apart.
        """
        west, south, step = 0.0, 0.0, 0.1 * self.scale_m
        if len(self):
            west, south = float(self.easting_m.min()), float(self.northing_m.min())
            extent = max(float(np.ptp(self.easting_m)), float(np.ptp(self.northing_m)))
            step = max(step, extent / _WORD)
        record = np.zeros(len(self), np.dtype("u2,u2,u1,u1,u2"))
        record["f0"] = np.round((self.easting_m - west) / step)
        record["f1"] = np.round((self.northing_m - south) / step)
        record["f2"] = self.kind
        size = 8 * np.log2(np.maximum(self.size_m / self.scale_m, 0.01)) + 100
        strength = -2000 * np.log2(np.maximum(self.strength_per_m, 1e-9))
        record["f3"] = np.round(np.clip(size, 0, 255))
        record["f4"] = np.round(np.clip(strength, 0, _WORD))
        head = np.array([west, south, step, self.scale_m, self.area_m2])
        return head.tobytes() + record.tobytes()

    @classmethod
    def unpacked(cls, data: bytes) -> Landmarks:
        """Read what `packed` wrote."""
        west, south, step, scale, area = np.frombuffer(data[:40])
        record = np.frombuffer(data[40:], np.dtype("u2,u2,u1,u1,u2"))
        return cls(
            easting_m=west + step * record["f0"],
            northing_m=south + step * record["f1"],
            kind=record["f2"].astype(np.int64),
            strength_per_m=2.0 ** (-record["f4"].astype(float) / 2000),
            size_m=scale * 2.0 ** ((record["f3"].astype(float) - 100) / 8),
            scale_m=float(scale),
            area_m2=float(area),
        )


def find_landmarks(grid: Grid, scale_m: float | None = None) -> Landmarks:
    """Segment a surface and take its landmarks; map and patch must be given the same scale.

    A landmark need not be certain: a false one costs little in the verification, a lost one is lost.
    So the signs of curvature count without tolerance and nothing is dissolved as doubtful.

    Parameters
    ----------
    scale_m : smoothing, Gaussian 1-sigma; None takes four cells.
    """
    scale = _SCALE_CELLS * max(grid.cell_m, grid.cell_north_m) if scale_m is None else scale_m
    config = RegionConfig(scale_m=scale, k_sigma=0.0, seed_probability=0.0, keep_probability=False)
    known = np.isfinite(grid.elevation_m)
    filled = replace(grid, elevation_m=_filled(grid, known, scale))
    return landmarks_of(segment(filled, config).regions, scale, known)


def _filled(grid: Grid, known: BoolArray, scale_m: float) -> FloatArray:
    """Fill holes smoothly: a shadow across a hill must not cut it in two."""
    if known.all() or not known.any():
        return grid.elevation_m
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    rough = grid.elevation_m[tuple(nearest)]
    width = (scale_m / grid.cell_north_m, scale_m / grid.cell_m)
    weight = ndimage.gaussian_filter(known.astype(float), width)
    level = ndimage.gaussian_filter(np.where(known, rough, 0.0), width)
    # Far inside a wide hole nothing weighs anything: the nearest height will do, it is not used.
    return np.where(known, rough, np.where(weight > 1e-3, level / np.maximum(weight, 1e-3), rough))


def landmarks_of(regions: RegionMap, scale_m: float, sounded: BoolArray | None = None) -> Landmarks:
    """Take the peaks and pits of a region map that lie clear of holes and borders.

    Parameters
    ----------
    scale_m : smoothing that the regions were made with.
    sounded : (rows, cols) cells that had a height before holes were filled; None all.
    """
    known = np.pad(regions.region > 0, 1)
    cell_north = regions.cell_m if regions.cell_height_m is None else regions.cell_height_m
    depth = ndimage.distance_transform_edt(known, sampling=(cell_north, regions.cell_m))
    depth = depth[1:-1, 1:-1]
    table = regions.table
    kind = np.asarray(table["class_code"])
    # A region that reaches the border goes on beyond it: its centroid is not the landmark's.
    inner = ndimage.minimum(depth, regions.region, np.arange(1, len(kind) + 1))
    east, north = np.asarray(table["easting_m"]), np.asarray(table["northing_m"])
    col = ((east - regions.west_m) / regions.cell_m).astype(int)
    row = ((regions.north_m - north) / cell_north).astype(int)
    rows, cols = depth.shape
    inside = depth[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)]
    cut = 1.5 * max(regions.cell_m, cell_north)
    use = np.isin(kind, _KINDS) & (np.asarray(inner) > cut) & (inside > _BORDER_SCALES * scale_m)
    if sounded is not None:
        share = ndimage.mean(sounded, regions.region, np.arange(1, len(kind) + 1))
        use &= np.asarray(share) > _LEAST_SOUNDED
    return Landmarks(
        easting_m=east[use],
        northing_m=north[use],
        kind=kind[use].astype(np.int64),
        strength_per_m=np.abs(np.asarray(table["mean_H"], float))[use],
        size_m=np.sqrt(np.asarray(table["area_m2"], float))[use],
        scale_m=scale_m,
        area_m2=float(np.count_nonzero(regions.region)) * regions.cell_m * cell_north,
    )


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
    """Hypotheses, best first; whether the best may be used, and why."""

    hypotheses: tuple[Placement, ...]
    accepted: bool
    reason: str


class Constellation:
    """Landmarks of a prior map, ready to be searched.

    Parameters
    ----------
    marks : the map's landmarks.
    """

    def __init__(self, marks: Landmarks) -> None:
        self.marks = marks
        self.places = np.stack([marks.easting_m, marks.northing_m], axis=1)
        self.trees = {k: cKDTree(self.places[marks.kind == k]) for k in _KINDS}
        self.of_kind = {k: np.flatnonzero(marks.kind == k) for k in _KINDS}
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
        for k in _KINDS:
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
        for k in _KINDS:
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
        if best.score < np.log(places) + _CHANCE:
            reason = f"no better than chance: {where}, {np.log(places) + _CHANCE:.1f} needed"
        elif margin < _DISTINCT:
            reason = f"ambiguous: {where}, {margin:.1f} above the next place, {_DISTINCT:g} needed"
        else:
            return ConstellationMatch(tuple(kept), True, where)
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
