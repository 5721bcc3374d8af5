"""A patch of sea floor placed anywhere in a map: position, heading, how sure, and which places rival it.

Two ways, one answer: on the raster itself (`correlation`, every heading tried), or on a map that a vehicle
carries in a hundredth of the bytes (`compact`). Patch and map need not have one cell size: both are brought
to the map's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from localization.compact import CompactMap, match_compact
from localization.constellation import Placement
from localization.correlation import match_patch
from localization.integrity import protection_level
from localization.refinement import Match
from localization.rescaled import cells_of, in_cells, without_white_error
from perception.records import FloatArray, Grid, InputError, Progress, silent

# A patch of fewer known cells of the map's tells nothing.
_FEWEST_CELLS = 200
# 1-sigma of a place from reading both rasters between their cells, in cells and for each axis.
_BETWEEN = 0.03
# Places nearer than this, in cells of the thumbnail, are one and the same told twice.
_ONE_PLACE = 1.5


@dataclass(frozen=True, slots=True)
class Place:
    """One place where a patch may belong.

    Attributes
    ----------
    easting_m, northing_m : of the patch's centre.
    turn_rad : azimuth, from grid north, of the patch's own north.
    covariance : (3, 3) of easting, northing (m) and turn (rad).
    evidence : log likelihood ratio against ground of no relation to the patch.
    """

    easting_m: float
    northing_m: float
    turn_rad: float
    covariance: FloatArray
    evidence: float

    @property
    def protection_m(self) -> float:
        """Radius that the error exceeds with a risk of 1e-5, if this is the right place."""
        return protection_level(self.covariance)


@dataclass(frozen=True, slots=True)
class Placing:
    """Places, likeliest first; whether the first may be used, and why.

    `carried_bytes` is the size of the map that was matched against.
    """

    places: tuple[Place, ...]
    accepted: bool
    reason: str
    carried_bytes: int

    @property
    def ambiguity(self) -> float:
        """Probability that another of the places kept is the right one, all alike beforehand."""
        if len(self.places) < 2:
            return 0.0 if self.accepted else math.nan
        above = np.array([p.evidence - self.places[0].evidence for p in self.places])
        return float(1.0 - 1.0 / np.exp(above).sum())


def place_on_raster(
    prior: Grid, patch: Grid, turn_rad: float | None = None, progress: Progress = silent
) -> Placing:
    """Place a patch on the map's raster, over all headings or near the one given.

    Raises
    ------
    InputError
        The patch holds too few heights, or is larger than the map.
    """
    cell = cells_of(prior)
    prior, patch = in_cells(prior, cell), in_cells(patch, cell)
    _refuse_small(patch)
    if max(patch.shape) > 2 * max(prior.shape):
        raise InputError(
            f"the patch ({patch.shape[1] * cell:.0f} by {patch.shape[0] * cell:.0f} m) is larger than "
            f"the map ({prior.shape[1] * cell:.0f} by {prior.shape[0] * cell:.0f} m); are they swapped?"
        )
    found = match_patch(without_white_error(prior), patch.elevation_m, turn_rad, progress=progress)
    frame = (prior.west_m, prior.north_m, cell)
    places = tuple(_of_match(m, frame) for m in found.hypotheses if m.evidence > 0)
    size = 4 * prior.elevation_m.size
    return Placing(places, found.accepted and bool(places), found.reason, size)


def place_on_compact(
    carried: CompactMap, patch: Grid, turn_rad: float | None = None, progress: Progress = silent
) -> Placing:
    """Place a patch on a compact map; arguments as `place_on_raster`.

    Raises
    ------
    InputError
        The patch holds too few heights.
    """
    _refuse_small(in_cells(patch, carried.fine_m))
    # Counted from the patch's centre, a shift is the centre's place.
    half_e, half_n = (patch.east_m - patch.west_m) / 2, (patch.north_m - patch.south_m) / 2
    centred = replace(patch, west_m=-half_e, north_m=half_n)
    found = match_compact(carried, centred, turn_rad, progress)
    frame = (carried.west_m, carried.north_m, carried.cell_m)
    places = [_of_match(m, frame) for m in found.thumbnail.hypotheses if m.evidence > 0]
    places += [_of_placement(h) for h in found.landmarks.hypotheses]
    size = len(carried.packed())
    if found.best is None:
        return Placing((), False, found.reason, size)
    if isinstance(found.best, Match):
        best = _of_match(found.best, frame)
    else:
        best = _of_placement(found.best)

    def told_of_best(p: Place) -> bool:
        away = np.hypot(p.easting_m - best.easting_m, p.northing_m - best.northing_m)
        return bool(away < _ONE_PLACE * carried.cell_m)

    # Of one place told by both, the stronger word counts.
    evidence = max((p.evidence for p in places if told_of_best(p)), default=best.evidence)
    others = sorted((p for p in places if not told_of_best(p)), key=lambda p: -p.evidence)
    return Placing((replace(best, evidence=evidence), *others), found.accepted, found.reason, size)


def _of_match(m: Match, frame: tuple[float, float, float]) -> Place:
    """A place in rows and columns of a raster of west edge, north edge and cell, as one in metres."""
    west, north, cell = frame
    # Rows run southward: north is minus the row.
    axes = np.array([[0.0, cell, 0.0], [-cell, 0.0, 0.0], [0.0, 0.0, 1.0]])
    between = np.diag([1.0, 1.0, 0.0]) * (_BETWEEN * cell) ** 2
    return Place(
        easting_m=west + (m.col + 0.5) * cell,
        northing_m=north - (m.row + 0.5) * cell,
        turn_rad=m.turn_rad,
        covariance=axes @ m.covariance @ axes.T + between,
        evidence=m.evidence,
    )


def _of_placement(h: Placement) -> Place:
    return Place(h.easting_m, h.northing_m, h.turn_rad, h.covariance, h.score)


def _refuse_small(patch: Grid) -> None:
    known = int(np.isfinite(patch.elevation_m).sum())
    if known < _FEWEST_CELLS:
        raise InputError(
            f"the patch holds {known} heights on cells of {patch.cell_m:g} m (the map's); "
            f"at least {_FEWEST_CELLS} are needed: give a larger patch or a finer map"
        )
