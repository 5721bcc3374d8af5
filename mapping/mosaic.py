"""Echo mosaic: the equalised echo level of all passes on one grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapping.fusion import fuse
from mapping.rasters import write_bands
from perception.records import ElevationStrip, FloatArray, Grid


def echo_mosaic(
    strips: Sequence[ElevationStrip], cell_m: float | None = None, crs: str | None = None
) -> Grid:
    """Return the mosaic as a `Grid` whose `elevation_m` holds the echo level in dB, 0 where nominal.

    Power is averaged, not decibels: a shadow among echoes must not pull the mean to silence. Each pass
    counts by how well it sees: far out its cells are coarse, at nadir the echo is glare, so the weight
    is greatest in the middle of the swath.
    """
    levels = []
    for strip in strips:
        echo = np.where(np.isfinite(strip.echo) & (strip.echo >= 0), strip.echo, np.nan)
        sigma = echo_sigma(strip.across_m, strip.altitude_m)
        levels.append(replace(strip, elevation_m=echo, sigma_m=sigma))
    mosaic = fuse(levels, cell_m, crs)
    return replace(mosaic, elevation_m=level_db(mosaic.elevation_m), sigma_m=None)


def echo_sigma(across_m: FloatArray, altitude_m: FloatArray) -> FloatArray:
    """Return (n, m) the 1-sigma by which echoes are weighted: columns (m,), lines' altitudes (n,)."""
    away = np.abs(across_m)[None, :] / np.maximum(np.nan_to_num(altitude_m), 0.1)[:, None]
    # Seen best between one and four altitudes out; a sigma of 1 there, 5 at nadir.
    sigma: FloatArray = (
        1.0 + 4.0 * np.exp(-((away / 0.5) ** 2)) + 0.25 * np.maximum(away - 4.0, 0.0)
    )
    return sigma


def level_db(power: FloatArray) -> FloatArray:
    """Return echo power over nominal in dB, no less than -40."""
    level: FloatArray = 10.0 * np.log10(np.maximum(power, 1e-4))
    return level


def write_mosaic(path: Path, mosaic: Grid) -> None:
    """Write `mosaic.tif`: one band, `echo_db`."""
    write_bands(path, {"echo_db": mosaic.elevation_m}, mosaic)
