"""The near end is found whatever the recorder did to the levels; a mirrored row turns the answer."""

from __future__ import annotations

import numpy as np
import pytest

from perception.readers.orientation import first_return_fractions, near_end_evidence

SAMPLES, RANGE_M = 1024, 50.0
RANGES_M = (np.arange(SAMPLES) + 0.5) * RANGE_M / SAMPLES
UNKNOWN = np.full(60, np.nan)


def pings(kind: str, share: float, n: int = 60) -> list[np.ndarray]:
    """Pings over a floor that rolls by 10 %, each with one object and its shadow."""
    rng = np.random.default_rng(7)
    return [ping(kind, RANGE_M * share * (1 + 0.1 * np.sin(i / 10)), rng) for i in range(n)]


def ping(kind: str, altitude_m: float, rng: np.random.Generator) -> np.ndarray:
    r = RANGES_M
    floor = np.sqrt(np.minimum(altitude_m / r, 1.0)) * (r > altitude_m)
    if kind in ("untuned", "noiseless"):
        floor = floor / r**2 * 10 ** (-0.05 * r / 20)
    level = floor * np.sqrt(rng.exponential(1.0, SAMPLES))
    at, length = rng.uniform(altitude_m * 1.3, RANGE_M), rng.uniform(1, 8)
    level[(r > at) & (r < at + length)] *= 0.02
    level[(r > at - 1) & (r < at)] *= 4
    noise = {"untuned": 1e-3, "noiseless": 0.0}.get(kind, 0.01) * level.max()
    noise = noise * np.sqrt(rng.exponential(1.0, SAMPLES))
    if kind == "loud far noise":
        noise = noise * 20 * (RANGES_M / RANGE_M) ** 3
    level = level + noise
    if kind != "noiseless":
        level[:8] = 2 * level.max()
    if kind == "padded":
        level[-150:] = 0
    if kind == "decibels":
        level = np.clip(20 * np.log10(level + 1e-4) + 80, 0, 255)
    return level


@pytest.mark.parametrize("share", [0.03, 0.1, 0.3, 0.6])
@pytest.mark.parametrize(
    "kind", ["untuned", "noiseless", "tuned", "loud far noise", "padded", "decibels"]
)
def test_the_near_end_is_known_from_the_echoes_alone(kind, share):
    rows = pings(kind, share)
    assert near_end_evidence(rows, UNKNOWN) > 0
    assert near_end_evidence([row[::-1] for row in rows], UNKNOWN) < 0


def test_rows_without_a_water_column_decide_nothing():
    rng = np.random.default_rng(1)
    rows = [np.sqrt(rng.exponential(1.0, SAMPLES)) for _ in range(60)]
    assert near_end_evidence(rows, UNKNOWN) == 0
    assert near_end_evidence([np.zeros(SAMPLES)] * 9, UNKNOWN[:9]) == 0
    assert near_end_evidence([], []) == 0


def test_scale_does_not_matter():
    rows = pings("tuned", 0.2)
    assert near_end_evidence(rows, UNKNOWN) == near_end_evidence([1e6 * r for r in rows], UNKNOWN)


def test_first_returns_lie_at_the_bottom():
    shares = 0.2 * (1 + 0.1 * np.sin(np.arange(60) / 10))
    found = first_return_fractions(pings("tuned", 0.2))
    # Blocks of 1/128 of the row, speckle puts the step one or two of them outward.
    assert np.nanmedian(abs(found - shares)) < 2 / 128
