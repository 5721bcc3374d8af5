"""Ground seen from one side only keeps the broad shape that soundings and shadows give it.

Shading tells slope against the gain of its angle. Two looks from opposite sides tell them apart: gain has one
sign in both, slope has two. A single look cannot, so a gain that is a little wrong tilts the ground, metres at
the outer rim of a survey. There the joint surface is trusted for its detail, and the strips' own surface
(altimeter, shadow heights, their variogram's sigma) for what is broader than the altitude.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter

from perception.records import ElevationStrip, FloatArray, Grid

# Mean resultant length of the looks' directions: 0 opposite looks, 0.71 two at right angles, 1 one look.
_BALANCED, _ONE_SIDED = 0.45, 0.7


def look_balance(grid: Grid, strips: Sequence[ElevationStrip]) -> FloatArray:
    """Return (rows, cols) the mean resultant length of the directions from which cells were seen.

    Every pass and side counts once a cell, so that a slow pass does not outvote a fast one; NaN unseen.
    """
    east, north, number = np.zeros((3, *grid.shape))
    for strip in strips:
        easting_m, northing_m = strip.positions()
        row, col = (np.floor(v + 0.5) for v in grid.fractional_index(easting_m, northing_m))
        rows, cols = grid.shape
        inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols) & np.isfinite(strip.echo)
        for side in (-1.0, 1.0):
            here = inside & (np.sign(strip.across_m) == side)
            cell = (row[here] * cols + col[here]).astype(np.int64)
            heading = np.broadcast_to(strip.heading_rad[:, None], here.shape)[here]
            count = np.bincount(cell, minlength=rows * cols)
            seen = np.maximum(count, 1)
            for total, part in ((east, np.cos(heading)), (north, -np.sin(heading))):
                mean = side * np.bincount(cell, part, minlength=rows * cols) / seen
                total += mean.reshape(grid.shape)
            number += (count > 0).reshape(grid.shape)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.hypot(east, north) / np.where(number > 0, number, np.nan)


def hold_one_sided(
    grid: Grid, soundings: Grid, strips: Sequence[ElevationStrip], altitude_m: float
) -> Grid:
    """Return the joint map with one-sided ground held to the strips' broad shape.

    Parameters
    ----------
    grid : the joint map.
    soundings : the strips fused on cells of the same size, with sigma.
    altitude_m : scale that parts detail from shape.

    Returns
    -------
    Grid
        Unchanged where ground was seen from opposite sides; the strips' sigma is the least where it was not.
    """
    balance = look_balance(grid, strips)
    part = np.clip((balance - _BALANCED) / (_ONE_SIDED - _BALANCED), 0.0, 1.0)
    # Cells that no strip's flat geometry reached are rim: one-sided.
    part = np.where(np.isfinite(part), part, 1.0)
    width = max(altitude_m / grid.cell_m, 1.0)
    part = gaussian_filter(part, 0.5 * width)
    e, n = np.meshgrid(*grid.centres())
    shape_m = soundings.sample(e, n)
    known = np.isfinite(shape_m) & np.isfinite(grid.elevation_m)
    difference = np.where(known, grid.elevation_m - shape_m, 0.0)
    weight = gaussian_filter(known.astype(float), width)
    broad = gaussian_filter(difference, width) / np.maximum(weight, 1e-6)
    held = grid.elevation_m - np.where(weight > 1e-3, part * broad, 0.0)
    sigma = grid.sigma_m
    if sigma is not None and soundings.sigma_m is not None:
        theirs = replace(soundings, elevation_m=soundings.sigma_m).sample(e, n)
        # Beyond the strips' reach the nearest of them tells how little is known, not the echoes' own sigma.
        theirs = _nearest_known(theirs, sigma)
        sigma = np.maximum(sigma, part * theirs)
    return replace(grid, elevation_m=held, sigma_m=sigma)


def _nearest_known(values: FloatArray, otherwise: FloatArray) -> FloatArray:
    """Return `values` with NaN replaced by the nearest finite one; `otherwise` where there is none."""
    known = np.isfinite(values)
    if not known.any():
        return otherwise
    row, col = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.asarray(values[row, col])
