"""Global matching: where in a map does a patch of heights belong, with its heading known or not.

Normalised cross-correlation under masks (Padfield 2012) by FFT, so holes and partial overlap count
for what they are; over all headings when none is known, coarse first. The best few places are kept as
hypotheses and each is verified at full resolution by least squares on shift, heading and depth bias,
which gives the subcell place and its covariance. A match is accepted when the best hypothesis fits
better than every distinct other by more than chance allows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import fft, ndimage, optimize

from perception.records import BoolArray, FloatArray

# Share of the patch that must lie on the map's data.
_LEAST_OVERLAP = 0.4
# Side of the map in the coarse search: rotation by rotation, 256 cells are enough to find peaks.
_COARSE_SIDE = 300
# Points of the patch that verify a hypothesis: more do not sharpen it and cost time.
_VERIFY_POINTS = 4000
# Log likelihood ratio between best and second place: e^12 covers a million places tried.
_DISTINCT = 12.0
_LEAST_NCC = 0.5


@dataclass(frozen=True, slots=True)
class Match:
    """One place and heading where a patch may belong.

    Attributes
    ----------
    row, col : fractional cell of the map under the patch's centre.
    turn_rad : clockwise rotation that takes the patch's axes to the map's.
    ncc : normalised correlation there.
    covariance : (3, 3) of row, col (cells) and turn (rad).
    misfit_m : rms of what is left after removing the mean.
    independent : number of independent values in what is left.
    """

    row: float
    col: float
    turn_rad: float
    ncc: float
    covariance: FloatArray
    misfit_m: float
    independent: float = 0.0


@dataclass(frozen=True, slots=True)
class Matching:
    """Result of a global match: hypotheses, best first; whether the best may be used, and why."""

    hypotheses: tuple[Match, ...]
    accepted: bool
    reason: str
    margin: float

    @property
    def best(self) -> Match:
        return self.hypotheses[0]


def masked_ncc(values: FloatArray, patch: FloatArray, least_overlap: float) -> FloatArray:
    """Normalised correlation of a patch at every place of a map, holes left out of both.

    Parameters
    ----------
    values, patch : (R, C) and (r, c) heights, NaN no data.
    least_overlap : number of common cells below which there is no result (-1).

    Returns
    -------
    (R + r - 1, C + c - 1) : element (i, j) has the patch's first cell at (i - r + 1, j - c + 1).
    """
    return _ncc_with(_Spectra(values, patch.shape), patch, least_overlap)


class _Spectra:
    """Transforms of a map, kept for the rotations of a patch."""

    def __init__(self, values: FloatArray, patch_shape: tuple[int, int]) -> None:
        known = np.isfinite(values)
        self.level = float(values[known].mean())
        f = np.where(known, values - self.level, 0.0)
        self.full = tuple(int(a + b - 1) for a, b in zip(values.shape, patch_shape, strict=True))
        self.size = tuple(fft.next_fast_len(n, real=True) for n in self.full)
        self.mask = fft.rfft2(known.astype(float), self.size)
        self.value = fft.rfft2(f, self.size)
        self.square = fft.rfft2(f * f, self.size)


def _ncc_with(spectra: _Spectra, patch: FloatArray, least_overlap: float) -> FloatArray:
    known = np.isfinite(patch)
    g = np.where(known, patch - np.nanmean(patch), 0.0)[::-1, ::-1]
    mask = fft.rfft2(known[::-1, ::-1].astype(float), spectra.size)
    value = fft.rfft2(g, spectra.size)
    square = fft.rfft2(g * g, spectra.size)

    def correlate(a: FloatArray, b: FloatArray) -> FloatArray:
        out: FloatArray = fft.irfft2(a * b, spectra.size)[: spectra.full[0], : spectra.full[1]]
        return out

    number = np.maximum(np.round(correlate(spectra.mask, mask)), 1.0)
    sum_f, sum_g = correlate(spectra.value, mask), correlate(spectra.mask, value)
    var_f = correlate(spectra.square, mask) - sum_f**2 / number
    var_g = correlate(spectra.mask, square) - sum_g**2 / number
    cross = correlate(spectra.value, value) - sum_f * sum_g / number
    # Where a window holds no relief the ratio is rounding over rounding.
    least = 1e-9 * float(np.nanvar(patch)) * number + 1e-12
    usable = (number >= least_overlap) & (var_f > least) & (var_g > least)
    ncc = np.full(spectra.full, -1.0)
    ncc[usable] = cross[usable] / np.sqrt(var_f[usable] * var_g[usable])
    return np.clip(ncc, -1.0, 1.0)


def match_patch(
    values: FloatArray,
    patch: FloatArray,
    turn_rad: float | None = 0.0,
    keep: int = 6,
    step_rad: float = np.radians(4.0),
) -> Matching:
    """Find where a patch belongs in a map of the same cell size.

    Parameters
    ----------
    values, patch : heights, NaN no data; any constant between them is free.
    turn_rad : the patch's rotation where it is known; None searches all headings.
    keep : hypotheses to verify.
    step_rad : step of the search over headings.

    Returns
    -------
    Matching
        Never empty; without relief or overlap the one hypothesis has correlation -1.
    """
    thin = max(1, round(max(values.shape) / _COARSE_SIDE)) if turn_rad is None else 1
    coarse_map, coarse_patch = _thinned(values, thin), _thinned(patch, thin)
    turns = (
        np.arange(0.0, 2 * np.pi - step_rad / 2, step_rad)
        if turn_rad is None
        else np.array([turn_rad])
    )
    candidates = _candidates(coarse_map, coarse_patch, turns, thin, 3 * keep, values.shape)
    free = turn_rad is None
    verified = [verify(values, patch, c, free) for c in candidates]
    verified.sort(key=lambda m: -m.ncc)
    chosen = _distinct(verified, max(patch.shape) / 10)[:keep]
    return _judge(chosen)


def _thinned(values: FloatArray, every: int) -> FloatArray:
    """Average blocks of `every` cells, holes left out."""
    if every == 1:
        return values
    rows, cols = (n // every * every for n in values.shape)
    blocks = values[:rows, :cols].reshape(rows // every, every, cols // every, every)
    known = np.isfinite(blocks)
    number = known.sum(axis=(1, 3))
    total = np.where(known, blocks, 0.0).sum(axis=(1, 3))
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


def rotated(patch: FloatArray, turn_rad: float) -> FloatArray:
    """Turn a patch clockwise about its centre; the result holds all of it, NaN around."""
    if turn_rad == 0.0:
        return patch
    rows, cols = patch.shape
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    side_r = int(np.ceil(abs(rows * c) + abs(cols * s)))
    side_c = int(np.ceil(abs(rows * s) + abs(cols * c)))
    r, q = np.meshgrid(
        np.arange(side_r) - (side_r - 1) / 2, np.arange(side_c) - (side_c - 1) / 2, indexing="ij"
    )
    # Rows grow downwards: clockwise on the map is clockwise on the screen.
    at = np.array([c * r - s * q + (rows - 1) / 2, s * r + c * q + (cols - 1) / 2])
    return ndimage.map_coordinates(patch, at, order=1, cval=np.nan)


def _candidates(
    values: FloatArray,
    patch: FloatArray,
    turns: FloatArray,
    thin: int,
    number: int,
    shape: tuple[int, ...],
) -> list[Match]:
    """Return the highest peaks over all turns, in cells of the full map."""
    side = int(np.ceil(np.hypot(*patch.shape))) if len(turns) > 1 else max(patch.shape)
    spectra = _Spectra(values, (side, side))
    least = _LEAST_OVERLAP * float(np.isfinite(patch).sum())
    found: list[Match] = []
    for turn in turns:
        turned = rotated(patch, float(turn))
        ncc = _ncc_with(spectra, turned, least)
        for _ in range(4):
            i, j = np.unravel_index(int(np.argmax(ncc)), ncc.shape)
            score = float(ncc[i, j])
            if score <= 0:
                break
            row = i - turned.shape[0] + 1 + (turned.shape[0] - 1) / 2
            col = j - turned.shape[1] + 1 + (turned.shape[1] - 1) / 2
            at = ((row + 0.5) * thin - 0.5, (col + 0.5) * thin - 0.5)
            found.append(Match(*at, float(turn), score, np.full((3, 3), np.nan), np.nan))
            near = max(2, min(patch.shape) // 6)
            ncc[max(i - near, 0) : i + near + 1, max(j - near, 0) : j + near + 1] = -1.0
    found.sort(key=lambda m: -m.ncc)
    if not found:
        return [Match(0.0, 0.0, float(turns[0]), -1.0, np.full((3, 3), np.nan), np.nan)]
    return _distinct(found, max(shape) / 200)[:number]


def _distinct(matches: list[Match], apart: float) -> list[Match]:
    """Drop a match that lies within `apart` cells and 15 degrees of a better one."""
    kept: list[Match] = []
    for m in matches:
        if all(
            np.hypot(m.row - k.row, m.col - k.col) > apart
            or abs((m.turn_rad - k.turn_rad + np.pi) % (2 * np.pi) - np.pi) > np.radians(15)
            for k in kept
        ):
            kept.append(m)
    return kept


def verify(values: FloatArray, patch: FloatArray, start: Match, free_turn: bool) -> Match:
    """Refine a hypothesis by least squares on shift, heading and level; score it at full resolution."""
    fit = _Fit(values, patch, start.turn_rad, free_turn)
    x = np.array([start.row, start.col, start.turn_rad])[: 3 if free_turn else 2]
    # A gentle blur widens the basin that least squares converges in; the map itself has the answer.
    for blur in (1.0, 0.0):
        fit.blur(blur)
        solved = optimize.least_squares(
            fit.residual, x, x_scale=fit.scale[: len(x)], diff_step=1e-4, max_nfev=20
        )
        x = solved.x
    full = fit.full(x)
    there, inside = fit.read(full)
    if inside.sum() < _LEAST_OVERLAP * len(inside):
        return replace(start, ncc=-1.0)
    here, there = fit.heights[inside], there[inside]
    if there.std() == 0 or here.std() == 0:
        return replace(start, ncc=-1.0)
    miss = (here - here.mean()) - (there - there.mean())
    field = np.full(patch.shape, np.nan)
    field[fit.rows[inside], fit.cols[inside]] = miss
    independent = _independent(field)
    return Match(
        row=float(full[0]),
        col=float(full[1]),
        turn_rad=float(full[2] % (2 * np.pi)),
        ncc=float(np.corrcoef(here, there)[0, 1]),
        covariance=_covariance(solved, len(miss), independent, free_turn),
        misfit_m=float(miss.std()),
        independent=independent,
    )


class _Fit:
    """Least squares of a patch on a map: shift, turn and level."""

    def __init__(self, values: FloatArray, patch: FloatArray, turn: float, free: bool) -> None:
        rows, cols = np.nonzero(np.isfinite(patch))
        every = max(1, len(rows) // _VERIFY_POINTS)
        # A square thinning would alias; every k-th of a shuffled list does not.
        order = np.random.default_rng(0).permutation(len(rows))[::every]
        self.rows, self.cols = rows[order], cols[order]
        self.r = self.rows - (patch.shape[0] - 1) / 2
        self.q = self.cols - (patch.shape[1] - 1) / 2
        self.heights = patch[self.rows, self.cols]
        known = np.isfinite(values)
        self.filled = np.where(known, values, np.nanmean(values))
        self.known = known.astype(np.float32)
        self.turn, self.free = turn, free
        self.scale = np.array([1.0, 1.0, 2.0 / max(patch.shape)])
        self.blur(0.0)

    def blur(self, cells: float) -> None:
        """Read the map through a Gaussian of `cells`."""
        self.map = ndimage.gaussian_filter(self.filled, cells) if cells else self.filled

    def full(self, x: FloatArray) -> FloatArray:
        """Row, column and turn of a parameter vector."""
        return x if self.free else np.array([x[0], x[1], self.turn])

    def read(self, full: FloatArray) -> tuple[FloatArray, BoolArray]:
        """The map's heights under the patch's points, and whether it has any."""
        c, s = np.cos(full[2]), np.sin(full[2])
        at = np.array([full[0] + c * self.r + s * self.q, full[1] - s * self.r + c * self.q])
        inside = ndimage.map_coordinates(self.known, at, order=1, cval=0.0) > 0.99
        return ndimage.map_coordinates(self.map, at, order=1, mode="nearest"), inside

    def residual(self, x: FloatArray) -> FloatArray:
        """Misfit without its mean; zero where the map has no data."""
        there, inside = self.read(self.full(x))
        miss = self.heights - there
        if inside.sum() < _LEAST_OVERLAP * len(miss):
            return np.full(len(miss), 10.0 * float(self.heights.std()) + 1.0)
        return np.where(inside, miss - miss[inside].mean(), 0.0)


def _covariance(
    solved: optimize.OptimizeResult, number: int, independent: float, free_turn: bool
) -> FloatArray:
    """Gauss-Newton covariance with the misfit's own variance and number of independent points."""
    out = np.zeros((3, 3))
    normal = solved.jac.T @ solved.jac
    if np.linalg.cond(normal) > 1e14:
        return np.full((3, 3), np.nan)
    variance = 2 * solved.cost / max(number - len(solved.x) - 1, 1)
    k = 3 if free_turn else 2
    out[:k, :k] = np.linalg.inv(normal) * variance * max(number / max(independent, 4.0), 1.0)
    return out


def _judge(matches: list[Match]) -> Matching:
    """Accept the best if no other place fits nearly as well.

    Were the second the true place, what it leaves would be noise, and the best could leave less only
    by chance: the log likelihood ratio says how unlikely that is. The number of independent points is
    the best misfit's own, so a misfit that looks like terrain proves nothing.
    """
    best = matches[0]
    if best.ncc < _LEAST_NCC or not np.isfinite(best.covariance).all():
        reason = f"no place fits: best correlation {best.ncc:.2f}"
        return Matching(tuple(matches), False, reason, 0.0)
    if len(matches) == 1:
        return Matching(tuple(matches), True, "one place fits", np.inf)
    left = [max(1.0 - m.ncc**2, 1e-9) for m in matches[:2]]
    margin = 0.5 * best.independent * float(np.log(left[1] / left[0]))
    where = f"correlation {best.ncc:.2f} here, {matches[1].ncc:.2f} elsewhere"
    if margin < _DISTINCT:
        reason = f"ambiguous: {where} (log likelihood ratio {margin:.1f}, {_DISTINCT:g} needed)"
        return Matching(tuple(matches), False, reason, margin)
    return Matching(tuple(matches), True, f"{where}: log likelihood ratio {margin:.0f}", margin)


def _independent(field: FloatArray) -> float:
    """Number of independent values in a field with holes: values over correlation area."""
    known = np.isfinite(field)
    g = np.where(known, field - np.nanmean(field), 0.0)
    size = tuple(2 * n for n in field.shape)
    covariance = fft.irfft2(np.abs(fft.rfft2(g, size)) ** 2, size)
    overlap = fft.irfft2(np.abs(fft.rfft2(known.astype(float), size)) ** 2, size)
    share = known.mean()
    correlation = covariance / np.maximum(overlap, 1.0)
    correlation /= max(correlation[0, 0], 1e-12)
    # Each lag's estimate scatters by 1 / overlap, which adds up to a spurious correlation area.
    near = overlap > 0.25 * overlap.max()
    square = np.where(near, correlation**2 - 1.0 / np.maximum(overlap, 1.0), 0.0)
    area = max(float(np.sum(square)), 1.0) * share
    return float(known.sum()) / max(area, 1.0)
