"""How likely the echo around a shadow is under the bump-or-pit model, and the climb to the likeliest."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from perception.records import FloatArray
from perception.silhouettes import N_PARAMETERS, N_SHAPE, Form, predict

# The likelihood takes no mean for darker than this. At a shadow's true level one lit sample where the family
# of shapes has none would outweigh fifty that agree; dark enough is dark.
LEAST_MEAN = 0.1
# A highlight above this many times nominal is "bright" and no more.
HIGHLIGHT_CAP = 5.0
# Priors in logarithms: objects are about as long as wide; shapes lie between a Gaussian and a flat top.
_ASPECT_SIGMA = 0.5
_SHAPE_MEAN, _SHAPE_SIGMA = float(np.log(1.7)), 0.6
_SHAPE_LOW, _SHAPE_HIGH = float(np.log(0.8)), float(np.log(8.0))
# Profiles that end: from a half sphere's to a bell's about a paraboloid's or a cone's.
_ENDED_SIGMA, _ENDED_LOW = 0.5, float(np.log(0.25))
# The floor's angular law is near Lambert's square, but recorders and sediments differ.
_LAW_MEAN, _LAW_SIGMA = float(np.log(1.95)), 0.13
# The gain follows albedo over blocks larger than objects; patches of sediment are smaller.
_LEVEL_SIGMA = 0.3


class Heard(NamedTuple):
    """The data of one patch: `ratio` (n, m) power over nominal, NaN says nothing; `weight` looks of a cell."""

    ratio: FloatArray
    weight: float


@njit(cache=True, nogil=True, error_model="numpy")
def _soft(mean):  # type: ignore[no-untyped-def]
    """Compress means above 0.6 of the cap smoothly: a hard cut would leave the fit no slope to climb."""
    bend = 0.6 * HIGHLIGHT_CAP
    if mean <= bend:
        return mean
    return bend + bend * (1.0 - np.exp(-(mean - bend) / bend))


@njit(cache=True, nogil=True, error_model="numpy")
def _surroundings(parameters, n, m):  # type: ignore[no-untyped-def]
    """Return the level (n, m) of the floor around the object: albedo that the gain has not followed."""
    level = np.empty((n, m))
    for i in range(n):
        row = parameters[7] + parameters[9] * (2.0 * i / max(n - 1, 1) - 1.0)
        for k in range(m):
            level[i, k] = np.exp(row + parameters[8] * (2.0 * k / max(m - 1, 1) - 1.0))
    return level


@njit(cache=True, nogil=True, error_model="numpy")
def _mean(parameters, form, scene, n, m):  # type: ignore[no-untyped-def]
    """Return the model's echo before its surroundings' level, that level, and the mean of the data, (n, m) each."""
    base = predict(parameters, form, scene, np.empty((n, m)))
    around = _surroundings(parameters, n, m)
    mean = np.empty((n, m))
    for i in range(n):
        for k in range(m):
            mean[i, k] = max(_soft(base[i, k] * around[i, k]), LEAST_MEAN)
    return base, around, mean


@njit(cache=True, nogil=True, error_model="numpy")
def _slopes(parameters, form, scene, base, around, mean):  # type: ignore[no-untyped-def]
    """Return the derivatives (10, n, m) of the mean by every parameter."""
    n, m = base.shape
    slopes = np.empty((N_PARAMETERS, n, m))
    moved = parameters.copy()
    for p in range(N_SHAPE):
        # Half a facet of position, or 2 % of a logarithm: smooth over the facets' own steps.
        h = 0.5 * scene.facet_m if p < 2 else 0.02
        moved[p] = parameters[p] + h
        predict(moved, form, scene, slopes[p])
        moved[p] = parameters[p]
        for i in range(n):
            for k in range(m):
                if slopes[p, i, k] == base[i, k]:
                    slopes[p, i, k] = 0.0
                else:
                    after = max(_soft(slopes[p, i, k] * around[i, k]), LEAST_MEAN)
                    slopes[p, i, k] = (after - mean[i, k]) / h
    for i in range(n):
        for k in range(m):
            by_level = 0.0
            if mean[i, k] > LEAST_MEAN:
                by_level = (_soft(base[i, k] * around[i, k] * 1.02) - mean[i, k]) / 0.02
            slopes[7, i, k] = by_level
            slopes[8, i, k] = by_level * (2.0 * k / max(m - 1, 1) - 1.0)
            slopes[9, i, k] = by_level * (2.0 * i / max(n - 1, 1) - 1.0)
    return slopes


@njit(cache=True, nogil=True, error_model="numpy")
def fisher_step(parameters, form, scene, heard):  # type: ignore[no-untyped-def]
    """Return the log likelihood, its gradient (10,) and Fisher information (10, 10) of one patch.

    Samples are Gamma with the model's mean; data above the cap are censored and the mean is compressed
    there, so the strength of a highlight (the object's own reflectivity) says little beyond "bright".
    """
    ratio, weight = heard
    n, m = ratio.shape
    base, around, mean = _mean(parameters, form, scene, n, m)
    slopes = _slopes(parameters, form, scene, base, around, mean)
    value = 0.0
    gradient = np.zeros(N_PARAMETERS)
    information = np.zeros((N_PARAMETERS, N_PARAMETERS))
    for i in range(n):
        for k in range(m):
            e = ratio[i, k]
            if np.isnan(e):
                continue
            mu = mean[i, k]
            # A datum above the cap is censored: it says "more than the cap" and no more.
            if e < HIGHLIGHT_CAP:
                value -= weight * (e / mu + np.log(mu))
                pull = weight * (e - mu) / (mu * mu)
            else:
                value -= weight * HIGHLIGHT_CAP / mu
                pull = weight * HIGHLIGHT_CAP / (mu * mu)
            for p in range(N_PARAMETERS):
                s = slopes[p, i, k]
                if s == 0.0:
                    continue
                gradient[p] += pull * s
                for o in range(p + 1):
                    information[p, o] += weight * s * slopes[o, i, k] / (mu * mu)
    for p in range(N_PARAMETERS):
        for o in range(p):
            information[o, p] = information[p, o]
    return value, gradient, information


@njit(cache=True, nogil=True, error_model="numpy")
def log_likelihood(parameters, form, scene, heard):  # type: ignore[no-untyped-def]
    """Return the log likelihood of one patch, as `fisher_step` has it."""
    ratio, weight = heard
    n, m = ratio.shape
    _, _, mean = _mean(parameters, form, scene, n, m)
    value = 0.0
    for i in range(n):
        for k in range(m):
            e, mu = ratio[i, k], mean[i, k]
            if not np.isnan(e):
                value -= weight * (e / mu + np.log(mu) if e < HIGHLIGHT_CAP else HIGHLIGHT_CAP / mu)
    return value


@njit(cache=True, nogil=True, error_model="numpy")
def _prior(parameters, power):  # type: ignore[no-untyped-def]
    """Return log prior, its gradient (10,) and its information (10, 10)."""
    gradient = np.zeros(N_PARAMETERS)
    information = np.zeros((N_PARAMETERS, N_PARAMETERS))
    shape_mean, shape_sigma = _SHAPE_MEAN, _SHAPE_SIGMA
    if power > 0.0:
        shape_mean, shape_sigma = 0.0, _ENDED_SIGMA
    aspect = (parameters[3] - parameters[4]) / _ASPECT_SIGMA**2
    shape = (parameters[5] - shape_mean) / shape_sigma**2
    law = (parameters[6] - _LAW_MEAN) / _LAW_SIGMA**2
    gradient[3], gradient[4], gradient[5], gradient[6] = -aspect, aspect, -shape, -law
    information[3, 3] = information[4, 4] = 1 / _ASPECT_SIGMA**2
    information[3, 4] = information[4, 3] = -1 / _ASPECT_SIGMA**2
    information[5, 5] = 1 / shape_sigma**2
    information[6, 6] = 1 / _LAW_SIGMA**2
    level = 0.0
    for p in range(N_SHAPE, N_PARAMETERS):
        gradient[p] = -parameters[p] / _LEVEL_SIGMA**2
        information[p, p] = 1 / _LEVEL_SIGMA**2
        level += parameters[p] ** 2 / _LEVEL_SIGMA**2
    value = -0.5 * (
        level
        + aspect * (parameters[3] - parameters[4])
        + shape * (parameters[5] - shape_mean)
        + law * (parameters[6] - _LAW_MEAN)
    )
    return value, gradient, information


@njit(cache=True, nogil=True, error_model="numpy")
def score(sign, corner, parameters, scene, heard):  # type: ignore[no-untyped-def]
    """Return the log posterior (s,) of generalised Gaussians, one per row of `sign`, `corner`, `parameters`."""
    value = np.empty(len(sign))
    for s in range(len(sign)):
        form = Form(sign[s], corner[s], 0.0)
        value[s] = log_likelihood(parameters[s], form, scene, heard) + _prior(parameters[s], 0.0)[0]
    return value


@njit(cache=True, nogil=True, error_model="numpy")
def climb(start, form, scene, heard, rounds):  # type: ignore[no-untyped-def]
    """Climb the posterior from `start` by damped Fisher scoring, at most `rounds` steps.

    Returns the parameters (10,), log posterior and its information (10, 10).
    """
    at, damping = start.copy(), 1e-2
    value, gradient, information = fisher_step(at, form, scene, heard)
    prior = _prior(at, form.power)
    value += prior[0]
    shape_low = _SHAPE_LOW if form.power == 0.0 else _ENDED_LOW
    limit = np.array([0.0, 0.0, 0.5, 0.5, 0.5, 0.7, 0.3, 0.3, 0.3, 0.3])
    for _ in range(rounds):
        whole = information + prior[2]
        for p in range(N_PARAMETERS):
            whole[p, p] += damping * whole[p, p] + 1e-6
        step = np.linalg.solve(whole, gradient + prior[1])
        # A logarithm moves by half at most, a place by the object's own width: the model is not linear.
        limit[0], limit[1] = np.exp(at[3]), np.exp(at[4])
        trial = at + np.minimum(np.maximum(step, -limit), limit)
        trial[5] = min(max(trial[5], shape_low), _SHAPE_HIGH)
        trial_prior = _prior(trial, form.power)
        rise = trial_prior[0] + log_likelihood(trial, form, scene, heard) - value
        if rise > 0:
            at, prior, damping = trial, trial_prior, max(damping * 0.3, 1e-4)
            value, gradient, information = fisher_step(at, form, scene, heard)
            value += prior[0]
            if rise < 0.05:
                break
        else:
            damping *= 6
            if damping > 1e4:
                break
    return at, value, information + prior[2]
