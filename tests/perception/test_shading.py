"""Tracing echoes over a surface: what was planted in the power is read back as a ratio."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from perception import bands
from perception.facets import between
from perception.rays import Rays
from perception.shading import Rows, trace


def ray(side: int, east_m: float, power: np.ndarray) -> Rays:
    n = len(power)
    turn = np.pi / 2 if side else -np.pi / 2
    return Rays(
        np.full(n, east_m), 5.0 + np.arange(n), np.full(n, 10.0), np.full(n, turn), np.zeros(n),
        power.astype(np.float32), np.full(n, 0.1), side, side,
    )  # fmt: skip


def lambert(n: int, samples: int = 300) -> np.ndarray:
    """Return what a level floor 10 m below echoes by slant range, per metre: cos^2(incidence) r / g."""
    slant = (np.arange(samples) + 0.5) * 0.1
    ground = np.sqrt(np.maximum(slant**2 - 100.0, 0.0))
    power = np.where(ground > 0, (10.0 / slant) ** 2 * slant / np.maximum(ground, 1e-3), 0.0)
    return np.tile(power, (n, 1))


def traced(surface: np.ndarray, rays: list[Rays]) -> tuple[Rows, np.ndarray]:
    dark = [np.zeros(r.power.shape, np.bool_) for r in rays]
    return trace(surface, 0.0, 0.0, 1.0, rays, 2.0, dark)


def test_a_level_floor_echoes_as_predicted_and_a_gain_is_the_ratio() -> None:
    rows, passed = traced(np.zeros((33, 65)), [ray(1, 20.0, 4.0 * lambert(20))])
    beyond = rows.ground_m > 8.0
    assert beyond.sum() > 100
    # Power is four times what a floor of unit albedo returns.
    assert_allclose(np.median(rows.ratio[beyond]), np.log(4.0), atol=0.02)
    assert_allclose(rows.slope, 0.0, atol=1e-6)
    assert passed[10, 30] and not passed[10, 5]


def test_ground_behind_a_wall_is_passed_but_echoes_nothing() -> None:
    surface = np.zeros((33, 65))
    surface[:, 34:36] = 4.0
    rows, passed = traced(surface, [ray(1, 20.0, lambert(20))])
    lit = np.zeros(32 * 64, bool)
    lit[rows.cell] = True
    # The wall's top is 14.5 m away and 6 m below: its shadow reaches 24 m.
    assert not lit.reshape(32, 64)[10, 38:42].any()
    assert passed[10, 38:42].all()


def test_tracing_does_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    surface = np.cumsum(rng.normal(0, 0.05, (33, 65)), axis=1)
    rays = [ray(side, 30.0, lambert(20) * rng.gamma(4, 0.25, (20, 300))) for side in (0, 1, 0, 1)]
    answers = []
    for threads in (1, 3):
        monkeypatch.setattr(bands, "thread_count", lambda n=threads: n)
        bands._pool.cache_clear()
        answers.append(traced(surface, rays))
    bands._pool.cache_clear()
    (one, passed), (three, also) = answers
    assert np.array_equal(passed, also)
    for name in ("cell", "c_east", "c_level", "ratio", "look"):
        assert np.array_equal(getattr(one, name), getattr(three, name))


def test_a_running_sum_is_read_up_to_its_last_place_and_not_beyond() -> None:
    """A range just short of the swath's end, over the width of a sample, may round to the number of samples."""
    stored = np.array([0.0, 1.0, 3.0, 6.0, 10.0, np.nan])
    running = stored[:5]
    assert between(running, 2.5, 4.0) == 5.5
    assert between(running, 3.0, 4.0) == 4.0
