"""Smoothing at the scale that noise and relief ask for, cell by cell, before curvature.

A stack of surfaces z_0 (the map), z_1, z_2 ... each smoothed by `fit_twice` over sigma a_k, half an octave
apart. Of the Hessian (r, s, t) at each cell and scale

    bias_k^2 = sum over j <= k of the local mean of |Hessian(z_{j-1} - z_j)|^2, less its noise,
    var_k    = noise of one cell, carried through the kernels,

and the derivatives are blended with weights (bias_k^2 + var_k)^-4. No scale is set by hand: where there is no
noise the map itself is taken, and the rougher the ground the finer the scale.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit, prange
from scipy import ndimage

from perception.curvature import (
    Derivatives,
    NoiseGain,
    Operator,
    differentiate,
    stencil,
)
from perception.noise import independent_noise
from perception.records import FloatArray
from perception.smoothing import (
    QuadraticKernel,
    fit_smooth,
    fit_twice,
    quadratic_kernel,
    upsample_twice,
)

# Sigmas of the fits on every level of the pyramid, in its cells: half an octave apart.
_WIDTHS = (2.0, 2.0 * np.sqrt(2.0))
# Sigma of the fit before thinning by two: what would alias into the passband of the narrowest fit on the
# thinned grid (2.7 rad a cell) is cut to 0.25 %, the passband itself (0.25 rad) droops by 0.3 %.
_THINNING = 1.5
# The local mean of the bands' energy: Gaussian of this many a_k. Wider, and a sharp hill keeps the smooth
# ground about it at its own fine scale.
_WINDOW = 1.2
# Energy above the noise counts from this excess on, in shares of the noise: so narrow a mean of noise
# alone scatters by half, and its tail must not pass for relief.
_EXCESS = 2.0
# Standard deviation of r, s, t together and of r + t behind `fit_twice`, against that far from any edge, by
# the distance to the edge in sigmas of the fit; measured on white noise (tests/perception/test_scale.py).
_RIM = np.array([0, 0.125, 0.25, 0.375, 0.55, 0.65, 0.75, 0.9, 1.12, 1.38, 1.62, 2.0])
_RIM_HESSIAN = np.array([4.2, 3.68, 3.1, 2.77, 2.33, 2.05, 1.9, 1.5, 1.25, 1.11, 1.04, 1.0])
_RIM_LAPLACIAN = np.array([3.6, 3.17, 2.66, 2.44, 2.08, 1.85, 1.75, 1.44, 1.24, 1.12, 1.04, 1.0])
# A scale whose squared bias is this many times the least risk has a share of one in ten thousand.
_HOPELESS = 10.0
# Cells from one node to the next of the maps of weights, noise and scale.
_STEP = 8
# Above this many cells single precision is worked in, to stay within memory.
_DOUBLE_CELLS = 2_000_000


@dataclass(frozen=True, slots=True)
class Smoothing:
    """The derivatives of a smoothed surface and what was done to the noise.

    Attributes
    ----------
    derivatives : slopes and second derivatives, (rows, cols) each; NaN where the map has no height.
    gain : variance of the surface's derivatives per unit variance of the noise, arrays (m, n) on every
        `step`-th row and column.
    noise_m : (m, n) 1-sigma of the independent noise of one cell.
    scale_m : (m, n) Gaussian sigma of the smoothing, or the equivalent by its noise gain; 0 where none.
    """

    derivatives: Derivatives
    gain: NoiseGain
    noise_m: FloatArray
    scale_m: FloatArray
    step: int


@dataclass(frozen=True, slots=True)
class _Scale:
    """One surface of the stack: on every `thinning`-th cell, `response` its wavenumber response."""

    surface: npt.NDArray[np.floating]
    thinning: int
    width: float  # sigma of the fit in cells of the map; 0 is the map itself
    response: npt.NDArray[np.float64]


def smooth(
    z: FloatArray,
    cell_m: float,
    cell_north_m: float,
    sigma_m: FloatArray | None = None,
    scale_m: float | None = None,
    operator: Operator = "difference",
    least_scale_m: float = 0.0,
) -> Smoothing:
    """Smooth a map and differentiate it.

    Parameters
    ----------
    z : (rows, cols) heights; NaN no data.
    sigma_m : (rows, cols) 1-sigma of the heights, an upper bound of the independent noise; None
        leaves the noise to the data alone.
    scale_m : one scale for the whole map (Gaussian sigma or equivalent, 0 for none) instead of
        one chosen per cell.
    operator : the 3 x 3 derivative of the map's own cells.
    least_scale_m : where the scale is chosen per cell, none finer than this is taken.
    """
    flat, slope = _less_plane(z, cell_m, cell_north_m)
    noise = np.maximum(independent_noise(flat, sigma_m, _STEP), _rounding(z, flat))
    quadrature = _Quadrature(cell_m, cell_north_m, operator)
    rim = _rim_distance(flat, noise.shape)
    if scale_m is None:
        least_width = _equivalent_width(least_scale_m, quadrature)
        scales = _stack(flat, quadrature)
        stack, weights = _weigh(scales, noise, rim, quadrature, least_width)
    else:
        stack = [_only_scale(flat, quadrature, _equivalent_width(scale_m, quadrature))]
        weights = np.ones((1, *noise.shape))
    gain, scale = _gain(stack, weights, rim, quadrature)
    planes = _blend(stack, weights, flat, quadrature)
    planes[0] += slope[0]
    planes[1] += slope[1]
    return Smoothing(Derivatives(*planes), gain, noise, scale, _STEP)


def _less_plane(
    z: FloatArray, cell_m: float, cell_north_m: float
) -> tuple[npt.NDArray[np.floating], tuple[float, float]]:
    """Take off the plane fitted to a sample of the heights: sixth digits survive single precision."""
    stride = max(1, int(np.sqrt(z.size / 1e5)))
    sample = z[::stride, ::stride]
    rows, cols = np.nonzero(np.isfinite(sample))
    if len(rows) == 0:
        rows, cols = np.nonzero(np.isfinite(z))
        sample, stride = z, 1
    east, north = cols * stride * cell_m, -rows * stride * cell_north_m
    heights = sample[rows, cols].astype(np.float64)
    mean = np.array([heights.mean(), east.mean(), north.mean()])
    design = np.column_stack([east - mean[1], north - mean[2]])
    slopes = np.linalg.lstsq(design, heights - mean[0], rcond=None)[0]
    level = float(mean[0] - slopes @ mean[1:])
    line = level + slopes[0] * cell_m * np.arange(z.shape[1])
    column = -slopes[1] * cell_north_m * np.arange(z.shape[0])
    dtype = np.float64 if z.size <= _DOUBLE_CELLS else np.float32
    flat = np.empty(z.shape, dtype)
    for i in range(z.shape[0]):  # row by row: no second map in double precision
        flat[i] = z[i] - (line + column[i])
    return flat, (float(slopes[0]), float(slopes[1]))


class _Quadrature:
    """Nodes and weights over wavenumbers, and the responses of the derivatives, for noise variances.

    The noise is white: a variance is the mean of the squared response over both wavenumbers from 0 to pi
    a cell. Panels of an octave each serve the widest scale as well as the map itself.
    """

    def __init__(self, cell_m: float, cell_north_m: float, operator: Operator) -> None:
        points, weights = np.polynomial.legendre.leggauss(6)
        edges = np.r_[0, np.pi / 2.0 ** np.arange(10, -1, -1)]
        half = 0.5 * np.diff(edges)[:, None]
        f = (half * (points + 1) + edges[:-1, None]).ravel()
        w = (half * weights).ravel() / np.pi
        self.fx, self.fy = (a.ravel() for a in np.meshgrid(f, f))
        self.weight = np.outer(w, w).ravel()
        self.cell_m, self.cell_north_m, self.operator = cell_m, cell_north_m, operator
        mean_cell_m = np.sqrt(cell_m * cell_north_m)
        # Widths are given in mean cells: a window is round in metres.
        self.stretch = (mean_cell_m / cell_m, mean_cell_m / cell_north_m)
        self.mean_cell_m = mean_cell_m

    def kernel(self, width: float) -> QuadraticKernel:
        return quadratic_kernel(width * self.stretch[0], width * self.stretch[1])

    def fit_response(self, width: float, thinning: int) -> npt.NDArray[np.float64]:
        """Return the response of one fit on a thinned grid, nothing beyond that grid's last wavenumber."""
        fx, fy = self.fx * thinning, self.fy * thinning
        inside = (fx <= np.pi) & (fy <= np.pi)
        out = np.zeros(fx.shape)
        out[inside] = self.kernel(width).transforms(fx[inside], fy[inside])
        return out

    def derivatives(self, thinning: int = 1) -> dict[str, npt.NDArray[np.float64]]:
        """Return the products of the derivatives' responses whose means are variances."""
        fx, fy = self.fx * thinning, self.fy * thinning
        dx, dy = self.cell_m * thinning, self.cell_north_m * thinning
        r, t = (2 - 2 * np.cos(fx)) / dx**2, (2 - 2 * np.cos(fy)) / dy**2
        p, q = np.sin(fx) / dx, np.sin(fy) / dy
        ss = (p * q) ** 2
        if self.operator == "least-squares" and thinning == 1:
            across_x, across_y = (1 + 2 * np.cos(fx)) / 3, (1 + 2 * np.cos(fy)) / 3
            r, p, t, q = r * across_y, p * across_y, t * across_x, q * across_x
        return {"pp": p**2, "qq": q**2, "rr": r**2, "ss": ss, "tt": t**2, "rt": r * t}

    def hessian(self, response: npt.NDArray[np.float64], thinning: int = 1) -> float:
        """Return the noise variance of r^2 + 2 s^2 + t^2 behind a response."""
        d = self.derivatives(thinning)
        return float(self.weight @ (response**2 * (d["rr"] + 2 * d["ss"] + d["tt"])))

    def equivalent_sigma_m(self, rr_tt: FloatArray) -> FloatArray:
        """Return the Gaussian sigma that leaves the same noise in r and t (product of variances)."""
        area = self.cell_m * self.cell_north_m
        # A Gaussian of sigma S leaves var r = 3 area / (16 pi S^6) of white noise.
        return (3 * area / (16 * np.pi * np.sqrt(rr_tt))) ** (1 / 6)


def _equivalent_width(scale_m: float, quadrature: _Quadrature) -> float:
    """Return the width of the fits, in mean cells, that leave the noise of a Gaussian of `scale_m`."""
    # Both noises go with the sixth power, so one of the widths in use gives the factor.
    trial = _WIDTHS[1]
    fit = quadrature.fit_response(trial, 1)
    response = 1 - (1 - fit) ** 2
    d = quadrature.derivatives()
    rr_tt = (quadrature.weight @ (response**2 * d["rr"])) * (
        quadrature.weight @ (response**2 * d["tt"])
    )
    sigma_m = float(quadrature.equivalent_sigma_m(np.array(rr_tt)))
    return 0.0 if scale_m == 0 else max(scale_m * trial / sigma_m, 0.7)


def _map_itself(flat: npt.NDArray[np.floating], quadrature: _Quadrature) -> _Scale:
    return _Scale(flat, 1, 0.0, np.ones(quadrature.fx.shape))


def _stack(flat: npt.NDArray[np.floating], quadrature: _Quadrature) -> Iterator[_Scale]:
    """Yield the map smoothed at every scale, finest first, up to a quarter of the map's size."""
    yield _map_itself(flat, quadrature)
    level, prior, thinning = flat, np.ones(quadrature.fx.shape), 1
    limit = max(flat.shape) / 4
    while min(level.shape) >= 2 and _WIDTHS[0] * thinning <= limit:
        for width in _WIDTHS:
            if width * thinning <= limit:
                yield _fitted(level, prior, thinning, width, quadrature)
        if min(level.shape) < 12:
            return
        level, prior, thinning = _thinned(level, prior, thinning, quadrature)


def _only_scale(flat: npt.NDArray[np.floating], quadrature: _Quadrature, width: float) -> _Scale:
    """Return the map smoothed by fits of one width, in cells of the map."""
    if width == 0:
        return _map_itself(flat, quadrature)
    level, prior, thinning = flat, np.ones(quadrature.fx.shape), 1
    # Beyond the map's own size every fit is the same, one quadratic through everything.
    width = min(width, float(max(flat.shape)))
    while width / thinning >= 4 and min(level.shape) >= 12:
        level, prior, thinning = _thinned(level, prior, thinning, quadrature)
    return _fitted(level, prior, thinning, width / thinning, quadrature)


def _fitted(
    level: npt.NDArray[np.floating],
    prior: npt.NDArray[np.float64],
    thinning: int,
    width: float,
    quadrature: _Quadrature,
) -> _Scale:
    fit = quadrature.fit_response(width, thinning)
    surface = fit_twice(level, quadrature.kernel(width), 0 if thinning == 1 else 4)
    return _Scale(surface, thinning, width * thinning, prior * (1 - (1 - fit) ** 2))


def _thinned(
    level: npt.NDArray[np.floating],
    prior: npt.NDArray[np.float64],
    thinning: int,
    quadrature: _Quadrature,
) -> tuple[npt.NDArray[np.floating], npt.NDArray[np.float64], int]:
    response = prior * quadrature.fit_response(_THINNING, thinning)
    return fit_smooth(level, quadrature.kernel(_THINNING), 2, 4), response, 2 * thinning


def _rounding(z: FloatArray, flat: npt.NDArray[np.floating]) -> float:
    """Return the noise of the numbers themselves, some units in their last place."""
    original = np.finfo(np.float64).eps * max(abs(np.nanmax(z)), abs(np.nanmin(z)))
    worked = np.finfo(flat.dtype).eps * max(abs(np.nanmax(flat)), abs(np.nanmin(flat)))
    return 8 * float(max(original, worked))


def _rim_distance(flat: npt.NDArray[np.floating], nodes: tuple[int, int]) -> FloatArray:
    """Return the distance of the nodes to the map's edge or the next hole, in cells."""
    rows, cols = (np.arange(n) * _STEP + 0.5 for n in nodes)
    down = np.minimum(rows, flat.shape[0] - rows)
    across = np.minimum(cols, flat.shape[1] - cols)
    edge = np.maximum(np.minimum(down[:, None], across), 0.0)
    missing = np.isnan(flat)
    if not missing.any():
        return edge
    half = _STEP // 2
    m, n = -(-flat.shape[0] // half), -(-flat.shape[1] // half)
    padded = np.zeros((m * half, n * half), np.bool_)
    padded[: flat.shape[0], : flat.shape[1]] = missing
    holes = padded.reshape(m, half, n, half).any(axis=(1, 3))
    # From the middle of a block to the middle of the next that has a hole, less what may lie between.
    distance = np.maximum(ndimage.distance_transform_edt(~holes) * half - 0.5 * half, 0.5)
    at = np.meshgrid(
        *((np.arange(n) * _STEP - half / 2 + 0.5) / half for n in nodes), indexing="ij"
    )
    to_hole = ndimage.map_coordinates(distance, at, order=1, mode="nearest")
    return np.minimum(edge, to_hole)


def _rim_rise(scale: _Scale, rim: FloatArray, table: FloatArray) -> FloatArray:
    """Return by how much noise behind a fit rises near edges, (m, n)."""
    if scale.width == 0:
        return np.ones(rim.shape)
    return np.interp(rim / scale.width, _RIM, table)


def _weigh(
    scales: Iterator[_Scale],
    noise_m: FloatArray,
    rim: FloatArray,
    quadrature: _Quadrature,
    least_width: float,
) -> tuple[list[_Scale], npt.NDArray[np.float64]]:
    """Return the scales that matter and the share of each on the nodes, (scales, m, n), sum 1.

    No wider scale is made once its bias alone rules it out everywhere.
    """
    variance = noise_m**2
    finer = next(scales)
    stack = [finer]
    bias = np.zeros(noise_m.shape)
    risk = [quadrature.hessian(finer.response) * variance]
    least = risk[0]
    for coarser in scales:
        energy = _band_energy(finer, coarser, noise_m.shape, quadrature)
        band = quadrature.hessian(finer.response - coarser.response, coarser.thinning)
        excess = np.where(energy > (1 + _EXCESS) * band * variance, energy - band * variance, 0.0)
        bias = bias + excess
        rise = _rim_rise(coarser, rim, _RIM_HESSIAN) ** 2
        risk.append(bias + quadrature.hessian(coarser.response) * variance * rise)
        stack.append(coarser)
        least = np.minimum(least, risk[-1])
        # Widths are half an octave apart: one within a quarter of an octave will do.
        if coarser.width >= 0.84 * least_width and (bias > _HOPELESS * least).all():
            break
        finer = coarser
    too_fine = min(sum(s.width < 0.84 * least_width for s in stack), len(stack) - 1)
    stack, risks = stack[too_fine:], np.array(risk[too_fine:])
    least = risks.min(axis=0)
    # Where even the best is exact, all that are as exact share.
    ratio = np.where(risks > 0, least / np.where(risks > 0, risks, 1.0), 1.0)
    weights = ratio**4
    weights /= weights.sum(axis=0)
    used = weights.max(axis=(1, 2)) > 1e-3
    weights = weights[used]
    return [s for s, u in zip(stack, used, strict=True) if u], weights / weights.sum(axis=0)


def _band_energy(
    finer: _Scale, coarser: _Scale, nodes: tuple[int, int], quadrature: _Quadrature
) -> FloatArray:
    """Return the local mean of r^2 + 2 s^2 + t^2 of the band between two scales, on the nodes."""
    skip = coarser.thinning // finer.thinning
    upper = finer.surface[::skip, ::skip] if skip > 1 else finer.surface
    spacing = max(_STEP, 2 * coarser.thinning)
    rows, cols = coarser.surface.shape
    block = spacing // coarser.thinning
    shape = ((rows - 1 + block // 2) // block + 1, (cols - 1 + block // 2) // block + 1)
    total, count = np.zeros(shape), np.zeros(shape)
    dx = quadrature.cell_m * coarser.thinning
    dy = quadrature.cell_north_m * coarser.thinning
    _energy_blocks(upper, coarser.surface, dx, dy, block, total, count)
    sigma = _WINDOW * coarser.width / spacing
    widths = (sigma * quadrature.stretch[1], sigma * quadrature.stretch[0])
    total = ndimage.gaussian_filter(total, widths, mode="constant", truncate=3.0)
    count = ndimage.gaussian_filter(count, widths, mode="constant", truncate=3.0)
    # Where no cell of the band is near, nothing speaks for the finer scale.
    energy = np.where(count > 1e-6, total / np.maximum(count, 1e-6), 0.0)
    at = np.meshgrid(*(np.arange(n) * (_STEP / spacing) for n in nodes), indexing="ij")
    return ndimage.map_coordinates(energy, at, order=1, mode="nearest")


@njit(cache=True, parallel=True)
def _energy_blocks(
    upper: npt.NDArray[np.floating],
    lower: npt.NDArray[np.floating],
    dx: float,
    dy: float,
    block: int,
    total: npt.NDArray[np.float64],
    count: npt.NDArray[np.float64],
) -> None:
    """Add up r^2 + 2 s^2 + t^2 of upper - lower about each node; windows with a NaN are passed over."""
    rows, cols = lower.shape
    half = block // 2
    for bi in prange(total.shape[0]):
        b = np.empty((3, 3))
        for i in range(max(bi * block - half, 1), min((bi + 1) * block - half, rows - 1)):
            for j in range(1, cols - 1):
                for k in range(3):
                    for m in range(3):
                        b[k, m] = upper[i + k - 1, j + m - 1] - lower[i + k - 1, j + m - 1]
                r = (b[1, 0] + b[1, 2] - 2 * b[1, 1]) / (dx * dx)
                t = (b[0, 1] + b[2, 1] - 2 * b[1, 1]) / (dy * dy)
                s = (b[0, 2] + b[2, 0] - b[0, 0] - b[2, 2]) / (4 * dx * dy)
                energy = r * r + 2 * s * s + t * t
                if not np.isnan(energy):
                    node = (j + half) // block
                    total[bi, node] += energy
                    count[bi, node] += 1


def _gain(
    stack: list[_Scale],
    weights: npt.NDArray[np.float64],
    rim: FloatArray,
    quadrature: _Quadrature,
) -> tuple[NoiseGain, FloatArray]:
    """Return the noise gain of the blend's derivatives and its equivalent scale, on the nodes."""
    shape = weights.shape[1:]
    inside = np.ones(shape)
    rise = np.array([_rim_rise(scale, rim, _RIM_LAPLACIAN) for scale in stack])
    flat = weights.reshape(len(stack), -1)
    at_rim = (weights * rise).reshape(len(stack), -1)
    responses = np.array([scale.response for scale in stack])
    gains = {}
    for name, product in quadrature.derivatives().items():
        covariance = (responses * (quadrature.weight * product)) @ responses.T
        gains[name] = np.einsum("kn,kn->n", at_rim, covariance @ at_rim).reshape(shape)
        if name in ("rr", "tt"):
            product_inside = np.einsum("kn,kn->n", flat, covariance @ flat).reshape(shape)
            inside = product_inside if name == "rr" else inside * product_inside
    gain = NoiseGain(**gains)
    sigma_m = quadrature.equivalent_sigma_m(inside)
    # The bare second difference has the noise of a Gaussian of half a cell: that is no smoothing.
    bare = quadrature.derivatives()
    least = float(
        quadrature.equivalent_sigma_m(
            (quadrature.weight @ bare["rr"]) * (quadrature.weight @ bare["tt"])
        )
    )
    return gain, np.where(sigma_m > 1.02 * least, sigma_m, 0.0)


def _blend(
    stack: list[_Scale],
    weights: npt.NDArray[np.float64],
    flat: npt.NDArray[np.floating],
    quadrature: _Quadrature,
) -> npt.NDArray[np.floating]:
    """Add the scales' derivatives by their shares, coarse to fine, (5, rows, cols).

    Derivatives are added, not heights: the slope of a share times the difference of two heights would
    pass for curvature.
    """
    beyond = np.cumsum(weights[::-1], axis=0)[::-1]  # share of this scale and all coarser
    fit = quadrature.operator == "least-squares"
    planes, thinning = None, 1
    for k in range(len(stack) - 1, -1, -1):
        scale = stack[k]
        dx, dy = quadrature.cell_m * scale.thinning, quadrature.cell_north_m * scale.thinning
        shape = (5, *scale.surface.shape)
        if planes is None:
            planes = np.zeros(shape, flat.dtype)
            share = np.zeros(weights.shape[1:])
        else:
            planes = _refine(planes, thinning, scale.thinning, scale.surface.shape)
            share = np.where(beyond[k] > 0, beyond[k + 1] / np.maximum(beyond[k], 1e-300), 0.0)
        thinning = scale.thinning
        # Beyond a few cells the smoothed surface is so slack that five points serve best.
        _mix(scale.surface, planes, share, thinning / _STEP, dx, dy, fit, thinning > 1)
    assert planes is not None  # the stack holds at least the map itself
    planes = _refine(planes, thinning, 1, flat.shape)
    if stack[0].thinning == 1 and len(stack) == 1 and stack[0].width == 0:
        return planes
    planes[:, np.isnan(flat)] = np.nan
    return planes


def _refine(
    planes: npt.NDArray[np.floating], thinning: int, wanted: int, shape: tuple[int, ...]
) -> npt.NDArray[np.floating]:
    """Interpolate derivatives to a grid thinned less; `shape` is that of the grid wanted."""
    while thinning > wanted:
        thinning //= 2
        ratio = thinning // wanted
        size = tuple((n - 1) // ratio + 1 for n in shape)
        finer = np.empty((5, *size), planes.dtype)
        for k in range(5):
            finer[k] = upsample_twice(planes[k], (size[0], size[1]))
        planes = finer
    return planes


@njit(cache=True)
def _three_points(
    z: npt.NDArray[np.floating], i: int, j: int, dx: float, dy: float, d: npt.NDArray[np.float64]
) -> bool:
    """Differentiate centrally; False where the window leaves the array or meets a NaN."""
    rows, cols = z.shape
    if i < 1 or j < 1 or i > rows - 2 or j > cols - 2:
        return False
    east, west, north, south, mid = z[i, j + 1], z[i, j - 1], z[i - 1, j], z[i + 1, j], z[i, j]
    d[0] = (east - west) / (2 * dx)
    d[1] = (north - south) / (2 * dy)
    d[2] = ((east - mid) - (mid - west)) / (dx * dx)
    d[3] = (z[i - 1, j + 1] + z[i + 1, j - 1] - z[i - 1, j - 1] - z[i + 1, j + 1]) / (4 * dx * dy)
    d[4] = ((north - mid) - (mid - south)) / (dy * dy)
    return not np.isnan(d[2] + d[3] + d[4])


@njit(cache=True)
def _five_points(
    z: npt.NDArray[np.floating], i: int, j: int, dx: float, dy: float, d: npt.NDArray[np.float64]
) -> bool:
    """Differentiate to the fourth order; False where the window leaves the array or meets a NaN."""
    rows, cols = z.shape
    if i < 2 or j < 2 or i > rows - 3 or j > cols - 3:
        return False
    e1, w1, e2, w2 = z[i, j + 1], z[i, j - 1], z[i, j + 2], z[i, j - 2]
    n1, s1, n2, s2 = z[i - 1, j], z[i + 1, j], z[i - 2, j], z[i + 2, j]
    mid = z[i, j]
    near = z[i - 1, j + 1] + z[i + 1, j - 1] - z[i - 1, j - 1] - z[i + 1, j + 1]
    far = z[i - 2, j + 2] + z[i + 2, j - 2] - z[i - 2, j - 2] - z[i + 2, j + 2]
    d[0] = (8 * (e1 - w1) - (e2 - w2)) / (12 * dx)
    d[1] = (8 * (n1 - s1) - (n2 - s2)) / (12 * dy)
    d[2] = (16 * (e1 + w1) - (e2 + w2) - 30 * mid) / (12 * dx * dx)
    d[3] = (16 * near - far) / (48 * dx * dy)
    d[4] = (16 * (n1 + s1) - (n2 + s2) - 30 * mid) / (12 * dy * dy)
    return not (np.isnan(d[2]) or np.isnan(d[3]) or np.isnan(d[4]))


@njit(cache=True, parallel=True)
def _mix(
    z: npt.NDArray[np.floating],
    planes: npt.NDArray[np.floating],
    share: npt.NDArray[np.float64],
    pitch: float,
    dx: float,
    dy: float,
    fit: bool,
    wide: bool,
) -> None:
    """Turn `planes` into d(z) + share (planes - d(z)); `share` is bilinear, nodes 1 / pitch cells apart."""
    rows, cols = z.shape
    for i in prange(rows):
        box, d = np.empty((3, 3)), np.empty(5)
        a = min(i * pitch, share.shape[0] - 1.0)
        top = int(a)
        low = min(top + 1, share.shape[0] - 1)
        a -= top
        for j in range(cols):
            b = min(j * pitch, share.shape[1] - 1.0)
            left = int(b)
            right = min(left + 1, share.shape[1] - 1)
            b -= left
            part = (share[top, left] * (1 - b) + share[top, right] * b) * (1 - a)
            part += (share[low, left] * (1 - b) + share[low, right] * b) * a
            if np.isnan(planes[0, i, j]):
                part = 0.0
            # A thousandth of a scale is not worth its stencil.
            if part > 0.999 or np.isnan(z[i, j]):
                if part == 0.0:
                    planes[:, i, j] = np.nan
                continue
            # The whole window by its formula, else (an edge, a hole, the least-squares choice) the box.
            whole = (wide and _five_points(z, i, j, dx, dy, d)) or (
                not wide and not fit and _three_points(z, i, j, dx, dy, d)
            )
            if not whole:
                stencil(z, i, j, box)
                differentiate(box, dx, dy, fit and not wide, d)
            for k in range(5):
                if part == 0.0:
                    planes[k, i, j] = d[k]
                else:
                    planes[k, i, j] = d[k] + part * (planes[k, i, j] - d[k])


def upsample(nodes: FloatArray, step: int, shape: tuple[int, int]) -> npt.NDArray[np.float32]:
    """Interpolate a map on every `step`-th row and column bilinearly to all, (rows, cols) float32."""
    out = np.empty(shape, np.float32)
    _upsample_nodes(np.ascontiguousarray(nodes, np.float64), step, out)
    return out


@njit(cache=True, parallel=True)
def _upsample_nodes(
    nodes: npt.NDArray[np.float64], step: int, out: npt.NDArray[np.float32]
) -> None:
    for i in prange(out.shape[0]):
        a = min(i / step, nodes.shape[0] - 1.0)
        top = int(a)
        low = min(top + 1, nodes.shape[0] - 1)
        a -= top
        for j in range(out.shape[1]):
            b = min(j / step, nodes.shape[1] - 1.0)
            left = int(b)
            right = min(left + 1, nodes.shape[1] - 1)
            b -= left
            above = nodes[top, left] * (1 - b) + nodes[top, right] * b
            below = nodes[low, left] * (1 - b) + nodes[low, right] * b
            out[i, j] = above * (1 - a) + below * a
