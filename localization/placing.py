"""A patch of sea floor placed anywhere in a map: position, heading, how sure, and which places rival it.

Two ways, one answer: on the raster itself (`correlation`, every heading tried), or on the compact map of
hills and hollows (`constellation`), which a vehicle carries in a hundredth of the bytes. Patch and map
need not have one cell size: both are brought to the map's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from localization.constellation import Constellation, Landmarks, find_landmarks
from localization.correlation import match_patch, smoothed
from localization.integrity import protection_level
from localization.maperror import assumed_sigma, filter_map
from perception.records import FloatArray, Grid, InputError

# A patch of fewer known cells of the map's tells nothing.
_FEWEST_CELLS = 200
# 1-sigma of a place from reading both rasters between their cells, in cells and for each axis.
_BETWEEN = 0.03
# Cells that agree to this part are of one size.
_SAME = 1e-6


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

    `ambiguity` is the probability that one of the others kept is the right one, all places alike beforehand;
    `carried_bytes` the size of the map that was matched against.
    """

    places: tuple[Place, ...]
    accepted: bool
    reason: str
    carried_bytes: int

    @property
    def ambiguity(self) -> float:
        if len(self.places) < 2:
            return 0.0 if self.accepted else math.nan
        above = np.array([p.evidence - self.places[0].evidence for p in self.places])
        return float(1.0 - 1.0 / np.exp(above).sum())


def place_on_raster(prior: Grid, patch: Grid, turn_rad: float | None = None) -> Placing:
    """Place a patch on the map's raster, over all headings or at the one given.

    Raises
    ------
    InputError
        The patch holds too few heights, or is larger than the map.
    """
    prior, patch = _alike(prior, patch)
    found = match_patch(_without_white_error(prior), patch.elevation_m, turn_rad)
    cell = prior.cell_m
    # Rows run southward: north is minus the row.
    axes = np.array([[0.0, cell, 0.0], [-cell, 0.0, 0.0], [0.0, 0.0, 1.0]])
    places = tuple(
        Place(
            easting_m=prior.west_m + (m.col + 0.5) * cell,
            northing_m=prior.north_m - (m.row + 0.5) * cell,
            turn_rad=m.turn_rad,
            covariance=axes @ m.covariance @ axes.T
            + np.diag([1.0, 1.0, 0.0]) * (_BETWEEN * cell) ** 2,
            evidence=m.evidence,
        )
        for m in found.hypotheses
        if m.evidence > 0
    )
    return Placing(
        places, found.accepted and bool(places), found.reason, 4 * prior.elevation_m.size
    )


def place_on_landmarks(prior: Grid, patch: Grid, turn_rad: float | None = None) -> Placing:
    """Place a patch by its hills and hollows on those of the map; arguments as `place_on_raster`."""
    prior, patch = _alike(prior, patch)
    packed = find_landmarks(prior).packed()
    # The patch's landmarks are counted from its centre, so that the shift is the centre's place.
    rows, cols = patch.shape
    half_e, half_n = cols * patch.cell_m / 2, rows * patch.cell_m / 2
    marks = find_landmarks(replace(patch, west_m=-half_e, north_m=half_n))
    found = Constellation(Landmarks.unpacked(packed)).match(marks, turn_rad)
    places = tuple(
        Place(h.easting_m, h.northing_m, h.turn_rad, h.covariance, h.score)
        for h in found.hypotheses
    )
    return Placing(places, found.accepted, found.reason, len(packed))


def _without_white_error(prior: Grid) -> FloatArray:
    """Heights less the map's white error: its slopes would pass for the ground's, and for certainty."""
    height, sigma = prior.elevation_m, prior.sigma_m
    if sigma is None:
        sigma = np.full(height.shape, assumed_sigma(abs(float(np.nanmedian(height)))))
    return filter_map(height, sigma, prior.cell_m, prior.cell_north_m)[0]


def _alike(prior: Grid, patch: Grid) -> tuple[Grid, Grid]:
    """Bring both to square cells of the map's size; refuse what cannot be placed."""
    cell = max(prior.cell_m, prior.cell_north_m)
    prior, patch = in_cells(prior, cell), in_cells(patch, cell)
    known = int(np.isfinite(patch.elevation_m).sum())
    if known < _FEWEST_CELLS:
        raise InputError(
            f"the patch holds {known} heights on cells of {cell:g} m (the map's); "
            f"at least {_FEWEST_CELLS} are needed: give a larger patch or a finer map"
        )
    if max(patch.shape) > 2 * max(prior.shape):
        raise InputError(
            f"the patch ({patch.shape[1] * cell:.0f} by {patch.shape[0] * cell:.0f} m) is larger than "
            f"the map ({prior.shape[1] * cell:.0f} by {prior.shape[0] * cell:.0f} m); are they swapped?"
        )
    return prior, patch


def in_cells(grid: Grid, cell_m: float) -> Grid:
    """Resample a raster to square cells: averaged over the wider cell, or interpolated to a finer one."""
    ratio = np.array([cell_m / grid.cell_north_m, cell_m / grid.cell_m])
    if np.all(np.abs(ratio - 1.0) < _SAME):
        return grid
    values = grid.elevation_m
    # A cell's mean is a box; a Gaussian of its standard deviation keeps as much and does not alias.
    width = np.sqrt(np.maximum(ratio**2 - 1.0, 0.0) / 12.0)
    if width.max() > 0:
        values = smoothed(values, width)
    # Whole cells about the same centre: it is the centre that is placed.
    rows, cols = (max(int(n / k), 1) for n, k in zip(grid.shape, ratio, strict=True))
    row, col = np.meshgrid(
        (np.arange(rows) - (rows - 1) / 2) * ratio[0] + (grid.shape[0] - 1) / 2,
        (np.arange(cols) - (cols - 1) / 2) * ratio[1] + (grid.shape[1] - 1) / 2,
        indexing="ij",
    )
    read = ndimage.map_coordinates(values, [row, col], order=1, mode="nearest")
    west = 0.5 * (grid.west_m + grid.east_m - cols * cell_m)
    north = 0.5 * (grid.north_m + grid.south_m + rows * cell_m)
    sigma = None
    if grid.sigma_m is not None and np.isfinite(grid.sigma_m).any():
        # Errors of neighbouring cells may be alike: an average is not taken to be better than its cells.
        sigma = np.where(np.isfinite(read), float(np.nanmedian(grid.sigma_m)), np.nan)
    return Grid(read, west, north, cell_m, grid.crs, sigma, datum=grid.datum)
