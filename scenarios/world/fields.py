"""Random fields of a stated spectrum, the same at every resolution."""

from __future__ import annotations

import numpy as np
from scipy import fft
from scipy.interpolate import RectBivariateSpline

from perception.records import FloatArray, Grid


def spectral_field(
    frame: Grid,
    *,
    rms: float,
    slope: float,
    longest_m: float,
    shortest_m: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Draw an isotropic Gaussian field with a power-law spectrum between two wavelengths.

    The two-dimensional power density is ``|k|^-(slope + 1)`` between the wavelengths and zero
    outside, so that a profile along a line falls as ``k^-slope``. The coefficients belong to a
    period that depends on the frame's size and not on its cell: the same generator gives the same
    field, sampled finer or coarser.

    Parameters
    ----------
    frame : gives size and cell (square); its heights are not read.
    rms : root mean square of the field over its whole period.
    slope : spectral exponent of a profile, about 2 to 3 for sea floors (Goff & Jordan 1988).
    longest_m, shortest_m : wavelengths of the band; `shortest_m` should be at least four cells.

    Returns
    -------
    (rows, cols) array in the unit of `rms`.
    """
    rows, cols = frame.shape
    extent_m = max(rows, cols) * frame.cell_m
    # The period exceeds the frame, or opposite edges would be alike; whole multiples of 16 m keep
    # it independent of the cell.
    period_m = 16.0 * np.ceil(max(1.25 * extent_m, longest_m) / 16.0)
    modes = int(np.ceil(period_m / shortest_m))
    index = np.arange(-modes, modes + 1)
    wavenumber = np.hypot(index[:, None], index[None, :]) / period_m
    band = (wavenumber >= 1.0 / longest_m * 0.999) & (wavenumber <= 1.0 / shortest_m)
    band[modes, modes] = False
    density = np.zeros(wavenumber.shape)
    density[band] = wavenumber[band] ** -(slope + 1.0)
    noise = rng.standard_normal((2, *wavenumber.shape))
    if not band.any() or rms == 0:
        return np.zeros((rows, cols))
    coefficients = np.sqrt(density) * (noise[0] + 1j * noise[1])
    # The real part of the sum keeps the Hermitian part only; scaled by what this draw holds, the
    # root mean square over the period is the stated one exactly.
    hermitian = 0.5 * (coefficients + np.conj(coefficients[::-1, ::-1]))
    coefficients = hermitian * (rms / np.sqrt(np.sum(np.abs(hermitian) ** 2)))
    return _sum_of_modes(coefficients, period_m, frame)


def _sum_of_modes(coefficients: FloatArray, period_m: float, frame: Grid) -> FloatArray:
    """Evaluate the Fourier sum at the frame's cell centres, measured from its south-west corner.

    The sum is made on a grid of its own, at least six points to the shortest wave, and laid over
    the frame by a bicubic spline: right to half a percent there, and the same for every frame.
    """
    modes = coefficients.shape[0] // 2
    size = int(fft.next_fast_len(max(6 * modes, 16)))
    spectrum = np.zeros((size, size), np.complex128)
    index = np.arange(-modes, modes + 1) % size
    spectrum[np.ix_(index, index)] = coefficients
    field = fft.ifft2(spectrum, norm="forward", overwrite_x=True).real
    step_m = period_m / size
    south, west = ((np.arange(n) + 0.5) * frame.cell_m for n in frame.shape)
    # The frame is smaller than the period: what the spline needs beyond it wraps round.
    inside = [np.arange(-4, int(axis[-1] / step_m) + 6) for axis in (south, west)]
    patch = field[np.ix_(inside[0] % size, inside[1] % size)]
    spline = RectBivariateSpline(inside[0] * step_m, inside[1] * step_m, patch)
    return np.asarray(spline(south, west))[::-1]
