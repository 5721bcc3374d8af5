"""The paper's relation, its counterpart for craters, and their errors."""

from __future__ import annotations

import doctest

import numpy as np
import pytest
from numpy.testing import assert_allclose

import perception.shadows
from perception.shadows import (
    crater_depth,
    crater_sigma,
    hill_height,
    hill_sigma,
    thin_object_height,
)


def test_the_papers_worked_example_gives_seven_and_a_half_metres() -> None:
    assert float(hill_height(36.0, 60.0, 20.0)) == 7.5
    assert float(crater_depth(36.0, 60.0, 20.0)) == 12.0


def test_examples_in_the_docstrings_hold() -> None:
    assert doctest.testmod(perception.shadows).failed == 0


@pytest.mark.parametrize("x_graze, height", [(20.0, 1.0), (45.0, 3.0), (12.0, 5.0)])
def test_heights_are_exact_for_rays_drawn_by_hand(x_graze: float, height: float) -> None:
    """Ray over the grazing point to the floor, in ground coordinates; the formula in slant range."""
    sonar = 15.0
    x_end = x_graze * sonar / (sonar - height)
    start, end = np.hypot(x_graze, sonar - height), np.hypot(x_end, sonar)
    assert_allclose(hill_height(end - start, start, sonar), height)
    # The same ray ending on a floor 0.5 m higher or lower than the object's foot.
    for z_end in (0.5, -0.5):
        x_end = x_graze * (sonar - z_end) / (sonar - height)
        end = np.hypot(x_end, sonar - z_end)
        assert_allclose(hill_height(end - start, start, sonar, z_end), height)


def test_crater_depth_is_exact_at_the_shadows_end() -> None:
    sonar, rim, depth = 15.0, 20.0, 2.0
    x_end = rim * (sonar + depth) / sonar
    start, end = np.hypot(rim, sonar), np.hypot(x_end, sonar + depth)
    assert_allclose(crater_depth(end - start, start, sonar), depth)


def test_a_thin_pole_is_measured_from_its_foot() -> None:
    foot, height, sonar = 30.0, 4.0, 12.0
    end = foot * sonar / (sonar - height)
    assert_allclose(thin_object_height(foot, end, sonar), height)
    # The slant formula with the foot taken for the grazing point is biased low.
    slant_foot, slant_end = np.hypot(foot, sonar), np.hypot(end, sonar)
    assert float(hill_height(slant_end - slant_foot, slant_foot, sonar)) < height


@pytest.mark.parametrize("relation", ["hill", "crater"])
def test_claimed_sigma_is_the_spread_of_noisy_heights(relation: str) -> None:
    rng = np.random.default_rng(1)
    start, end, sonar = 30.0, 36.0, 12.0
    edge, altitude, floor = 0.08, 0.1, 0.15
    a = start + rng.normal(0, edge, 200_000)
    b = end + rng.normal(0, edge, 200_000)
    h = sonar + rng.normal(0, altitude, 200_000)
    if relation == "hill":
        z = rng.normal(0, floor, 200_000)
        spread = np.std(hill_height(b - a, a, h, z))
        claimed = hill_sigma(end - start, start, sonar, edge, altitude, floor)
    else:
        spread = np.std(crater_depth(b - a, a, h))
        claimed = crater_sigma(end - start, start, sonar, edge, altitude)
    # First-order propagation against 2e5 draws: 2 %.
    assert_allclose(claimed, spread, rtol=0.02)


def test_sensitivities_are_those_of_the_worked_example() -> None:
    """1.3 cm for 10 cm of one edge at the far end, 3.8 cm for 10 cm of altitude."""
    assert_allclose(hill_height(36.1, 60.0, 20.0) - 7.5, 0.013, atol=0.0005)
    assert_allclose(hill_height(36.0, 60.0, 20.1) - 7.5, 0.0375, atol=0.0005)
