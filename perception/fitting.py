"""Fit one shadow's surroundings with the bump-or-pit model: height, shape, place, and their covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.records import FloatArray
from perception.silhouettes import N_PARAMETERS, fisher_step, log_likelihood


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


@dataclass(frozen=True, slots=True)
class BumpFit:
    """The best bump (`sign` 1) or pit (-1): parameters x0, y0, log|A|, log sx, log sy, log beta,
    log kappa.

    `corner` is 2 for an elliptic footprint, 6 for a rectangular one; `gain` is the log likelihood over that of a flat floor, priors included.
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
_SHAPE_BOUNDS = (float(np.log(0.8)), float(np.log(8.0)))
# The floor's angular law is near Lambert's square, but recorders and sediments differ.
_LAW_MEAN, _LAW_SIGMA = float(np.log(1.9)), 0.18
_FACETS_PER_BIN = 1.5
# Rounds of climbing from every start, and from the best of each kind afterwards.
_FIRST_ROUNDS, _LAST_ROUNDS = 5, 14


def fit_patch(
    patch: Patch, starts: list[tuple[float, float, FloatArray]], favour: float = 0.0
) -> BumpFit | None:
    """Return the most likely fit over all starts (sign, corner, parameters), or None where none converges.

    `favour` is what other evidence adds to the log likelihood of a hill over a crater.
    """
    flat_value = _flat_likelihood(patch)
    scored = [
        (_likelihood(patch, sign, corner, at) + _prior(at)[0], sign, corner, at)
        for sign, corner, at in starts
    ]
    first = []
    for sign in (1.0, -1.0):
        # One start of each length across the track: the best of all alone would often be the longest ones,
        # which fit loosely at once and cannot be mended by climbing.
        best_of: dict[float, tuple[float, float, float, FloatArray]] = {}
        for start in scored:
            length = float(start[3][3])
            if start[1] == sign and (length not in best_of or start[0] > best_of[length][0]):
                best_of[length] = start
        first += [
            _climb(patch, *start[1:], flat_value, _FIRST_ROUNDS) for start in best_of.values()
        ]
    last = []
    best = max((f.gain for f in first if f is not None), default=0.0)
    for sign in (1.0, -1.0):
        mine = sorted((f for f in first if f is not None and f.sign == sign), key=lambda f: -f.gain)
        # A kind that is far behind after the first rounds will not catch up.
        for fit in mine[:1]:
            if fit.gain > 0.6 * best:
                last.append(
                    _climb(patch, sign, fit.corner, fit.parameters, flat_value, _LAST_ROUNDS)
                )
    found = [fit for fit in last if fit is not None]
    return max(found, key=lambda fit: fit.gain + 0.5 * fit.sign * favour) if found else None


def _facet_m(patch: Patch) -> float:
    """Return the facets' ground length: a part of a bin at the patch's far edge."""
    far_m = patch.start_m + patch.ratio.shape[1] * patch.step_m
    ground_m = np.sqrt(max(far_m**2 - float(patch.drop_m.mean()) ** 2, 1e-2))
    return float(patch.step_m * far_m / ground_m / _FACETS_PER_BIN)


def _fixed(patch: Patch) -> tuple[FloatArray, FloatArray, float, float, float, float, float, float]:
    return (patch.drop_m, patch.along_m, patch.start_m, patch.step_m, patch.leak, _facet_m(patch),
            HIGHLIGHT_CAP, patch.weight)  # fmt: skip


def _likelihood(patch: Patch, sign: float, corner: float, at: FloatArray) -> float:
    return float(log_likelihood(at, sign, corner, patch.ratio, *_fixed(patch)))


def _flat_likelihood(patch: Patch) -> float:
    e = patch.ratio[np.isfinite(patch.ratio)]
    mean = 1.0 + patch.leak
    each = np.where(e < HIGHLIGHT_CAP, e / mean + np.log(mean), HIGHLIGHT_CAP / mean)
    return float(-patch.weight * each.sum())


def _prior(parameters: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return log prior, its gradient and its information."""
    gradient = np.zeros(N_PARAMETERS)
    information = np.zeros((N_PARAMETERS, N_PARAMETERS))
    aspect = (parameters[3] - parameters[4]) / _ASPECT_SIGMA**2
    shape = (parameters[5] - _SHAPE_MEAN) / _SHAPE_SIGMA**2
    gradient[3], gradient[4], gradient[5] = -aspect, aspect, -shape
    information[3:5, 3:5] = np.array([[1, -1], [-1, 1]]) / _ASPECT_SIGMA**2
    information[5, 5] = 1 / _SHAPE_SIGMA**2
    law = (parameters[6] - _LAW_MEAN) / _LAW_SIGMA**2
    gradient[6], information[6, 6] = -law, 1 / _LAW_SIGMA**2
    value = -0.5 * (
        aspect * (parameters[3] - parameters[4])
        + shape * (parameters[5] - _SHAPE_MEAN)
        + law * (parameters[6] - _LAW_MEAN)
    )
    return float(value), gradient, information


def _climb(
    patch: Patch, sign: float, corner: float, start: FloatArray, flat_value: float, rounds: int
) -> BumpFit | None:
    """Climb the posterior from `start` by damped Fisher scoring."""
    fixed = _fixed(patch)
    at = start.copy()
    damping = 1e-2
    value, gradient, information = fisher_step(at, sign, corner, patch.ratio, *fixed)
    prior_value, prior_gradient, prior_information = _prior(at)
    for _ in range(rounds):
        whole = information + prior_information
        scale = np.diag(np.diag(whole) * damping + 1e-6)
        step = np.linalg.solve(whole + scale, gradient + prior_gradient)
        # A logarithm moves by half at most, a place by the object's own width: the model is not linear.
        width = np.exp(at[3:5])
        step = np.clip(
            step,
            -np.array([*width, 0.5, 0.5, 0.5, 0.7, 0.3]),
            np.array([*width, 0.5, 0.5, 0.5, 0.7, 0.3]),
        )
        trial = at + step
        trial[5] = np.clip(trial[5], *_SHAPE_BOUNDS)
        trial_value = log_likelihood(trial, sign, corner, patch.ratio, *fixed)
        trial_prior = _prior(trial)
        rise = trial_value + trial_prior[0] - value - prior_value
        if rise > 0:
            at, damping = trial, max(damping * 0.3, 1e-4)
            value, gradient, information = fisher_step(at, sign, corner, patch.ratio, *fixed)
            prior_value, prior_gradient, prior_information = trial_prior
            if rise < 0.05:
                break
        else:
            damping *= 6
            if damping > 1e4:
                break
    covariance = _inverse(information + prior_information)
    if not np.all(np.isfinite(covariance)) or not np.all(np.isfinite(at)):
        return None
    return BumpFit(at, covariance, sign, corner, float(value + prior_value - flat_value))


def _inverse(information: FloatArray) -> FloatArray:
    """Return the inverse of an information matrix; unseen directions come out very wide."""
    inverse: FloatArray = np.linalg.inv(information + 1e-6 * np.eye(len(information)))
    return inverse
