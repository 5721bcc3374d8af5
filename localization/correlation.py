"""Global matching: where in a map does a patch of heights belong, with its heading known or not.

Normalised cross-correlation under masks (Padfield 2012) by FFT, so holes and partial overlap count
for what they are; over all headings when none is known, coarse first. The best few places are kept as
hypotheses and each is verified at full resolution by least squares on shift, heading and depth bias,
which gives the subcell place and its covariance. A match is accepted when the best hypothesis fits
better than every distinct other by more than chance allows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage

from localization.refinement import LEAST_OVERLAP, Match, smoothed, verify
from perception.records import FloatArray, Progress, silent

# Side of the map in the coarse search: rotation by rotation, 256 cells are enough to find peaks.
_COARSE_SIDE = 300
# A patch of fewer cells a side is searched at half of a cell, on a map no larger than the coarse one: on a
# larger map that would be gigabytes, and such a patch is searched cell by cell.
_FINE_SIDE = 24
# Log likelihood ratio between best and second place: e^12 covers a million places tried.
_DISTINCT = 12.0
# The best of all wrong places reaches 20 to 30: e^18 places and turns on a thousand cells a side, each
# fitted. As sure again as above, and some for ground that repeats itself.
_CHANCE = 45.0
# The same over all octaves at once: of strong, smooth, real grounds wrong places had 0, right ones above
# 1,000; patches of weak relief on a thumbnail have some 100.
_PLAIN = 60.0
# A survey's own map errs in long waves, and on low relief they are all that the right place leaves: few
# independent values. Then e^12, a million places, must do, where the octaves say ten times what they say of any
# other place and ten times the bar above. The eight wrong places of 380 that had so much had 0.0 here.
_PLAIN_ALONE, _ALONE = 12.0, 10.0
# Cells a side that a patch keeps in the coarse search: of 30 cells thinned by 7 nothing can be recognised.
_FEWEST_COARSE = 12
# Places are ranked without what a Gaussian of this part of the patch keeps, but of so many cells at least
# (of parts of 3, 6 and 12 the last ranked best, docs/terrain-navigation.md).
_LONGEST_PART, _SHARPEST = 12.0, 2.0


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


class Spectra:
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


def masked_ncc(
    spectra: Spectra, patch: FloatArray, least_overlap: float
) -> tuple[FloatArray, FloatArray]:
    """Normalised correlation of a patch at every place of a map, holes left out of both.

    Parameters
    ----------
    patch : (r, c) heights, NaN no data; of a map (R, C).
    least_overlap : number of common cells below which there is no result (-1).

    Returns
    -------
    correlation, number of common cells : (R + r - 1, C + c - 1) each; element (i, j) has the patch's
        first cell at (i - r + 1, j - c + 1).
    """
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
    progress: Progress = silent,
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
    thin = min(thin, float(max(1, min(patch.shape) // _FEWEST_COARSE)))
    if min(patch.shape) < _FINE_SIDE:
        # Of few wide cells, half a cell beside the place no short wave fits any more.
        thin = 0.5 if max(values.shape) <= _COARSE_SIDE else 1.0
    coarse_map, coarse_patch = _thinned(values, thin), _thinned(patch, thin)
    if not np.isfinite(patch).any():
        return _judge([_nowhere(turn_rad or 0.0)])
    turns = (
        np.arange(0.0, 2 * np.pi - step_rad / 2, step_rad)
        if turn_rad is None
        else np.array([turn_rad])
    )
    candidates = _candidates(coarse_map, coarse_patch, turns, thin, values.shape, progress)
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
        finer: FloatArray = ndimage.zoom(values, 1 / thin, order=1, grid_mode=True, mode="nearest")
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
    progress: Progress = silent,
) -> list[Match]:
    """Return the places that fit best over all turns, in cells of the full map.

    Long waves are taken off both first: of smooth ground they are most of the relief and tell places
    apart least. A place is ranked by evidence, common cells times
    ``-log(1 - ncc^2)``: the same correlation over half of the patch says half as much.
    """
    side = int(np.ceil(np.hypot(*patch.shape))) if len(turns) > 1 else max(patch.shape)
    width = max(min(patch.shape) / _LONGEST_PART, _SHARPEST)
    sharp, fine = _sharpened(patch, width), _sharpened(values, width)
    spectra = Spectra(fine, (side, side))
    least = LEAST_OVERLAP * float(np.isfinite(patch).sum())
    found: list[tuple[float, Match]] = []
    for k, turn in enumerate(turns):
        progress("headings tried", k, len(turns))
        turned = rotated(sharp, float(turn))
        ncc, common = masked_ncc(spectra, turned, least)
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
    progress("headings tried", len(turns), len(turns))
    if not found:
        return [_nowhere(float(turns[0]))]
    found.sort(key=lambda f: -f[0])
    return _distinct([match for _, match in found], max(shape) / 200)


def _nowhere(turn_rad: float) -> Match:
    """What stands for a place where none was found."""
    return Match(0.0, 0.0, turn_rad, -1.0, np.full((3, 3), np.nan), np.nan)


def _sharpened(values: FloatArray, width: float) -> FloatArray:
    """Take off what a Gaussian of `width` cells keeps, holes left out."""
    return values - smoothed(values, width)


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


def _judge(matches: list[Match]) -> Matching:
    """Accept the best if chance does not explain it and no other place fits nearly as well."""
    best = matches[0]
    rival = matches[1].evidence if len(matches) > 1 else 0.0
    margin = best.evidence - rival
    where = f"log likelihood ratio {best.evidence:.0f} against unrelated ground"
    alone = best.evidence > _ALONE * max(rival, _CHANCE)
    plain = _PLAIN_ALONE if alone else _PLAIN
    if not np.isfinite(best.covariance).all() or best.evidence < _CHANCE:
        reason = f"no place fits: {where}, {_CHANCE:g} needed"
    elif best.plain < plain:
        reason = (
            f"no place fits for certain: the best has a {where} (next place {rival:.0f}), but what it leaves is as "
            f"smooth as ground: {best.plain:.0f} by all waves at once, {plain:g} needed"
        )
    elif margin < _DISTINCT:
        reason = f"ambiguous: {where}, {margin:.1f} above the next place, {_DISTINCT:g} needed"
    else:
        return Matching(tuple(matches), True, f"{where}, {margin:.0f} above the next place", margin)
    return Matching(tuple(matches), False, reason, margin)
