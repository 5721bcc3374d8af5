"""The joint inversion: one surface from the echoes and soundings of all passes.

    soundings -> a first surface and how rough the sea floor is
    repeat: trace every ray over the surface -> log (observed / predicted) power per cell and look
            solve for heights, albedo and gain together
    spread of perturbed solutions -> sigma

docs/joint-inversion.md derives the model and tells what it costs and reaches.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage

from perception.first_return import first_return_lead
from perception.gain_basis import GainBasis
from perception.occlusion import dark_samples, shadow_equations
from perception.posterior import Problem, Spectrum
from perception.profiles import crossing, mean_profiles, one_sided
from perception.rays import Look, Rays, Soundings, of_unit_level, stack_rays, stack_soundings
from perception.records import BoolArray, FloatArray, Grid, InputError, IntArray, Progress, silent
from perception.roughness import learn_roughness
from perception.shading import Rows, trace
from perception.soundings import (
    Equations,
    both,
    join,
    sounding_equations,
)
from perception.stencils import dual_features

__all__ = ["InversionConfig", "InversionResult", "Look", "invert"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class InversionConfig:
    """Settings of the joint inversion.

    Attributes
    ----------
    iterations : relinearisations at most.
    exponent : n of the sea floor's angle law ``cos(incidence)^n``; 2 is Lambert's.
    least_sigma : least 1-sigma of a datum (log power of one look on one cell). Echoes of one look
        share errors of the model that no average takes out.
    albedo_sigma, albedo_length_m : 1-sigma (log power) and correlation length of the albedo.
    sounding_sigma_m : added to the soundings' own sigma.
    nadir : part of the altitude within which echoes tell nothing of slope (specular, layover).
    samples : perturbed solutions drawn for sigma.
    independent : part of the data that counts as independent when sigma is drawn; neighbouring data
        share the model's errors (roughness below a cell, registration).
    shadows : put start and end of each shadow on one ray, and leave dark samples out of the shading.
    caution : weight, in units of the prior, that holds a step to the present surface from the second
        on. What echoes decide converges all the same; what they cannot tell from gain moves little.
    nodes_at_once : nodes beyond which the first steps are taken on wider cells.
    max_cells : nodes beyond which a cell that was not asked for is enlarged.
    """

    iterations: int = 6
    exponent: float = 2.0
    least_sigma: float = 0.2
    albedo_sigma: float = 0.35
    albedo_length_m: float = 4.0
    sounding_sigma_m: float = 0.05
    nadir: float = 0.35
    samples: int = 8
    independent: float = 0.3
    shadows: bool = False
    caution: float = 4.0
    nodes_at_once: int = 250_000
    max_cells: int = 4_000_000


@dataclass(frozen=True, slots=True)
class InversionResult:
    """The surface and how it came about.

    Attributes
    ----------
    grid : elevation, 1-sigma and number of looks per cell; NaN outside what was seen.
    albedo : (rows, cols) log of the albedo, of zero mean, on the grid's cells.
    gain : curves in dB: `angle_deg`, `port_db`, `starboard_db`, `range_m`, `range_db`.
    roughness : precision spectrum of the sea floor, learned from the soundings.
    residual : rms of the log power's residual at each iteration.
    step_m : rms change of the surface at each iteration.
    """

    grid: Grid
    albedo: FloatArray
    gain: dict[str, FloatArray]
    roughness: Spectrum
    residual: tuple[float, ...] = ()
    step_m: tuple[float, ...] = ()


@dataclass(slots=True)
class _State:
    """What the iterations carry: the frame, the data, and the fields so far."""

    west_m: float
    south_m: float
    cell_m: float
    shape: tuple[int, int]
    rays: list[Rays]
    soundings: Soundings
    roughness: Spectrum
    albedo_prior: Spectrum
    basis: GainBasis
    mean_m: float
    surface: FloatArray
    albedo: FloatArray
    gain: FloatArray
    config: InversionConfig
    lead_m: FloatArray | float = 0.0
    lead_sigma_m: float = 0.0
    base: FloatArray | None = None
    residual: list[float] = field(default_factory=list)
    step_m: list[float] = field(default_factory=list)


def invert(
    looks: Sequence[Look],
    cell_m: float | None = None,
    config: InversionConfig | None = None,
    crs: str | None = None,
    progress: Progress = silent,
    rng: np.random.Generator | None = None,
) -> InversionResult:
    """Find the surface that all passes' echoes and soundings agree on.

    Parameters
    ----------
    looks : the passes, with corrected poses in one projected frame.
    cell_m : width of a cell; None takes what the pings' spacing and range support.
    crs : projected CRS of the result; None takes the first swath's.
    rng : draws the perturbations for sigma; None uses a fixed stream, so results repeat.

    Raises
    ------
    InputError
        No look has a usable ping, or none a sounding.
    """
    config = config or InversionConfig()
    rng = rng or np.random.default_rng(0)
    if not looks:
        raise InputError("no pass to invert; give at least one")
    state = _prepare(looks, cell_m, config, rng)
    total = config.iterations + 3
    progress("joint inversion", 1, total)
    if state.surface.size > config.nodes_at_once:
        # Large maps take their first steps on cells twice as wide, at a quarter of the cost.
        coarse = _prepare(looks, 2 * state.cell_m, config, rng)
        solved = _iterate(coarse, config.iterations - 1, progress, rng)
        deviation, base_sigma = _spread(coarse, solved, rng)
        _hand_down(coarse, state)
        last = _iterate(state, 2, progress, rng)
        deviation = _resample(deviation, coarse, state)
        base_sigma = _resample(base_sigma, coarse, state)
    else:
        last = _iterate(state, config.iterations, progress, rng)
        deviation, base_sigma = _spread(state, last, rng)
    progress("joint inversion", total, total)
    sigma = _honest_sigma(state, deviation, base_sigma)
    return _result(state, sigma, last, crs or looks[0].swath.crs)


def _prepare(
    looks: Sequence[Look],
    cell_m: float | None,
    config: InversionConfig,
    rng: np.random.Generator,
) -> _State:
    cell = cell_m or _natural_cell(looks)
    rays = of_unit_level([ray for i, look in enumerate(looks) for ray in stack_rays(look, i, cell)])
    if not rays:
        raise InputError(
            f"no pass has an echo to invert ({len(looks)} given, every usable sample is missing); "
            "use --method shadow, or mend the bottom track or the quality flags"
        )
    bottoms = [
        b
        for look in looks
        if (b := stack_soundings(look, cell, config.sounding_sigma_m)) is not None
    ]
    if not bottoms:
        raise InputError(
            f"none of the {len(looks)} passes has a bottom track; without one sounding the echoes "
            "have no height to start from: give --bottom FILE"
        )
    west, south, shape = _frame(rays, bottoms, cell)
    if cell_m is None:
        while shape[0] * shape[1] > config.max_cells:
            cell *= 2
            west, south, shape = _frame(rays, bottoms, cell)
    bottom = join(bottoms)
    roughness = learn_roughness(bottoms, float(np.median(bottom.sigma_m)) / 2, cell, rng)
    reach = max((ray.reach_m for ray in rays), default=1.0)
    basis = GainBasis(reach)
    mean = float(np.mean(bottom.up_m - bottom.range_m))
    state = _State(
        west, south, cell, shape, rays, bottom, roughness, _albedo_prior(config), basis, mean,
        np.full(shape, mean), np.zeros(shape), np.zeros(basis.size), config,
    )  # fmt: skip
    state.surface = _sounding_surface(state)
    return state


def _natural_cell(looks: Sequence[Look]) -> float:
    """Return the cell that the data support, on a 1-2-5 scale.

    Two pings per cell along the track; a hundredth of the range across it, which is the footprint
    of a one degree beam at half the range.
    """
    from perception.rays import ping_spacing_m

    along = 2 * float(np.median([ping_spacing_m(look.swath) for look in looks]))
    across = 0.01 * max(
        float(np.nanmax(look.swath.sample_m)) * look.swath.n_samples for look in looks
    )
    wanted = max(along, across, 1e-3)
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(min((f * decade for f in (1, 2, 5, 10)), key=lambda c: abs(np.log(c / wanted))))


def _frame(
    rays: Sequence[Rays], bottoms: Sequence[Soundings], cell: float
) -> tuple[float, float, tuple[int, int]]:
    """Return node (0, 0) and the shape: all rays' reach, a number of cells that halves often."""
    east = np.concatenate([b.easting_m for b in bottoms])
    north = np.concatenate([b.northing_m for b in bottoms])
    ends_e, ends_n = [east], [north]
    for ray in rays:
        ends_e.append(ray.easting_m + ray.reach_m * np.sin(ray.azimuth_rad))
        ends_n.append(ray.northing_m + ray.reach_m * np.cos(ray.azimuth_rad))
    east, north = np.concatenate(ends_e), np.concatenate(ends_n)
    # Nodes are centres of cells whose edges lie at multiples of the cell.
    west = (np.floor(east.min() / cell) - 1) * cell + cell / 2
    south = (np.floor(north.min() / cell) - 1) * cell + cell / 2
    cols = int((east.max() - west) / cell) + 2
    rows = int((north.max() - south) / cell) + 2
    fold = 16 if max(rows, cols) < 400 else 32 if max(rows, cols) < 1200 else 64
    return west, south, ((rows // fold + 1) * fold + 1, (cols // fold + 1) * fold + 1)


def _albedo_prior(config: InversionConfig) -> Spectrum:
    """Return the precision of a Matérn field of smoothness 1."""
    length = config.albedo_length_m
    scale = 4 * np.pi * length**2 * config.albedo_sigma**2
    return Spectrum(1 / scale, 2 * length**2 / scale, length**4 / scale)


def _sounding_surface(state: _State) -> FloatArray:
    equations = sounding_equations(
        state.surface,
        state.west_m,
        state.south_m,
        state.cell_m,
        state.soundings,
        below=True,
        lead_m=state.lead_m,
        lead_sigma_m=state.lead_sigma_m,
    )
    problem = _problem(state, None, equations)
    fields = (state.surface, state.albedo, state.gain)
    solution, _ = problem.solve(fields, problem.right_side(), tolerance=1e-5, most=100)
    return solution[0]


@dataclass(frozen=True, slots=True)
class _Data:
    """The linearised data rows and their weights."""

    rows: Rows
    weight: FloatArray
    c_level: FloatArray
    value: FloatArray
    knot: IntArray
    share: FloatArray


# The solver stops at this part of the first residual, or after so many steps; what is left is taken
# up by the next relinearisation.
_TOLERANCE = 3e-3
# The iteration ends when the residual does not fall below this part of the one before.
_NO_BETTER = 0.97
# Where looks from both sides cover some of the ground they settle the gain, and holding the rest to
# profiles that soundings only extrapolate would spoil it.
_MOSTLY_ONE_SIDED = 0.85
_SOLVER_STEPS = 40


@dataclass(frozen=True, slots=True)
class _Solved:
    """The last linear problem: data, equations without the held profiles, one-sided cells, rays."""

    data: _Data
    equations: Equations
    single: BoolArray
    passed: BoolArray


def _problem(
    state: _State, data: _Data | None, equations: Equations, caution: float = 0.0
) -> Problem:
    """Return the linear problem; `caution` is the weight of the present surface beside the prior."""
    none = np.zeros(0)
    return Problem(
        cell_m=state.cell_m,
        shape=state.shape,
        cell=np.zeros(0, np.int64) if data is None else data.rows.cell,
        weight=none if data is None else data.weight,
        c_east=none if data is None else data.rows.c_east,
        c_north=none if data is None else data.rows.c_north,
        c_level=none if data is None else data.c_level,
        value=none if data is None else data.value,
        knot=np.zeros((0, 4), np.int64) if data is None else data.knot,
        share=np.zeros((0, 4)) if data is None else data.share,
        gain_precision=state.basis.precision(),
        rows=equations.matrix,
        row_weight=equations.weight,
        row_value=equations.value,
        height=_times(state.roughness, 1 + caution),
        albedo=state.albedo_prior,
        mean_height=(state.mean_m + caution * state.surface) / (1 + caution),
    )


def _iterate(state: _State, steps: int, progress: Progress, rng: np.random.Generator) -> _Solved:
    """Relinearise and solve until the surface stands still."""
    for k in range(len(state.step_m), len(state.step_m) + steps):
        dark = _dark(state, first=k == 0)
        rows, passed = trace(
            state.surface, state.west_m, state.south_m, state.cell_m, state.rays,
            state.config.exponent, dark,
        )  # fmt: skip
        # On the soundings' surface nothing hides; what other passes see is known after a step.
        if k in (0, 2) or state.lead_sigma_m == 0.0:
            _learn_lead(state, rows, rng)
        data = _linearise(state, rows, first=k == 0)
        equations = sounding_equations(
            state.surface,
            state.west_m,
            state.south_m,
            state.cell_m,
            state.soundings,
            lead_m=state.lead_m,
            lead_sigma_m=state.lead_sigma_m,
        )
        single = one_sided(rows, state.shape)
        held = _held_profiles(state, single, passed)
        if k > 0 and state.config.shadows:
            equations = both(
                equations,
                shadow_equations(
                    state.surface, state.west_m, state.south_m, state.cell_m, state.rays, dark
                ),
            )
        caution = 0.0 if k == 0 else _caution(state, rows)
        solved = _Solved(data, equations, single, passed)
        if len(state.residual) > 2 and state.residual[-1] > _NO_BETTER * state.residual[-2]:
            # Further steps would only follow what gain and surface can trade.
            break
        problem = _problem(state, data, both(equations, held), caution)
        fields = (state.surface, state.albedo, state.gain)
        solution, used = problem.solve(
            fields, problem.right_side(), tolerance=_TOLERANCE, most=_SOLVER_STEPS
        )
        seen = np.zeros(state.shape, bool)
        seen[:-1, :-1] = passed
        step = float(np.sqrt(np.mean((solution[0] - state.surface)[seen] ** 2)))
        state.surface, state.albedo, state.gain = solution
        state.step_m.append(step)
        logger.info(
            "joint inversion: iteration %d, %d data, residual %.3f, step %.3f m, %d solver steps",
            k + 1, len(rows.cell), state.residual[-1], step, used,
        )  # fmt: skip
        progress("joint inversion", k + 2, state.config.iterations + 3)
        if step < 0.02:
            break
    return solved


def _dark(state: _State, first: bool) -> list[BoolArray]:
    """Return the samples of all rays that lie in shadow; none before the gain is known."""
    if first or not state.config.shadows:
        return [np.zeros(ray.power.shape, np.bool_) for ray in state.rays]
    level = float(np.median(state.soundings.up_m - state.soundings.range_m))
    return [
        dark_samples(ray, np.full(len(ray.up_m), level), state.basis, state.gain, state.cell_m)
        for ray in state.rays
    ]


def _caution(state: _State, rows: Rows) -> float:
    """Return the step's caution: none where many cells are seen along crossing directions.

    There a gain cannot pass for a slope, and steps may be longer.
    """
    crossed = crossing(rows, state.shape)
    seen = np.unique(rows.cell).size
    return state.config.caution * (0.0 if float(np.sum(crossed)) > 0.1 * seen else 1.0)


def _times(spectrum: Spectrum, factor: float) -> Spectrum:
    return Spectrum(factor * spectrum.p0, factor * spectrum.p1, factor * spectrum.p2)


def _held_profiles(state: _State, single: BoolArray, lit: BoolArray) -> Equations:
    """Return the mean profiles that one-sided looks must not change."""
    if state.base is None:
        # Once the first returns' lead is known: the surface of the soundings alone.
        state.base = _sounding_surface(state)
    bottom = state.soundings
    spread = float(np.std(bottom.up_m - bottom.range_m))
    frame = (state.base, state.west_m, state.south_m, state.cell_m, state.rays)
    if float(np.sum(single)) >= _MOSTLY_ONE_SIDED * float(np.sum(lit)):
        return mean_profiles(*frame, single, max(0.1 * spread, 0.02))
    # Means over a line of independent stretches: the longer the line, the less may its profile rise.
    length = float(np.median([_length(ray) for ray in state.rays]))
    stretches = max(length / (2 * _correlation_length(state.roughness, length)), 1.0)
    return mean_profiles(*frame, lit & ~single, spread / np.sqrt(stretches), relative=True)


def _length(ray: Rays) -> float:
    return float(np.hypot(np.ptp(ray.easting_m), np.ptp(ray.northing_m)))


def _correlation_length(roughness: Spectrum, longest_m: float) -> float:
    """Return the mean inverse wave number of the heights' variance, of waves that fit a line, metres."""
    k = np.geomspace(2 * np.pi / longest_m, 10, 400)
    power = k / (roughness.p0 + roughness.p1 * k**2 + roughness.p2 * k**4)
    return float(np.trapezoid(power / k, k) / np.trapezoid(power, k))


def _learn_lead(state: _State, rows: Rows, rng: np.random.Generator) -> None:
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


def _linearise(state: _State, rows: Rows, first: bool) -> _Data:
    """Return the data rows about the present surface, robustly weighted."""
    config = state.config
    knot, share = state.basis.place(rows.angle_rad, rows.slant_m, rows.side.astype(np.int64))
    if first:
        state.gain = state.basis.start(rows.ratio, knot)
    present = np.empty((4, state.shape[0] - 1, state.shape[1] - 1))
    dual_features(state.surface, state.albedo, state.cell_m, present)
    at = present.reshape(4, -1)[:, rows.cell]
    gain = np.einsum("ij,ij->i", share, state.gain[knot])
    residual = rows.ratio - gain - at[3]
    scale = _scale_by_angle(residual, rows.angle_rad)
    # Residuals of the first pass are the relief itself: there the width is given, not measured.
    sigma = np.full(len(residual), 0.35) if first else np.maximum(scale, config.least_sigma)
    unit = residual if first else residual / (2.5 * np.maximum(scale, 0.1))
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
    return _Data(rows, weight, c_level, value, knot, share)


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


def _spread(
    state: _State, solved: _Solved, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return the 1-sigma of the heights, jointly and from the soundings alone, by perturbation."""
    weight = solved.data.weight * state.config.independent
    # One-sided data rest on the gain alone; their share of the truth is small.
    weight = np.where(solved.single.ravel()[solved.data.rows.cell], 0.1 * weight, weight)
    joint = _problem(state, replace(solved.data, weight=weight), solved.equations)
    alone = _problem(
        state,
        None,
        sounding_equations(
            state.surface,
            state.west_m,
            state.south_m,
            state.cell_m,
            state.soundings,
            lead_m=state.lead_m,
            lead_sigma_m=state.lead_sigma_m,
        ),
    )
    return _sample_sigma(joint, state, rng), _sample_sigma(alone, state, rng)


def _sample_sigma(problem: Problem, state: _State, rng: np.random.Generator) -> FloatArray:
    total = np.zeros(state.shape)
    for _ in range(state.config.samples):
        zero = (np.zeros(state.shape), np.zeros(state.shape), np.zeros(state.basis.size))
        solution, _ = problem.solve(zero, problem.perturbation(rng), tolerance=3e-2, most=20)
        total += solution[0] ** 2
    # Few samples: neighbours lend theirs, the spread varies slowly.
    return np.sqrt(ndimage.uniform_filter(total / state.config.samples, 7, mode="nearest"))


def _honest_sigma(state: _State, joint: FloatArray, alone: FloatArray) -> FloatArray:
    """Return the sigma of the map, and hold the map to what the soundings allow.

    A height further from the soundings' surface than four of its sigmas is no finding but a failure
    of the model: it is drawn back, and its sigma is that of the soundings.
    """
    base = state.surface if state.base is None else state.base
    limit = 4 * alone
    beyond = np.abs(state.surface - base) > limit
    state.surface = np.clip(state.surface, base - limit, base + limit)
    # The lead of the first returns shifts the whole map; it is known to about a half.
    sigma = np.sqrt(joint**2 + (0.5 * float(np.mean(state.lead_m))) ** 2)
    return np.where(beyond, np.maximum(sigma, alone), sigma)


def _resample(values: FloatArray, source: _State, target: _State) -> FloatArray:
    """Read a field of one frame on the nodes of another; beyond the edge the edge's value."""
    row = target.south_m + np.arange(target.shape[0]) * target.cell_m - source.south_m
    col = target.west_m + np.arange(target.shape[1]) * target.cell_m - source.west_m
    r, c = np.meshgrid(row / source.cell_m, col / source.cell_m, indexing="ij")
    return np.asarray(ndimage.map_coordinates(values, [r, c], order=1, mode="nearest"))


def _hand_down(coarse: _State, fine: _State) -> None:
    """Let the fine problem start where the coarse one ended."""
    fine.surface = _resample(coarse.surface, coarse, fine)
    fine.albedo = _resample(coarse.albedo, coarse, fine)
    if coarse.base is not None:
        fine.base = _resample(coarse.base, coarse, fine)
    fine.gain, fine.roughness = coarse.gain, coarse.roughness
    fine.lead_m, fine.lead_sigma_m = coarse.lead_m, coarse.lead_sigma_m
    # Residuals on other cells do not compare: the fine problem's own decide when it ends.
    fine.step_m = list(coarse.step_m)


def _result(state: _State, sigma: FloatArray, solved: _Solved, crs: str) -> InversionResult:
    """Cut the fields to what was seen and turn them to the records' row order."""
    rows, passed = solved.data.rows, solved.passed
    seen = np.zeros(state.shape, bool)
    seen[:-1, :-1] |= passed
    seen[1:, 1:] |= passed
    seen = ndimage.binary_closing(seen, np.ones((3, 3), bool), iterations=2)
    count = np.zeros(state.shape)
    duals = np.bincount(rows.cell, minlength=(state.shape[0] - 1) * (state.shape[1] - 1))
    count[:-1, :-1] = duals.reshape(state.shape[0] - 1, state.shape[1] - 1)
    r = np.flatnonzero(seen.any(axis=1))
    c = np.flatnonzero(seen.any(axis=0))
    window = (slice(r[0], r[-1] + 1), slice(c[0], c[-1] + 1))

    def cut(values: FloatArray) -> FloatArray:
        return np.where(seen, values, np.nan)[window][::-1]

    grid = Grid(
        elevation_m=cut(state.surface),
        west_m=state.west_m + (c[0] - 0.5) * state.cell_m,
        north_m=state.south_m + (r[-1] + 0.5) * state.cell_m,
        cell_m=state.cell_m,
        crs=crs,
        sigma_m=cut(sigma),
        count=cut(count),
    )
    return InversionResult(
        grid, cut(state.albedo), state.basis.curves(state.gain), state.roughness,
        tuple(state.residual), tuple(state.step_m),
    )  # fmt: skip
