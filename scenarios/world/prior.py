"""The prior map: the true floor made coarse, old and wrong in a stated way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from perception.records import FloatArray, Grid
from scenarios.sections import PriorSection, WorldSection
from scenarios.world.build import frame_of
from scenarios.world.fields import spectral_field


def block_mean(floor: Grid, config: WorldSection, cell_m: float) -> Grid:
    """Return the mean height of the true floor in cells of `cell_m`, on their own multiples."""
    frame = frame_of(config, cell_m)
    easting_m, northing_m = floor.centres()
    rows = np.clip(((frame.north_m - northing_m) / cell_m).astype(int), 0, frame.shape[0] - 1)
    cols = np.clip(((easting_m - frame.west_m) / cell_m).astype(int), 0, frame.shape[1] - 1)
    row_starts = np.flatnonzero(np.diff(rows, prepend=-1))
    col_starts = np.flatnonzero(np.diff(cols, prepend=-1))
    sums = np.add.reduceat(floor.elevation_m, row_starts, axis=0)
    sums = np.add.reduceat(sums, col_starts, axis=1)
    counts = np.outer(np.diff(row_starts, append=len(rows)), np.diff(col_starts, append=len(cols)))
    heights = np.full(frame.shape, np.nan)
    heights[np.ix_(rows[row_starts], cols[col_starts])] = sums / counts
    return replace(frame, elevation_m=heights)


def prior_map(
    floor: Grid, world: WorldSection, config: PriorSection, *, rng: np.random.Generator
) -> Grid:
    """Return the prior map with the sigma it states: white and correlated error together.

    Change since it was made and its datum's offset are not in the stated sigma: that is what makes
    an old map wrong.
    """
    white, correlated, change, holes = rng.spawn(4)
    grid = block_mean(floor, world, config.cell_m)
    heights = grid.elevation_m + config.datum_offset_m
    heights = heights + config.white_sigma_m * white.standard_normal(grid.shape)
    for rms, length, stream in (
        (config.correlated_sigma_m, config.correlated_length_m, correlated),
        (config.change_rms_m, config.change_length_m, change),
    ):
        heights = heights + _smooth_error(grid, rms, length, stream)
    easting_m, northing_m = grid.centres()
    for _ in range(config.holes):
        e = holes.uniform(grid.west_m, grid.east_m)
        n = holes.uniform(grid.south_m, grid.north_m)
        distance = np.hypot((easting_m - e)[None, :], (northing_m - n)[:, None])
        heights[distance < config.hole_radius_m] = np.nan
    sigma = np.hypot(config.white_sigma_m, config.correlated_sigma_m)
    stated = np.where(np.isnan(heights), np.nan, max(float(sigma), 1e-3))
    return replace(grid, elevation_m=heights, sigma_m=stated)


def _smooth_error(
    grid: Grid, rms: float, length_m: float, rng: np.random.Generator
) -> FloatArray | float:
    if rms == 0:
        return 0.0
    shortest = max(length_m / 10.0, 2.0 * grid.cell_m)
    return spectral_field(
        grid,
        rms=rms,
        slope=2.0,
        longest_m=max(length_m, 1.5 * shortest),
        shortest_m=shortest,
        rng=rng,
    )
