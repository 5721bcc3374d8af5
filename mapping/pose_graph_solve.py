"""The survey's graph solved: one linear system, each registration one factor, eliminated by GTSAM.

All factors are linear in the corrections (`pose_graph`), so the answer is one elimination away. The patches of ground
and the means of two keyframes that tie a registration to its passes are variables of no other factor: eliminated
beforehand they leave one factor a registration, of two rows, and a third of the unknowns. What doubts the
registrations weighs these factors anew and eliminates again, as often as it takes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import gtsam as typed_gtsam
import numpy as np
from gtsam.symbol_shorthand import E, G
from scipy.stats import chi2

from mapping.keyframes import KeyframeFix, Keyframes
from mapping.pose_graph import (
    GraphConfig,
    HeightStep,
    Link,
    Solution,
    add_fix,
    add_passes,
    add_starts,
    add_step,
    jacobian,
    same_dive,
    solution_of,
    tie_terms,
    trusted,
    way_terms,
)
from mapping.pose_graph_root import Root
from perception.records import BoolArray, FloatArray

gtsam: Any = typed_gtsam

logger = logging.getLogger(__name__)

# A solution whose gradient is not so much smaller than at the start has lost its digits: QR keeps twice as many.
_LEAST_GAIN = 1e-7
# By this factor GNC's cost nears the truncated one from step to step; and it ends when each weight is so near 0 or 1.
_SHARPER, _DECIDED = 1.4, 1e-4
_MOST_STEPS = 100


class LinearGraph:
    """A survey's graph as GTSAM's Gaussian factors; those that may be wrong stand apart and can be weighed.

    Attributes
    ----------
    doubtful : factors of links, then height steps, then fixes.
    """

    def __init__(
        self,
        keyframes: Keyframes,
        links: Sequence[Link],
        fixes: Sequence[KeyframeFix],
        config: GraphConfig,
        steps: Sequence[HeightStep] = (),
    ) -> None:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        add_passes(graph, values, keyframes, config)
        add_starts(graph, values, keyframes, config, absolute=bool(fixes))
        sure = graph.size()
        for step in steps:
            add_step(graph, step)
        for fix in fixes:
            add_fix(graph, fix)
        linear = graph.linearize(values)
        self._sure = [linear.at(i) for i in range(sure)]
        self._sure += [jacobian(*terms) for terms in way_terms(keyframes, config)]
        self.doubtful = [_link_factor(keyframes, link) for link in links]
        self.doubtful += [linear.at(i) for i in range(sure, linear.size())]
        # The weight that each carries now: GTSAM holds it as a noise model.
        self._weight = np.ones(len(self.doubtful))
        self._ordering = gtsam.Ordering.ColamdGaussianFactorGraph(
            self.graph(np.ones(len(self.doubtful)))
        )

    def graph(self, weight: FloatArray) -> Any:
        """Return the factors that count, the doubtful ones with the weights (0 to 1) of their squares."""
        graph = gtsam.GaussianFactorGraph()
        for factor in self._sure:
            graph.add(factor)
        for factor, w in zip(self.doubtful, weight, strict=True):
            if w > 0:
                factor.setModel(False, np.full(factor.rows(), w**-0.5))
                graph.add(factor)
        self._weight = np.where(weight > 0, weight, self._weight)
        return graph

    def optimum(self, weight: FloatArray) -> Any:
        """Return the answer under these weights.

        Raises
        ------
        RuntimeError
            The graph does not determine its unknowns.
        """
        graph = self.graph(weight)
        return self._eliminated(graph, graph.eliminateMultifrontal)[1]

    def misfit(self, values: Any) -> FloatArray:
        """Return chi-square of each doubtful factor, unweighted."""
        return np.array([2.0 * f.error(values) for f in self.doubtful]) / self._weight

    def net(self, graph: Any) -> tuple[Any, Any]:
        """Return the Bayes net of a graph of these factors and its answer.

        Raises
        ------
        RuntimeError
            The graph does not determine its unknowns.
        """
        return self._eliminated(graph, graph.eliminateSequential)

    def _eliminated(self, graph: Any, eliminate: Callable[..., Any]) -> tuple[Any, Any]:
        """Return what is left of a graph and its answer, by QR where Cholesky loses it."""
        try:
            left_over = eliminate(self._ordering)
            values = left_over.optimize()
            left, start = graph.gradient(values).norm(), graph.gradientAtZero().norm()
            if left <= _LEAST_GAIN * start + 1e-9:
                return left_over, values
            logger.info("pose graph: gradient %.1e of %.1e left, solved by QR", left, start)
        except RuntimeError as error:
            logger.info("pose graph: solved by QR: %s", str(error).strip().splitlines()[0])
        left_over = eliminate(self._ordering, gtsam.EliminateQR)
        return left_over, left_over.optimize()


def _link_factor(keyframes: Keyframes, link: Link) -> Any:
    """Return a registration as one factor between keyframes and pass errors, its own variables eliminated."""
    graph, inner = gtsam.GaussianFactorGraph(), gtsam.Ordering()
    for brought, terms in tie_terms(keyframes, link):
        graph.add(jacobian(*terms))
        inner.push_back(brought)
    white = np.linalg.inv(np.linalg.cholesky(link.covariance_m2))
    unit = gtsam.noiseModel.Unit.Create(2)
    graph.add(gtsam.JacobianFactor(G(0), -white, G(1), white, white @ link.shift_m, unit))
    _, remaining = gtsam.JacobianFactor(graph).eliminate(inner)
    return remaining


def consistent(graph: LinearGraph, config: GraphConfig) -> BoolArray:
    """Return which doubtful factors agree with the rest: truncated least squares by graduated non-convexity.

    Yang et al. 2020, equations 12 to 14, from the solution of all factors; `gtsam.GncGaussNewtonOptimizer` decides the
    same (tested), but solves and linearises the unreduced graph at each step.
    """
    weight = np.ones(len(graph.doubtful))
    rows = np.array([f.rows() for f in graph.doubtful])
    bound = np.asarray(chi2.ppf(1.0 - config.outlier_probability, rows))
    misfit = graph.misfit(graph.optimum(weight))
    far = 2.0 * misfit > bound
    if not far.any():
        return weight > 0.5
    mu = float((bound[far] / (2.0 * misfit[far] - bound[far])).min())
    for _ in range(_MOST_STEPS):
        low, high = mu / (mu + 1.0) * bound, (mu + 1.0) / mu * bound
        between = np.sqrt(bound * mu * (mu + 1.0) / np.maximum(misfit, 1e-300)) - mu
        weight = np.where(misfit >= high, 0.0, np.where(misfit <= low, 1.0, between))
        misfit = graph.misfit(graph.optimum(weight))
        if np.minimum(weight, 1.0 - weight).max() < _DECIDED:
            break
        mu *= _SHARPER
    else:
        logger.warning(
            "pose graph: %d registrations, height steps or fixes undecided after %d steps; the likelier is taken",
            ((weight > _DECIDED) & (weight < 1.0 - _DECIDED)).sum(), _MOST_STEPS,
        )  # fmt: skip
    return weight > 0.5


def solve(
    keyframes: Keyframes,
    links: Sequence[Link] = (),
    fixes: Sequence[KeyframeFix] = (),
    config: GraphConfig | None = None,
    robust: bool = True,
    steps: Sequence[HeightStep] = (),
    decided: Solution | None = None,
) -> Solution:
    """Solve the survey's graph; wrong registrations and fixes are found by graduated non-convexity.

    Parameters
    ----------
    robust : False takes every registration and fix at its word.
    decided : an answer to the same links, fixes and steps: what it doubted is doubted, no more and no less.
    """
    config = config or GraphConfig()
    linear = LinearGraph(keyframes, links, fixes, config, steps)
    used = np.ones(len(linear.doubtful), bool)
    if decided is not None:
        used = np.concatenate([decided.link_used, decided.step_used, decided.fix_used])
    try:
        if decided is None and robust and len(used):
            used = consistent(linear, config)
        graph = linear.graph(used.astype(float))
        net, values = linear.net(graph)
    except RuntimeError as error:
        logger.warning("the pose graph is indeterminate: %s", str(error).strip().splitlines()[0])
        graph = net = values = None
    n_links = len(links)
    solution = _solution(
        keyframes, config, graph, net, values, used[:n_links],
        used[n_links + len(steps) :], used[n_links : n_links + len(steps)],
    )  # fmt: skip
    logger.info(
        "pose graph: %d keyframes, %d of %d registrations used, error %.1f -> %.1f",
        len(keyframes), solution.link_used.sum(), n_links, solution.error_before, solution.error_after,
    )  # fmt: skip
    return solution


def with_range_scale(
    solution: Solution,
    keyframes: Keyframes,
    links: Sequence[Link],
    fixes: Sequence[KeyframeFix],
) -> Solution:
    """Return a solution whose covariances hold what a range scale that all passes have in common would do to it.

    Ground at a from the track is drawn at a (1 + k), so neighbours that look at each other are registered too near or
    too far by the same part of their distance, again and again across a survey, and no covariance of single
    registrations grows as that does. k is considered and not estimated (Schmidt 1966): with s the answer's change per k,
    ``C + sigma_k^2 s s'``.

    Parameters
    ----------
    links, fixes : of the solution, in its order.
    """
    config = solution.config
    if solution.root is None or not config.range_scale:
        return solution
    pulls = [
        replace(link, shift_m=_range_effect(keyframes, link))
        for link in trusted(links, solution.link_used)
    ]
    still = [replace(fix, correction_m=np.zeros(2)) for fix in trusted(fixes, solution.fix_used)]
    # Heights have no part in it.
    linear = LinearGraph(keyframes, pulls, still, config)
    try:
        values = linear.optimum(np.ones(len(linear.doubtful)))
    except RuntimeError as error:
        logger.warning(
            "a range scale in common is left out of the claimed covariances: %s",
            str(error).strip().splitlines()[0],
        )
        return solution
    change = config.range_scale * np.array([values.at(E(k)) for k in range(len(keyframes))])
    spread = change[:, :, None] * change[:, None, :]
    wider = solution.covariance_m2 + spread
    return replace(solution, covariance_m2=wider, range_effect_m=change)


def _range_effect(keyframes: Keyframes, link: Link) -> FloatArray:
    """Return how the shift (2,) that a registration finds changes per unit of range scale."""
    drawn = []
    for k, offset in ((link.first, link.first_offset_m), (link.second, link.second_offset_m)):
        heading = keyframes.heading_rad[k]
        starboard = np.array([np.cos(heading), -np.sin(heading)])
        drawn.append((offset @ starboard) * starboard)
    effect: FloatArray = drawn[0] - drawn[1]
    return effect


def log_evidence(
    keyframes: Keyframes,
    links: Sequence[Link],
    fixes: Sequence[KeyframeFix],
    config: GraphConfig,
    steps: Sequence[HeightStep] = (),
) -> float:
    """Return the log-probability of the data under `config`, all unknowns integrated out, but for a constant.

    Of the noise models' own determinants only the one that `GraphConfig.shared` changes is counted. NaN
    where the graph does not determine its unknowns.
    """
    linear = LinearGraph(keyframes, links, fixes, config, steps)
    graph = linear.graph(np.ones(len(linear.doubtful)))
    try:
        net, values = linear.net(graph)
    except RuntimeError:
        return float("nan")
    chained = int(same_dive(keyframes).sum()) if config.shared else 0
    half_of_priors = -1.5 * chained * np.log(1.0 - config.shared**2)
    return float(half_of_priors - graph.error(values) - net.logDeterminant())


def _solution(
    keyframes: Keyframes, config: GraphConfig, graph: Any, net: Any, values: Any,
    link_used: BoolArray, fix_used: BoolArray, step_used: BoolArray,
) -> Solution:  # fmt: skip
    """Put an answer and its covariances into the survey's terms; without an answer, no correction and NaN."""
    root, before, after = None, float("nan"), float("nan")
    if values is not None:
        root = Root.of(net)
        before, after = graph.error(gtsam.VectorValues.Zero(values)), graph.error(values)
    return solution_of(
        keyframes,
        None if values is None else lambda keys: np.array([values.at(key) for key in keys]),
        None if root is None else root.covariances,
        config, link_used=link_used, fix_used=fix_used, step_used=step_used,
        error_before=before, error_after=after, root=root,
    )  # fmt: skip
