"""Risk arithmetic against simulation and the textbook's figures."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from perception.records import InputError
from planning.risk import clearance_factor, clearance_sigma, patches_crossed


def test_k_keeps_the_stated_share_of_simulated_routes():
    rng = np.random.default_rng(0)
    k = clearance_factor(0.05, 40)
    broken = (rng.normal(size=(20_000, 40)).max(axis=1) > k).mean()
    assert_allclose(broken, 0.05, atol=3 * np.sqrt(0.05 * 0.95 / 20_000))


def test_k_is_3_72_for_one_in_a_hundred_over_a_hundred_patches():
    assert_allclose(clearance_factor(0.01, 100), 3.72, atol=0.005)
    assert clearance_factor(0.01, 1000) > clearance_factor(0.01, 100) > clearance_factor(0.1, 100)
    assert patches_crossed(30.0, 50.0) == 1.0
    with pytest.raises(InputError, match="between 0 and 1, got 2"):
        clearance_factor(2.0, 10)


def test_position_errors_count_by_the_slope():
    east = np.tile(np.arange(5.0) * 0.5, (5, 1))
    sigma = clearance_sigma(east, (1.0, 1.0), np.full((5, 5), 0.3), 0.8, 0.0)
    assert_allclose(sigma, np.hypot(0.3, 0.4))
    assert clearance_sigma(east, (1.0, 1.0), None, 0.0, 0.0) is None
    assert clearance_sigma(east, (1.0, 1.0), np.full((5, 5), np.nan), 0.0, 0.0) is None
