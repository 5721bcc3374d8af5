"""A place that a search proposes, made exact and weighed: least squares, covariance and evidence.

Shift, turn and level are fitted by least squares on the points that have a map under them; the misfit's own
variance and correlation area give the covariance. Evidence is the log likelihood ratio against ground of
no relation to the patch, octave by octave (`evidence_of`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import fft, ndimage, optimize

from perception.records import BoolArray, FloatArray

# Share of the patch that must lie on the map's data.
LEAST_OVERLAP = 0.4
# Points of the patch that verify a hypothesis: more do not sharpen it and cost time.
_VERIFY_POINTS = 4000
# 1-sigma of a heading that is given: a compass's.
TURN_SIGMA_RAD = float(np.radians(0.5))
# Octaves of fewer values are left out.
_FEWEST_VALUES = 10.0


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
    plain : the same over all octaves at once, counting the independent values of what is left.
    """

    row: float
    col: float
    turn_rad: float
    ncc: float
    covariance: FloatArray
    misfit_m: float
    independent: float = 0.0
    evidence: float = 0.0
    plain: float = 0.0


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
    if inside.sum() < LEAST_OVERLAP * len(inside):
        return replace(start, ncc=-1.0)
    here, there = fit.heights[inside], there[inside]
    if there.std() == 0 or here.std() == 0:
        return replace(start, ncc=-1.0)
    miss = (here - here.mean()) - (there - there.mean())
    field = np.full(patch.shape, np.nan)
    field[fit.rows[inside], fit.cols[inside]] = miss
    independent = _independent(field)
    covariance = _covariance(solved, len(miss), independent, free_turn)
    if not free_turn:
        covariance = _with_turn(covariance, fit.lever(x, solved.jac))
    return Match(
        row=float(full[0]),
        col=float(full[1]),
        turn_rad=float(full[2] % (2 * np.pi)),
        ncc=float(np.corrcoef(here, there)[0, 1]),
        covariance=covariance,
        misfit_m=float(miss.std()),
        independent=independent,
        evidence=evidence_of(patch, _misfit(values, patch, full)),
        plain=_plain(patch, _misfit(values, patch, full)),
    )


def _misfit(values: FloatArray, patch: FloatArray, full: FloatArray) -> FloatArray:
    """The patch less the map under it at a place, in the patch's cells; NaN where either has none."""
    r, q = np.indices(patch.shape)
    r, q = r - (patch.shape[0] - 1) / 2, q - (patch.shape[1] - 1) / 2
    c, s = np.cos(full[2]), np.sin(full[2])
    at = np.array([full[0] + c * r + s * q, full[1] - s * r + c * q])
    return patch - ndimage.map_coordinates(values, at, order=1, cval=np.nan)


def evidence_of(patch: FloatArray, miss: FloatArray) -> float:
    """Log likelihood ratio of a place against ground of no relation to the patch.

    Octave by octave: the variance that the place leaves over the patch's own, by the number of independent
    values that the octave has on the common cells. One number for all octaves would be misled twice: a
    white noise hides that what is left of the long waves looks like terrain, and a smooth stretch of map
    "fits" short waves better than a rough one. An octave that the place does not explain counts nothing.
    Nor does slope or bend of the patch as a whole: any hillside has them.
    """
    common = np.isfinite(miss)
    cells = float(common.sum())
    own, left = _without_bend(np.where(common, patch, np.nan)), miss - np.nanmean(miss)
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


def _plain(patch: FloatArray, miss: FloatArray) -> float:
    """Evidence by all of the variance at once.

    What a wrong place leaves of strong and smooth ground is smooth as well: it has few independent values,
    and all octaves see the same few. What the right place leaves is noise, which has many.
    """
    own = _without_bend(np.where(np.isfinite(miss), patch, np.nan))
    ratio = float(np.nanvar(own)) / max(float(np.nanvar(miss)), 1e-30)
    return 0.5 * _independent(miss) * max(float(np.log(max(ratio, 1e-30))), 0.0)


def _without_bend(values: FloatArray) -> FloatArray:
    """Take off the surface of second degree that fits best; NaN stays."""
    known = np.isfinite(values)
    row, col = (np.linspace(-1, 1, n) for n in values.shape)
    r, c = np.meshgrid(row, col, indexing="ij")
    terms = np.stack([np.ones_like(r), r, c, r * r, r * c, c * c], axis=-1)
    weights = np.linalg.lstsq(terms[known], values[known], rcond=None)[0]
    return values - terms @ weights


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
        if self.inside.sum() < LEAST_OVERLAP * len(miss):
            return np.full(len(miss), 10.0 * float(self.heights.std()) + 1.0)
        return np.where(self.inside, miss - miss[self.inside].mean(), 0.0)

    def lever(self, x: FloatArray, slopes: FloatArray) -> FloatArray:
        """How far the best place moves, (2,) cells a radian, if the given turn is wrong.

        From the normal equations: ``-(J^T J)^-1 J^T g`` of the residual's slopes J by place and g by turn.
        """
        given, ends = self.turn, []
        for self.turn in (given - TURN_SIGMA_RAD, given + TURN_SIGMA_RAD):
            ends.append(self.residual(x))
        self.turn = given
        by_turn = (ends[1] - ends[0]) / (2 * TURN_SIGMA_RAD)
        return -np.linalg.lstsq(slopes, by_turn, rcond=None)[0]


def _with_turn(covariance: FloatArray, lever: FloatArray) -> FloatArray:
    """Covariance (3, 3) of a fit at a turn that is known to a compass's error; `lever` (2,) cells a radian."""
    if not np.isfinite(covariance).all():
        return covariance
    moves = np.array([*lever, 1.0]) * TURN_SIGMA_RAD
    return covariance + np.outer(moves, moves)


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


def smoothed(
    values: FloatArray, width: float | FloatArray, least_known: float | None = None
) -> FloatArray:
    """Smooth by a Gaussian of `width` cells (both axes, or one for each); NaN is left out.

    NaN stays where it was, or with `least_known` is where less than that part of the weight is known.
    """
    known = np.isfinite(values)
    weight = ndimage.gaussian_filter(known.astype(float), width, mode="constant")
    total = ndimage.gaussian_filter(np.where(known, values, 0.0), width, mode="constant")
    told = known if least_known is None else weight > least_known
    return np.where(told, total / np.maximum(weight, 1e-12), np.nan)


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
