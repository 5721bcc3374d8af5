"""What the joint inversion carries from step to step: frame, data, fields so far, and one linear problem."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from perception.gain_basis import GainBasis
from perception.multigrid import Spectrum
from perception.posterior import Problem
from perception.rays import Rays, Soundings
from perception.records import BoolArray, FloatArray, IntArray
from perception.shading import Rows
from perception.soundings import Equations, sounding_equations


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
        on, where nearly all the ground is seen from one side: what echoes cannot tell from gain moves
        little.
    fine_steps : steps on cells half as wide that follow, where the map is small enough for them.
    fine_nodes : nodes of the narrower cells up to which those steps are taken; 0 for none.
    nodes_at_once : nodes beyond which the first steps are taken on wider cells.
    max_cells : nodes beyond which a cell that was not asked for is enlarged.
    """

    iterations: int = 7
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
    fine_steps: int = 3
    fine_nodes: int = 500_000
    nodes_at_once: int = 250_000
    max_cells: int = 4_000_000


@dataclass(slots=True)
class State:
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
    first: FloatArray | None = None
    residual: list[float] = field(default_factory=list)
    step_m: list[float] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Data:
    """The linearised data rows and their weights."""

    rows: Rows
    weight: FloatArray
    c_level: FloatArray
    value: FloatArray
    knot: IntArray
    share: FloatArray


@dataclass(frozen=True, slots=True)
class Solved:
    """The last linear problem: data, equations without the held profiles, one-sided cells, rays."""

    data: Data
    equations: Equations
    single: BoolArray
    passed: BoolArray


def linear_problem(
    state: State, data: Data | None, equations: Equations, caution: float = 0.0
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


def _times(spectrum: Spectrum, factor: float) -> Spectrum:
    return Spectrum(factor * spectrum.p0, factor * spectrum.p1, factor * spectrum.p2)


def present_soundings(state: State, below: bool = False) -> Equations:
    """Return the soundings as equations about the present surface, by their lead as known so far."""
    return sounding_equations(
        state.surface, state.west_m, state.south_m, state.cell_m, state.soundings,
        below=below, lead_m=state.lead_m, lead_sigma_m=state.lead_sigma_m,
    )  # fmt: skip


def sounding_surface(state: State) -> FloatArray:
    """Return the surface of the soundings and the prior alone."""
    problem = linear_problem(state, None, present_soundings(state, below=True))
    fields = (state.surface, state.albedo, state.gain)
    solution, _ = problem.solve(fields, problem.right_side())
    return solution[0]
