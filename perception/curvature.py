"""Mean and Gaussian curvature of a height raster, by the fundamental forms of the surface z(x, y).

x runs east and y north, z up, so a summit has H < 0. With p, q the slopes and r, s, t the second
derivatives z_xx, z_xy, z_yy, the first form is (1 + p^2, p q, 1 + q^2), the second (r, s, t) / W with
W^2 = 1 + p^2 + q^2, and

    H = ((1 + q^2) r - 2 p q s + (1 + p^2) t) / (2 W^3),      K = (r t - s^2) / W^4

(Besl & Jain 1986). No small-slope shortcut is taken: H and K of a sphere are those of a sphere on its flank.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from perception.records import FloatArray

Window = Literal["box", "gaussian"]
Operator = Literal["difference", "least-squares"]


@dataclass(frozen=True, slots=True)
class Derivatives:
    """Slopes and second derivatives of a surface, each (rows, cols); NaN where not determined."""

    p: FloatArray
    q: FloatArray
    r: FloatArray
    s: FloatArray
    t: FloatArray


@dataclass(frozen=True, slots=True)
class NoiseGain:
    """Variance of the derivatives per unit variance of the heights' noise.

    Each is a number or an array (rows, cols). By the symmetry of the kernels the slopes do not
    correlate with the second derivatives, nor s with r and t.
    """

    pp: Any
    qq: Any
    rr: Any
    ss: Any
    tt: Any
    rt: Any


@dataclass(frozen=True, slots=True)
class Curvature:
    """Mean and Gaussian curvature with their 1-sigma; each (rows, cols), NaN no data.

    Attributes
    ----------
    H, sigma_H : per metre; H < 0 where the surface is a summit (z up).
    K, sigma_K : per square metre.
    scale_m : Gaussian sigma of the smoothing, or its equivalent; 0 where none.
    noise_m : 1-sigma of the independent part of the heights' noise.
    """

    H: FloatArray
    K: FloatArray
    sigma_H: FloatArray
    sigma_K: FloatArray
    scale_m: FloatArray
    noise_m: FloatArray


def mean_and_gaussian(d: Derivatives) -> tuple[FloatArray, FloatArray]:
    """Return H and K, (rows, cols) each, from slopes and second derivatives."""
    w2 = 1 + d.p**2 + d.q**2
    mean = ((1 + d.q**2) * d.r - 2 * d.p * d.q * d.s + (1 + d.p**2) * d.t) / (2 * w2**1.5)
    gaussian = (d.r * d.t - d.s**2) / w2**2
    return mean, gaussian


def derivatives_3x3(
    z: FloatArray, cell_m: float, cell_north_m: float, operator: Operator = "difference"
) -> Derivatives:
    """Differentiate over 3 x 3 cells.

    Parameters
    ----------
    z : (rows, cols) heights, rows north to south; NaN no data.
    operator : "difference", central differences (error h^2/12 f'''' ), or "least-squares", the
        quadratic fitted to the nine cells (noise variance of r a third, error of r larger).

    Returns
    -------
    Derivatives
        A missing neighbour is extrapolated from up to four cells behind (cubic, else quadratic, else
        linear, else constant), so edges and rims of holes have derivatives too. NaN where z is NaN.
    """
    values = np.ascontiguousarray(z)
    if values.dtype not in (np.float32, np.float64):
        values = values.astype(np.float64)
    out = np.empty((5, *values.shape), values.dtype)
    _derivatives(values, cell_m, cell_north_m, operator == "least-squares", out)
    return Derivatives(*out)


@njit(cache=True)
def _along(z: npt.NDArray[Any], i: int, j: int, di: int, dj: int) -> float:
    """Return z one step from (i, j), extrapolated from the cells behind where it is missing."""
    rows, cols = z.shape
    a, b = i + di, j + dj
    if 0 <= a < rows and 0 <= b < cols and not np.isnan(z[a, b]):
        return z[a, b]
    back = np.empty(4)
    n = 0
    for k in range(4):
        a, b = i - k * di, j - k * dj
        if not (0 <= a < rows and 0 <= b < cols) or np.isnan(z[a, b]):
            break
        back[n] = z[a, b]
        n += 1
    if n == 4:
        return 4 * back[0] - 6 * back[1] + 4 * back[2] - back[3]
    if n == 3:
        return 3 * back[0] - 3 * back[1] + back[2]
    if n == 2:
        return 2 * back[0] - back[1]
    return z[i, j]


@njit(cache=True)
def stencil(z: npt.NDArray[Any], i: int, j: int, box: npt.NDArray[Any]) -> None:
    """Fill the 3 x 3 box of heights about (i, j), row 0 northernmost."""
    rows, cols = z.shape
    for a in range(3):
        for b in range(3):
            ii, jj = i + a - 1, j + b - 1
            if 0 <= ii < rows and 0 <= jj < cols and not np.isnan(z[ii, jj]):
                box[a, b] = z[ii, jj]
            else:
                box[a, b] = np.nan
    for a in range(3):
        for b in range(3):
            if np.isnan(box[a, b]) and (a == 1 or b == 1):
                box[a, b] = _along(z, i, j, a - 1, b - 1)
    for a in (0, 2):
        for b in (0, 2):
            if np.isnan(box[a, b]):
                # The twist term from the opposite corner where there is one: exact for quadratics.
                # In a corner, whose opposite is missing too, from a quadrant beside, where it turns sign.
                plain = box[a, 1] + box[1, b] - box[1, 1]
                twist = box[2 - a, 2 - b] - box[2 - a, 1] - box[1, 2 - b] + box[1, 1]
                if np.isnan(twist):
                    twist = box[2 - a, 1] + box[1, b] - box[2 - a, b] - box[1, 1]
                if np.isnan(twist):
                    twist = box[a, 1] + box[1, 2 - b] - box[a, 2 - b] - box[1, 1]
                box[a, b] = plain if np.isnan(twist) else plain + twist


@njit(cache=True, parallel=True)
def _derivatives(
    z: npt.NDArray[Any], dx: float, dy: float, fit: bool, out: npt.NDArray[Any]
) -> None:
    rows, cols = z.shape
    for i in prange(rows):
        box = np.empty((3, 3))
        d = np.empty(5)
        for j in range(cols):
            if np.isnan(z[i, j]):
                out[:, i, j] = np.nan
                continue
            stencil(z, i, j, box)
            differentiate(box, dx, dy, fit, d)
            for k in range(5):
                out[k, i, j] = d[k]


@njit(cache=True)
def differentiate(
    box: npt.NDArray[Any], dx: float, dy: float, fit: bool, d: npt.NDArray[Any]
) -> None:
    """Turn nine heights, row 0 northernmost, into p, q, r, s, t."""
    east, west = box[1, 2], box[1, 0]
    north, south, mid = box[0, 1], box[2, 1], box[1, 1]
    ne, nw, se, sw = box[0, 2], box[0, 0], box[2, 2], box[2, 0]
    d[3] = (ne + sw - nw - se) / (4 * dx * dy)
    if fit:
        d[0] = (ne + east + se - nw - west - sw) / (6 * dx)
        d[1] = (ne + north + nw - se - south - sw) / (6 * dy)
        d[2] = (ne + east + se + nw + west + sw - 2 * (north + mid + south)) / (3 * dx * dx)
        d[4] = (ne + north + nw + se + south + sw - 2 * (east + mid + west)) / (3 * dy * dy)
    else:
        d[0] = (east - west) / (2 * dx)
        d[1] = (north - south) / (2 * dy)
        d[2] = (east + west - 2 * mid) / (dx * dx)
        d[4] = (north + south - 2 * mid) / (dy * dy)


def curvature_of(
    d: Derivatives, gain: NoiseGain, noise_m: FloatArray, step: int = 1
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return H, K, sigma_H and sigma_K, (rows, cols) each.

    The heights' noise is propagated through the fit. First order in H; K = (r t - s^2) / W^4 takes
    the second-order term as well, because its gradient vanishes on a plane while its error does not.

    Parameters
    ----------
    gain, noise_m : noise gain of the derivatives and 1-sigma of the independent noise of one cell, on
        every `step`-th row and column from the first, bilinear between; (m, n) each.
    """
    maps = np.stack(
        [
            np.broadcast_to(np.asarray(g, np.float64) * noise_m**2, noise_m.shape)
            for g in (gain.pp, gain.qq, gain.rr, gain.ss, gain.tt, gain.rt)
        ]
    )
    out = np.empty((4, *d.p.shape), d.p.dtype)
    _curvature(d.p, d.q, d.r, d.s, d.t, maps, step, out)
    return out[0], out[1], out[2], out[3]


@njit(cache=True, parallel=True)
def _curvature(
    p: npt.NDArray[Any],
    q: npt.NDArray[Any],
    r: npt.NDArray[Any],
    s: npt.NDArray[Any],
    t: npt.NDArray[Any],
    maps: npt.NDArray[Any],
    step: int,
    out: npt.NDArray[Any],
) -> None:
    rows, cols = p.shape
    for i in prange(rows):
        d = np.empty(5)
        v = np.empty(6)
        line = np.empty((maps.shape[2], 6))
        _row_of_maps(maps, i / step, line)
        for j in range(cols):
            if np.isnan(p[i, j]):
                out[:, i, j] = np.nan
                continue
            d[0], d[1], d[2], d[3], d[4] = p[i, j], q[i, j], r[i, j], s[i, j], t[i, j]
            left = min(j // step, maps.shape[2] - 1)
            right = min(left + 1, maps.shape[2] - 1)
            b = (j - left * step) / step
            for k in range(6):
                v[k] = line[left, k] + b * (line[right, k] - line[left, k])
            out[0, i, j], out[1, i, j], out[2, i, j], out[3, i, j] = _forms(d, v)


@njit(cache=True)
def _row_of_maps(maps: npt.NDArray[Any], row: float, out: npt.NDArray[Any]) -> None:
    """Interpolate every map at a fractional row, held constant beyond the last, (nodes, maps)."""
    i = min(int(row), maps.shape[1] - 1)
    k = min(i + 1, maps.shape[1] - 1)
    a = min(row - i, 1.0)
    for n in range(maps.shape[0]):
        for j in range(maps.shape[2]):
            out[j, n] = maps[n, i, j] * (1 - a) + maps[n, k, j] * a


@njit(cache=True)
def _forms(d: npt.NDArray[Any], v: npt.NDArray[Any]) -> tuple[float, float, float, float]:
    """Return H, K and their sigmas from p, q, r, s, t and variances pp, qq, rr, ss, tt, rt."""
    p, q, r, s, t = d[0], d[1], d[2], d[3], d[4]
    w2 = 1 + p * p + q * q
    w3 = w2 * np.sqrt(w2)
    form = (1 + q * q) * r - 2 * p * q * s + (1 + p * p) * t
    mean = form / (2 * w3)
    gauss = (r * t - s * s) / (w2 * w2)
    hr, ht, hs = (1 + q * q) / (2 * w3), (1 + p * p) / (2 * w3), -p * q / w3
    hp = (p * t - q * s) / w3 - 3 * p * mean / w2
    hq = (q * r - p * s) / w3 - 3 * q * mean / w2
    var_h = hr * hr * v[2] + ht * ht * v[4] + hs * hs * v[3] + 2 * hr * ht * v[5]
    var_h += hp * hp * v[0] + hq * hq * v[1]
    var_k = t * t * v[2] + r * r * v[4] + 4 * s * s * v[3] + 2 * r * t * v[5]
    var_k += v[2] * v[4] + v[5] * v[5] + 2 * v[3] * v[3]
    var_k /= w2 * w2 * w2 * w2
    kp, kq = 4 * p * gauss / w2, 4 * q * gauss / w2
    var_k += kp * kp * v[0] + kq * kq * v[1]
    return mean, gauss, np.sqrt(max(var_h, 0.0)), np.sqrt(max(var_k, 0.0))
