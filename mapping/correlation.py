"""Correlation of two gridded fields over a search of shifts, as log-likelihood; and the climb below a cell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import fft, ndimage

from perception.records import FloatArray

# First field, its weight, second field, its weight: (size, size) or (layers, size, size) float32.
Fields = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, slots=True)
class Surface:
    """One channel's correlation over the search: (s, s) arrays, row 0 the southernmost shift."""

    rho: FloatArray
    log_likelihood: FloatArray
    common: FloatArray
    independent: FloatArray
    scale: FloatArray
    significance: FloatArray

    def scaled(self, share: float) -> Surface:
        """Return the surface with its evidence, but not its correlation, reduced."""
        return replace(
            self,
            log_likelihood=self.log_likelihood * share,
            independent=self.independent * share,
        )

    def gain(self, row: int, col: int) -> float:
        """Return what the log-likelihood gains per unit of the raw correlation, 0 where it is negative."""
        rho, scale = float(self.rho[row, col]), float(self.scale[row, col])
        if rho <= 0.0 or scale <= 0.0:
            return 0.0
        return float(self.independent[row, col]) * rho / (1 - rho**2) / scale


@dataclass(frozen=True, slots=True)
class Side:
    """What one of two fields brings to a correlation: transforms that several channels share.

    `weight`, `mask` are those of the weights and of where they are positive; `field`, `square` of weight times
    the field and times its square. `number` is of cells with data, `size` of cells on a side.
    """

    weight: npt.NDArray[np.complexfloating[Any]]
    mask: npt.NDArray[np.complexfloating[Any]]
    field: npt.NDArray[np.complexfloating[Any]]
    square: npt.NDArray[np.complexfloating[Any]]
    number: float
    size: int

    @classmethod
    def of(cls, values: FloatArray, weights: FloatArray) -> Side:
        """Transform a field and its weights."""
        mask = (weights > 0).astype(np.float32)
        weighted = weights * values
        planes = fft.rfft2(np.stack([weights, mask, weighted, weighted * values]))
        return cls(planes[0], planes[1], planes[2], planes[3], float(mask.sum()), len(values))

    def carrying(self, values: FloatArray, weights: FloatArray) -> Side:
        """Return the same weights under another field."""
        weighted = weights * values
        planes = fft.rfft2(np.stack([weighted, weighted * values]))
        return replace(self, field=planes[0], square=planes[1])


@dataclass(frozen=True, slots=True)
class Products:
    """Correlations of two sides over the search, (s, s) each, and the variance of `total` under no match."""

    total: FloatArray
    power_u: FloatArray
    power_v: FloatArray
    common: FloatArray
    variance: float
    n_u: float

    def surface(self, sign: float = 1.0) -> Surface | None:
        """Return what the products say of each shift; `sign` -1 turns one of the fields upside down."""
        energy = np.sqrt(np.maximum(self.power_u, 0.0) * np.maximum(self.power_v, 0.0))
        if self.variance <= 0 or energy.max() <= 0:
            return None
        common = self.common
        good = (common > 0.3 * common.max()) & (energy > 1e-6 * energy.max())
        rho = np.where(good, sign * self.total / np.where(good, energy, 1.0), 0.0)
        rho = np.clip(rho, -0.999, 0.999)
        number = np.maximum(common, 1.0)
        variance = self.variance * number / self.n_u
        independent = np.minimum(energy**2 / variance, number)
        likelihood = -0.5 * independent * np.log1p(-(np.maximum(rho, 0.0) ** 2))
        significance = np.where(good, sign * self.total / np.sqrt(variance), 0.0)
        return Surface(
            rho, np.where(good, likelihood, 0.0), common, independent, energy, significance
        )


def products(left: Side, right: Side, reach: int, alike: Products | None = None) -> Products | None:
    """Correlate two sides over shifts of up to `reach` cells; None where either has hardly a cell.

    Under no match the sum over x of U(x) V(x + d) has the variance sum over lags of R_U R_V, whatever the
    fields' own correlation; dividing by it tells how many cells the square is really worth.

    Parameters
    ----------
    alike : products of the same `right` with another field under the weights of `left`: what does not
        depend on that field is taken from there.
    """
    if left.number < 25 or right.number < 25:
        return None
    size = left.size
    planes = [np.conj(left.field) * right.field, np.conj(left.square) * right.weight]
    if alike is None:
        planes += [np.conj(left.weight) * right.square, np.conj(left.mask) * right.mask]
    whole = fft.irfft2(np.stack(planes), s=(size, size))
    steps = np.arange(-reach, reach + 1) % size
    near = whole[:, steps[:, None], steps]
    power_v, common = (near[2], near[3]) if alike is None else (alike.power_v, alike.common)
    power = _squared(left.field) * _squared(right.field)
    # The half spectrum of a real field counts each inner column twice.
    total = 2.0 * float(power.sum(dtype=np.float64)) - float(power[:, 0].sum(dtype=np.float64))
    if size % 2 == 0:
        total -= float(power[:, -1].sum(dtype=np.float64))
    variance = total / (float(size) ** 2 * right.number)
    return Products(near[0], near[1], power_v, common, variance, left.number)


def _squared(spectrum: npt.NDArray[np.complexfloating[Any]]) -> FloatArray:
    squared: FloatArray = spectrum.real**2 + spectrum.imag**2
    return squared


def correlate(
    u: FloatArray, wu: FloatArray, v: FloatArray, wv: FloatArray, reach: int
) -> Surface | None:
    """Correlate two weighted fields over shifts of up to `reach` cells (`products`)."""
    found = products(Side.of(u, wu), Side.of(v, wv), reach)
    return None if found is None else found.surface()


# Of the objects that one pass shows the other shows about a third at the same place (other side, other
# range); the centres agree to about a metre and a half.
_SEEN_AGAIN = 0.3
_CENTRE_SIGMA_M = 1.5


def landmark_field(
    a: FloatArray, wa: FloatArray, b: FloatArray, wb: FloatArray, cell_m: float
) -> Fields | None:
    """Return first's objects as points and what a point gains, in log-likelihood, by lying on second.

    Objects are few, so they are a pattern of points and no texture: a point of the first strip that lands
    at a place where the second has objects of the same kind at density D gains
    ln(1 - p + p D / mean density), with p the chance of being seen again. One coincidence proves nothing,
    five in one shift do. Hills and craters have fields of their own, laid side by side.
    """
    if not (a.any() and b.any()):
        return None
    points, gains = [], []
    seen = (wb > 0).astype(np.float32)
    ground = float(seen.sum())
    width = np.sqrt(2.0) * _CENTRE_SIGMA_M / cell_m
    for sign in (1.0, -1.0):
        mine = np.where(wa > 0, np.maximum(sign * a * wa, 0.0), 0.0)
        theirs = np.where(wb > 0, np.maximum(sign * b * wb, 0.0), 0.0)
        mine, theirs = _unit_points(mine), _unit_points(theirs)
        if ground < 25 or not mine.any() or not theirs.any():
            continue
        # One more object than was counted: a lone one must not make its surroundings a desert.
        mean = (theirs.sum() + 1.0) / ground
        density = ndimage.gaussian_filter(theirs, width, truncate=3.5) / mean
        points.append(mine)
        gains.append(np.log(1.0 - _SEEN_AGAIN + _SEEN_AGAIN * density) * seen)
    if not points:
        return None
    one = np.ones_like(wa)
    if len(points) == 1:
        return points[0], one, gains[0].astype(np.float32), one
    stack = [np.stack(fields).astype(np.float32) for fields in (points, gains)]
    return stack[0], one, stack[1], one


def _unit_points(spread: FloatArray) -> FloatArray:
    """Return one unit per object from spikes that gridding shared among neighbouring cells."""
    label, count = ndimage.label(spread > 0, structure=np.ones((3, 3)))
    points = np.zeros_like(spread, dtype=np.float32)
    if count:
        index = np.arange(1, count + 1)
        for row, col in ndimage.center_of_mass(spread, label, index):
            points[round(row), round(col)] = 1.0
    return points


def coincide(
    points: FloatArray, _: FloatArray, gain: FloatArray, __: FloatArray, reach: int
) -> Surface:
    """Return the surface of what all points gain together, over the search."""
    size = gain.shape[-1]
    product = fft.irfft2(np.conj(fft.rfft2(points)) * fft.rfft2(gain), s=(size, size))
    total = product.sum(axis=0) if product.ndim == 3 else product
    steps = np.arange(-reach, reach + 1) % size
    likelihood = total[steps[:, None], steps]
    count = max(float(points.sum()), 1.0)
    top = np.log(1.0 + _SEEN_AGAIN / (2 * np.pi) * size**2)
    one = np.ones_like(likelihood)
    return Surface(
        rho=np.clip(likelihood / (count * top), -0.999, 0.999),
        log_likelihood=likelihood,
        common=one,
        independent=count * one,
        scale=one,
        significance=likelihood,
    )


def refine(
    fields: dict[str, Fields],
    gains: dict[str, float],
    best: FloatArray,
    inner: int,
    waves: dict[str, FloatArray] | None = None,
) -> tuple[FloatArray, FloatArray | None, FloatArray]:
    """Climb to the top of the summed correlation below a cell; return offset, covariance, lobe (cells).

    With X(k) the cross-spectrum of the squares at the whole-cell shift, the correlation's slope at a
    further shift d is the sum of -k Im X exp(ikd), its curvature that of -k k' Re X exp(ikd). What the two
    squares share has no imaginary part at the right d; what they do not has random phase. So the sum of
    k k' (Im X)^2 is the slope's variance, and curvature^-1 variance curvature^-1 the shift's (the
    sandwich), whatever the fields' spectra.

    Parameters
    ----------
    waves : (inner, inner // 2 + 1) by which each wave of a channel counts, where not all count alike.
    """
    waves = waves or {}
    # Channels that share their speckle (shading and echo) add up before they are squared below.
    total = np.zeros((inner, inner // 2 + 1), complex)
    filled = 0.0
    known: dict[int, tuple[npt.NDArray[np.complexfloating[Any]], float]] = {}
    for channel, gain in gains.items():
        if gain > 0:
            field = fields[channel]
            if id(field) not in known:
                known[id(field)] = _cross_spectrum(field, best, inner)
            spectrum, part = known[id(field)]
            total += spectrum * (waves.get(channel, 1.0) * (gain / inner**2))
            filled = max(filled, part)
    if not filled:
        return np.zeros(2), None, np.ones(2)
    ky = 2 * np.pi * fft.fftfreq(inner)[:, None]
    kx = 2 * np.pi * fft.rfftfreq(inner)[None, :]
    twice = np.full(kx.shape, 2.0)
    twice[0, 0] = 1.0
    if inner % 2 == 0:
        twice[0, -1] = 1.0
    offset, nothing = np.zeros(2), np.ones(2)
    for last in (False, False, True):
        turn = np.exp(1j * (kx * offset[0] + ky * offset[1]))
        x = total * turn
        slope = -np.array([(kx * twice * x.imag).sum(), (ky * twice * x.imag).sum()])
        curvature = _second_moments(kx, ky, twice * x.real)
        if np.linalg.eigvalsh(curvature).min() <= 0:
            return offset, None, nothing
        inverse = np.linalg.inv(curvature)
        if last:
            # Where the squares are filled in part, neighbouring modes move together.
            spread = _second_moments(kx, ky, (twice * x.imag) ** 2) / filled
            sandwich = inverse @ spread @ inverse
            # The curvature's own word where few objects decide, whose random phases are too few to average.
            covariance = max(sandwich, inverse, key=lambda c: float(np.trace(c)))
            return offset, covariance, np.sqrt(np.diag(inverse))
        offset = offset + np.clip(inverse @ slope, -0.8, 0.8)
    raise AssertionError("unreachable: the last round returns")


def _cross_spectrum(
    field: Fields, best: FloatArray, inner: int
) -> tuple[npt.NDArray[np.complexfloating[Any]], float]:
    """Return the cross-spectrum of the two squares at a whole-cell shift, and how far they are filled."""
    u, wu, v, wv = field
    edge = (u.shape[-1] - inner) // 2
    here = np.s_[..., edge : edge + inner, edge : edge + inner]
    col, row = best.astype(int)
    there = np.s_[..., edge + row : edge + row + inner, edge + col : edge + col + inner]
    # Weighed alike: where one pass's weight rises and the other's falls, as between two tracks, weights of their own
    # would draw the match along (by 0.1 m, the same way at each pair of neighbours).
    weight = np.sqrt(wu[here] * wv[there])
    both = weight > 0
    left, right = weight * u[here], weight * v[there]
    spectrum = np.conj(fft.rfft2(left)) * fft.rfft2(right)
    return spectrum.sum(axis=0) if spectrum.ndim == 3 else spectrum, float(both.mean())


def _second_moments(kx: FloatArray, ky: FloatArray, weight: FloatArray) -> FloatArray:
    xy = (kx * ky * weight).sum()
    return np.array([[(kx * kx * weight).sum(), xy], [xy, (ky * ky * weight).sum()]])


def fan_filters(
    values: FloatArray, weights: FloatArray, gains: Sequence[FloatArray]
) -> list[FloatArray]:
    """Return a field with each wave of its spectrum multiplied by each of `gains` (`wave_directions`' shape)."""
    if not gains:
        return []
    spectrum = fft.rfft2(np.where(weights > 0, values, 0.0).astype(np.float32))
    planes = spectrum * np.stack(gains).astype(np.float32)
    filtered = fft.irfft2(planes, s=values.shape)
    return [np.where(weights > 0, plane, 0.0).astype(np.float32) for plane in filtered]


@lru_cache(maxsize=32)
def wave_directions(size: int) -> tuple[FloatArray, FloatArray]:
    """Return unit east and north components of the waves of a half spectrum, zero for the mean."""
    north = fft.fftfreq(size)[:, None] + np.zeros(size // 2 + 1)
    east = fft.rfftfreq(size)[None, :] + np.zeros((size, 1))
    length = np.hypot(east, north)
    length[0, 0] = 1.0
    return east / length, north / length
