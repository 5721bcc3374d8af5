"""The joint inversion: one surface from the echoes and soundings of all passes.

    soundings -> a first surface and how rough the sea floor is
    repeat: trace every ray over the surface -> log (observed / predicted) power per cell and look
            solve for heights, albedo and gain together
    spread of perturbed solutions -> sigma

docs/joint-inversion.md derives the model and tells what it costs and reaches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from perception.gain_basis import GainBasis
from perception.inverse_sigma import honest_sigma, spread
from perception.inverse_state import InversionConfig, Solved, State, sounding_surface
from perception.multigrid import Spectrum
from perception.rays import Look, Rays, Soundings, of_unit_level, stack_rays, stack_soundings
from perception.records import FloatArray, Grid, InputError, Progress, silent
from perception.relinearise import iterate, mostly_one_sided
from perception.roughness import learn_roughness
from perception.soundings import join

__all__ = ["InversionConfig", "InversionResult", "Look", "invert"]


# A survey asked for fewer steps than this is a draft: it takes none on narrower cells.
_WHOLE = 6
# Errors of the model are shared over ground, not over a number of cells: of four cells in the place of one fewer count as
# independent. (0.4 was cautious on rough floors, the whole bold by a half on crossed ones.)
_FINE_DATA_PART = 0.6
# Echoes traced on narrow cells tell more of the level: errors of maps were a tenth of the lead, 0.5 at most.
_FINE_LEAD_PART = 0.25


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
    survey = _survey(looks, cell_m, config)
    total = config.iterations + 3
    progress("joint inversion", 1, total)
    lead_part = 0.5
    if survey.shape[0] * survey.shape[1] > config.nodes_at_once:
        # Large maps take their first steps on cells twice as wide, at a quarter of the cost.
        coarse = _learn(_survey(looks, 2 * survey.cell_m, config), config, rng)
        solved = iterate(coarse, config.iterations - 1, progress, rng)
        deviation, base_sigma = spread(coarse, solved, rng)
        state = _handed_down(coarse, survey)
        deviation = _resample(deviation, coarse, state)
        base_sigma = _resample(base_sigma, coarse, state)
        # Rays and rows of the wide cells have had their say; the finest grid needs their room.
        del coarse, solved
        last = iterate(state, 2, progress, rng)
    else:
        state = _learn(survey, config, rng)
        last = iterate(state, config.iterations, progress, rng)
        if _fine_enough(survey, config) and not mostly_one_sided(last.single, last.passed):
            deviation, base_sigma = _with_fine_steps(state, looks, progress, rng)
            lead_part = _FINE_LEAD_PART
        else:
            deviation, base_sigma = spread(state, last, rng)
    progress("joint inversion", total, total)
    sigma = honest_sigma(state, last, deviation, base_sigma, lead_part)
    return _result(state, sigma, last, crs or looks[0].swath.crs)


def _fine_enough(survey: _Survey, config: InversionConfig) -> bool:
    """Return whether steps on narrower cells follow: on small maps, and not for a draft of few steps."""
    whole = config.iterations >= _WHOLE
    return whole and 4 * survey.shape[0] * survey.shape[1] <= config.fine_nodes


def _with_fine_steps(
    state: State, looks: Sequence[Look], progress: Progress, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Take the last steps on cells half as wide; return the sigmas, jointly and of the soundings alone.

    What a cell echoes is no function of its mean slope where waves shorter than the cell shade and hide one another.
    The state receives the means over its own cells.
    """
    fine = _handed_down(state, _survey(looks, 0.5 * state.cell_m, state.config))
    solved = iterate(fine, state.config.fine_steps, progress, rng)
    deviation, base_sigma = spread(fine, solved, rng, _FINE_DATA_PART)
    # A node of the wide cells lies amid four of the narrow ones: to interpolate there is to take their mean.
    state.surface = _resample(fine.surface, fine, state)
    state.albedo = _resample(fine.albedo, fine, state)
    state.gain = fine.gain
    state.residual += fine.residual
    state.step_m += fine.step_m[len(state.step_m) :]
    return _resample(deviation, fine, state), _resample(base_sigma, fine, state)


@dataclass(frozen=True, slots=True)
class _Survey:
    """The echoes and soundings on one frame of nodes, before anything is learned of them."""

    west_m: float
    south_m: float
    cell_m: float
    shape: tuple[int, int]
    rays: list[Rays]
    bottoms: list[Soundings]


def _survey(looks: Sequence[Look], cell_m: float | None, config: InversionConfig) -> _Survey:
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
    return _Survey(west, south, cell, shape, rays, bottoms)


def _learn(survey: _Survey, config: InversionConfig, rng: np.random.Generator) -> State:
    """Return the state to start from: the roughness and the surface that the soundings tell."""
    bottom = join(survey.bottoms)
    noise = float(np.median(bottom.sigma_m)) / 2
    roughness = learn_roughness(survey.bottoms, noise, survey.cell_m, rng)
    state = _state(survey, bottom, roughness, config)
    state.surface = sounding_surface(state)
    return state


def _state(
    survey: _Survey, bottom: Soundings, roughness: Spectrum, config: InversionConfig
) -> State:
    basis = GainBasis(max((ray.reach_m for ray in survey.rays), default=1.0))
    mean = float(np.mean(bottom.up_m - bottom.range_m))
    return State(
        survey.west_m, survey.south_m, survey.cell_m, survey.shape, survey.rays, bottom, roughness,
        _albedo_prior(config), basis, mean, np.full(survey.shape, mean), np.zeros(survey.shape),
        np.zeros(basis.size), config,
    )  # fmt: skip


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


def _resample(values: FloatArray, source: State, target: State) -> FloatArray:
    """Read a field of one frame on the nodes of another; beyond the edge the edge's value."""
    row = target.south_m + np.arange(target.shape[0]) * target.cell_m - source.south_m
    col = target.west_m + np.arange(target.shape[1]) * target.cell_m - source.west_m
    r, c = np.meshgrid(row / source.cell_m, col / source.cell_m, indexing="ij")
    return np.asarray(ndimage.map_coordinates(values, [r, c], order=1, mode="nearest"))


def _handed_down(coarse: State, survey: _Survey) -> State:
    """Return the state of narrower cells that starts where the wider ones ended."""
    fine = _state(survey, join(survey.bottoms), coarse.roughness, coarse.config)
    fine.surface = _resample(coarse.surface, coarse, fine)
    fine.albedo = _resample(coarse.albedo, coarse, fine)
    if coarse.base is not None:
        fine.base = _resample(coarse.base, coarse, fine)
    if coarse.first is not None:
        fine.first = _resample(coarse.first, coarse, fine)
    fine.gain = coarse.gain
    fine.lead_m, fine.lead_sigma_m = coarse.lead_m, coarse.lead_sigma_m
    # Residuals on other cells do not compare: the fine problem's own decide when it ends.
    fine.step_m = list(coarse.step_m)
    return fine


def _result(state: State, sigma: FloatArray, solved: Solved, crs: str) -> InversionResult:
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
