"""The climb below a cell finds the true shift whatever the weights of the two passes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mapping.correlation import refine


@pytest.mark.parametrize("sharp", [True, False])
def test_weights_that_fall_off_away_from_either_track_draw_no_match_along(sharp: bool) -> None:
    """One ground seen twice lies where it lies, though one weight rises where the other falls."""
    rng = np.random.default_rng(1)
    ground = gaussian_filter(rng.normal(size=(64, 64)), 2.0).astype(np.float32)
    rising = np.linspace(0.2, 1.0, 64, dtype=np.float32)
    if sharp:
        # A rim: half a cell's data, then nothing.
        rising = np.concatenate([np.zeros(15), [0.5], np.ones(48)]).astype(np.float32)
    first, second = np.tile(rising, (64, 1)), np.tile(rising[::-1], (64, 1))
    fields = {"echo": (ground, first, ground, second)}
    offset, covariance, _ = refine(fields, {"echo": 1.0}, np.zeros(2), 48)
    assert covariance is not None
    np.testing.assert_allclose(offset, 0.0, atol=1e-5)
