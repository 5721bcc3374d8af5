"""Local quadratic fits as a smoother, on a pyramid: the same cost at every scale, holes and edges kept.

One fit: a full quadratic by least squares under separable Gaussian weights, of which the value at the
centre is taken. Where the window is full this is a convolution of two separable terms,

    k(x, y) = w(x) w(y) (c0 + cx x^2 + cy y^2),

near holes and edges the fit itself. Twice: fit, then fit what is left, T = 1 - (1 - S)^2, which passes
everything up to its edge and cuts off sharply (Tukey's twicing): its error on relief of wavenumber f
grows with (f a)^8 where a Gaussian's grows with (f a)^2. Wide scales work on a grid thinned by
two at each level after the same fit, so that a window never spans more than some 20 cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from perception.records import FloatArray

Array = npt.NDArray[Any]

# The window ends at this many sigma: weight 0.011 there; more costs time and changes nothing seen.
_REACH = 3.0


@dataclass(frozen=True, slots=True)
class QuadraticKernel:
    """The full-window fit: 1-D weights and the coefficients of its polynomial.

    Attributes
    ----------
    wx, wy : (2 n + 1,) Gaussian weights, sum 1.
    c : (3,) c0, cx, cy, with x and y in cells.
    """

    wx: Array
    wy: Array
    c: Array

    @property
    def transforms(self) -> Any:
        """Return the kernel's response as a function of wavenumbers (fx, fy) in radians a cell."""
        nx, ny = len(self.wx) // 2, len(self.wy) // 2
        x, y = np.arange(-nx, nx + 1), np.arange(-ny, ny + 1)

        def response(fx: FloatArray, fy: FloatArray) -> FloatArray:
            cos_x, cos_y = np.cos(fx[..., None] * x), np.cos(fy[..., None] * y)
            x0, x2 = cos_x @ self.wx, cos_x @ (self.wx * x**2)
            y0, y2 = cos_y @ self.wy, cos_y @ (self.wy * y**2)
            return self.c[0] * x0 * y0 + self.c[1] * x2 * y0 + self.c[2] * x0 * y2

        return response


def quadratic_kernel(sigma_x: float, sigma_y: float) -> QuadraticKernel:
    """Return the kernel for Gaussian weights of these sigma, in cells."""
    weights, moments = [], []
    for sigma in (sigma_x, sigma_y):
        # Two cells each way at least: three points determine a parabola and smooth nothing.
        n = max(2, int(np.ceil(_REACH * sigma)))
        x = np.arange(-n, n + 1)
        w = np.exp(-0.5 * (x / sigma) ** 2)
        w /= w.sum()
        weights.append(w)
        moments.append((float(w @ x**2), float(w @ x**4)))
    (x2, x4), (y2, y4) = moments
    # The conditions that make it reproduce quadratics: sum k = 1, sum k x^2 = sum k y^2 = 0.
    a = np.array([[1, x2, y2], [x2, x4, x2 * y2], [y2, x2 * y2, y4]])
    return QuadraticKernel(weights[0], weights[1], np.linalg.solve(a, [1.0, 0.0, 0.0]))


def fit_smooth(z: Array, kernel: QuadraticKernel, stride: int = 1, beyond: int = 0) -> Array:
    """Return the fit's value on every `stride`-th cell; NaN where too little data is near.

    Parameters
    ----------
    z : (rows, cols); NaN no data.
    beyond : how many cells into a hole the fit is evaluated (an upsampler needs a rim).
    """
    rows, cols = z.shape
    shape = ((rows - 1) // stride + 1, (cols - 1) // stride + 1)
    known = ~np.isnan(z)
    whole = bool(known.all())
    filled = z if whole else np.where(known, z, z.dtype.type(0))
    ny, nx = len(kernel.wy) // 2, len(kernel.wx) // 2
    out = np.empty(shape, z.dtype)
    if rows > 2 * ny and cols > 2 * nx:
        x = np.arange(-nx, nx + 1)
        y = np.arange(-ny, ny + 1)
        first = (kernel.wx * (kernel.c[0] + kernel.c[1] * x**2)).astype(z.dtype)
        u = np.empty((rows, shape[1]), z.dtype)
        v = np.empty((rows, shape[1]), z.dtype)
        _row_pass(filled, kernel.wx.astype(z.dtype), first, stride, u, v)
        second = (kernel.wy * kernel.c[2] * y**2).astype(z.dtype)
        _column_pass(u, v, kernel.wy.astype(z.dtype), second, stride, out)
        del u, v
        table = _clipped_kernels(kernel.wx, kernel.wy).astype(z.dtype)
        clear = np.ones((1, 1), np.bool_) if whole else clear_windows(known, ny, nx)
    else:
        table = np.zeros((0, 0, 0, 0), z.dtype)
        clear = np.zeros((rows, cols), np.bool_)
    near = np.ones((1, 1), np.bool_) if whole else ~clear_windows(~known, beyond, beyond)
    _fit_rims(filled, known, clear, near, kernel.wx, kernel.wy, table, stride, out)
    return out


def fit_twice(z: Array, kernel: QuadraticKernel, beyond: int = 0) -> Array:
    """Fit, then fit the remainder and add it: 1 - (1 - S)^2."""
    first = fit_smooth(z, kernel, 1, beyond)
    rest = fit_smooth(z - first, kernel, 1, beyond)
    rest += first
    return rest


@njit(cache=True, parallel=True, fastmath=True)
def _row_pass(z: Array, w: Array, w2: Array, stride: int, u: Array, v: Array) -> None:
    rows, cols = z.shape
    n = len(w) // 2
    lo = -(-n // stride)
    hi = (cols - 1 - n) // stride
    for i in prange(rows):
        line, a, b = z[i], u[i], v[i]
        a[:] = 0
        b[:] = 0
        for j in range(lo, hi + 1):
            a[j] = w[n] * line[j * stride]
            b[j] = w2[n] * line[j * stride]
        # Views from zero up: an index that might be negative keeps the loop from vectorising.
        size = max(hi + 1 - lo, 0)
        a_in, b_in = a[lo : lo + size], b[lo : lo + size]
        for k in range(1, n + 1):
            wk, vk = w[n + k], w2[n + k]
            left, right = line[lo * stride - k :], line[lo * stride + k :]
            if stride == 1:
                for j in range(size):
                    pair = left[j] + right[j]
                    a_in[j] += wk * pair
                    b_in[j] += vk * pair
            else:
                for j in range(size):
                    pair = left[2 * j] + right[2 * j]
                    a_in[j] += wk * pair
                    b_in[j] += vk * pair


@njit(cache=True, parallel=True, fastmath=True)
def _column_pass(u: Array, v: Array, w: Array, w2: Array, stride: int, out: Array) -> None:
    rows, cols = u.shape
    n = len(w) // 2
    for i in prange(out.shape[0]):
        c = i * stride
        line = out[i]
        if c < n or c > rows - 1 - n:
            line[:] = 0
            continue
        for j in range(cols):
            line[j] = w[n] * v[c, j] + w2[n] * u[c, j]
        for k in range(1, n + 1):
            wk, uk = w[n + k], w2[n + k]
            up_v, lo_v, up_u, lo_u = v[c - k], v[c + k], u[c - k], u[c + k]
            for j in range(cols):
                line[j] += wk * (up_v[j] + lo_v[j]) + uk * (up_u[j] + lo_u[j])


@njit(cache=True)
def _clear_rows(known: Array, nx: int, out: Array) -> None:
    rows, cols = known.shape
    for i in range(rows):
        run = 0
        for j in range(cols):
            run = run + 1 if known[i, j] else 0
            out[i, j] = 0
            if run >= min(2 * nx + 1, j + 1) and j - nx >= 0:
                out[i, j - nx] = 1
        # Cells whose window reaches past the east edge: clear if the run to the edge is long enough.
        for j in range(max(cols - nx, 0), cols):
            out[i, j] = 1 if run >= min(cols - j + nx, cols) else 0


def clear_windows(known: Array, ny: int, nx: int) -> Array:
    """Return whether every cell of the (2 ny + 1) x (2 nx + 1) window, as far as the array goes, is known."""
    if ny == 0 and nx == 0:
        return known.copy()
    across = np.empty(known.shape, np.bool_)
    _clear_rows(known, nx, across)
    turned = np.ascontiguousarray(across.T)
    down = np.empty(turned.shape, np.bool_)
    _clear_rows(turned, ny, down)
    return np.ascontiguousarray(down.T)


@njit(cache=True)
def _solve_first(a: Array, b: Array) -> float:
    """Return the first unknown of the normal equations, leaving out terms the data do not determine.

    Elimination from the last unknown up, so that what is left at the end is the first. A pivot that
    has all but vanished belongs to a term that the others already explain.
    """
    n = len(b)
    scale = np.empty(n)
    for i in range(n):
        scale[i] = a[i, i]
    for k in range(n - 1, 0, -1):
        pivot = a[k, k]
        if pivot <= 1e-5 * scale[k] or pivot <= 0:
            continue
        for i in range(k):
            factor = a[i, k] / pivot
            if factor != 0.0:
                for j in range(k):
                    a[i, j] -= factor * a[k, j]
                b[i] -= factor * b[k]
    return b[0] / a[0, 0] if a[0, 0] > 1e-5 * scale[0] else np.nan


@njit(cache=True)
def _add_sample(a: Array, basis: Array, w: float, x: float, y: float) -> None:
    basis[0], basis[1], basis[2] = 1.0, x, y
    basis[3], basis[4], basis[5] = x * x, x * y, y * y
    for m in range(6):
        wb = w * basis[m]
        for n in range(m, 6):
            a[m, n] += wb * basis[n]


@njit(cache=True)
def _masked_value(
    z: Array,
    known: Array,
    row: int,
    col: int,
    wx: Array,
    wy: Array,
    a: Array,
    b: Array,
    basis: Array,
) -> float:
    """Fit the quadratic to the known cells about (row, col) and return its value there."""
    rows, cols = z.shape
    ny, nx = len(wy) // 2, len(wx) // 2
    a[:] = 0
    b[:] = 0
    found = 0
    for i in range(max(row - ny, 0), min(row + ny + 1, rows)):
        for j in range(max(col - nx, 0), min(col + nx + 1, cols)):
            if known[i, j]:
                w = wy[i - row + ny] * wx[j - col + nx]
                _add_sample(a, basis, w, j - col, i - row)
                for m in range(6):
                    b[m] += w * basis[m] * z[i, j]
                found += 1
    if found == 0:
        return np.nan
    for m in range(6):
        for n in range(m):
            a[m, n] = a[n, m]
    return _solve_first(a, b)


@njit(cache=True)
def _clipped_kernels(wx: Array, wy: Array) -> Array:
    """Return the fit as a kernel for windows clipped by the array's edges.

    Entry (ny + v, nx + h) is for a window that lacks v rows at its top (v > 0) or -v at its bottom, and
    h columns at its west or -h at its east. Along an edge the mask repeats, so the fits are made once.
    """
    ny, nx = len(wy) // 2, len(wx) // 2
    table = np.zeros((2 * ny + 1, 2 * nx + 1, 2 * ny + 1, 2 * nx + 1))
    a, rhs, basis = np.empty((6, 6)), np.empty(6), np.empty(6)
    for v in range(-ny, ny + 1):
        for h in range(-nx, nx + 1):
            if v == 0 and h == 0:
                continue
            i0, i1 = max(v, 0), 2 * ny + 1 + min(v, 0)
            j0, j1 = max(h, 0), 2 * nx + 1 + min(h, 0)
            a[:] = 0
            for i in range(i0, i1):
                for j in range(j0, j1):
                    _add_sample(a, basis, wy[i] * wx[j], j - nx, i - ny)
            for m in range(6):
                for n in range(m):
                    a[m, n] = a[n, m]
            # The value is e1' A^-1 sum(w basis z): solve A g = e1, then k = w (g . basis).
            rhs[:] = 0
            rhs[0] = 1.0
            g = np.linalg.solve(a, rhs)
            for i in range(i0, i1):
                for j in range(j0, j1):
                    x, y = j - nx, i - ny
                    poly = g[0] + g[1] * x + g[2] * y + g[3] * x * x + g[4] * x * y + g[5] * y * y
                    table[ny + v, nx + h, i, j] = wy[i] * wx[j] * poly
    return table


@njit(cache=True, parallel=True)
def _fit_rims(
    z: Array,
    known: Array,
    clear: Array,
    near: Array,
    wx: Array,
    wy: Array,
    table: Array,
    stride: int,
    out: Array,
) -> None:
    """Fit where the window is not full; NaN where no known cell is near."""
    rows, cols = z.shape
    ny, nx = len(wy) // 2, len(wx) // 2
    whole = clear.size == 1 and z.size > 1
    has_holes = near.size == z.size and not (whole and near.size == 1)
    for i in prange(out.shape[0]):
        a, b, basis = np.empty((6, 6)), np.empty(6), np.empty(6)
        row = i * stride
        v = ny - row if row < ny else (rows - 1 - row - ny if row > rows - 1 - ny else 0)
        # Between the rims of a map without holes every window is full: nothing to do there.
        inner = -(-nx // stride) if whole and v == 0 else out.shape[1]
        outer = max((cols - 1 - nx) // stride + 1, inner)
        for jj in range(inner + max(out.shape[1] - outer, 0)):
            j = jj if jj < inner else jj - inner + outer
            col = j * stride
            h = nx - col if col < nx else (cols - 1 - col - nx if col > cols - 1 - nx else 0)
            full = whole or clear[row, col]
            if full and v == 0 and h == 0:
                continue
            if has_holes and near.size > 1 and not near[row, col]:
                out[i, j] = np.nan
            elif full:
                total = z[row, col] * 0
                for ii in range(max(-ny, -row), min(ny + 1, rows - row)):
                    for k in range(max(-nx, -col), min(nx + 1, cols - col)):
                        total += table[ny + v, nx + h, ii + ny, k + nx] * z[row + ii, col + k]
                out[i, j] = total
            else:
                out[i, j] = _masked_value(z, known, row, col, wx, wy, a, b, basis)


def upsample_twice(coarse: Array, shape: tuple[int, int]) -> Array:
    """Interpolate from every second cell to all, (rows, cols).

    Six-point Lagrange, exact to the fifth degree; beside a NaN the mean of the two neighbours.
    """
    columns = _half_weights(coarse.shape[1])
    rows = _half_weights(coarse.shape[0])
    across = np.empty((coarse.shape[0], shape[1]), coarse.dtype)
    _upsample_rows(coarse, *columns, across)
    out = np.empty(shape, coarse.dtype)
    _upsample_columns(across, *rows, out)
    return out


def _half_weights(n: int) -> tuple[npt.NDArray[np.int64], Array]:
    """Return for each gap between n nodes the first node of its stencil and the Lagrange weights.

    Near the ends the stencil is shifted inward. The last gap, half a cell past node n - 1, is asked for
    where the fine array is even; it is extrapolated by a parabola, since a higher degree would
    multiply what noise there is.
    """
    m = min(6, n)
    start = np.clip(np.arange(n) - m // 2 + 1, 0, n - m)
    weights = np.tile(np.array([3.0, -25.0, 150.0, 150.0, -25.0, 3.0])[:m] / 256.0, (n, 1))
    ends = range(n) if n <= 8 else (0, 1, n - 4, n - 3, n - 2, n - 1)
    for g in ends:
        used = range(max(m - 3, 0), m) if g == n - 1 else range(m)
        weights[g] = 0.0
        for k in used:
            others = [q for q in used if q != k]
            weights[g, k] = np.prod([(g + 0.5 - start[g] - q) / (k - q) for q in others])
    return start, weights


@njit(cache=True)
def _half_value(line: Array, g: int, first: int, weights: Array) -> float:
    total = 0.0
    for k in range(weights.shape[1]):
        # The last gap leaves nodes out by a weight of zero: their NaN must not count.
        if weights[g, k] != 0.0:
            total += weights[g, k] * line[first + k]
    if np.isnan(total):
        left = line[g]
        right = line[min(g + 1, len(line) - 1)]
        if np.isnan(left):
            return right
        if np.isnan(right):
            return left
        return 0.5 * (left + right)
    return total


@njit(cache=True, parallel=True)
def _upsample_rows(z: Array, start: Array, weights: Array, out: Array) -> None:
    n = z.shape[1]
    for i in prange(z.shape[0]):
        line, fine = z[i], out[i]
        gaps = out.shape[1] // 2
        for g in range((out.shape[1] + 1) // 2):
            fine[2 * g] = line[g]
        inner = max(min(n - 5, gaps - 2), 0)
        a, b, c, d, e, f = line, line[1:], line[2:], line[3:], line[4:], line[5:]
        odd = fine[5:]
        for g in range(inner):
            # 3, -25, 150 over 256: Lagrange weights half way between the middle two of six.
            odd[2 * g] = (
                0.5859375 * (c[g] + d[g]) - 0.09765625 * (b[g] + e[g]) + 0.01171875 * (a[g] + f[g])
            )
        for g in range(gaps):
            if g < 2 or g >= inner + 2 or np.isnan(fine[2 * g + 1]):
                fine[2 * g + 1] = _half_value(line, g, start[g], weights)


@njit(cache=True, parallel=True)
def _upsample_columns(z: Array, start: Array, weights: Array, out: Array) -> None:
    m = weights.shape[1]
    for i in prange(out.shape[0]):
        g = i // 2
        line = out[i]
        if i % 2 == 0:
            line[:] = z[g]
            continue
        line[:] = 0
        for k in range(m):
            w, source = weights[g, k], z[start[g] + k]
            # The last gap leaves nodes out by a weight of zero: their NaN must not count.
            if w != 0.0:
                for j in range(len(line)):
                    line[j] += w * source[j]
        above, below = z[g], z[min(g + 1, z.shape[0] - 1)]
        for j in range(len(line)):
            if np.isnan(line[j]):
                if np.isnan(above[j]):
                    line[j] = below[j]
                elif np.isnan(below[j]):
                    line[j] = above[j]
                else:
                    line[j] = (above[j] + below[j]) / 2
