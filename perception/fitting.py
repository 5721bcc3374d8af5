"""Fit one shadow's surroundings with the bump-or-pit model: height, shape, place, and their covariance.

The likelihood has many hills of its own: all starts are weighed on a coarse copy of the echo, the best of every
length and outline climb there, and the few that lead go on in full.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from perception.records import FloatArray, IntArray
from perception.silhouettes import N_PARAMETERS, N_SHAPE, fisher_step, log_likelihood


@dataclass(frozen=True, slots=True)
class Patch:
    """The equalised echo around one shadow, averaged to a workable size.

    Attributes
    ----------
    ratio : (n, m) float64 power over nominal; NaN says nothing.
    along_m, drop_m : (n,) place along the track and height of the sonar above the floor.
    start_m, step_m : near edge of the first bin and width of a bin, slant.
    weight : looks times independent part of one cell.
    leak : level inside shadows.
    """

    ratio: FloatArray
    along_m: FloatArray
    drop_m: FloatArray
    start_m: float
    step_m: float
    weight: float
    leak: float

    def halved(self) -> Patch:
        """Return the patch with bins joined in pairs; a cell of one known bin counts as that bin."""
        bins = self.ratio.shape[1] // 2
        pairs = self.ratio[:, : 2 * bins].reshape(-1, bins, 2)
        known = np.isfinite(pairs)
        mean = np.where(known, pairs, 0).sum(axis=2) / np.maximum(known.sum(axis=2), 1)
        mean[~known.any(axis=2)] = np.nan
        return replace(
            self,
            ratio=np.ascontiguousarray(mean),
            step_m=2 * self.step_m,
            weight=2 * self.weight,
        )


@dataclass(frozen=True, slots=True)
class Starts:
    """Starting points of a fit, one per row: `sign` and `corner` (s,), `parameters` (s, 10)."""

    sign: FloatArray
    corner: FloatArray
    parameters: FloatArray

    def take(self, rows: IntArray) -> Starts:
        """Return the chosen starts."""
        return Starts(self.sign[rows], self.corner[rows], self.parameters[rows])


@dataclass(frozen=True, slots=True)
class BumpFit:
    """The best bump (`sign` 1) or pit (-1), with the parameters of `perception.silhouettes`.

    `corner` is 2 for an elliptic footprint, 4 for a rectangular one; `gain` is the log likelihood over that of
    a flat floor, priors included.
    """

    parameters: FloatArray
    covariance: FloatArray
    sign: float
    corner: float
    gain: float

    @property
    def height_m(self) -> float:
        """Return the extreme height or depth; positive for either kind."""
        return float(np.exp(self.parameters[2]))


# A highlight above this many times nominal is "bright" and no more.
HIGHLIGHT_CAP = 5.0
# Priors in logarithms: objects are about as long as wide; shapes lie between a Gaussian and a flat top.
_ASPECT_SIGMA = 0.5
_SHAPE_MEAN, _SHAPE_SIGMA = float(np.log(1.7)), 0.6
_SHAPE_LOW, _SHAPE_HIGH = float(np.log(0.8)), float(np.log(8.0))
# The floor's angular law is near Lambert's square, but recorders and sediments differ.
_LAW_MEAN, _LAW_SIGMA = float(np.log(1.95)), 0.13
# The gain follows albedo over blocks larger than objects; patches of sediment are smaller.
_LEVEL_SIGMA = 0.3
_FACETS_PER_BIN = 1.5
# Rounds of climbing: every start on the coarse patch, the best of those, and the leaders in full.
_FIRST_ROUNDS, _MIDDLE_ROUNDS, _LAST_ROUNDS = 3, 5, 14
_MIDDLE_STARTS, _LAST_STARTS = 3, 2
# A kind this far behind the other after the coarse rounds will not catch up.
_BEHIND = 0.6
# Halving a patch of fewer bins would leave too little of it.
_LEAST_BINS = 36


def fit_patch(patch: Patch, starts: Starts, favour: float = 0.0) -> BumpFit | None:
    """Return the most likely fit over all starts, or None where none converges.

    `favour` is what other evidence adds to the log likelihood of a hill over a crater.
    """
    coarse = patch.halved() if patch.ratio.shape[1] >= _LEAST_BINS else patch
    value = _score(starts.sign, starts.corner, starts.parameters, *_fixed(coarse))
    chosen = _leaders(starts, value)
    climbed = {
        sign: _climbed(coarse, starts.take(chosen[starts.sign[chosen] == sign]))
        for sign in (1.0, -1.0)
    }
    best = max((fit.gain for fits in climbed.values() for fit in fits), default=0.0)
    found = []
    for fits in climbed.values():
        if fits and fits[0].gain > _BEHIND * best:
            found += [_climb(patch, fit, _LAST_ROUNDS) for fit in fits[:_LAST_STARTS]]
    good = [fit for fit in found if fit is not None]
    return max(good, key=lambda fit: fit.gain + 0.5 * fit.sign * favour) if good else None


def _leaders(starts: Starts, value: FloatArray) -> IntArray:
    """Return the best start of each kind, outline and length across the track.

    The best of all alone would often be the longest ones, which fit loosely at once and cannot be mended
    by climbing.
    """
    best: dict[tuple[float, float, float], int] = {}
    for row in np.argsort(value):
        key = (float(starts.sign[row]), float(starts.corner[row]), float(starts.parameters[row, 3]))
        best[key] = int(row)
    return np.array(sorted(best.values()), dtype=np.int64)


def _climbed(patch: Patch, starts: Starts) -> list[BumpFit]:
    """Climb from each start, on from the best few, and return those, the best first."""
    first = [
        _climb(patch, BumpFit(at, np.empty(0), float(sign), float(corner), 0.0), _FIRST_ROUNDS)
        for sign, corner, at in zip(starts.sign, starts.corner, starts.parameters, strict=True)
    ]
    ranked = sorted((fit for fit in first if fit is not None), key=lambda fit: -fit.gain)
    further = [_climb(patch, fit, _MIDDLE_ROUNDS) for fit in ranked[:_MIDDLE_STARTS]]
    return sorted((fit for fit in further if fit is not None), key=lambda fit: -fit.gain)


def _climb(patch: Patch, start: BumpFit, rounds: int) -> BumpFit | None:
    """Climb the posterior of a patch from a fit's parameters; None where it leads nowhere."""
    at, value, information = climb(
        start.parameters, start.sign, start.corner, *_fixed(patch), rounds
    )
    if not (np.all(np.isfinite(at)) and np.all(np.isfinite(information))):
        return None
    # Unseen directions come out very wide.
    covariance = np.linalg.inv(information + 1e-6 * np.eye(N_PARAMETERS))
    gain = float(value - _flat_likelihood(patch))
    return BumpFit(at, covariance, start.sign, start.corner, gain)


def _facet_m(patch: Patch) -> float:
    """Return the facets' ground length: a part of a bin at the patch's far edge."""
    far_m = patch.start_m + patch.ratio.shape[1] * patch.step_m
    ground_m = np.sqrt(max(far_m**2 - float(patch.drop_m.mean()) ** 2, 1e-2))
    return float(patch.step_m * far_m / ground_m / _FACETS_PER_BIN)


def _fixed(
    patch: Patch,
) -> tuple[FloatArray, FloatArray, FloatArray, float, float, float, float, float, float]:
    return (patch.ratio, patch.drop_m, patch.along_m, patch.start_m, patch.step_m, patch.leak,
            _facet_m(patch), HIGHLIGHT_CAP, patch.weight)  # fmt: skip


def _flat_likelihood(patch: Patch) -> float:
    e = patch.ratio[np.isfinite(patch.ratio)]
    mean = 1.0 + patch.leak
    each = np.where(e < HIGHLIGHT_CAP, e / mean + np.log(mean), HIGHLIGHT_CAP / mean)
    return float(-patch.weight * each.sum())


@njit(cache=True, nogil=True, error_model="numpy")
def _prior(parameters):  # type: ignore[no-untyped-def]
    """Return log prior, its gradient (10,) and its information (10, 10)."""
    gradient = np.zeros(N_PARAMETERS)
    information = np.zeros((N_PARAMETERS, N_PARAMETERS))
    aspect = (parameters[3] - parameters[4]) / _ASPECT_SIGMA**2
    shape = (parameters[5] - _SHAPE_MEAN) / _SHAPE_SIGMA**2
    law = (parameters[6] - _LAW_MEAN) / _LAW_SIGMA**2
    gradient[3], gradient[4], gradient[5], gradient[6] = -aspect, aspect, -shape, -law
    information[3, 3] = information[4, 4] = 1 / _ASPECT_SIGMA**2
    information[3, 4] = information[4, 3] = -1 / _ASPECT_SIGMA**2
    information[5, 5] = 1 / _SHAPE_SIGMA**2
    information[6, 6] = 1 / _LAW_SIGMA**2
    level = 0.0
    for p in range(N_SHAPE, N_PARAMETERS):
        gradient[p] = -parameters[p] / _LEVEL_SIGMA**2
        information[p, p] = 1 / _LEVEL_SIGMA**2
        level += parameters[p] ** 2 / _LEVEL_SIGMA**2
    value = -0.5 * (
        level
        + aspect * (parameters[3] - parameters[4])
        + shape * (parameters[5] - _SHAPE_MEAN)
        + law * (parameters[6] - _LAW_MEAN)
    )
    return value, gradient, information


@njit(cache=True, nogil=True, error_model="numpy")
def _score(  # type: ignore[no-untyped-def]
    sign, corner, parameters, ratio, drop_m, along_m, start_m, step_m, leak, facet_m, cap, weight
):
    """Return the log posterior (s,) of every start."""
    value = np.empty(len(sign))
    for s in range(len(sign)):
        value[s] = log_likelihood(
            parameters[s], sign[s], corner[s], ratio, drop_m, along_m, start_m, step_m, leak,
            facet_m, cap, weight,
        ) + _prior(parameters[s])[0]  # fmt: skip
    return value


@njit(cache=True, nogil=True, error_model="numpy")
def climb(  # type: ignore[no-untyped-def]
    start, sign, corner, ratio, drop_m, along_m, start_m, step_m, leak, facet_m, cap, weight, rounds
):
    """Climb the posterior from `start` by damped Fisher scoring, at most `rounds` steps.

    Returns the parameters (10,), log posterior and its information (10, 10).
    """
    at, damping = start.copy(), 1e-2
    value, gradient, information = fisher_step(
        at, sign, corner, ratio, drop_m, along_m, start_m, step_m, leak, facet_m, cap, weight
    )
    prior = _prior(at)
    value += prior[0]
    limit = np.array([0.0, 0.0, 0.5, 0.5, 0.5, 0.7, 0.3, 0.3, 0.3, 0.3])
    for _ in range(rounds):
        whole = information + prior[2]
        for p in range(N_PARAMETERS):
            whole[p, p] += damping * whole[p, p] + 1e-6
        step = np.linalg.solve(whole, gradient + prior[1])
        # A logarithm moves by half at most, a place by the object's own width: the model is not linear.
        limit[0], limit[1] = np.exp(at[3]), np.exp(at[4])
        trial = at + np.minimum(np.maximum(step, -limit), limit)
        trial[5] = min(max(trial[5], _SHAPE_LOW), _SHAPE_HIGH)
        trial_prior = _prior(trial)
        trial_value = trial_prior[0] + log_likelihood(
            trial, sign, corner, ratio, drop_m, along_m, start_m, step_m, leak, facet_m, cap, weight
        )
        rise = trial_value - value
        if rise > 0:
            at, prior, damping = trial, trial_prior, max(damping * 0.3, 1e-4)
            value, gradient, information = fisher_step(
                at,
                sign,
                corner,
                ratio,
                drop_m,
                along_m,
                start_m,
                step_m,
                leak,
                facet_m,
                cap,
                weight,
            )
            value += prior[0]
            if rise < 0.05:
                break
        else:
            damping *= 6
            if damping > 1e4:
                break
    return at, value, information + prior[2]
