"""Sigma of the joint surface: the spread of perturbed solutions, and how far the surface may be believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from perception.bands import in_threads
from perception.inverse_state import Solved, State, linear_problem, present_soundings
from perception.posterior import Fields, Problem
from perception.profiles import uncrossed
from perception.records import FloatArray

# Ground that no two sides see, or that none sees, is known no better than this part of the soundings' sigma: the
# rms error of one pass was 0.7 to 0.9 of theirs on four floors.
_ONE_SIDED_PART = 0.8
# A bottom track is early or late by centimetres throughout, whatever the number of its soundings.
_LATE_M = 0.02
# A gain that ripples by 0.07 dB and a dome of this part of the altitude between parallel lines explain the same mean echoes
# (0.4 dB and 0.3 m at 15 m altitude); only looks across tell them apart. No curve on knots is known better.
_RIPPLE = 0.0035
# Long waves are few among the unknowns and hold nearly all of the spread: they are solved to a sigma in all, not
# to a part of the whole.
_TOLERANCE = 1.0
# Samples in hand together: threads share them, and memory holds no more.
_AT_ONCE = 4


def spread(
    state: State, solved: Solved, rng: np.random.Generator, part: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """Return the 1-sigma of the heights, jointly and from the soundings alone, by perturbation.

    `part` : of the data that else would count as independent, where cells are narrower than was asked for.
    """
    weight = solved.data.weight * state.config.independent * part
    joint = linear_problem(state, replace(solved.data, weight=weight), solved.equations)
    alone = linear_problem(state, None, present_soundings(state))
    return _sample_sigma(joint, state, rng), _sample_sigma(alone, state, rng)


def _sample_sigma(problem: Problem, state: State, rng: np.random.Generator) -> FloatArray:
    zero = (np.zeros(state.shape), np.zeros(state.shape), np.zeros(state.basis.size))

    def height(right: Fields) -> FloatArray:
        return problem.solve(zero, right, _TOLERANCE)[0][0]

    total = np.zeros(state.shape)
    for drawn in range(0, state.config.samples, _AT_ONCE):
        count = min(_AT_ONCE, state.config.samples - drawn)
        for solution in in_threads(height, [problem.perturbation(rng) for _ in range(count)]):
            total += solution**2
    # Few samples: neighbours lend theirs, the spread varies slowly.
    return np.sqrt(ndimage.uniform_filter(total / state.config.samples, 7, mode="nearest"))


def honest_sigma(
    state: State, solved: Solved, joint: FloatArray, alone: FloatArray, lead_part: float = 0.5
) -> FloatArray:
    """Return the sigma of the map, and hold the map to what the soundings allow.

    `lead_part` : how much of the first returns' lead is not known, as a part of it.

    A height further from the soundings' surface than four of its sigmas and half the relief is no finding but a failure
    of the model: it is drawn back, and its sigma is that of the soundings.
    """
    base = state.surface if state.base is None else state.base
    relief = float(np.std(state.soundings.up_m - state.soundings.range_m))
    # The soundings' own sigma is small beside a track, where the surface of the first returns is at its worst.
    limit = 4 * np.hypot(alone, 0.5 * relief)
    beyond = np.abs(state.surface - base) > limit
    state.surface = np.clip(state.surface, base - limit, base + limit)
    # The lead of the first returns shifts the whole map, and so does a track that is late throughout.
    level = np.hypot(lead_part * float(np.mean(state.lead_m)), _LATE_M)
    sigma = np.hypot(joint, level)
    part = ndimage.uniform_filter(
        uncrossed(solved.data.rows, state.shape).astype(float), max(3, round(10 / state.cell_m))
    )
    ripple = np.zeros(state.shape)
    ripple[:-1, :-1] = _RIPPLE * float(np.median(state.soundings.range_m)) * part
    sigma = np.hypot(sigma, ripple)
    both_sides = np.zeros(state.shape, bool)
    lit = np.bincount(solved.data.rows.cell, minlength=solved.single.size).reshape(
        solved.single.shape
    )
    both_sides[:-1, :-1] = (lit > 0) & ~solved.single
    both_sides = ndimage.binary_dilation(both_sides, np.ones((3, 3), bool), iterations=2)
    sigma = np.where(both_sides, sigma, np.maximum(sigma, _ONE_SIDED_PART * alone))
    return np.where(beyond, np.maximum(sigma, alone), sigma)
