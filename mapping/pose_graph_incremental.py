"""The pose graph pass by pass in iSAM2: each new pass adds its factors, and only what they touch is solved anew."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gtsam as typed_gtsam
import numpy as np

from mapping.keyframes import KeyframeFix, Keyframes
from mapping.pose_graph import (
    GraphConfig,
    HeightStep,
    Link,
    Solution,
    add_fix,
    add_link,
    add_odometry,
    add_passes,
    add_step,
    solution_of,
)
from perception.records import BoolArray

gtsam: Any = typed_gtsam


class IncrementalGraph:
    """A survey's graph that grows; its answer is that of `pose_graph.solve` on the same factors.

    Parameters
    ----------
    absolute : whether fixes are to come, which then decide where the survey lies
        (`GraphConfig.start_with_fixes_m`).
    """

    def __init__(self, config: GraphConfig, absolute: bool) -> None:
        parameters = gtsam.ISAM2Params()
        # The same as in the batch: Cholesky squares the condition number.
        parameters.setFactorization("QR")
        parameters.relinearizeSkip = 1
        self._isam = gtsam.ISAM2(parameters)
        self._config, self._absolute = config, absolute
        self._keyframes: Keyframes | None = None
        self._links: list[Link] = []
        # Factor of each link, fix and step, in the order they were added; None taken out again.
        self._link_factor: list[int | None] = []
        self._fix_factor: list[int | None] = []
        self._step_factor: list[int | None] = []
        self._first_error = 0.0

    @property
    def links(self) -> tuple[Link, ...]:
        """Every registration ever added, in order; `Solution.link_used` says which are still in."""
        return tuple(self._links)

    def add_pass(self, keyframes: Keyframes, fixes: Sequence[KeyframeFix] = ()) -> None:
        """Add the last pass of `keyframes`, those of all passes so far, and fixes of it."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        number = len(keyframes.starts) - 2
        add_passes(graph, values, keyframes, self._config, number)
        first = int(keyframes.starts[number])
        add_odometry(graph, values, keyframes, self._config, self._absolute, first)
        before = graph.size()
        for fix in fixes:
            add_fix(graph, fix)
        new = self._isam.update(graph, values).getNewFactorsIndices()
        self._fix_factor += [int(i) for i in list(new)[before:]]
        self._keyframes = keyframes

    def add_links(self, links: Sequence[Link], steps: Sequence[HeightStep] = ()) -> None:
        """Add registrations and height steps between passes that are there."""
        if self._keyframes is None:
            raise ValueError("add a pass before its registrations")
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        places = []
        for link in links:
            number = len(self._links)
            self._links.append(link)
            places.append(add_link(graph, values, self._keyframes, link, number))
        after = graph.size()
        for step in steps:
            add_step(graph, step)
        new = list(self._isam.update(graph, values).getNewFactorsIndices())
        self._link_factor += [int(new[place]) for place in places]
        self._step_factor += [int(i) for i in new[after:]]

    def take_out(self, link: Sequence[int] = (), fix: Sequence[int] = ()) -> None:
        """Take links and fixes out again, by their number in the order they were added."""
        gone = []
        for chosen, factors in ((link, self._link_factor), (fix, self._fix_factor)):
            for number in chosen:
                factor = factors[number]
                if factor is not None:
                    gone.append(factor)
                factors[number] = None
        if gone:
            removed = gtsam.KeyVector(gone) if hasattr(gtsam, "KeyVector") else gone
            self._isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), removed)

    def solution(self) -> Solution:
        """Return the present answer, with marginal covariances."""
        if self._keyframes is None:
            raise ValueError("a graph without a pass has no solution")
        isam = self._isam
        estimate = isam.calculateBestEstimate()
        factors = isam.getFactorsUnsafe()
        error = sum(
            factors.at(i).error(estimate) for i in range(factors.size()) if factors.exists(i)
        )

        def used(factor: Sequence[int | None]) -> BoolArray:
            return np.array([f is not None for f in factor], bool)

        return solution_of(
            self._keyframes,
            estimate.atVector,
            isam.marginalCovariance,
            self._config,
            link_used=used(self._link_factor),
            fix_used=used(self._fix_factor),
            step_used=used(self._step_factor),
            error_before=float(error),
            error_after=float(error),
        )
