"""What the passes share, compass, log and depth sensor: decided by what the survey itself says.

A dive's course and speed errors may be one constant of the instruments or may change from pass to pass. Taken for one
constant they are known far better; taken so wrongly they bend the track. Both assumptions predict the same
data with some probability, and the more probable one is taken. So with the size of the passes' height offsets: small
ones must not be fitted to the noise of the crossings, large ones (tide, a pressure sensor between dives) must not be denied.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapping.keyframes import KeyframeFix, Keyframes
from mapping.pose_graph import GraphConfig, HeightStep, Link, Solution, trusted
from mapping.pose_graph_solve import LinearGraph, consistent, log_evidence, solve, with_range_scale

logger = logging.getLogger(__name__)

# Sizes of height offsets, 1-sigma, that are tried beside the configured one.
_HEIGHTS_M = (0.03, 0.3)
# Another size must be so many times as probable (in logarithms) to be taken.
_LEAST_GAIN = 1.0
# Each pass its own; mostly alike; one constant but for a tenth of its sigma.
_CORRELATIONS = (0.0, 0.8, 0.995)


def height_size(steps: Sequence[HeightStep], passes: int, config: GraphConfig) -> float:
    """Return the 1-sigma of the passes' height offsets under which their crossings are most probable.

    Steps are ``A h + noise`` with the offsets h of that size, so their covariance is known for each.
    """
    if not steps:
        return config.height_m
    z = np.array([step.height_m for step in steps])
    noise = np.diag([step.sigma_m**2 for step in steps])
    between = np.zeros((len(steps), passes))
    for row, step in enumerate(steps):
        between[row, step.first], between[row, step.second] = -1.0, 1.0

    def log_probability(size_m: float) -> float:
        covariance = size_m**2 * between @ between.T + noise
        return float(
            -0.5 * z @ np.linalg.solve(covariance, z) - 0.5 * np.linalg.slogdet(covariance)[1]
        )

    own = log_probability(config.height_m)
    best = max(_HEIGHTS_M, key=log_probability)
    return best if log_probability(best) > own + _LEAST_GAIN else config.height_m


def solve_shared(
    keyframes: Keyframes,
    links: Sequence[Link],
    fixes: Sequence[KeyframeFix],
    config: GraphConfig,
    steps: Sequence[HeightStep] = (),
) -> Solution:
    """Solve the graph under the correlation between passes that has the greatest evidence.

    All are weighed over the same registrations and fixes, those that the first assumption finds consistent. The
    covariances hold what a range scale in common adds.
    """
    solution = _most_evident(keyframes, links, fixes, config, steps)
    return with_range_scale(solution, keyframes, links, fixes)


def _most_evident(
    keyframes: Keyframes,
    links: Sequence[Link],
    fixes: Sequence[KeyframeFix],
    config: GraphConfig,
    steps: Sequence[HeightStep],
) -> Solution:
    first = solve(keyframes, links, fixes, config, steps=steps)
    if len(keyframes.starts) < 3:
        return first
    used_links = trusted(links, first.link_used)
    used_fixes = trusted(fixes, first.fix_used)
    used_steps = trusted(steps, first.step_used)
    config = replace(config, height_m=height_size(used_steps, len(keyframes.starts) - 1, config))
    best, most = config.shared, float("-inf")
    for shared in _CORRELATIONS:
        tried = replace(config, shared=shared)
        found = log_evidence(keyframes, used_links, used_fixes, tried, used_steps)
        logger.info("pass errors correlated by %.3f: log evidence %.2f", shared, found)
        if found > most:
            best, most = shared, found
    if best == config.shared and config == first.config:
        return first
    config = replace(config, shared=best)
    # The size of height offsets has no say in the plane, and smaller ones clear no step that was doubted.
    same = best == first.config.shared and config.height_m <= first.config.height_m
    decided = _steps_doubted(first, keyframes, steps, config) if same else None
    return solve(keyframes, links, fixes, config, steps=steps, decided=decided)


def _steps_doubted(
    first: Solution, keyframes: Keyframes, steps: Sequence[HeightStep], config: GraphConfig
) -> Solution:
    """Return what was decided of registrations and fixes, with the steps that it believed weighed anew.

    What large offsets explain smaller ones may not. Heights hang on nothing but steps, so these decide alone.
    """
    believed = np.flatnonzero(first.step_used).tolist()
    linear = LinearGraph(keyframes, (), (), config, [steps[i] for i in believed])
    used = first.step_used.copy()
    used[believed] = consistent(linear, config)
    return replace(first, step_used=used)
