"""The steps of the joint inversion: trace the present surface, compare, solve, trace again."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from scipy import ndimage

from perception.first_return import first_return_lead
from perception.inverse_state import (
    Data,
    Solved,
    State,
    linear_problem,
    present_soundings,
    sounding_surface,
)
from perception.occlusion import dark_samples, shadow_equations
from perception.profiles import mean_profiles, one_sided
from perception.records import BoolArray, FloatArray, Progress
from perception.shading import Rows, trace
from perception.soundings import Equations, both, mean_soundings
from perception.stencils import dual_features

logger = logging.getLogger(__name__)

# Where looks from both sides cover some of the ground they settle the gain, and holding the rest to
# profiles that soundings only extrapolate would spoil it.
_MOSTLY_ONE_SIDED = 0.85


# Looks from one side rest on a gain that their own ground cannot correct; so much they count.
_ONE_SIDED_PART = 0.1


# Steps about a surface without detail, that settle the mean profiles; least 1-sigma of those afterwards.
_SMOOTH_STEPS = 4
_PROFILE_M = 0.02


def iterate(state: State, steps: int, progress: Progress, rng: np.random.Generator) -> Solved:
    """Relinearise and solve until the surface stands still."""
    # Two steps at least see the detail.
    smooth_steps = max(min(_SMOOTH_STEPS, state.config.iterations - 2), 1)
    for k in range(len(state.step_m), len(state.step_m) + steps):
        dark = _dark(state, first=k == 0)
        rows, passed = trace(
            state.surface, state.west_m, state.south_m, state.cell_m, state.rays,
            state.config.exponent, dark,
        )  # fmt: skip
        if state.lead_sigma_m == 0.0:
            _learn_lead(state, rows, rng)
        smooth = k < smooth_steps
        data = _linearise(state, rows, first=k == 0, smooth=smooth)
        equations = present_soundings(state)
        single = one_sided(rows, state.shape)
        alone = mostly_one_sided(single, passed)
        if state.base is None:
            # Once the first returns' lead is known: the surface of the soundings alone.
            state.base = sounding_surface(state)
        held = mean_soundings(equations, state.soundings, float(np.mean(state.lead_m)))
        if alone:
            held = both(_sounding_profiles(state, state.base, single), held)
        elif state.first is not None:
            held = both(held, _first_profiles(state, state.first, passed))
        if k > 0 and state.config.shadows:
            equations = both(
                equations,
                shadow_equations(
                    state.surface, state.west_m, state.south_m, state.cell_m, state.rays, dark
                ),
            )
        solved = Solved(_less_of_one_sided(data, single), equations, single, passed)
        if k > 0 and not alone:
            data = solved.data
        caution = state.config.caution if k > 0 and alone else 0.0
        problem = linear_problem(state, data, both(equations, held), caution)
        fields = (state.surface, state.albedo, state.gain)
        solution, used = problem.solve(fields, problem.right_side())
        # The grids of a large map take hundreds of megabytes: the next step's come in their place.
        del problem
        seen = np.zeros(state.shape, bool)
        seen[:-1, :-1] = passed & ~single if np.any(passed & ~single) else passed
        step = float(np.sqrt(np.mean((solution[0] - state.surface)[seen] ** 2)))
        state.surface, state.albedo, state.gain = solution
        if k + 1 == smooth_steps:
            state.first = state.surface
        elif smooth and not alone:
            state.surface = _without_detail(state)
        state.step_m.append(step)
        logger.info(
            "joint inversion: iteration %d, %d data, residual %.3f, step %.3f m, %d solver steps",
            k + 1, len(rows.cell), state.residual[-1], step, used,
        )  # fmt: skip
        # Steps on narrower cells come on top of those foreseen.
        progress(
            "joint inversion", min(k, state.config.iterations) + 2, state.config.iterations + 3
        )
        if step < 0.02 and not smooth:
            break
    return solved


def mostly_one_sided(single: BoolArray, passed: BoolArray) -> bool:
    """Return whether nearly all the ground that rays passed was seen from one side only."""
    return float(np.sum(single)) >= _MOSTLY_ONE_SIDED * float(np.sum(passed))


def _dark(state: State, first: bool) -> list[BoolArray]:
    """Return the samples of all rays that lie in shadow; none before the gain is known."""
    if first or not state.config.shadows:
        return [np.zeros(ray.power.shape, np.bool_) for ray in state.rays]
    level = float(np.median(state.soundings.up_m - state.soundings.range_m))
    return [
        dark_samples(ray, np.full(len(ray.up_m), level), state.basis, state.gain, state.cell_m)
        for ray in state.rays
    ]


def _less_of_one_sided(data: Data, single: BoolArray) -> Data:
    """Return the data with those of one-sided ground weighing less.

    A slope and a gain explain one look alike. Where looks from both sides settle the gain, what is left of its
    error tilts the ground outside them, by metres at the rim; the pull of that ground then spoils the gain.
    """
    part = np.where(single.ravel()[data.rows.cell], _ONE_SIDED_PART, 1.0)
    return replace(data, weight=data.weight * part)


def _sounding_profiles(state: State, base: FloatArray, single: BoolArray) -> Equations:
    """Return the mean profiles of a survey seen from one side: there echoes must not change them."""
    bottom = state.soundings
    spread = float(np.std(bottom.up_m - bottom.range_m))
    frame = (base, state.west_m, state.south_m, state.cell_m, state.rays)
    return mean_profiles(*frame, single, max(0.1 * spread, 0.02))


def _first_profiles(state: State, first: FloatArray, lit: BoolArray) -> Equations:
    """Return the mean profiles across the tracks as the steps about a smooth floor found them.

    About a smooth floor mean slope and mean log power are in proportion. What that misses grows with the
    roughness, and so does what detail seen from two sides tells of the profile: the hold's 1-sigma is the
    lead of the first returns, which is roughness in metres. On a smooth floor the steps that follow would raise
    domes of a decimetre that only the gain contradicts.
    """
    frame = (first, state.west_m, state.south_m, state.cell_m, state.rays)
    sigma = max(float(np.mean(state.lead_m)), _PROFILE_M)
    return mean_profiles(*frame, lit, sigma, relative=True)


def _without_detail(state: State) -> FloatArray:
    """Return the surface without what is narrower than a third of the altitude."""
    width_m = float(np.median(state.soundings.range_m)) / 3
    return np.asarray(
        ndimage.gaussian_filter(state.surface, width_m / state.cell_m, mode="nearest")
    )


def _learn_lead(state: State, rows: Rows, rng: np.random.Generator) -> None:
    """Find by how much first returns lead; less where other passes resolve the floor below a track."""
    bottom, config = state.soundings, state.config
    col = np.clip((bottom.easting_m - state.west_m) / state.cell_m, 0, state.shape[1] - 2)
    row = np.clip((bottom.northing_m - state.south_m) / state.cell_m, 0, state.shape[0] - 2)
    below = np.unique(row.astype(np.int64) * (state.shape[1] - 1) + col.astype(np.int64))
    duals = (state.shape[0] - 1) * (state.shape[1] - 1)
    far = np.bincount(rows.cell[rows.ground_m > rows.drop_m], minlength=duals)
    # Two looks tell slope from albedo.
    seen = float(np.mean(np.minimum(far[below], 2))) / 2
    altitude = float(np.median(bottom.range_m))
    lead = spread = 0.0
    for part, resolved in ((seen, True), (1 - seen, False)):
        if part > 0.02:
            mean, sigma = first_return_lead(
                state.roughness, altitude, config.nadir * altitude,
                float(np.median(bottom.sigma_m)), state.cell_m, resolved, rng,
            )  # fmt: skip
            lead, spread = lead + part * mean, sigma
    state.lead_m, state.lead_sigma_m = lead, spread
    logger.info(
        "first returns lead by %.3f +- %.3f m, %.0f %% seen by other passes",
        lead,
        spread,
        100 * seen,
    )


def _linearise(state: State, rows: Rows, first: bool, smooth: bool) -> Data:
    """Return the data rows about the present surface, robustly weighted."""
    config = state.config
    knot, share = state.basis.place(rows.angle_rad, rows.slant_m, rows.side.astype(np.int64))
    # Two million data take their room: a knot's number is small, and so is what a share is good for.
    knot, share = knot.astype(np.int16), share.astype(np.float32)
    if first:
        state.gain = state.basis.start(rows.ratio, knot)
    present = np.empty((4, state.shape[0] - 1, state.shape[1] - 1))
    dual_features(state.surface, state.albedo, state.cell_m, present)
    at = present.reshape(4, -1)[:, rows.cell]
    gain = np.einsum("ij,ij->i", share, state.gain[knot])
    residual = rows.ratio - gain - at[3]
    scale = _scale_by_angle(residual, rows.angle_rad)
    # Residuals of the first pass are the relief itself: there the width is given, not measured.
    sigma = np.full(len(residual), 0.35) if smooth else np.maximum(scale, config.least_sigma)
    unit = residual if smooth else residual / (2.5 * np.maximum(scale, 0.1))
    weight = rows.share**2 / (1 + unit**2) / sigma**2
    weight[rows.ground_m < config.nadir * rows.drop_m] = 0.0
    lever = np.maximum(rows.ground_m - rows.drop_m * rows.slope, 0.3 * rows.ground_m)
    slope = 0.0 if first else state.basis.angle_slope(state.gain, knot)
    c_level = rows.c_level + slope * rows.share / lever
    value = (
        _linear_residual(rows, residual, config.exponent) + gain + at[3]
        + rows.c_east * at[0] + rows.c_north * at[1] + c_level * at[2]
    )  # fmt: skip
    state.residual.append(float(np.sqrt(np.average(residual**2, weights=weight))))
    return Data(rows, weight, c_level, value, knot, share)


def _linear_residual(rows: Rows, residual: FloatArray, exponent: float) -> FloatArray:
    """Return the residual that a linear step needs to land on the slope that explains it.

    The log power bends strongly with slope where grazing; the law is inverted for the slope, and the
    change of slope is multiplied by the derivative: a Newton step that does not overshoot.
    """
    tangent = (rows.drop_m + rows.ground_m * rows.slope) / (
        rows.ground_m - rows.drop_m * rows.slope
    )
    tangent = np.maximum(tangent, 0.02)
    power = tangent**2 / np.sqrt(1 + tangent**2) * np.exp(np.clip(residual, -6, 3))
    wanted = np.sqrt((power**2 + np.sqrt(power**4 + 4 * power**2)) / 2)
    slope = (wanted * rows.ground_m - rows.drop_m) / (rows.ground_m + wanted * rows.drop_m)
    change = np.clip(slope - rows.slope, -0.6, 0.6)
    return np.hypot(rows.c_east, rows.c_north) * change


def _scale_by_angle(residual: FloatArray, angle_rad: FloatArray) -> FloatArray:
    """Return the robust 1-sigma of the residuals in bins of 5 degrees of angle."""
    bins = np.clip((np.degrees(angle_rad) / 5).astype(np.int64), 0, 20)
    scale = np.ones(len(residual))
    for b in np.unique(bins):
        chosen = bins == b
        if chosen.sum() > 20:
            spread = residual[chosen]
            scale[chosen] = 1.4826 * np.median(np.abs(spread - np.median(spread)))
    return np.maximum(scale, 1e-3)
