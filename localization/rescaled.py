"""Rasters brought to one cell size, and rid of white error, before they are compared."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from localization.maperror import assumed_sigma, filter_map
from localization.refinement import smoothed
from perception.records import FloatArray, Grid

# Cells that agree to this part are of one size.
_SAME = 1e-6
# Part of a wide cell's surroundings, by weight, that must be known.
_LEAST_KNOWN = 0.3


def cells_of(grid: Grid) -> float:
    """Side of the square cells that a raster is compared on."""
    return max(grid.cell_m, grid.cell_north_m)


def without_white_error(prior: Grid) -> FloatArray:
    """Heights less the map's white error: its slopes would pass for the ground's, and for certainty."""
    height, sigma = prior.elevation_m, prior.sigma_m
    if sigma is None:
        sigma = np.full(height.shape, assumed_sigma(abs(float(np.nanmedian(height)))))
    return filter_map(height, sigma, prior.cell_m, prior.cell_north_m)[0]


def in_cells(grid: Grid, cell_m: float) -> Grid:
    """Resample a raster to square cells: averaged over the wider cell, or interpolated to a finer one."""
    ratio = np.array([cell_m / grid.cell_north_m, cell_m / grid.cell_m])
    if np.all(np.abs(ratio - 1.0) < _SAME):
        return grid
    values = grid.elevation_m
    # A cell's mean is a box; a Gaussian of its standard deviation keeps as much and does not alias.
    width = np.sqrt(np.maximum(ratio**2 - 1.0, 0.0) / 12.0)
    if width.max() > 0:
        # One hole among the cells read must not cost the wide cell: filled where enough is known about it.
        values = smoothed(values, width, least_known=_LEAST_KNOWN)
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
