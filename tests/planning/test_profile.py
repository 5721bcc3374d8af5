"""The best depth profile against what a general optimiser finds, and its limits."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
from scipy.optimize import linprog, minimize

from planning.profile import bridge_troughs, cone_envelope


def _cones(s, lower, up, down):
    z = np.empty(len(s))
    cone_envelope(s, lower, len(s), up, down, z)
    return z


def test_cones_give_the_lowest_profile_that_a_linear_programme_finds():
    rng = np.random.default_rng(1)
    s = np.cumsum(rng.uniform(0.5, 1.5, 60))
    lower = np.cumsum(rng.normal(size=60)) * 1.2
    up, down = 0.5, 0.8
    n = len(s)
    steps = np.diff(s)
    rise = np.zeros((n - 1, n))
    rise[np.arange(n - 1), np.arange(n - 1)] = -1
    rise[np.arange(n - 1), np.arange(1, n)] = 1
    answer = linprog(
        np.ones(n),
        A_ub=np.vstack([rise, -rise]),
        b_ub=np.concatenate([up * steps, down * steps]),
        bounds=[(value, None) for value in lower],
    )
    assert_allclose(_cones(s, lower, up, down), answer.x, atol=1e-7)


def test_bridging_a_trough_reaches_the_optimum_of_the_true_cost():
    s = np.linspace(0.0, 30.0, 61)
    ground = 4.0 * np.abs(s - 15.0) / 15.0
    a = 0.1

    def cost(z: np.ndarray) -> float:
        rate = 1.0 + 0.5 * a * (z[1:] + z[:-1] - ground[1:] - ground[:-1])
        return float((rate * np.hypot(np.diff(s), np.diff(z))).sum())

    z = ground.copy()
    bridge_troughs(s, z, np.full(61, 99.0), 61, a, np.empty(61, np.int64))
    best = minimize(
        cost, z, bounds=[(g, None) for g in ground], method="L-BFGS-B",
        options={"maxiter": 500, "maxfun": 200_000},
    )  # fmt: skip
    assert cost(z) < cost(ground)
    # The closed form leaves out (1 + z'^2) in the bend: good to a few parts in ten thousand.
    assert cost(z) <= best.fun * 1.0005


def test_bridges_keep_slopes_and_stay_below_the_ceiling():
    rng = np.random.default_rng(2)
    s = np.arange(200.0)
    lower = np.cumsum(rng.normal(size=200))
    z = _cones(s, lower, 0.5, 0.5)
    low = z.copy()
    bridge_troughs(s, z, low + 2.0, 200, 0.1, np.empty(200, np.int64))
    assert (z >= low - 1e-12).all() and (z <= low + 2.0 + 1e-12).all() and (z > low + 0.1).any()
    assert np.abs(np.diff(z)).max() <= 0.5 + 1e-9


def test_an_unbent_cost_leaves_the_profile_alone():
    z = np.array([0.0, -3.0, 0.0])
    bridge_troughs(np.arange(3.0), z, np.full(3, 9.0), 3, 0.0, np.empty(3, np.int64))
    assert_allclose(z, [0.0, -3.0, 0.0])
