"""The vertical tie of a map to one that was there before: one shift of all heights, and how well it is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mapping.compare import Difference, difference
from perception.records import FloatArray, Grid

# Blocks (north-south, east-west) into which the common ground is cut to see how far errors reach: squares, and bands,
# for what one pass got wrong reaches along all of it and no further.
_BLOCKS = ((2, 2), (4, 4), (8, 8), (4, 1), (8, 1), (1, 4), (1, 8))
# A block counts that holds this part of what a full one would.
_LEAST_PART = 0.2


@dataclass(frozen=True, slots=True)
class HeightTie:
    """How a map was tied to a prior one.

    Attributes
    ----------
    shift_m, sigma_m : to be added to the map's heights, and its 1-sigma, common to all cells.
    datum : the prior map's, which the map's heights then refer to.
    left : how the two still differ.
    """

    shift_m: float
    sigma_m: float
    datum: str
    left: Difference

    def metrics(self) -> dict[str, Any]:
        """Return the tie's figures, named as in `metrics.json`."""
        return {"prior_shift_m": self.shift_m, "prior_shift_sigma_m": self.sigma_m} | {
            f"prior_{name}": value for name, value in self.left.statistics.items()
        }

    def tied(self, grid: Grid) -> Grid:
        """Return the map at its new height, its sigma grown by the tie's own."""
        return _tied(grid, self.shift_m, self.sigma_m, self.datum)


def tie_heights(grid: Grid, prior: Grid) -> HeightTie:
    """Find the shift of heights that brings a map onto a prior one, and how the two still differ.

    The shift is the median difference: tide and depth bias are common to a survey, changes of the
    floor are not.
    """
    apart = difference(grid, prior).grid.elevation_m
    shift_m = float(np.nanmedian(apart))
    sigma_m, datum = sigma_of_median(apart), prior.datum or grid.datum
    left = difference(_tied(grid, shift_m, sigma_m, datum), prior)
    return HeightTie(shift_m, sigma_m, datum, left)


def _tied(grid: Grid, shift_m: float, sigma_m: float, datum: str) -> Grid:
    sigma = None if grid.sigma_m is None else np.hypot(grid.sigma_m, sigma_m)
    return replace(grid, elevation_m=grid.elevation_m + shift_m, sigma_m=sigma, datum=datum)


def sigma_of_median(values: FloatArray) -> float:
    """Return the 1-sigma of a raster's median whose errors reach over an unknown distance.

    Errors of two maps are shared by all that a pass saw: cells are not so many measurements. The raster is
    cut into blocks, whose medians scatter; where blocks are wider than the errors reach, their scatter over the
    root of their number is the sigma, and where they are narrower it is too small. So the largest of several widths is taken;
    of a raster too small to be cut, the scatter of its cells, not averaged.
    """
    known = np.isfinite(values)
    if not known.any():
        return float("nan")
    middle = np.median(values[known])
    whole = 1.4826 * float(np.median(np.abs(values[known] - middle)))
    rows, cols = (slice(int(v.min()), int(v.max()) + 1) for v in np.nonzero(known))
    found = [s for s in (_by_blocks(values[rows, cols], *n) for n in _BLOCKS) if s is not None]
    return max(found) if found else whole


def _by_blocks(values: FloatArray, down: int, across: int) -> float | None:
    """Return the standard error of the mean of the medians of `down` x `across` blocks; None of fewer than four.

    The scatter of m blocks is itself uncertain: Student's t with m - 1 degrees of freedom has the variance
    (m - 1) / (m - 3).
    """
    blocks = [
        block[np.isfinite(block)]
        for band in np.array_split(values, down, axis=0)
        for block in np.array_split(band, across, axis=1)
    ]
    least = max(_LEAST_PART * np.isfinite(values).sum() / (down * across), 4)
    medians = [float(np.median(block)) for block in blocks if len(block) >= least]
    if len(medians) < 4:
        return None
    m = len(medians)
    return float(np.std(medians, ddof=1) * np.sqrt((m - 1) / (m - 3) / m))
