"""The pose graph pass by pass in iSAM2: passes and registrations come and go, and only what they touch is solved anew."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence
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
    add_starts,
    add_step,
    solution_of,
)

gtsam: Any = typed_gtsam


class IncrementalGraph:
    """A survey's graph that grows; its answer is that of `pose_graph_solve.solve` on the same factors.

    Parameters
    ----------
    absolute : whether fixes are to come, which then decide where the survey lies
        (`GraphConfig.start_with_fixes_m`).
    """

    def __init__(self, config: GraphConfig, absolute: bool) -> None:
        parameters = gtsam.ISAM2Params()
        # Cholesky squares the condition number.
        parameters.setFactorization("QR")
        parameters.relinearizeSkip = 1
        self._isam = gtsam.ISAM2(parameters)
        self._config, self._absolute = config, absolute
        self._keyframes: Keyframes | None = None
        # Indices of the factors of each registration, fix and step that is in.
        self._held: dict[Hashable, list[int]] = {}
        self._numbers = 0
        self._sizes = (0, 0, 0)

    def goes_on(self, keyframes: Keyframes, config: GraphConfig, absolute: bool) -> bool:
        """Return whether the graph can grow to these keyframes; where other things are assumed it begins anew."""
        known = self._keyframes
        same = known is None or (len(known) <= len(keyframes) and known.cut_alike(keyframes))
        return same and config == self._config and absolute == self._absolute

    def add_passes(self, keyframes: Keyframes) -> None:
        """Add the passes of `keyframes`, those of all passes so far, that are not there yet."""
        known = self._keyframes
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        add_passes(
            graph, values, keyframes, self._config, 0 if known is None else len(known.starts) - 1
        )
        first = 0 if known is None else len(known)
        add_starts(graph, values, keyframes, self._config, self._absolute, first)
        add_odometry(graph, keyframes, self._config, first)
        if graph.size():
            self._isam.update(graph, values)
        self._keyframes = keyframes

    def hold(
        self,
        links: Sequence[Link] = (),
        fixes: Sequence[KeyframeFix] = (),
        steps: Sequence[HeightStep] = (),
    ) -> None:
        """Make the graph hold these registrations, fixes and height steps, and no others; what stays is left alone."""
        if self._keyframes is None:
            raise ValueError("add a pass before its registrations")
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        factors: list[Link | KeyframeFix | HeightStep] = [*links, *fixes, *steps]
        wanted = _names(factors)
        places: dict[Hashable, range] = {}
        for name, factor in zip(wanted, factors, strict=True):
            if name in self._held:
                continue
            before = int(graph.size())
            if isinstance(factor, Link):
                add_link(graph, values, self._keyframes, factor, self._numbers)
                self._numbers += 1
            elif isinstance(factor, HeightStep):
                add_step(graph, factor)
            else:
                add_fix(graph, factor)
            places[name] = range(before, int(graph.size()))
        kept = set(wanted)
        gone = [name for name in self._held if name not in kept]
        removed = [index for name in gone for index in self._held.pop(name)]
        if removed or graph.size():
            # A registration goes with the patches of ground that it brought, which nothing else holds.
            new = list(self._isam.update(graph, values, removed).getNewFactorsIndices())
            self._held |= {name: [int(new[i]) for i in where] for name, where in places.items()}
        self._sizes = len(links), len(fixes), len(steps)

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
        links, fixes, steps = (np.ones(size, bool) for size in self._sizes)
        return solution_of(
            self._keyframes,
            lambda keys: np.array([estimate.atVector(key) for key in keys]),
            lambda keys: np.array([isam.marginalCovariance(key) for key in keys]),
            self._config,
            link_used=links,
            fix_used=fixes,
            step_used=steps,
            error_before=float(error),
            error_after=float(error),
        )


def _names(factors: Sequence[Link | KeyframeFix | HeightStep]) -> list[Hashable]:
    """Return what tells each factor from every other: what it says, and how often that was said before."""
    said: Counter[Hashable] = Counter()
    names: list[Hashable] = []
    for factor in factors:
        content = _content(factor)
        names.append((content, said[content]))
        said[content] += 1
    return names


def _content(factor: Link | KeyframeFix | HeightStep) -> Hashable:
    if isinstance(factor, HeightStep):
        return factor
    if isinstance(factor, KeyframeFix):
        return factor.keyframe, factor.correction_m.tobytes(), factor.covariance_m2.tobytes()
    ends = np.concatenate([factor.first_offset_m, factor.second_offset_m, factor.shift_m])
    return (
        factor.first, factor.second, ends.tobytes(), factor.covariance_m2.tobytes(),
        factor.first_blend, factor.second_blend,
    )  # fmt: skip
