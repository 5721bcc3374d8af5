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
# A patch of fewer cells a side is searched at half of a cell.
_FINE_SIDE = 24
# Points of the patch that verify a hypothesis: more do not sharpen it and cost time.
_VERIFY_POINTS = 4000
# Log likelihood ratio between best and second place: e^12 covers a million places tried.
_DISTINCT = 12.0
# The best of all wrong places reaches 20 to 30: e^18 places and turns on a thousand cells a side, each
# fitted. As sure again as above, and some for ground that repeats itself.
_CHANCE = 45.0
# Places are ranked without what a Gaussian of this part of the patch, or of these cells, keeps (of 3, 6, 12 the last ranked
# best, docs/terrain-navigation.md); octaves of fewer values are left out.
_LONGEST_PART, _SHARPEST, _FEWEST_VALUES = 12.0, 2.0, 10.0


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
    evidence : log likelihood ratio of the place against ground of no relation to the patch.
    """

    row: float
    col: float
    turn_rad: float
    ncc: float
    covariance: FloatArray
    misfit_m: float
    independent: float = 0.0
    evidence: float = 0.0


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
    return _ncc_with(_Spectra(values, patch.shape), patch, least_overlap)[0]


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


def _ncc_with(
    spectra: _Spectra, patch: FloatArray, least_overlap: float
) -> tuple[FloatArray, FloatArray]:
    """Correlation at every place, and the number of common cells."""
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
    return np.clip(ncc, -1.0, 1.0), number


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
    thin = float(max(1, round(max(values.shape) / _COARSE_SIDE))) if turn_rad is None else 1.0
    if min(patch.shape) < _FINE_SIDE:
        # Of few wide cells, half a cell beside the place no short wave fits any more.
        thin = 0.5
    coarse_map, coarse_patch = _thinned(values, thin), _thinned(patch, thin)
    turns = (
        np.arange(0.0, 2 * np.pi - step_rad / 2, step_rad)
        if turn_rad is None
        else np.array([turn_rad])
    )
    candidates = _candidates(coarse_map, coarse_patch, turns, thin, values.shape)
    free = turn_rad is None
    found, verified = Matching((), False, "", 0.0), list[Match]()
    # Weak ground may hide the true place far down the coarse list: look there only if need be.
    for first, last in ((0, 3 * keep), (3 * keep, 15 * keep)):
        verified += [verify(values, patch, c, free) for c in candidates[first:last]]
        verified.sort(key=lambda m: -m.evidence)
        found = _judge(_distinct(verified, max(patch.shape) / 10)[:keep])
        if found.accepted:
            break
    return found


def _thinned(values: FloatArray, thin: float) -> FloatArray:
    """Average blocks of `thin` cells, holes left out; below 1 interpolate between cells."""
    if thin == 1:
        return values
    if thin < 1:
        finer: FloatArray = ndimage.zoom(
            values, 1 / thin, order=1, grid_mode=True, mode="nearest"
        )
        return finer
    every = int(thin)
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
    thin: float,
    shape: tuple[int, ...],
) -> list[Match]:
    """Return the places that fit best over all turns, in cells of the full map.

    Long waves are taken off both first: of smooth ground they are most of the relief and tell places
    apart least. A place is ranked by evidence, common cells times
    ``-log(1 - ncc^2)``: the same correlation over half of the patch says half as much.
    """
    side = int(np.ceil(np.hypot(*patch.shape))) if len(turns) > 1 else max(patch.shape)
    width = max(min(patch.shape) / _LONGEST_PART, _SHARPEST)
    sharp, fine = _sharpened(patch, width), _sharpened(values, width)
    spectra = _Spectra(fine, (side, side))
    least = _LEAST_OVERLAP * float(np.isfinite(patch).sum())
    found: list[tuple[float, Match]] = []
    for turn in turns:
        turned = rotated(sharp, float(turn))
        ncc, common = _ncc_with(spectra, turned, least)
        told = -common * np.log1p(-(np.clip(ncc, 0.0, 0.999) ** 2))
        for _ in range(4):
            i, j = np.unravel_index(int(np.argmax(told)), told.shape)
            if told[i, j] <= 0:
                break
            row = i - turned.shape[0] + 1 + (turned.shape[0] - 1) / 2
            col = j - turned.shape[1] + 1 + (turned.shape[1] - 1) / 2
            at = ((row + 0.5) * thin - 0.5, (col + 0.5) * thin - 0.5)
            match = Match(*at, float(turn), float(ncc[i, j]), np.full((3, 3), np.nan), np.nan)
            found.append((float(told[i, j]), match))
            near = max(2, min(patch.shape) // 6)
            told[max(i - near, 0) : i + near + 1, max(j - near, 0) : j + near + 1] = 0.0
    if not found:
        return [Match(0.0, 0.0, float(turns[0]), -1.0, np.full((3, 3), np.nan), np.nan)]
    found.sort(key=lambda f: -f[0])
    return _distinct([match for _, match in found], max(shape) / 200)


def _sharpened(values: FloatArray, width: float) -> FloatArray:
    """Take off what a Gaussian of `width` cells keeps, holes left out."""
    return values - smoothed(values, width)


def smoothed(values: FloatArray, width: float | FloatArray) -> FloatArray:
    """Smooth by a Gaussian of `width` cells (both axes, or one for each); NaN is left out and stays."""
    known = np.isfinite(values)
    weight = ndimage.gaussian_filter(known.astype(float), width, mode="constant")
    total = ndimage.gaussian_filter(np.where(known, values, 0.0), width, mode="constant")
    return np.where(known, total / np.maximum(weight, 1e-12), np.nan)


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
    for blur in (1.0, 0.0, 0.0):
        fit.blur(blur)
        fit.settle(x)
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
        evidence=_evidence(patch, _misfit(values, patch, full)),
    )


def _misfit(values: FloatArray, patch: FloatArray, full: FloatArray) -> FloatArray:
    """The patch less the map under it at a place, in the patch's cells; NaN where either has none."""
    r, q = np.indices(patch.shape)
    r, q = r - (patch.shape[0] - 1) / 2, q - (patch.shape[1] - 1) / 2
    c, s = np.cos(full[2]), np.sin(full[2])
    at = np.array([full[0] + c * r + s * q, full[1] - s * r + c * q])
    return patch - ndimage.map_coordinates(values, at, order=1, cval=np.nan)


def _evidence(patch: FloatArray, miss: FloatArray) -> float:
    """Log likelihood ratio of a place against ground of no relation to the patch.

    Octave by octave: the variance that the place leaves over the patch's own, by the number of independent
    values that the octave has on the common cells. One number for all octaves would be misled twice: a
    white noise hides that what is left of the long waves looks like terrain, and a smooth stretch of map
    "fits" short waves better than a rough one. An octave that the place does not explain counts nothing.
    """
    common = np.isfinite(miss)
    cells = float(common.sum())
    own, left = np.where(common, patch, np.nan), miss
    own, left = own - np.nanmean(own), left - np.nanmean(left)
    width, total, values = 0.0, 0.0, cells
    while values > _FEWEST_VALUES:
        next_width = max(2.0 * width, 1.0)
        smooth_own, smooth_left = smoothed(own, next_width), smoothed(left, next_width)
        # A field smoothed by s has a correlation area of 2 pi s^2.
        fewer = cells / (2 * np.pi * next_width**2)
        before, after = float(np.nanvar(own - smooth_own)), float(np.nanvar(left - smooth_left))
        total += 0.5 * (values - fewer) * max(float(np.log(before / max(after, 1e-30))), 0.0)
        own, left, width, values = smooth_own, smooth_left, next_width, fewer
    return total


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
        self.inside = np.ones(len(self.heights), bool)
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

    def settle(self, x: FloatArray) -> None:
        """Choose the points that count: those with data under them at a place.

        They stay the same while the place moves a little. Points that come and go at a border would be
        steps of the misfit, and their derivatives a certainty that is not there.
        """
        _, self.inside = self.read(self.full(x))

    def residual(self, x: FloatArray) -> FloatArray:
        """Misfit without its mean; zero where the map has no data."""
        there, _ = self.read(self.full(x))
        miss = self.heights - there
        if self.inside.sum() < _LEAST_OVERLAP * len(miss):
            return np.full(len(miss), 10.0 * float(self.heights.std()) + 1.0)
        return np.where(self.inside, miss - miss[self.inside].mean(), 0.0)


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
    """Accept the best if chance does not explain it and no other place fits nearly as well."""
    best = matches[0]
    margin = best.evidence - (matches[1].evidence if len(matches) > 1 else 0.0)
    where = f"log likelihood ratio {best.evidence:.0f} against unrelated ground"
    if not np.isfinite(best.covariance).all() or best.evidence < _CHANCE:
        reason = f"no place fits: {where}, {_CHANCE:g} needed"
    elif margin < _DISTINCT:
        reason = f"ambiguous: {where}, {margin:.1f} above the next place, {_DISTINCT:g} needed"
    else:
        return Matching(tuple(matches), True, f"{where}, {margin:.0f} above the next place", margin)
    return Matching(tuple(matches), False, reason, margin)


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
