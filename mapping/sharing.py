"""Whether the passes share one compass and log error: decided by what the survey itself says.

A dive's course and speed errors may be one constant of the instruments or may change from pass to pass. Taken for one
constant they are known far better; taken so wrongly they bend the track. Both assumptions predict the same
data with some probability, and the more probable one is taken.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

from mapping.keyframes import KeyframeFix, Keyframes
from mapping.pose_graph import GraphConfig, HeightStep, Link, Solution, log_evidence, solve

logger = logging.getLogger(__name__)

# Each pass its own; mostly alike; one constant but for a tenth of its sigma.
_CORRELATIONS = (0.0, 0.8, 0.995)


def solve_shared(
    keyframes: Keyframes,
    links: Sequence[Link],
    fixes: Sequence[KeyframeFix],
    config: GraphConfig,
    steps: Sequence[HeightStep] = (),
) -> Solution:
    """Solve the graph under the correlation between passes that has the greatest evidence.

    All are weighed over the same registrations and fixes, those that the first assumption finds consistent.
    """
    first = solve(keyframes, links, fixes, config, steps=steps)
    if len(keyframes.starts) < 3:
        return first
    used_links = [x for x, ok in zip(links, first.link_used, strict=True) if ok]
    used_fixes = [x for x, ok in zip(fixes, first.fix_used, strict=True) if ok]
    used_steps = [x for x, ok in zip(steps, first.step_used, strict=True) if ok]
    best, most = config.shared, float("-inf")
    for shared in _CORRELATIONS:
        tried = replace(config, shared=shared)
        found = log_evidence(keyframes, used_links, used_fixes, tried, used_steps)
        logger.info("pass errors correlated by %.3f: log evidence %.2f", shared, found)
        if found > most:
            best, most = shared, found
    if best == config.shared:
        return first
    return solve(keyframes, links, fixes, replace(config, shared=best), steps=steps)
