"""A map in a hundredth of its bytes: hills and hollows, and a thumbnail of the heights.

    landmarks   peaks and pits of the H-K region map, eight bytes each: sharp in place (`constellation`)
    thumbnail   heights averaged over seven cells, one byte each: strong in telling places apart

Hills and hollows alone lose a patch of weak relief that lies half off the map: few landmarks are left, and
noise moves them. Averaged heights are what such a patch has most of: 49 cells to one take noise of 1 m to
0.15 m, and octave by octave (`correlation`) a wrong place is told from the right one by evidence of
100 against 20. The thumbnail is matched over all headings; the landmarks' places are tried on it as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from localization.constellation import Constellation, ConstellationMatch, Placement
from localization.correlation import Matching, match_patch
from localization.landmarks import Landmarks, find_landmarks
from localization.refinement import Match, verify
from localization.rescaled import cells_of, in_cells, without_white_error
from perception.records import FloatArray, Grid, IntArray, Progress, silent

# Cells of the map in one of the thumbnail: 49 cells of four bytes to one byte is half of a hundredth.
_WIDE = 7
_LEVELS = 254
# Evidence on the thumbnail by which the landmarks' place may fall behind the thumbnail's own.
_BEHIND = 6.0
# Where the thumbnail knows nothing of that place, by how much more than is asked of them otherwise the
# landmarks must be sure: as much again as their bar over chance.
_UNCHECKED = 8.0


@dataclass(frozen=True, slots=True)
class CompactMap:
    """What a vehicle carries instead of a raster.

    Attributes
    ----------
    landmarks : as `Landmarks.packed` has them.
    thumbnail : (rows, cols) uint8, 0 no data, else levels of `step_m` from `low_m`.
    west_m, north_m, cell_m : frame of the thumbnail, square cells.
    fine_m : cell of the map that it was made of; patches are brought to it for their landmarks.
    """

    landmarks: bytes
    thumbnail: IntArray
    low_m: float
    step_m: float
    west_m: float
    north_m: float
    cell_m: float
    fine_m: float

    @classmethod
    def of(cls, prior: Grid) -> CompactMap:
        """Reduce a map."""
        prior = in_cells(prior, cells_of(prior))
        wide = in_cells(
            replace(prior, elevation_m=without_white_error(prior)), _WIDE * prior.cell_m
        )
        height = wide.elevation_m
        low, high = float(np.nanmin(height)), float(np.nanmax(height))
        step = max((high - low) / _LEVELS, 1e-6)
        levels = np.where(np.isfinite(height), np.round((height - low) / step) + 1, 0)
        return cls(
            find_landmarks(prior).packed(), levels.astype(np.uint8), low, step, wide.west_m,
            wide.north_m, wide.cell_m, prior.cell_m,
        )  # fmt: skip

    def heights(self) -> FloatArray:
        """The thumbnail in metres, NaN no data."""
        return np.where(
            self.thumbnail > 0, self.low_m + (self.thumbnail - 1.0) * self.step_m, np.nan
        )

    def packed(self) -> bytes:
        """Return all of it as bytes."""
        head = np.array(
            [self.low_m, self.step_m, self.west_m, self.north_m, self.cell_m, self.fine_m,
             *self.thumbnail.shape]
        )  # fmt: skip
        return head.tobytes() + np.asarray(self.thumbnail, np.uint8).tobytes() + self.landmarks

    @classmethod
    def unpacked(cls, data: bytes) -> CompactMap:
        """Read what `packed` wrote."""
        low, step, west, north, cell, fine, rows, cols = np.frombuffer(data[:64])
        shape = int(rows), int(cols)
        end = 64 + shape[0] * shape[1]
        thumbnail = np.frombuffer(data[64:end], np.uint8).reshape(shape)
        return cls(
            data[end:], thumbnail, float(low), float(step), float(west), float(north), float(cell),
            float(fine),
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class CompactMatch:
    """What thumbnail and landmarks say; `best` the place and `reason` why it may be used or not."""

    thumbnail: Matching
    landmarks: ConstellationMatch
    best: Match | Placement | None
    accepted: bool
    reason: str


def match_compact(
    carried: CompactMap, patch: Grid, turn_rad: float | None = None, progress: Progress = silent
) -> CompactMatch:
    """Place a patch, its coordinates counted from its centre, on a compact map."""
    marks = Constellation(Landmarks.unpacked(carried.landmarks)).match(
        find_landmarks(in_cells(patch, carried.fine_m)), turn_rad
    )
    wide = in_cells(patch, carried.cell_m).elevation_m
    heights = carried.heights()
    thumb = match_patch(heights, wide, turn_rad, progress=progress)
    named = f"thumbnail: {thumb.reason}; landmarks: {marks.reason}"
    if not marks.hypotheses or not marks.accepted:
        best = thumb.best if thumb.hypotheses else None
        return CompactMatch(thumb, marks, best, thumb.accepted, named)
    place = marks.hypotheses[0]
    if thumb.accepted and _same(carried, place, thumb.best):
        return CompactMatch(thumb, marks, place, True, named)
    if thumb.accepted:
        return CompactMatch(thumb, marks, thumb.best, False, f"the two disagree: {named}")
    # The landmarks are sure: the thumbnail, which is not, must at least not know a better place.
    tried = _match_of(carried, place)
    if np.isfinite(wide).any():
        tried = verify(heights, wide, tried, free_turn=turn_rad is None)
    if tried.evidence > 0:
        stands = tried.evidence > thumb.best.evidence - _BEHIND
        return CompactMatch(thumb, marks, place, stands, named)
    stands = marks.surplus >= _UNCHECKED
    named = f"not checked on the thumbnail, {marks.surplus:.1f} above the bar, {_UNCHECKED:g} needed: {named}"
    return CompactMatch(thumb, marks, place, stands, named)


def _match_of(carried: CompactMap, place: Placement) -> Match:
    """A place of the landmarks in the thumbnail's rows and columns."""
    row = (carried.north_m - place.northing_m) / carried.cell_m - 0.5
    col = (place.easting_m - carried.west_m) / carried.cell_m - 0.5
    return Match(row, col, place.turn_rad, 0.0, np.full((3, 3), np.nan), np.nan)


def _same(carried: CompactMap, place: Placement, match: Match) -> bool:
    """Whether two places are one: within a cell of the thumbnail and ten degrees."""
    other = _match_of(carried, place)
    turn = (match.turn_rad - place.turn_rad + np.pi) % (2 * np.pi) - np.pi
    near = np.hypot(match.row - other.row, match.col - other.col) < 1.0
    return bool(near and abs(turn) < np.radians(10.0))
