"""Filling: holes of known truth, sigma that holds and grows, nothing beyond reach or outline, tiles alike."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator
from scipy.ndimage import distance_transform_edt, gaussian_filter

from mapping.fill import SEARCH, fill_gaps, fill_map, learn_variogram
from perception.records import FloatArray, Grid, InputError
from tests.mapping.worlds import fractal


def a_floor(kind: str, rng: np.random.Generator, size: int = 160) -> FloatArray:
    if kind == "smooth":
        field = gaussian_filter(rng.normal(size=(size, size)), 12.0, mode="wrap")
        return -30.0 + field / field.std()
    return -30.0 + fractal(rng, size, 1.0, {"rough": 1.5, "middling": 2.0}[kind])


def holed(height: FloatArray, rng: np.random.Generator, holes: int = 16) -> FloatArray:
    """Cut round holes and slanting gaps between swaths."""
    size = len(height)
    rows, cols = np.indices(height.shape)
    known = height.copy()
    for _ in range(holes):
        r, c = rng.uniform(10, size - 10, 2)
        known[np.hypot(rows - r, cols - c) < rng.uniform(2, 10)] = np.nan
    known[np.abs(rows - 0.3 * cols - 60) < 8] = np.nan
    return known


@pytest.mark.parametrize(
    ("kind", "noise_m"), [("rough", 0.0), ("rough", 0.1), ("middling", 0.0), ("smooth", 0.1)]
)
def test_sigma_of_filled_cells_holds(kind: str, noise_m: float) -> None:
    """Shares of errors within one and two sigma are a normal's, roughly; data's errors are broad, as passes' are."""
    ratios, errors, plain = [], [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        truth = a_floor(kind, rng)
        broad = gaussian_filter(rng.normal(size=truth.shape), 12.0, mode="wrap")
        known = holed(truth + noise_m * broad / broad.std(), rng)
        sigma = np.where(np.isfinite(known), max(noise_m, 1e-3), np.nan)
        grid, filled = fill_map(Grid(known, 0.0, 80.0, 0.5, "", sigma, np.ones_like(known)), 5.0)
        assert filled.sum() > 1000
        error = (grid.elevation_m - truth)[filled]
        ratios.append(error / grid.sigma_m[filled])
        errors.append(error)
        plain.append((np.nanmean(known) - truth)[filled])
        np.testing.assert_array_equal(grid.count[filled], 0.0)
        np.testing.assert_array_equal(grid.elevation_m[~filled], known[~filled])
    ratio = np.abs(np.concatenate(ratios))
    assert 0.55 < (ratio < 1).mean() < 0.85, (ratio < 1).mean()
    assert 0.90 < (ratio < 2).mean() < 0.995, (ratio < 2).mean()
    assert np.std(np.concatenate(errors)) < 0.6 * np.std(np.concatenate(plain))


def test_sigma_grows_with_the_distance_from_data() -> None:
    rng = np.random.default_rng(7)
    known = holed(a_floor("middling", rng), rng)
    sigma = np.where(np.isfinite(known), 0.05, np.nan)
    grid, filled = fill_map(Grid(known, 0.0, 80.0, 0.5, "", sigma), 6.0)
    away = distance_transform_edt(~np.isfinite(known)) * 0.5
    means = [grid.sigma_m[filled & (away > a) & (away <= a + 1)].mean() for a in range(4)]
    assert means[0] > 0.05 and all(b > a for a, b in itertools.pairwise(means))


def test_heights_are_those_of_an_independent_interpolation() -> None:
    """Exponent 1 is the linear radial basis function; scipy's takes all data, ours the nearest in each direction."""
    rng = np.random.default_rng(1)
    truth = a_floor("rough", rng, 64)
    known = truth.copy()
    known[28:36, 25:40] = np.nan
    height, _ = fill_gaps(
        known, np.full_like(known, 0.05), 1.0, 10.0, replace_exponent(known, exponent=1.0)
    )
    rows, cols = np.nonzero(np.isfinite(known))
    near = (np.abs(rows - 32) < 20) & (np.abs(cols - 32) < 20)
    peer = RBFInterpolator(
        np.column_stack([rows, cols])[near], known[rows, cols][near], kernel="linear"
    )
    gap = np.argwhere(np.isnan(known))
    theirs, ours = peer(gap), height[tuple(gap.T)]
    error = truth[tuple(gap.T)]
    assert np.std(ours - theirs) < 0.35 * np.std(theirs - error)
    assert np.std(ours - error) < 1.15 * np.std(theirs - error)


def replace_exponent(known: FloatArray, exponent: float):  # type: ignore[no-untyped-def]
    from dataclasses import replace

    return replace(learn_variogram([known], 1.0, 10.0), exponent=exponent, nugget_m2=0.0)


def test_nothing_is_filled_beyond_reach_or_outside_the_outline() -> None:
    known = np.full((80, 80), np.nan)
    known[20:60, 20:60] = -30.0 + np.add.outer(0.1 * np.arange(40), 0.2 * np.arange(40))
    known[30:50, 30:50] = np.nan
    truth = -30.0 + np.add.outer(0.1 * np.arange(-20, 60), 0.2 * np.arange(-20, 60))
    sigma = np.where(np.isfinite(known), 0.1, np.nan)
    grid, filled = fill_map(Grid(known, 0.0, 80.0, 1.0, "", sigma), 5.0)
    assert not filled[:20].any() and not filled[:, 60:].any()
    away = distance_transform_edt(~np.isfinite(known))
    inside = np.zeros_like(filled)
    inside[30:50, 30:50] = True
    # Reach 5 m, data looked for up to 10: the gap's middle is too far, its rim is filled.
    assert not filled[inside & (away > 5)].any() and filled[inside & (away <= 4)].any()
    # A plane comes back as a plane.
    assert np.abs(grid.elevation_m - truth)[filled].max() < 0.1
    whole, _ = fill_map(Grid(known, 0.0, 80.0, 1.0, "", sigma), 12.0)
    assert np.isfinite(whole.elevation_m[30:50, 30:50]).all()


def test_a_window_with_its_rim_is_filled_as_the_whole_is() -> None:
    rng = np.random.default_rng(3)
    known = holed(a_floor("rough", rng), rng)
    sigma = np.where(np.isfinite(known), 0.1, np.nan)
    variogram = learn_variogram([known], 0.5, 4.0)
    whole = fill_gaps(known, sigma, 0.5, 4.0, variogram)
    rim = int(np.ceil(SEARCH * 4.0 / 0.5)) + 1
    outer, inner = np.s_[60 - rim : 110 + rim, 50 - rim : 100 + rim], np.s_[rim:-rim, rim:-rim]
    part = fill_gaps(known[outer], sigma[outer], 0.5, 4.0, variogram)
    for one, other in zip(whole, part, strict=True):
        np.testing.assert_allclose(other[inner], one[60:110, 50:100], rtol=1e-9)


def test_a_height_without_sigma_is_no_gap() -> None:
    rng = np.random.default_rng(4)
    known = holed(a_floor("middling", rng, 80), rng, holes=3)
    sigma = np.where(np.isfinite(known), 0.1, np.nan)
    unsure = np.isfinite(known) & (rng.random(known.shape) < 0.02)
    sigma[unsure] = np.nan
    grid, filled = fill_map(Grid(known, 0.0, 40.0, 0.5, "", sigma), 4.0)
    there = np.isfinite(known)
    assert unsure.any() and filled.any() and not filled[there].any()
    np.testing.assert_array_equal(grid.elevation_m[there], known[there])
    np.testing.assert_array_equal(grid.sigma_m[there], sigma[there])


def test_a_map_that_cannot_be_filled_is_refused() -> None:
    height = np.full((5, 5), np.nan)
    height[2, 2] = -30.0
    with pytest.raises(InputError, match="too few heights"):
        fill_map(Grid(height, 0.0, 5.0, 1.0, "", np.full((5, 5), 0.1)), 3.0)
    with pytest.raises(InputError, match="without sigma"):
        fill_map(Grid(np.zeros((5, 5)), 0.0, 5.0, 1.0), 3.0)
