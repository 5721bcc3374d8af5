"""Sigma of the joint surface: the spread of perturbed solutions, and how far the surface may be believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from perception.bands import in_threads
from perception.inverse_state import Solved, State, linear_problem, present_soundings
from perception.multigrid import Fields
from perception.posterior import Problem
from perception.profiles import uncrossed
from perception.rays import Soundings
from perception.records import FloatArray

# Ground that no two sides see, or that none sees, is known no better than this part of the soundings' sigma.
_ONE_SIDED_PART = 0.9
# So few stretches of track leave a prior's variance open; Student's t has none with two.
_LEAST_STRETCHES = 3.0
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


def prior_doubt(
    bottom: Soundings, west_m: float, south_m: float, cell_m: float, shape: tuple[int, int]
) -> FloatArray:
    """Return (rows, cols) the factor on a sigma that rests on a prior learned from the track itself.

    What heights differ by over a distance `d` is learned from about ``n = length / d`` separate stretches of track. A
    normal error whose variance is estimated from `n` values follows Student's t, of variance ``n / (n - 2)``
    times that (Student, Biometrika 6, 1908). `d` is the distance to the nearest sounding; track over cells that were
    sounded before does not count again.
    """
    sounded = np.zeros(shape, bool)
    row = np.rint((bottom.northing_m - south_m) / cell_m).astype(np.int64)
    col = np.rint((bottom.easting_m - west_m) / cell_m).astype(np.int64)
    sounded[np.clip(row, 0, shape[0] - 1), np.clip(col, 0, shape[1] - 1)] = True
    step = np.hypot(np.diff(bottom.easting_m), np.diff(bottom.northing_m))
    usual = float(np.median(step)) if len(step) else cell_m
    length = float(np.sum(step[step <= 10 * usual])) * np.count_nonzero(sounded) / len(row)
    distance = np.maximum(ndimage.distance_transform_edt(~sounded), 1.0) * cell_m
    stretches = np.maximum(length / distance, _LEAST_STRETCHES)
    return np.sqrt(stretches / (stretches - 2))


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
    doubt = prior_doubt(state.soundings, state.west_m, state.south_m, state.cell_m, state.shape)
    sigma = np.where(both_sides, sigma, doubt * np.maximum(sigma, _ONE_SIDED_PART * alone))
    return np.where(beyond, np.maximum(sigma, alone), sigma)
