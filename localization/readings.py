"""Readings of one map: what the ground is if the map's error is alike over 8 m, or over 150 m.

A correlated error has slopes of its own, ``sigma sqrt(2) / L``, and a filter that takes the map's
slopes for the ground's counts them as terrain: 0.3 m over 15 m is a slope of 0.03, more than a smooth
valley has. Worse, it believes them, for the information on a position is the sum of squared slopes.
The cure is to look for the position on the *expected* ground, the map less what its error is likely to
have added. The expected ground's slopes are independent of what is still wrong with it.

Ground differs from place to place, a mountain beside a plain, so the expectation is taken band by band
and place by place: the map is split into octaves, the power P of an octave around a place is compared
with the power N that the error would have there, and the octave is kept in the part ``1 - N / P``
(Wiener's filter with local power; Lee 1980 for images). Where all of an octave's power may be error,
nothing of it is kept.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage

from perception.records import BoolArray, FloatArray

# Width of the neighbourhood that an octave's power is taken over, in its own smoothing widths: some
# thirty independent values, so that P scatters by a quarter.
_WINDOW, _SCATTER = 4.0, 0.25
# First smoothing width in cells; below it an octave holds what bilinear reading cannot use.
_FIRST = 0.7
# Part of the map whose error is at most what is told of it.
_COVERED = 95.0


@dataclass(frozen=True, slots=True)
class Reading:
    """The expected ground under one assumption on the map's error.

    Attributes
    ----------
    length_m : distance over which the map's error falls to 1/e.
    weight : prior probability of that length.
    shared_m : 1-sigma of what is still wrong.
    height_m : (rows, cols) float32 expected height, NaN no data.
    """

    length_m: float
    weight: float
    shared_m: float
    height_m: FloatArray


def expected_ground(
    height_m: FloatArray,
    excess: FloatArray,
    cell_m: tuple[float, float],
    error_m: float,
    lengths: Mapping[float, float],
) -> list[Reading]:
    """Read a map under each correlation length that its error may have.

    Parameters
    ----------
    height_m : (rows, cols), NaN no data.
    excess : (rows, cols) a cell's 1-sigma over the map's median one.
    cell_m : width and height of a cell.
    error_m : 1-sigma of the correlated error.
    lengths : correlation length (m) to prior weight.
    """
    valid = np.isfinite(height_m)
    size = np.where(valid & np.isfinite(excess), excess, 1.0).astype(np.float32) ** 2
    bands = _Bands(height_m, valid, cell_m, max(lengths))
    spectra = {length: bands.error_spectrum(error_m, length) for length in lengths}
    ground = {length: bands.low.copy() for length in lengths}
    # Variance of the error that the coarsest, unfiltered octave holds: all of it stays.
    coarsest = {length: bands.share(spectrum, bands.lowest) for length, spectrum in spectra.items()}
    left = {length: np.full(height_m.shape, coarsest[length], np.float32) for length in lengths}
    total = dict(coarsest)
    for j in range(bands.count):
        transfer = bands.transfer(j)
        octave, power = bands.octave(j, transfer)
        for length, spectrum in spectra.items():
            error = bands.share(spectrum, transfer)
            total[length] += error
            likely = (1.0 + _SCATTER) * error * size
            gain = np.clip(1.0 - likely / np.maximum(power, 1e-12), 0.0, 1.0)
            ground[length] += gain * octave
            left[length] += error * gain
    out = []
    for length, weight in lengths.items():
        # The octaves overlap: their shares sum to less than the whole, and are scaled to it.
        part = float(np.percentile(left[length][valid], _COVERED)) / max(total[length], 1e-30)
        shared = error_m * float(np.sqrt(min(part, 1.0)))
        height = np.where(valid, ground[length], np.nan).astype(np.float32)
        out.append(Reading(length, weight, shared, height))
    return out


class _Bands:
    """Octaves of a map: differences of Gaussian smoothings, by FFT with mirrored edges."""

    def __init__(
        self,
        height_m: FloatArray,
        valid: BoolArray,
        cell_m: tuple[float, float],
        longest_m: float,
    ) -> None:
        rows, cols = height_m.shape
        side = max(cell_m)
        # Octaves up to twice the longest error, as far as the map can tell their power.
        reach = min(2.0 * longest_m, min(rows * cell_m[1], cols * cell_m[0]) / 8)
        number = int(np.log2(max(reach / (_FIRST * side), 1.0)))
        self.widths_m = [0.0, *(_FIRST * side * 2.0**j for j in range(number + 1))]
        self.count = len(self.widths_m) - 1
        pad = [min(n - 1, int(2 * self.widths_m[-1] / c)) for n, c in zip((rows, cols), cell_m[::-1], strict=True)]  # fmt: skip
        nearest = ndimage.distance_transform_edt(
            ~valid, return_distances=False, return_indices=True
        )
        self.level = float(height_m[valid].mean())
        wide = np.pad(
            height_m[tuple(nearest)] - self.level, [(p, p) for p in pad], mode="reflect"
        ).astype(np.float32)
        self.size = tuple(fft.next_fast_len(n, real=True) for n in wide.shape)
        self.inside = tuple(slice(p, p + n) for p, n in zip(pad, (rows, cols), strict=True))
        self.wide = wide.shape
        self.spectrum = fft.rfft2(wide, self.size)
        self.square = np.hypot(
            fft.fftfreq(self.size[0], cell_m[1])[:, None],
            fft.rfftfreq(self.size[1], cell_m[0])[None, :],
        ).astype(np.float32) ** 2  # fmt: skip
        self.lowest = self._smoothing(self.widths_m[-1])
        self.low = self._back(self.spectrum * self.lowest)[self.inside] + self.level

    def transfer(self, j: int) -> FloatArray:
        """Transfer function of octave j."""
        return self._smoothing(self.widths_m[j]) - self._smoothing(self.widths_m[j + 1])

    def octave(self, j: int, transfer: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Heights of octave j, and their mean square around each cell."""
        octave = self._back(self.spectrum * transfer)
        window = self._smoothing(_WINDOW * self.widths_m[j + 1])
        power = self._back(fft.rfft2(octave**2, self.size) * window)[self.inside]
        return octave[self.inside], np.maximum(power, 0.0)

    def _smoothing(self, width_m: float) -> FloatArray:
        return np.exp(-2 * np.pi**2 * width_m**2 * self.square)

    def _back(self, spectrum: FloatArray) -> FloatArray:
        out: FloatArray = fft.irfft2(spectrum, self.size)[: self.wide[0], : self.wide[1]]
        return out

    def error_spectrum(self, error_m: float, length_m: float) -> FloatArray:
        """Variance of the error in each cell of the spectrum, for a correlation length.

        A Matern process of order 3/2, ``(1 + r) exp(-r)`` with r = d sqrt(3) / l, falls to 1/e at
        d = 1.24 l; its spectrum in the plane falls as ``(3 / l^2 + 4 pi^2 k^2)^(-5/2)``.
        """
        reach = length_m / 1.24
        density = (3.0 / reach**2 + 4 * np.pi**2 * self.square) ** -2.5
        twice = np.full(density.shape[1], 2.0)
        # The real transform keeps one of each pair of columns, but of the first and the middle one.
        twice[0] = 1.0
        if self.size[1] % 2 == 0:
            twice[-1] = 1.0
        density = density * twice
        return np.asarray(error_m**2 * density / density.sum(), np.float32)

    def share(self, spectrum: FloatArray, transfer: FloatArray) -> float:
        """Variance of the error in an octave."""
        return float(np.sum(spectrum * transfer**2))
