"""Surfaces of known curvature through the whole chain, turned, edges and corners included."""

import numpy as np
import pytest

from perception.records import Grid
from perception.region_detail import curvature_at
from scenarios.benchmarks.region_terrains import EXACT, of_formula, turned


@pytest.mark.parametrize("azimuth_deg", [0.0, 17.0, 45.0])
@pytest.mark.parametrize("name", list(EXACT))
def test_without_noise_the_curvature_is_within_half_a_percent(name, azimuth_deg):
    truth = of_formula(101, turned(EXACT[name], np.radians(azimuth_deg)), None)
    found = curvature_at(Grid(truth["z"], 0.0, 101.0, 1.0), None, 0.0, "difference")
    size = max(np.abs(truth["H"]).max(), np.sqrt(np.abs(truth["K"]).max()))
    size = size if size > 1e-7 else 1.0  # a plane has no size of its own
    inner = np.s_[2:-2, 2:-2]
    assert np.abs(found.H - truth["H"])[inner].max() < 0.005 * size
    assert np.abs(found.K - truth["K"])[inner].max() < 0.005 * size**2
