"""Particle filter on offset, heading bias and scale, the depth bias marginalised in each particle.

It finds the place: from 50 m an axis to a few metres, through any number of rival places. Regularised
(Musso, Oudjane & LeGland 2001): resampled particles are drawn from a kernel density, so constant
parameters do not collapse; with the shrinkage of Liu & West (2001) once one place is left, which
keeps the covariance, and with a kernel of metres while several are, which keeps them apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from localization.likelihood import GATE, sounding_noise
from localization.measurements import Soundings
from localization.terrain import TerrainMap
from perception.records import FloatArray

# A spread above this may hold rivals: no shrinkage to a common mean, which would lie between them.
_RIVALS_M = 15.0
# Kernel while rivals may live: the spacing of thousands of particles over 50 m an axis.
_KERNEL_M = 1.5


@dataclass(slots=True)
class Cloud:
    """Particles: offsets, heading bias, scale, depth bias' mean and variance, log weights; (n,)."""

    east: FloatArray
    north: FloatArray
    turn: FloatArray
    scale: FloatArray
    bias: FloatArray
    bias_var: FloatArray
    log_weight: FloatArray

    @property
    def count(self) -> int:
        return len(self.east)


class ParticleFilter:
    """Terrain-matching particle filter; `start`, then `predict` and `update` for every row.

    Parameters
    ----------
    terrain : the prior map.
    count : number of particles once the search has narrowed; it starts with `wide` of them.
    rng : source of every random draw.
    """

    def __init__(
        self, terrain: TerrainMap, count: int, rng: np.random.Generator, wide: int | None = None
    ) -> None:
        self.terrain = terrain
        self.count = count
        self.wide = max(wide or 4 * count, count)
        self.rng = rng
        self.cloud = _empty_cloud(1)
        self.work = np.empty((7, 1), np.float32)
        self._known: tuple[FloatArray, FloatArray] | None = None
        # On a slope, range noise is horizontal too; the map's rms slope says how much.
        cell = terrain.cell_m
        self.slope = float(np.sqrt(2 * terrain.structure_m2(np.array([cell]))[0])) / cell

    def start(self, mean: FloatArray, covariance: FloatArray) -> None:
        """Draw the cloud around a Gaussian of (east, north, turn, scale, depth bias), (5,) and (5, 5).

        Half of the particles are drawn three times as wide and carry the weights to match, so that a
        start error of three or four sigmas still has particles beside it.
        """
        n = self.wide
        root = np.linalg.cholesky(covariance[:4, :4] + 1e-12 * np.eye(4))
        white = self.rng.standard_normal((n, 4))
        stretch = np.ones((n, 4))
        stretch[n // 2 :, :2] = 3.0
        white *= stretch
        distance = np.sum(white[:, :2] ** 2, axis=1)
        proposal = 0.5 * np.exp(-0.5 * distance) + 0.5 * np.exp(-0.5 * distance / 9.0) / 9.0
        states = mean[:4] + white @ root.T
        # The depth bias that goes with each state, and what is left of its variance.
        slope = np.linalg.solve(covariance[:4, :4] + 1e-12 * np.eye(4), covariance[:4, 4])
        bias = mean[4] + (states - mean[:4]) @ slope
        left = max(float(covariance[4, 4] - covariance[:4, 4] @ slope), 1e-6)
        east, north, turn, scale = np.ascontiguousarray(states.T)
        self.take(
            Cloud(
                east,
                north,
                turn,
                scale,
                bias=bias,
                bias_var=np.full(n, left),
                log_weight=-0.5 * distance - np.log(proposal),
            )
        )

    def take(self, cloud: Cloud) -> None:
        """Take another cloud."""
        self.cloud = cloud
        self._known = None

    def predict(self, step_e: float, step_n: float, walk_m2: float) -> None:
        """Move every particle by what its scale and heading bias make of a dead-reckoned step."""
        c = self._changed()
        noise = self.rng.standard_normal((2, c.count), dtype=np.float32)
        _move(c.east, c.north, c.turn, c.scale, step_e, step_n, np.sqrt(walk_m2), noise)

    def shift(self, jump: FloatArray) -> None:
        """Move every offset: the dead-reckoned position jumped."""
        c = self._changed()
        c.east += jump[0]
        c.north += jump[1]

    def update(
        self, soundings: Soundings, easting_m: float, northing_m: float, step_m: float,
        bias_walk_m2: float,
    ) -> float:  # fmt: skip
        """Weigh the cloud by an update's soundings; resample when few particles carry it.

        Returns
        -------
        The share of soundings that fit, over all particles: 0 when all are off the map.
        """
        noise = sounding_noise(soundings, self.terrain, self.slope, step_m)
        c = self._changed()
        if self.work.shape[1] != c.count:
            self.work = np.empty((7, c.count), np.float32)
        effective, fitting = weigh(
            self.terrain.height_m, self.terrain.frame, c.east, c.north, c.turn, c.bias, c.bias_var,
            c.log_weight, easting_m, northing_m, soundings.east_m, soundings.north_m,
            soundings.elevation_m, noise.inflated_m2, bias_walk_m2, self.work,
        )  # fmt: skip
        if effective < 0.5 * c.count:
            self._resample()
        return fitting / max(soundings.count * c.count, 1)

    def fuse(self, offset_m: FloatArray, covariance_m2: FloatArray) -> None:
        """Weigh the cloud by an outside fix (2,) of the offset; one in twenty may be wrong."""
        c = self._changed()
        d = np.stack([c.east - offset_m[0], c.north - offset_m[1]])
        distance = np.einsum("in,ij,jn->n", d, np.linalg.inv(covariance_m2), d)
        c.log_weight += np.log(0.95 * np.exp(-0.5 * distance) + 0.05 * np.exp(-0.5 * 9.0))
        c.log_weight -= c.log_weight.max()

    def moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean (5,) and covariance (5, 5) of east, north, turn, scale and depth bias."""
        if self._known is None:
            c = self.cloud
            self._known = _moments(
                c.east, c.north, c.turn, c.scale, c.bias, c.bias_var, c.log_weight
            )
        mean, covariance = self._known
        return mean.copy(), covariance.copy()

    def share_within(self, mean: FloatArray, covariance: FloatArray, sigmas: float) -> float:
        """Weight of the particles within an ellipse of the horizontal Gaussian given."""
        c = self.cloud
        weight = np.exp(c.log_weight - c.log_weight.max())
        d = np.stack([c.east - mean[0], c.north - mean[1]])
        distance = np.einsum("in,ij,jn->n", d, np.linalg.inv(covariance[:2, :2]), d)
        return float(weight[distance < sigmas**2].sum() / weight.sum())

    def _changed(self) -> Cloud:
        """Return the cloud, about to be changed: its moments are no longer known."""
        self._known = None
        return self.cloud

    def _resample(self) -> None:
        mean, covariance = self.moments()
        spread = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
        single = spread < _RIVALS_M
        n = self.count if spread < 2 * _RIVALS_M else self.wide
        # Silverman's rule for four dimensions.
        h = (4.0 / 6.0) ** (1 / 8) * n ** (-1 / 8)
        kernel = covariance[:4, :4].copy()
        if not single:
            kernel = np.diag(np.diag(kernel))
            kernel[0, 0] = min(kernel[0, 0], (_KERNEL_M / h) ** 2)
            kernel[1, 1] = min(kernel[1, 1], (_KERNEL_M / h) ** 2)
        root = h * np.linalg.cholesky(kernel + 1e-14 * np.eye(4))
        keep = np.sqrt(1 - h * h) if single else 1.0
        c = self.cloud
        noise = self.rng.standard_normal((4, n), dtype=np.float32)
        chosen = _systematic(c.log_weight, n, self.rng.random())
        east, north, turn, scale = _regularise(
            c.east, c.north, c.turn, c.scale, chosen, mean, keep, root, noise
        )
        self.take(
            Cloud(
                east,
                north,
                turn,
                scale,
                bias=c.bias[chosen],
                bias_var=c.bias_var[chosen],
                log_weight=np.zeros(n),
            )
        )


def _empty_cloud(n: int) -> Cloud:
    east, north, turn, scale, bias, bias_var, log_weight = np.zeros((7, n))
    return Cloud(east, north, turn, scale, bias, bias_var, log_weight)


@numba.njit(cache=True, fastmath={"contract", "arcp", "reassoc", "nsz"})
def _move(east, north, turn, scale, step_e, step_n, walk, noise):  # type: ignore[no-untyped-def]
    for i in range(east.size):
        east[i] += scale[i] * step_e + turn[i] * step_n + walk * noise[0, i]
        north[i] += scale[i] * step_n - turn[i] * step_e + walk * noise[1, i]


@numba.njit(cache=True, fastmath={"contract", "arcp", "reassoc", "nsz"}, error_model="numpy")
def weigh(  # type: ignore[no-untyped-def]
    heights, frame, east, north, turn, bias, bias_var, log_weight, pe, pn, oe, on, z, r, walk, work
):
    """Add every particle's log likelihood; see `localization.likelihood.bias_marginal`.

    The same sums, beam by beam over all particles in single precision and without branches, so that
    the compiler turns them into vector instructions; `work` is (7, n) float32 scratch.

    Returns
    -------
    effective number of particles, number of fits (0 where nothing meets the map)
    """
    one, zero, gate = np.float32(1.0), np.float32(0.0), np.float32(GATE * GATE)
    rows, cols = heights.shape
    flat = heights.ravel()
    per_e, per_n = 1.0 / frame[2], 1.0 / frame[3]
    # From 32,768 cells on, single precision rounds 1.001 cells from the end to the last one itself.
    last_col, last_row = np.float32(cols - 1), np.float32(rows - 1)
    top_col = min(np.float32(cols - 1.001), np.nextafter(last_col, zero))
    top_row = min(np.float32(rows - 1.001), np.nextafter(last_row, zero))
    width = np.int32(cols)
    col_0, row_0, twist, m, v, total, scale = work
    for i in range(east.size):
        col_0[i], row_0[i], twist[i] = east[i] * per_e, north[i] * per_n, turn[i]
        m[i], v[i] = bias[i], bias_var[i] + walk
        total[i], scale[i] = zero, one
    fitting = 0
    for j in range(z.size):
        # What is common to all particles is summed in double precision: a map is 1e6 m from 0.
        col_j = np.float32((pe + oe[j] - frame[0]) * per_e)
        row_j = np.float32((frame[1] - pn - on[j]) * per_n)
        turn_col, turn_row = np.float32(on[j] * per_e), np.float32(oe[j] * per_n)
        z_j, r_j = np.float32(z[j]), np.float32(r[j])
        for i in range(east.size):
            col = col_j + col_0[i] + twist[i] * turn_col
            row = row_j - row_0[i] + twist[i] * turn_row
            col_in = min(max(col, zero), top_col)
            row_in = min(max(row, zero), top_row)
            c, k = np.int32(col_in), np.int32(row_in)
            f_col, f_row = col_in - np.float32(c), row_in - np.float32(k)
            at = k * width + c
            top = flat[at] + f_col * (flat[at + np.int32(1)] - flat[at])
            low = flat[at + width]
            low = low + f_col * (flat[at + width + np.int32(1)] - low)
            height = top + f_row * (low - top)
            s = v[i] + r_j
            y = z_j - height - m[i]
            q = y * y / s
            known = (col_in == col) & (row_in == row) & (height == height)
            fits = known & (q <= gate)
            gain = v[i] / s if fits else zero
            total[i] += (q if fits else gate) if known else one
            scale[i] *= s
            m[i] += gain * y if fits else zero
            v[i] -= gain * v[i]
            fitting += fits
    best = -np.inf
    for i in range(east.size):
        bias[i], bias_var[i] = m[i], v[i]
        log_weight[i] -= 0.5 * (total[i] + np.log(scale[i]))
        best = max(best, log_weight[i])
    return _effective(log_weight, best), fitting


@numba.njit(cache=True)
def _effective(log_weight, best):  # type: ignore[no-untyped-def]
    """Bring the greatest log weight to 0; return the effective number of particles."""
    total = 0.0
    square = 0.0
    for i in range(log_weight.size):
        log_weight[i] -= best
        # Below e^-30 a particle is dead weight: spare the exponential.
        if log_weight[i] > -30.0:
            w = np.exp(np.float32(log_weight[i]))
            total += w
            square += w * w
    return total * total / square


@numba.njit(cache=True, fastmath={"contract", "arcp", "reassoc", "nsz"})
def _moments(east, north, turn, scale, bias, bias_var, log_weight):  # type: ignore[no-untyped-def]
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    layers = (east, north, turn, scale, bias)
    mean = np.empty(5)
    for a in range(5):
        mean[a] = _dot(weight, layers[a])
    covariance = np.empty((5, 5))
    apart = np.empty(east.size)
    for a in range(5):
        for i in range(east.size):
            apart[i] = weight[i] * (layers[a][i] - mean[a])
        for b in range(a + 1):
            covariance[a, b] = covariance[b, a] = _dot_less(apart, layers[b], mean[b])
    covariance[4, 4] += _dot(weight, bias_var)
    return mean, covariance


@numba.njit(cache=True, fastmath={"contract", "arcp", "reassoc", "nsz"})
def _dot(a, b):  # type: ignore[no-untyped-def]
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@numba.njit(cache=True, fastmath={"contract", "arcp", "reassoc", "nsz"})
def _dot_less(a, b, mean):  # type: ignore[no-untyped-def]
    total = 0.0
    for i in range(a.size):
        total += a[i] * (b[i] - mean)
    return total


@numba.njit(cache=True)
def _systematic(log_weight, n, offset):  # type: ignore[no-untyped-def]
    """Indices (n,) drawn by systematic resampling."""
    weight = np.exp(log_weight - log_weight.max())
    step = weight.sum() / n
    chosen = np.empty(n, np.int64)
    i = 0
    reached = weight[0]
    for k in range(n):
        at = (k + offset) * step
        while reached < at and i < weight.size - 1:
            i += 1
            reached += weight[i]
        chosen[k] = i
    return chosen


@numba.njit(cache=True)
def _regularise(east, north, turn, scale, chosen, mean, keep, root, noise):  # type: ignore[no-untyped-def]
    """Shrink the chosen particles to the mean by `keep` and add the kernel's noise."""
    n = chosen.size
    out = np.empty((4, n))
    for k in range(n):
        i = chosen[k]
        out[0, k] = mean[0] + keep * (east[i] - mean[0])
        out[1, k] = mean[1] + keep * (north[i] - mean[1])
        out[2, k] = mean[2] + keep * (turn[i] - mean[2])
        out[3, k] = mean[3] + keep * (scale[i] - mean[3])
        for a in range(4):
            for b in range(a + 1):
                out[a, k] += root[a, b] * noise[b, k]
    return out[0], out[1], out[2], out[3]
