"""Multigrid for the fields of the joint problem: heights and log-albedo on nested grids.

The data of a cell enter as one symmetric 4 x 4 matrix (ten numbers) on (slope east, slope north, mean
height, mean albedo), whatever the number of looks; a coarser grid's matrix is the sum over its four
children, which makes a V-cycle cheap.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import sparse

from perception.records import FloatArray
from perception.stencils import (
    apply_data,
    apply_local,
    apply_prior,
    coarsen_local,
    local_of_moments,
)

# Places of the diagonal in a packed upper triangle of 8 rows.
_DIAGONAL = [8 * k - k * (k - 1) // 2 for k in range(8)]
# The diagonally scaled operator has no eigenvalue beyond the number of unknowns that one cell ties together;
# equations on many nodes enter the diagonal by their absolute row sums, which bound them by one.
_BOUND = 8.0
_LANCZOS_STEPS = 10


@dataclass(frozen=True, slots=True)
class Spectrum:
    """A random field's precision against wave number k: ``p0 + p1 k^2 + p2 k^4`` (isotropic)."""

    p0: float
    p1: float
    p2: float

    def coefficients(self, cell_m: float) -> tuple[float, float, float]:
        """Return the weights of squared value, first and second difference on a grid."""
        return self.p0 * cell_m**2, self.p1, self.p2 / cell_m**2


@dataclass(frozen=True, slots=True)
class FeatureData:
    """The data of the finest grid: cells' matrices on features, packed (rows, cols, 10)."""

    moments: FloatArray
    cell_m: float

    @property
    def shape(self) -> tuple[int, int]:
        return self.moments.shape[0], self.moments.shape[1]

    def add(self, z: FloatArray, a: FloatArray, out_z: FloatArray, out_a: FloatArray) -> None:
        apply_data(self.moments, z, a, self.cell_m, out_z, out_a)

    def diagonal(self) -> FloatArray:
        """Return what each cell adds to the diagonal of its corners' z and a (8, rows, cols)."""
        m, h = np.moveaxis(self.moments, 2, 0), self.cell_m
        out = np.empty((8, *self.shape))
        for k in range(4):
            e = (1 if k % 2 else -1) / (2 * h)
            n = (1 if k // 2 else -1) / (2 * h)
            out[k] = m[0] * e * e + m[4] * n * n + m[7] / 16
            out[k] += 2 * (m[1] * e * n + m[2] * e / 4 + m[5] * n / 4)
        out[4:] = m[9] / 16
        return out

    def coarser(self) -> CornerData:
        return CornerData(coarsen_local(local_of_moments(self.moments, self.cell_m)))


@dataclass(frozen=True, slots=True)
class CornerData:
    """The data of a coarser grid: cells' matrices on their corners' z and a, packed (rows, cols, 36).

    Within a wide cell a bilinear field has gradients that differ from child to child; the four features of its
    mean would not see that, and the coarse solution would overshoot.
    """

    local: FloatArray

    @property
    def shape(self) -> tuple[int, int]:
        return self.local.shape[0], self.local.shape[1]

    def add(self, z: FloatArray, a: FloatArray, out_z: FloatArray, out_a: FloatArray) -> None:
        apply_local(self.local, z, a, out_z, out_a)

    def diagonal(self) -> FloatArray:
        """Return what each cell adds to the diagonal of its corners' z and a (8, rows, cols)."""
        return np.moveaxis(self.local[:, :, _DIAGONAL], 2, 0)

    def coarser(self) -> CornerData:
        return CornerData(coarsen_local(self.local))


@dataclass(slots=True)
class Level:
    """One grid of the hierarchy with its operator."""

    cell_m: float
    data: FeatureData | CornerData
    height: Spectrum
    albedo: Spectrum
    rows: sparse.csr_matrix
    row_weight: FloatArray
    diagonal: tuple[FloatArray, FloatArray] = field(init=False)
    largest: float = field(init=False)
    turned: sparse.csr_matrix = field(init=False)

    def __post_init__(self) -> None:
        self.turned = sparse.csr_matrix(self.rows.T)
        self.diagonal = self._diagonal()
        self.largest = min(1.1 * self._largest_eigenvalue(), _BOUND)

    @property
    def shape(self) -> tuple[int, int]:
        return self.data.shape[0] + 1, self.data.shape[1] + 1

    def apply(self, z: FloatArray, a: FloatArray) -> tuple[FloatArray, FloatArray]:
        out_z = np.zeros_like(z)
        out_a = np.zeros_like(a)
        self.data.add(z, a, out_z, out_a)
        apply_prior(z, *self.height.coefficients(self.cell_m), out_z)
        apply_prior(a, *self.albedo.coefficients(self.cell_m), out_a)
        if self.rows.shape[0]:
            out_z += (self.turned @ (self.row_weight * (self.rows @ z.ravel()))).reshape(z.shape)
        return out_z, out_a

    def _diagonal(self) -> tuple[FloatArray, FloatArray]:
        rows, cols = self.shape
        d_z = np.zeros((rows, cols))
        d_a = np.zeros((rows, cols))
        own = self.data.diagonal()
        for k, (di, dj) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
            corner = slice(di, di + rows - 1), slice(dj, dj + cols - 1)
            d_z[corner] += own[k]
            d_a[corner] += own[4 + k]
        for d, spectrum in ((d_z, self.height), (d_a, self.albedo)):
            k0, k1, k2 = spectrum.coefficients(self.cell_m)
            d += k0 + 4 * k1 + 20 * k2
        if self.rows.shape[0]:
            size = abs(self.rows)
            reach = self.row_weight * np.asarray(size.sum(axis=1)).ravel()
            d_z += (size.T @ reach).reshape(d_z.shape)
        return d_z, d_a

    def _largest_eigenvalue(self) -> float:
        """Return the largest eigenvalue of the diagonally scaled operator, by Lanczos' iteration.

        A smoother built on too small a value makes errors grow and conjugate gradients fail.
        """
        scale = tuple(1 / np.sqrt(d) for d in self.diagonal)
        rng = np.random.default_rng(0)
        v = np.stack([rng.standard_normal(self.shape) for _ in range(2)])
        v /= np.linalg.norm(v)
        before = np.zeros_like(v)
        on, off = [], [0.0]
        for _ in range(min(_LANCZOS_STEPS, v.size)):
            w = np.stack(self.apply(scale[0] * v[0], scale[1] * v[1])) * scale
            on.append(float(np.vdot(v, w)))
            w -= on[-1] * v + off[-1] * before
            off.append(float(np.linalg.norm(w)))
            if off[-1] < 1e-9 * on[0]:
                break
            before, v = v, w / off[-1]
        small = np.diag(on) + np.diag(off[1 : len(on)], 1) + np.diag(off[1 : len(on)], -1)
        return float(np.linalg.eigvalsh(small)[-1])

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
        data: FeatureData | CornerData = FeatureData(moments, cell_m)
        levels = [Level(cell_m, data, height, albedo, rows, row_weight)]
        while all(n % 2 == 0 and n >= 8 for n in data.shape):
            fine = levels[-1]
            data = fine.data.coarser()
            nodes = (data.shape[0] + 1, data.shape[1] + 1)
            coarse_rows = sparse.csr_matrix(fine.rows @ _prolongation_matrix(*nodes))
            levels.append(Level(2 * fine.cell_m, data, height, albedo, coarse_rows, row_weight))
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
