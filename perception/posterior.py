"""The normal equations of the joint inversion, matrix-free, and their solution by multigrid.

Unknowns: height z and log-albedo a on the nodes of one grid, and gains. A datum belongs to a dual
cell (the square between four nodes) and sees four features of the fields there: the mean gradient
(east, north) of z, the mean of z, the mean of a. The data of a cell therefore enter as one symmetric
4x4 matrix (ten numbers), whatever the number of looks; a coarser grid's matrix is the sum over its
four children, which makes a multigrid preconditioner cheap.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import sparse

from perception.records import FloatArray, IntArray
from perception.stencils import (
    accumulate_moments,
    apply_data,
    apply_prior,
    dual_features,
    gain_normal,
    gain_to_features,
    rows_to_gain,
    spread_features,
)

# Heights, log-albedo and gains.
Fields = tuple[FloatArray, FloatArray, FloatArray]

# Upper triangle of the 4x4 matrix, row by row.
PAIRS = ((0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 3))


def add_prior_noise(
    b: FloatArray, weights: tuple[float, float, float], rng: np.random.Generator
) -> None:
    """Add noise whose covariance is the operator of `apply_prior`."""
    rows, cols = b.shape
    k0, k1, k2 = np.sqrt(weights)
    b += k0 * rng.standard_normal((rows, cols))
    east = k1 * rng.standard_normal((rows, cols - 1))
    b[:, 1:] += east
    b[:, :-1] -= east
    north = k1 * rng.standard_normal((rows - 1, cols))
    b[1:] += north
    b[:-1] -= north
    bend = k2 * rng.standard_normal((rows, cols - 2))
    b[:, 2:] += bend
    b[:, 1:-1] -= 2 * bend
    b[:, :-2] += bend
    bend = k2 * rng.standard_normal((rows - 2, cols))
    b[2:] += bend
    b[1:-1] -= 2 * bend
    b[:-2] += bend
    twist = np.sqrt(2) * k2 * rng.standard_normal((rows - 1, cols - 1))
    b[1:, 1:] += twist
    b[1:, :-1] -= twist
    b[:-1, 1:] -= twist
    b[:-1, :-1] += twist


@dataclass(frozen=True, slots=True)
class Spectrum:
    """A random field's precision against wave number k: ``p0 + p1 k^2 + p2 k^4`` (isotropic)."""

    p0: float
    p1: float
    p2: float

    def coefficients(self, cell_m: float) -> tuple[float, float, float]:
        """Return the weights of squared value, first and second difference on a grid."""
        return self.p0 * cell_m**2, self.p1, self.p2 / cell_m**2


@dataclass(slots=True)
class Level:
    """One grid of the hierarchy with its operator."""

    cell_m: float
    moments: FloatArray
    height: Spectrum
    albedo: Spectrum
    rows: sparse.csr_matrix
    row_weight: FloatArray
    diagonal: tuple[FloatArray, FloatArray] = field(init=False)
    largest: float = 0.0

    def __post_init__(self) -> None:
        self.diagonal = self._diagonal()
        self.largest = self._largest_eigenvalue()

    @property
    def shape(self) -> tuple[int, int]:
        return self.moments.shape[1] + 1, self.moments.shape[2] + 1

    def apply(self, z: FloatArray, a: FloatArray) -> tuple[FloatArray, FloatArray]:
        out_z = np.zeros_like(z)
        out_a = np.zeros_like(a)
        apply_data(self.moments, z, a, self.cell_m, out_z, out_a)
        apply_prior(z, *self.height.coefficients(self.cell_m), out_z)
        apply_prior(a, *self.albedo.coefficients(self.cell_m), out_a)
        if self.rows.shape[0]:
            out_z += (self.rows.T @ (self.row_weight * (self.rows @ z.ravel()))).reshape(z.shape)
        return out_z, out_a

    def _diagonal(self) -> tuple[FloatArray, FloatArray]:
        m, h = self.moments, self.cell_m
        rows, cols = self.shape
        d_z = np.zeros((rows, cols))
        d_a = np.zeros((rows, cols))
        for di, dj in ((0, 0), (0, 1), (1, 0), (1, 1)):
            e = (1 if dj else -1) / (2 * h)
            n = (1 if di else -1) / (2 * h)
            part = (
                m[0] * e * e + m[4] * n * n + m[7] / 16
                + 2 * (m[1] * e * n + m[2] * e / 4 + m[5] * n / 4)
            )  # fmt: skip
            d_z[di : di + rows - 1, dj : dj + cols - 1] += part
            d_a[di : di + rows - 1, dj : dj + cols - 1] += m[9] / 16
        for d, spectrum in ((d_z, self.height), (d_a, self.albedo)):
            k0, k1, k2 = spectrum.coefficients(h)
            d += k0 + 4 * k1 + 20 * k2
        if self.rows.shape[0]:
            d_z += (self.rows.multiply(self.rows).T @ self.row_weight).reshape(d_z.shape)
        return d_z, d_a

    def _largest_eigenvalue(self) -> float:
        """Bound the largest eigenvalue of the diagonally scaled operator by power iteration."""
        # A checkerboard start: the stencils' stiffest modes are the roughest.
        i, j = np.indices(self.shape)
        z = (-1.0) ** (i + j) + 0.3 * (-1.0) ** j
        a = z.copy()
        value = 1.0
        for _ in range(8):
            y_z, y_a = self.apply(z, a)
            y_z /= self.diagonal[0]
            y_a /= self.diagonal[1]
            value = float(np.sqrt(np.vdot(y_z, y_z) + np.vdot(y_a, y_a)))
            z, a = y_z / value, y_a / value
        return 1.15 * value

    def smooth(
        self, z: FloatArray, a: FloatArray, b_z: FloatArray, b_a: FloatArray, degree: int = 3
    ) -> tuple[FloatArray, FloatArray]:
        """Damp the upper part of the spectrum of the error by a Chebyshev polynomial."""
        high, low = self.largest, self.largest / 10
        middle, half = (high + low) / 2, (high - low) / 2
        sigma = middle / half
        rho = 1 / sigma
        d_z, d_a = self.diagonal
        y_z, y_a = self.apply(z, a)
        s_z = (b_z - y_z) / d_z / middle
        s_a = (b_a - y_a) / d_a / middle
        for k in range(degree):
            z = z + s_z
            a = a + s_a
            if k == degree - 1:
                break
            following = 1 / (2 * sigma - rho)
            y_z, y_a = self.apply(z, a)
            s_z = following * rho * s_z + 2 * following / half * (b_z - y_z) / d_z
            s_a = following * rho * s_a + 2 * following / half * (b_a - y_a) / d_a
            rho = following
        return z, a


def prolong(coarse: FloatArray) -> FloatArray:
    """Interpolate nodes of a grid to the grid of half its cell, bilinearly."""
    rows, cols = coarse.shape
    fine = np.empty((2 * rows - 1, 2 * cols - 1))
    fine[::2, ::2] = coarse
    fine[1::2, ::2] = 0.5 * (coarse[1:] + coarse[:-1])
    fine[:, 1::2] = 0.5 * (fine[:, 2::2] + fine[:, :-2:2])
    return fine


def restrict(fine: FloatArray) -> FloatArray:
    """Apply the transpose of `prolong`."""
    half = fine[:, ::2].copy()
    half[:, 1:] += 0.5 * fine[:, 1::2]
    half[:, :-1] += 0.5 * fine[:, 1::2]
    coarse = half[::2].copy()
    coarse[1:] += 0.5 * half[1::2]
    coarse[:-1] += 0.5 * half[1::2]
    return coarse


def _prolongation_matrix(rows: int, cols: int) -> sparse.csr_matrix:
    def line(n: int) -> sparse.csr_matrix:
        full = 2 * n - 1
        even = np.arange(n)
        odd = np.arange(n - 1)
        r = np.concatenate([2 * even, 2 * odd + 1, 2 * odd + 1])
        c = np.concatenate([even, odd, odd + 1])
        v = np.concatenate([np.ones(n), np.full(2 * (n - 1), 0.5)])
        return sparse.csr_matrix((v, (r, c)), shape=(full, n))

    return sparse.csr_matrix(sparse.kron(line(rows), line(cols)))


@dataclass(slots=True)
class Hierarchy:
    """Levels from fine to coarse, and the V-cycle that preconditions conjugate gradients."""

    levels: list[Level]

    @classmethod
    def build(
        cls,
        cell_m: float,
        moments: FloatArray,
        height: Spectrum,
        albedo: Spectrum,
        rows: sparse.csr_matrix,
        row_weight: FloatArray,
    ) -> Hierarchy:
        levels = [Level(cell_m, moments, height, albedo, rows, row_weight)]
        while all(n % 2 == 0 and n >= 8 for n in moments.shape[1:]):
            fine = levels[-1]
            moments = (
                fine.moments[:, ::2, ::2] + fine.moments[:, 1::2, ::2]
                + fine.moments[:, ::2, 1::2] + fine.moments[:, 1::2, 1::2]
            )  # fmt: skip
            nodes = (moments.shape[1] + 1, moments.shape[2] + 1)
            coarse_rows = sparse.csr_matrix(fine.rows @ _prolongation_matrix(*nodes))
            levels.append(Level(2 * fine.cell_m, moments, height, albedo, coarse_rows, row_weight))
        return cls(levels)

    def cycle(self, b_z: FloatArray, b_a: FloatArray, at: int = 0) -> tuple[FloatArray, FloatArray]:
        """Return an approximate solution of the fields' equations for the right-hand side."""
        level = self.levels[at]
        zero = np.zeros(level.shape)
        if at == len(self.levels) - 1:
            return level.smooth(zero, zero.copy(), b_z, b_a, degree=40)
        z, a = level.smooth(zero, zero.copy(), b_z, b_a)
        y_z, y_a = level.apply(z, a)
        c_z, c_a = self.cycle(restrict(b_z - y_z), restrict(b_a - y_a), at + 1)
        return level.smooth(z + prolong(c_z), a + prolong(c_a), b_z, b_a)


@dataclass(slots=True)
class Problem:
    """One linearised problem: data rows, equality rows on heights, priors, gain.

    The datum of a row: ``c . features + gain(knot) = value + noise``.
    """

    cell_m: float
    shape: tuple[int, int]
    cell: IntArray
    weight: FloatArray
    c_east: FloatArray
    c_north: FloatArray
    c_level: FloatArray
    value: FloatArray
    knot: IntArray
    share: FloatArray
    gain_precision: FloatArray
    rows: sparse.csr_matrix
    row_weight: FloatArray
    row_value: FloatArray
    height: Spectrum
    albedo: Spectrum
    mean_height: FloatArray
    hierarchy: Hierarchy = field(init=False)
    gain_block: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        rows, cols = self.shape
        moments = np.zeros((10, (rows - 1) * (cols - 1)))
        accumulate_moments(self.cell, self.weight, self.c_east, self.c_north, self.c_level, moments)
        self.hierarchy = Hierarchy.build(
            self.cell_m, moments.reshape(10, rows - 1, cols - 1), self.height, self.albedo,
            self.rows, self.row_weight,
        )  # fmt: skip
        block = self.gain_precision.copy()
        gain_normal(self.knot, self.share, self.weight, block)
        self.gain_block = block

    def gain_at(self, gain: FloatArray) -> FloatArray:
        return np.einsum("ij,ij->i", self.share, gain[self.knot])

    def apply(self, z: FloatArray, a: FloatArray, gain: FloatArray) -> Fields:
        out_z, out_a = self.hierarchy.levels[0].apply(z, a)
        features = self._features(z, a)
        out_g = self.gain_block @ gain
        rows_to_gain(
            self.cell, self.weight, self.c_east, self.c_north, self.c_level, self.knot,
            self.share, features, out_g,
        )  # fmt: skip
        self._spread(self.weight * self.gain_at(gain), out_z, out_a)
        return out_z, out_a, out_g

    def _features(self, z: FloatArray, a: FloatArray) -> FloatArray:
        rows, cols = self.shape
        features = np.empty((4, rows - 1, cols - 1))
        dual_features(z, a, self.cell_m, features)
        return features.reshape(4, -1)

    def _spread(self, value: FloatArray, out_z: FloatArray, out_a: FloatArray) -> None:
        rows, cols = self.shape
        q = np.zeros((4, (rows - 1) * (cols - 1)))
        gain_to_features(self.cell, value, self.c_east, self.c_north, self.c_level, q)
        spread_features(q.reshape(4, rows - 1, cols - 1), self.cell_m, out_z, out_a)

    def right_side(self) -> Fields:
        b_z = np.zeros(self.shape)
        b_a = np.zeros(self.shape)
        self._spread(self.weight * self.value, b_z, b_a)
        apply_prior(self.mean_height, *self.height.coefficients(self.cell_m), b_z)
        if self.rows.shape[0]:
            b_z += (self.rows.T @ (self.row_weight * self.row_value)).reshape(self.shape)
        v = self.weight * self.value
        n = len(self.gain_precision)
        b_g: FloatArray = np.bincount(
            self.knot.ravel(), (v[:, None] * self.share).ravel(), n
        ).astype(float)
        return b_z, b_a, b_g

    def perturbation(self, rng: np.random.Generator) -> Fields:
        """Draw a right-hand side whose solution is a sample of the posterior about zero.

        Every squared term of the cost, data and prior, gives its own derivative times unit noise.
        """
        b_z = np.zeros(self.shape)
        b_a = np.zeros(self.shape)
        noise = np.sqrt(self.weight) * rng.standard_normal(len(self.weight))
        self._spread(noise, b_z, b_a)
        for b, spectrum in ((b_z, self.height), (b_a, self.albedo)):
            add_prior_noise(b, spectrum.coefficients(self.cell_m), rng)
        if self.rows.shape[0]:
            draw = np.sqrt(self.row_weight) * rng.standard_normal(len(self.row_weight))
            b_z += (self.rows.T @ draw).reshape(self.shape)
        n = len(self.gain_precision)
        b_g: FloatArray = np.bincount(
            self.knot.ravel(), (noise[:, None] * self.share).ravel(), n
        ).astype(float)
        b_g = b_g + np.linalg.cholesky(self.gain_precision) @ rng.standard_normal(n)
        return b_z, b_a, b_g

    def solve(
        self,
        start: Fields,
        right: Fields,
        tolerance: float = 1e-4,
        most: int = 100,
    ) -> tuple[Fields, int]:
        """Solve by conjugate gradients, preconditioned by a V-cycle and the gain's own block."""
        gain_inverse = np.linalg.inv(self.gain_block)

        def precondition(r: Fields) -> Fields:
            z, a = self.hierarchy.cycle(r[0], r[1])
            return z, a, gain_inverse @ r[2]

        x: Fields = start
        y = self.apply(*x)
        r: Fields = _along(right, -1.0, y)
        s = precondition(r)
        p = s
        rs = _dot(r, s)
        first = rs
        if first <= 0.0:  # the start solves it: a flat floor under a flat start leaves no residual
            return x, 0
        for k in range(most):
            y = self.apply(*p)
            alpha = rs / _dot(p, y)
            x = _along(x, alpha, p)
            r = _along(r, -alpha, y)
            s = precondition(r)
            following = _dot(r, s)
            if following <= tolerance**2 * first:
                return x, k + 1
            p = _along(s, following / rs, p)
            rs = following
        return x, most


def _along(x: Fields, step: float, p: Fields) -> Fields:
    return x[0] + step * p[0], x[1] + step * p[1], x[2] + step * p[2]


def _dot(a: Fields, b: Fields) -> float:
    return float(sum(np.vdot(u, v) for u, v in zip(a, b, strict=True)))
