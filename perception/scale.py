"""Smoothing at the scale that noise and relief ask for, before curvature."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from perception.curvature import NoiseGain
from perception.records import FloatArray


@dataclass(frozen=True, slots=True)
class Smoothing:
    """A smoothed surface and what it did to the noise.

    Attributes
    ----------
    surface_m : (rows, cols) smoothed heights; NaN where the map has none.
    gain : variance of the surface's derivatives per unit variance of the noise, arrays (m, n) on every
        `step`-th row and column.
    noise_m : (m, n) 1-sigma of the independent noise of one cell.
    scale_m : (m, n) Gaussian sigma of the smoothing, or its equivalent.
    """

    surface_m: FloatArray
    gain: NoiseGain
    noise_m: FloatArray
    scale_m: FloatArray
    step: int


def independent_noise(z: FloatArray) -> float:
    """Estimate the 1-sigma of the noise that is independent from cell to cell, in m.

    The median absolute value of a fourth difference along both axes, whose response to relief falls
    with the fourth power of its wavenumber on each axis.
    """
    kernel = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / np.sqrt(70.0)
    fine = ndimage.correlate1d(
        ndimage.correlate1d(z, kernel, 0, mode="reflect"), kernel, 1, mode="reflect"
    )
    fine = fine[2:-2, 2:-2][np.isfinite(fine[2:-2, 2:-2])]
    return float(np.median(np.abs(fine)) / 0.6745) if fine.size > 25 else 0.0


def smooth(
    z: FloatArray,
    cell_m: float,
    cell_north_m: float,
    sigma_m: FloatArray | None,
    scale_m: float | None = None,
) -> Smoothing:
    """Smooth a map by a Gaussian at one scale."""
    noise = independent_noise(z)
    step = 8
    shape = ((z.shape[0] + step - 1) // step, (z.shape[1] + step - 1) // step)
    scale = scale_m if scale_m is not None else (0.0 if noise == 0 else 6 * cell_m)
    known = np.isfinite(z)
    filled = np.where(known, z, 0.0)
    widths = (scale / cell_north_m, scale / cell_m)
    if scale > 0:
        weight = ndimage.gaussian_filter(known.astype(float), widths)
        surface = ndimage.gaussian_filter(filled, widths) / np.maximum(weight, 1e-9)
    else:
        surface = filled
    surface = np.where(known, surface, np.nan)
    s2 = max(scale, 0.5 * cell_m) ** 2
    area = cell_m * cell_north_m
    density = area / (4 * np.pi * s2)
    ones = np.ones(shape)
    gain = NoiseGain(
        *(
            ones * density * factor
            for factor in (
                1 / (2 * s2), 1 / (2 * s2), 3 / (4 * s2**2), 1 / (4 * s2**2), 3 / (4 * s2**2), 1 / (4 * s2**2),
            )
        )
    )  # fmt: skip
    return Smoothing(surface, gain, ones * noise, ones * scale, step)


def upsample(
    coarse: npt.NDArray[np.floating], step: int, shape: tuple[int, int]
) -> npt.NDArray[np.float32]:
    """Interpolate a map on every `step`-th cell bilinearly to all cells, (rows, cols) float32."""
    rows = np.minimum(np.arange(shape[0]) / step, coarse.shape[0] - 1)
    cols = np.minimum(np.arange(shape[1]) / step, coarse.shape[1] - 1)
    i, j = rows.astype(int), cols.astype(int)
    a, b = (rows - i).astype(np.float32)[:, None], (cols - j).astype(np.float32)
    k, m = np.minimum(i + 1, coarse.shape[0] - 1), np.minimum(j + 1, coarse.shape[1] - 1)
    values = coarse.astype(np.float32)
    across = values[:, j] * (1 - b) + values[:, m] * b
    return across[i] * (1 - a) + across[k] * a
