"""The pose graph of a survey in GTSAM: keyframe corrections from odometry, fixes and registrations.

Unknown is the *correction* of the navigation at each keyframe, not the pose: headings are measured to
a fraction of a degree, so everything is linear in the corrections and one Gauss-Newton step solves it.
docs/pose-graph.md has the derivation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import gtsam as typed_gtsam
import numpy as np
from gtsam.symbol_shorthand import B, E, G, H, M

from mapping.keyframes import KeyframeFix, Keyframes
from mapping.pose_graph_root import Root
from perception.records import BoolArray, FloatArray

# The stubs of the wheel know neither KeyVector arguments nor overloads by noise model.
gtsam: Any = typed_gtsam

_Factor = TypeVar("_Factor")
# Keys with their matrices, then a noise model: what `jacobian` takes.
_Terms = tuple[Any, ...]

# The tie between a keyframe and the ground that it saw is exact; a centimetre is below any registration and
# keeps the system well-conditioned beside a start that is free by a hundred metres.
_TIE_M = 1e-2


@dataclass(frozen=True, slots=True)
class GraphConfig:
    """How far the navigation may be wrong.

    Attributes
    ----------
    drift_m_per_sqrt_km : random walk of the position, 1-sigma per axis after 1 km.
    heading_bias_deg, scale : 1-sigma of each pass's course error and speed-scale error.
    sonar_heading_deg : 1-sigma of the difference between the sonar's heading error and the course error.
    start_m : 1-sigma of the navigation's start where no fix is given (a GPS fix before the dive).
    start_with_fixes_m : the same where fixes are given, which then decide.
    shared : correlation of these errors from pass to pass of a dive: 0 each its own, near 1 one
        instrument's constant. `mapping.sharing` chooses it by what the survey says.
    range_scale : 1-sigma of what all passes misjudge of distances across the track in common: sound speed (3 m/s are 0.2 %),
        altitude, the second order of unknown relief. It is not estimated, for nothing
        else in a survey tells it, but it is part of every claimed covariance.
    height_m : 1-sigma of a strip's height offset (depth sensor, tide left over), where the survey does not
        say otherwise (`mapping.sharing`).
    outlier_probability : chance of refusing a good registration (chi-square tail of the GNC threshold).
    """

    drift_m_per_sqrt_km: float = 4.0
    heading_bias_deg: float = 0.5
    scale: float = 0.005
    sonar_heading_deg: float = 0.3
    shared: float = 0.0
    start_m: float = 2.0
    start_with_fixes_m: float = 300.0
    range_scale: float = 0.002
    height_m: float = 0.1
    outlier_probability: float = 0.01

    @property
    def walk_m2_per_m(self) -> float:
        """Variance (m2 an axis) of the random walk for each metre of way."""
        return self.drift_m_per_sqrt_km**2 / 1000.0


@dataclass(frozen=True, slots=True)
class Blend:
    """Two keyframes of one pass and the weight of the second: what stands between them is their mean."""

    low: int
    high: int
    share: float

    def of(self, values: FloatArray) -> FloatArray:
        """Return the weighted mean of per-keyframe values."""
        mean: FloatArray = (1.0 - self.share) * values[self.low] + self.share * values[self.high]
        return mean


@dataclass(frozen=True, slots=True)
class Link:
    """A registration between two keyframes: the ground each saw, brought together.

    Attributes
    ----------
    first, second : keyframes nearest to where each pass saw the ground.
    first_offset_m, second_offset_m : (2,) from each keyframe, or blend of two, to the matched ground.
    shift_m : (2,) correction of the ground of `second` minus that of `first`.
    covariance_m2 : (2, 2) of `shift_m`.
    first_blend, second_blend : where two keyframes tell better what the pass's correction was on average while it saw
        the ground; None the keyframe alone.
    """

    first: int
    second: int
    first_offset_m: FloatArray
    second_offset_m: FloatArray
    shift_m: FloatArray
    covariance_m2: FloatArray
    first_blend: Blend | None = None
    second_blend: Blend | None = None


@dataclass(frozen=True, slots=True)
class HeightStep:
    """Height correction of strip `second` minus that of strip `first`, with its 1-sigma."""

    first: int
    second: int
    height_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True)
class Solution:
    """Corrections with covariance, and what the solver thought of its input.

    Attributes
    ----------
    correction_m : (k, 2) to be added to the keyframes' positions; `covariance_m2` (k, 2, 2).
    pass_errors : (p, 3) scale, course bias, sonar heading bias (rad) of each strip; `pass_sigma` alike.
    height_m, height_sigma_m : (p,) to be added to each strip's heights.
    link_used, fix_used, step_used : which were found consistent.
    error_before, error_after : the graph's error (half a chi-square) over what was used.
    indeterminate, worsened : the graph does not determine the answer; the answer is no better.
    config : what was assumed.
    range_effect_m : (k, 2) what 1-sigma of `GraphConfig.range_scale` does to `correction_m`, whose square is part of
        `covariance_m2`; None where it is not.
    root : what all other covariances can be had from; None where the graph is indeterminate or was not solved as a whole.
    """

    correction_m: FloatArray
    covariance_m2: FloatArray
    pass_errors: FloatArray
    pass_sigma: FloatArray
    height_m: FloatArray
    height_sigma_m: FloatArray
    link_used: BoolArray
    fix_used: BoolArray
    step_used: BoolArray
    error_before: float
    error_after: float
    indeterminate: bool
    worsened: bool
    config: GraphConfig
    range_effect_m: FloatArray | None = None
    root: Root | None = field(default=None, repr=False, compare=False)


def perpendicular(vector: FloatArray) -> FloatArray:
    """Return the change of (east, north) vectors (..., 2) per radian of clockwise turn."""
    return np.stack([vector[..., 1], -vector[..., 0]], axis=-1)


def trusted(factors: Sequence[_Factor], used: BoolArray) -> tuple[_Factor, ...]:
    """Return the factors that a solution used, or whatever else a mask of the same length keeps."""
    return tuple(x for x, ok in zip(factors, used, strict=True) if ok)


def solution_of(
    keyframes: Keyframes,
    values_of: Callable[[list[int]], FloatArray] | None,
    covariances_of: Callable[[list[int]], FloatArray] | None,
    config: GraphConfig,
    *,
    link_used: BoolArray,
    fix_used: BoolArray,
    step_used: BoolArray,
    error_before: float,
    error_after: float,
    root: Root | None = None,
) -> Solution:
    """Collect a solution from what a solver says of variables of one size.

    Parameters
    ----------
    values_of, covariances_of : values (k, d) and marginal covariances (k, d, d) of some keys; None of a graph that
        does not determine them: no correction, and NaN.
    """
    passes = range(len(keyframes.starts) - 1)
    groups = [
        ([E(k) for k in range(len(keyframes))], 2), ([B(p) for p in passes], 3), ([H(p) for p in passes], 1)
    ]  # fmt: skip
    found, spread = [], []
    for keys, d in groups:
        found.append(np.zeros((len(keys), d)) if values_of is None else values_of(keys))
        nothing = np.full((len(keys), d, d), np.nan)
        spread.append(nothing if covariances_of is None else covariances_of(keys))
    return Solution(
        correction_m=found[0],
        covariance_m2=spread[0],
        pass_errors=found[1],
        pass_sigma=np.sqrt(np.diagonal(spread[1], axis1=1, axis2=2)),
        height_m=found[2][:, 0],
        height_sigma_m=np.sqrt(spread[2][:, 0, 0]),
        link_used=link_used,
        fix_used=fix_used,
        step_used=step_used,
        error_before=error_before,
        error_after=error_after,
        indeterminate=values_of is None,
        worsened=bool(error_after > error_before * (1 + 1e-9) + 1e-9),
        config=config,
        root=root,
    )


def build(
    keyframes: Keyframes,
    links: Sequence[Link],
    fixes: Sequence[KeyframeFix],
    config: GraphConfig,
    steps: Sequence[HeightStep] = (),
) -> tuple[Any, Any, list[int]]:
    """Return the graph, its start (no correction) and the indices of factors that may be wrong."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    add_passes(graph, values, keyframes, config)
    add_starts(graph, values, keyframes, config, absolute=bool(fixes))
    add_odometry(graph, keyframes, config)
    doubtful: list[int] = []
    for number, link in enumerate(links):
        doubtful.append(add_link(graph, values, keyframes, link, number))
    for step in steps:
        doubtful.append(graph.size())
        add_step(graph, step)
    for fix in fixes:
        doubtful.append(graph.size())
        add_fix(graph, fix)
    return graph, values, doubtful


def add_step(graph: Any, step: HeightStep) -> None:
    """Add a height step between two strips."""
    noise = gtsam.noiseModel.Isotropic.Sigma(1, step.sigma_m)
    height = np.array([step.height_m])
    graph.add(gtsam.BetweenFactorVector(H(step.first), H(step.second), height, noise))


def add_fix(graph: Any, fix: KeyframeFix) -> None:
    """Add an absolute fix of a keyframe."""
    noise = gtsam.noiseModel.Gaussian.Covariance(fix.covariance_m2)
    graph.add(gtsam.PriorFactorVector(E(fix.keyframe), fix.correction_m, noise))


def add_passes(
    graph: Any, values: Any, keyframes: Keyframes, config: GraphConfig, first: int = 0
) -> None:
    """Add scale, course bias, sonar heading bias and height offset of each pass from `first` on."""
    bias, sonar = np.radians(config.heading_bias_deg), np.radians(config.sonar_heading_deg)
    covariance = np.diag([config.scale**2, bias**2, bias**2 + sonar**2])
    # One compass steers the dead reckoning and points the sonar: their errors are mostly one.
    covariance[1, 2] = covariance[2, 1] = bias**2
    errors = gtsam.noiseModel.Gaussian.Covariance(covariance)
    kept = config.shared
    # A linear factor takes independent noise only, so it is whitened beforehand.
    white = np.linalg.inv(np.linalg.cholesky((1.0 - kept**2) * covariance))
    unit = gtsam.noiseModel.Unit.Create(3)
    height = gtsam.noiseModel.Isotropic.Sigma(1, config.height_m)
    chained = same_dive(keyframes)
    for p in range(first, len(keyframes.starts) - 1):
        values.insert(B(p), np.zeros(3))
        values.insert(H(p), np.zeros(1))
        if kept and chained[p]:
            graph.add(_linear((B(p - 1), -kept * white), (B(p), white), unit))
        else:
            graph.add(gtsam.PriorFactorVector(B(p), np.zeros(3), errors))
        graph.add(gtsam.PriorFactorVector(H(p), np.zeros(1), height))


def same_dive(keyframes: Keyframes) -> BoolArray:
    """Return (p,) which passes follow the one before in the same dive."""
    return np.isfinite(keyframes.way_m[keyframes.starts[:-1]])


def add_odometry(graph: Any, keyframes: Keyframes, config: GraphConfig, first: int = 0) -> None:
    """Add the way to each keyframe from `first` on."""
    for terms in way_terms(keyframes, config, first):
        graph.add(_linear(*terms))


def add_starts(
    graph: Any,
    values: Any,
    keyframes: Keyframes,
    config: GraphConfig,
    absolute: bool,
    first: int = 0,
) -> None:
    """Add corrections from keyframe `first` on, and what is known of those that no way leads to."""
    start_m = config.start_with_fixes_m if absolute else config.start_m
    start = gtsam.noiseModel.Isotropic.Sigma(2, start_m)
    for k in range(first, len(keyframes)):
        values.insert(E(k), np.zeros(2))
        if not np.isfinite(keyframes.way_m[k]):
            graph.add(gtsam.PriorFactorVector(E(k), np.zeros(2), start))


def way_terms(keyframes: Keyframes, config: GraphConfig, first: int = 0) -> Iterator[_Terms]:
    """Yield what ties each keyframe from `first` on to the one before, where a way leads from there.

    e[k] - e[k-1] = scale * d + bias * perpendicular(d) + walk, with d the navigation's step.
    """
    position = np.column_stack([keyframes.easting_m, keyframes.northing_m])
    step = np.diff(position, axis=0, prepend=position[:1])
    effects = np.stack([step, perpendicular(step), np.zeros_like(step)], axis=-1)
    walk_m = config.drift_m_per_sqrt_km * np.sqrt(keyframes.way_m / 1000.0)
    sigma_m = np.maximum(np.hypot(walk_m, keyframes.jump_m), 1e-3)
    for k in range(first, len(keyframes)):
        if np.isfinite(sigma_m[k]):
            yield (
                (E(k - 1), -np.eye(2)),
                (E(k), np.eye(2)),
                (B(int(keyframes.strip[k - 1])), -effects[k]),
                gtsam.noiseModel.Isotropic.Sigma(2, sigma_m[k]),
            )


def tie_terms(keyframes: Keyframes, link: Link, number: int = 0) -> Iterator[tuple[int, _Terms]]:
    """Yield the variables that a registration brings, each with what ties it to its pass.

    They are the two patches of ground, ``G(2 number)`` and the one after, and before each, where two keyframes stand for
    a pass, their mean M.
    """
    tie = gtsam.noiseModel.Isotropic.Sigma(2, _TIE_M)
    ends = (
        (link.first, link.first_blend, link.first_offset_m),
        (link.second, link.second_blend, link.second_offset_m),
    )
    for side, (k, blend, offset) in enumerate(ends):
        correction, ground = E(k), G(2 * number + side)
        if blend is not None and blend.low != blend.high:
            correction = M(2 * number + side)
            yield (
                correction,
                (
                    (E(blend.low), (blend.share - 1.0) * np.eye(2)),
                    (E(blend.high), -blend.share * np.eye(2)),
                    (correction, np.eye(2)),
                    tie,
                ),
            )
        # A wrong heading of the sonar swings the ground about the vehicle.
        swing = np.column_stack([np.zeros((2, 2)), perpendicular(offset)])
        yield (
            ground,
            (
                (correction, -np.eye(2)),
                (B(int(keyframes.strip[k])), -swing),
                (ground, np.eye(2)),
                tie,
            ),
        )


def add_link(graph: Any, values: Any, keyframes: Keyframes, link: Link, number: int) -> int:
    """Add the two patches of ground and the registration between them; return its factor's index."""
    for brought, terms in tie_terms(keyframes, link, number):
        values.insert(brought, np.zeros(2))
        graph.add(_linear(*terms))
    noise = gtsam.noiseModel.Gaussian.Covariance(link.covariance_m2)
    graph.add(gtsam.BetweenFactorVector(G(2 * number), G(2 * number + 1), link.shift_m, noise))
    return int(graph.size()) - 1


def jacobian(*terms: Any) -> Any:
    """Return the native linear factor ``sum A_i x_i = 0`` of (key, matrix) terms and a noise model."""
    *blocks, noise = terms
    flat = [part for block in blocks for part in block]
    return gtsam.JacobianFactor(*flat, np.zeros(blocks[0][1].shape[0]), noise)


def _linear(*terms: Any) -> Any:
    """Return the same as a factor of a graph that need not be linear."""
    # Without a linearisation point GTSAM reads a linear factor as one in increments, not in values.
    at = gtsam.Values()
    for key, matrix in terms[:-1]:
        at.insert(key, np.zeros(matrix.shape[1]))
    return gtsam.LinearContainerFactor(jacobian(*terms), at)


def gauss_newton() -> Any:
    """Return the parameters of the solver."""
    parameters = gtsam.GaussNewtonParams()
    # Cholesky squares the condition number, and weights of 1 cm stand beside some of 300 m.
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    return parameters
