"""Multigrid for the joint problem: heights, log-albedo and gains on nested grids.

The data of a cell enter as one symmetric 4 x 4 matrix (ten numbers) on (slope east, slope north, mean
height, mean albedo), whatever the number of looks; on a coarser grid as an 8 x 8 matrix on the corners, the sum over its
four children. On the coarsest grid heights, albedo and gains are solved directly, as one system; on the grids between
what ties the gains to the fields is kept at every residual (`perception.coupling`), for a gain and a dome between
tracks explain nearly the same echoes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import sparse

from perception.bands import over_bands
from perception.coarse import CoarseSolver, level_matrix
from perception.coupling import Coupling
from perception.level_kernels import (
    add_rows,
    advance,
    apply_corners,
    apply_features,
    begin,
    coarsen_rows,
    dot_rows,
    prolong_rows,
    read_equations,
    restrict_rows,
    spread_equations,
)
from perception.records import FloatArray, IntArray
from perception.stencils import child_map, feature_map, packed_map

# Heights, log-albedo and gains.
Fields = tuple[FloatArray, FloatArray, FloatArray]

# Nodes that are solved directly. More of them take no step off the solution and cost more than the grid they save.
COARSEST_NODES = 1200
# Places of the diagonal in a packed upper triangle of 8 rows.
_DIAGONAL = [8 * k - k * (k - 1) // 2 for k in range(8)]
# The diagonally scaled operator has no eigenvalue beyond the number of unknowns that one cell ties together;
# equations on many nodes enter the diagonal by their absolute row sums, which bound them by one.
_BOUND = 8.0
_LANCZOS_STEPS = 10
_SMOOTHING = 3


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
    """The data of the finest grid: cells' matrices on features, packed (10, rows, cols)."""

    moments: FloatArray
    cell_m: float

    @property
    def shape(self) -> tuple[int, int]:
        return self.moments.shape[1], self.moments.shape[2]

    def diagonal(self) -> FloatArray:
        """Return what each cell adds to the diagonal of its corners' z and a (8, rows, cols)."""
        m, h = self.moments, self.cell_m
        out = np.empty((8, *self.shape))
        for k in range(4):
            e = (1 if k % 2 else -1) / (2 * h)
            n = (1 if k // 2 else -1) / (2 * h)
            out[k] = m[0] * e * e + m[4] * n * n + m[7] / 16
            out[k] += 2 * (m[1] * e * n + m[2] * e / 4 + m[5] * n / 4)
        out[4:] = m[9] / 16
        return out

    def local(self) -> FloatArray:
        """Return the cells' matrices on their corners, packed (36, rows, cols)."""
        change = packed_map(feature_map(self.cell_m)).astype(np.float32)
        return np.tensordot(change, self.moments, 1)

    def child(self, number: int) -> FloatArray:
        """Return what makes a parent's packed matrix (36) of a child's (10)."""
        return packed_map(feature_map(self.cell_m) @ child_map(number))


@dataclass(frozen=True, slots=True)
class CornerData:
    """The data of a coarser grid: cells' matrices on their corners' z and a, packed (36, rows, cols).

    Within a wide cell a bilinear field has gradients that differ from child to child; the four features of its
    mean would not see that, and the coarse solution would overshoot. Single precision: these grids only precondition.
    """

    packed: FloatArray

    @property
    def shape(self) -> tuple[int, int]:
        return self.packed.shape[1], self.packed.shape[2]

    def diagonal(self) -> FloatArray:
        """Return what each cell adds to the diagonal of its corners' z and a (8, rows, cols)."""
        return np.asarray(self.packed[_DIAGONAL], float)

    def local(self) -> FloatArray:
        return self.packed

    def child(self, number: int) -> FloatArray:
        """Return what makes a parent's packed matrix (36) of a child's (36)."""
        return packed_map(child_map(number))


def coarser(data: FeatureData | CornerData) -> CornerData:
    """Return the data on cells twice as wide: exact for bilinear fields."""
    rows, cols = data.shape
    out = np.empty((36, rows // 2, cols // 2), np.float32)
    maps = sparse.csr_matrix(np.concatenate([data.child(k) for k in range(4)], axis=1))
    fine = data.moments if isinstance(data, FeatureData) else data.packed
    over_bands(
        coarsen_rows, rows // 2, out.size, fine, maps.indptr, maps.indices,
        maps.data.astype(np.float32), out,
    )  # fmt: skip
    return CornerData(out)


@dataclass(frozen=True, slots=True)
class Tie:
    """Linear equations on few of the nodes: a matrix on those alone, and its transpose."""

    matrix: sparse.csr_matrix
    weight: FloatArray
    nodes: IntArray
    spread: sparse.csr_matrix = field(init=False)

    @classmethod
    def of(cls, matrix: sparse.csr_matrix, weight: FloatArray) -> Tie:
        matrix.sum_duplicates()
        used = np.zeros(matrix.shape[1], np.bool_)
        used[matrix.indices] = True
        return cls(matrix, weight, np.flatnonzero(used))

    def __post_init__(self) -> None:
        place = np.zeros(self.matrix.shape[1], np.int32)
        place[self.nodes] = np.arange(len(self.nodes))
        read = sparse.csr_matrix(
            (self.matrix.data, place[self.matrix.indices], self.matrix.indptr),
            shape=(self.matrix.shape[0], len(self.nodes)),
        )
        object.__setattr__(self, "spread", sparse.csr_matrix(read.T))

    def add(self, z: FloatArray, out: FloatArray) -> None:
        """Add the equations' normal matrix applied to `z`."""
        if not len(self.nodes):
            return
        at, m, s = np.empty(len(self.weight)), self.matrix, self.spread
        over_bands(
            read_equations, len(at), m.nnz, m.indptr, m.indices, m.data, self.weight,
            z.reshape(-1), at,
        )  # fmt: skip
        over_bands(
            spread_equations, len(self.nodes), s.nnz, s.indptr, s.indices, s.data, self.nodes, at,
            out.reshape(-1),
        )  # fmt: skip

    def coarser(self, nodes: tuple[int, int]) -> Tie:
        return Tie.of(sparse.csr_matrix(self.matrix @ prolongation_matrix(*nodes)), self.weight)


@dataclass(slots=True)
class Level:
    """One grid of the hierarchy with its operator on (heights, albedo)."""

    cell_m: float
    data: FeatureData | CornerData
    height: Spectrum
    albedo: Spectrum
    tie: Tie
    coupling: Coupling
    diagonal: tuple[FloatArray, FloatArray] = field(init=False)
    largest: float = field(init=False)

    def __post_init__(self) -> None:
        self.diagonal = self._diagonal()
        self.largest = min(1.1 * self._largest_eigenvalue(), _BOUND)

    @property
    def shape(self) -> tuple[int, int]:
        return self.data.shape[0] + 1, self.data.shape[1] + 1

    def apply(self, z: FloatArray, a: FloatArray) -> tuple[FloatArray, FloatArray]:
        out_z, out_a = np.empty_like(z), np.empty_like(a)
        priors = self.height.coefficients(self.cell_m), self.albedo.coefficients(self.cell_m)
        if isinstance(self.data, FeatureData):
            over_bands(
                apply_features, z.shape[0], z.size, self.data.moments, z, a, self.cell_m, *priors,
                out_z, out_a,
            )  # fmt: skip
        else:
            over_bands(
                apply_corners, z.shape[0], z.size, self.data.packed, z, a, *priors, out_z, out_a
            )
        self.tie.add(z, out_z)
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
        if self.tie.matrix.shape[0]:
            size = abs(self.tie.matrix)
            reach = self.tie.weight * np.asarray(size.sum(axis=1)).ravel()
            d_z += (size.T @ reach).reshape(d_z.shape)
        return d_z.astype(np.float32), d_a.astype(np.float32)

    def _largest_eigenvalue(self) -> float:
        """Return the largest eigenvalue of the diagonally scaled operator, by Lanczos' iteration.

        A smoother built on too small a value makes errors grow and conjugate gradients fail.
        """
        scale = [1 / np.sqrt(d) for d in self.diagonal]
        rng = np.random.default_rng(0)
        v: list[FloatArray] = [rng.standard_normal(self.shape, np.float32) for _ in scale]
        before: list[FloatArray] = [np.zeros(self.shape, np.float32) for _ in scale]
        on: list[float] = []
        off: list[float] = []
        norm = float(np.sqrt(dot(v, v)))
        for _ in range(min(_LANCZOS_STEPS, 2 * v[0].size)):
            for part in v:
                part /= norm
            w = self.apply(scale[0] * v[0], scale[1] * v[1])
            for part, s in zip(w, scale, strict=True):
                part *= s
            on.append(dot(v, w))
            add_times(w, -on[-1], v)
            if off:
                add_times(w, -off[-1], before)
            norm = float(np.sqrt(dot(w, w)))
            if norm < 1e-9 * on[0]:
                break
            off.append(norm)
            before, v = v, list(w)
        rest = off[: len(on) - 1]
        return float(np.linalg.eigvalsh(np.diag(on) + np.diag(rest, 1) + np.diag(rest, -1))[-1])

    def smooth(
        self, z: FloatArray, a: FloatArray, b_z: FloatArray, b_a: FloatArray, anew: bool = False
    ) -> None:
        """Damp the upper part of the spectrum of the error of (z, a) by a Chebyshev polynomial, in place.

        `anew` : begin from zero, whatever (z, a) hold: saves an application of the operator.
        """
        high, low = self.largest, self.largest / 10
        middle, half = (high + low) / 2, (high - low) / 2
        sigma = middle / half
        keep, gain, rho = 0.0, 1 / middle, 1 / sigma
        s_z, s_a = (
            (np.empty_like(z), np.empty_like(a)) if anew else (np.zeros_like(z), np.zeros_like(a))
        )
        for k in range(_SMOOTHING):
            following = 1 / (2 * sigma - rho)
            if anew and k == 0:
                for b, d, s, x in zip((b_z, b_a), self.diagonal, (s_z, s_a), (z, a), strict=True):
                    over_bands(begin, x.shape[0], x.size, b, d, gain, s, x)
                keep, gain, rho = following * rho, 2 * following / half, following
                continue
            applied = self.apply(z, a)
            for b, y, d, s, x in zip(
                (b_z, b_a), applied, self.diagonal, (s_z, s_a), (z, a), strict=True
            ):
                over_bands(advance, x.shape[0], x.size, b, y, d, keep, gain, s, x)
            keep, gain, rho = following * rho, 2 * following / half, following


def dot(u: Sequence[FloatArray], v: Sequence[FloatArray]) -> float:
    """Return the inner product of fields; the same whatever the number of threads."""
    total = 0.0
    for x, y in zip(u, v, strict=True):
        if x.ndim == 1:
            total += float(np.sum(x * y))
            continue
        parts = np.empty(x.shape[0])
        over_bands(dot_rows, x.shape[0], x.size, x, y, parts)
        total += float(np.sum(parts))
    return total


def add_times(x: Sequence[FloatArray], factor: float, y: Sequence[FloatArray]) -> None:
    """Add `factor` times the fields `y` to `x`, in place."""
    for out, value in zip(x, y, strict=True):
        if out.ndim == 1:
            out += factor * value
        else:
            over_bands(add_rows, out.shape[0], out.size, factor, value, out)


def prolong(coarse: FloatArray) -> FloatArray:
    """Interpolate nodes of a grid to the grid of half its cell, bilinearly."""
    rows, cols = coarse.shape
    fine = np.empty((2 * rows - 1, 2 * cols - 1), coarse.dtype)
    over_bands(prolong_rows, fine.shape[0], fine.size, coarse, fine)
    return fine


def restrict(fine: FloatArray) -> FloatArray:
    """Apply the transpose of `prolong`."""
    rows, cols = fine.shape
    coarse = np.empty((rows // 2 + 1, cols // 2 + 1), fine.dtype)
    over_bands(restrict_rows, coarse.shape[0], fine.size, fine, coarse)
    return coarse


def prolongation_matrix(rows: int, cols: int) -> sparse.csr_matrix:
    """Return `prolong` of a grid (rows, cols) as a matrix."""

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
    coarsest: CoarseSolver

    @classmethod
    def build(
        cls,
        cell_m: float,
        moments: FloatArray,
        height: Spectrum,
        albedo: Spectrum,
        tie: Tie,
        couplings: Sequence[Coupling],
        gain_block: FloatArray,
    ) -> Hierarchy:
        """Build all grids down to the one that is factorised.

        Parameters
        ----------
        moments : the data of the finest grid, (10, rows - 1, cols - 1).
        tie : equations on heights.
        couplings : of the finest grid and, as far as they are at hand, of the next ones.
        gain_block : normal matrix of the gains alone, data and prior.
        """
        data: FeatureData | CornerData = FeatureData(moments, cell_m)
        levels = [Level(cell_m, data, height, albedo, tie, couplings[0])]
        while can_halve(levels[-1].shape):
            fine = levels[-1]
            data = coarser(fine.data)
            nodes = (data.shape[0] + 1, data.shape[1] + 1)
            if len(levels) < len(couplings):
                coupling = couplings[len(levels)]
            else:
                coupling = fine.coupling.coarser(prolongation_matrix(*nodes))
            tie = fine.tie.coarser(nodes)
            levels.append(Level(2 * fine.cell_m, data, height, albedo, tie, coupling))
        last = levels[-1]
        matrix = level_matrix(
            last.data.local(),
            last.height.coefficients(last.cell_m),
            last.albedo.coefficients(last.cell_m),
            last.tie.matrix,
            last.tie.weight,
        )
        return cls(levels, CoarseSolver.build(matrix, last.coupling.dense(), gain_block))

    def cycle(self, b_z: FloatArray, b_a: FloatArray, b_g: FloatArray) -> Fields:
        """Return an approximate solution for the right-hand side: symmetric, and positive.

        Before and after the coarser grids' part the fields are smoothed; gains move on the coarsest grid alone, but
        what they and the fields do to one another's residual is taken along on every grid. Left out on the finest
        grid, or read there through the next one's, it costs little where looks cross; with one pass alone
        it trebles the steps. Fields are in single precision: what it rounds is a correction.
        """
        z, a, gain = self._cycle(np.asarray(b_z, np.float32), np.asarray(b_a, np.float32), b_g, 0)
        return z.astype(float), a.astype(float), gain

    def _cycle(self, b_z: FloatArray, b_a: FloatArray, b_g: FloatArray, at: int) -> Fields:
        if at == len(self.levels) - 1:
            z, a, gain = self.coarsest.solve(b_z, b_a, b_g)
            return z.astype(np.float32), a.astype(np.float32), gain
        level = self.levels[at]
        z, a = np.empty_like(b_z), np.empty_like(b_a)
        level.smooth(z, a, b_z, b_a, anew=True)
        y_z, y_a = level.apply(z, a)
        felt = b_g - level.coupling.gains_of(z, a)
        c_z, c_a, gain = self._cycle(restrict(b_z - y_z), restrict(b_a - y_a), felt, at + 1)
        z += prolong(c_z)
        a += prolong(c_a)
        of_z, of_a = level.coupling.fields_of(gain, np.float32)
        level.smooth(z, a, b_z - of_z, b_a - of_a)
        return z, a, gain


def can_halve(shape: tuple[int, int]) -> bool:
    """Return whether a grid is too large to be solved directly and has a coarser one."""
    rows, cols = shape
    return rows * cols > COARSEST_NODES and all(n % 2 == 1 and n >= 9 for n in shape)
