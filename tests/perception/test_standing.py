"""Objects told from the floor's own relief, and shadows that run out of the swath."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from perception.contours import Roughness
from perception.objects import write_objects_csv
from perception.records import FloatArray
from perception.standing import object_odds, probabilities
from perception.strips import build_strip
from tests.perception.echo_fixtures import Height, Survey, box, gaussian, make_swath


def _relief(rms_m: float, seed: int) -> Height:
    """Return rough ground: waves of random direction, as steep at every length from 2 to 40 m."""
    rng = np.random.default_rng(seed)
    length = np.geomspace(2, 40, 60)
    azimuth, phase = rng.uniform(0, 2 * np.pi, (2, 60))
    amplitude = length / np.sqrt(np.mean(length**2) / 2 * 60) * rms_m

    def height(x: FloatArray, y: FloatArray) -> FloatArray:
        wave = 2 * np.pi / length
        along = (
            np.cos(azimuth) * np.asarray(x)[..., None] + np.sin(azimuth) * np.asarray(y)[..., None]
        )
        return (amplitude * np.sin(wave * along + phase)).sum(axis=-1)  # type: ignore[no-any-return]

    return height


SURVEY = Survey(n_pings=200, n_samples=600)


def test_relief_alone_lists_hardly_an_object() -> None:
    listed = [
        len(
            build_strip(make_swath(_relief(0.5, seed), SURVEY, np.random.default_rng(seed))).objects
        )
        for seed in range(3)
    ]
    assert sum(listed) <= 2


def test_a_boulder_on_relief_is_still_found() -> None:
    ground, block = _relief(0.25, 4), box(1.5, 17, 25, 0.8, 0.8)
    swath = make_swath(lambda x, y: ground(x, y) + block(x, y), SURVEY, np.random.default_rng(1))
    table = build_strip(swath).objects
    gap = np.hypot(table.across_m - 17, table.along_m - 25)
    found = int(np.argmin(gap))
    assert gap[found] < 1.5 and table.kind[found] == "hill"
    assert abs(table.height_m[found] - 1.5) < 3 * table.sigma_m[found]


def test_odds_rise_with_height_darkness_and_highlight_and_fall_with_roughness() -> None:
    rough, smooth = Roughness(0.01, 1.5), Roughness(0.0004, 1.5)
    usual = object_odds(1.0, 1.5, 0.05, 5.0, rough)
    assert object_odds(1.5, 1.5, 0.05, 5.0, rough) > usual
    assert object_odds(1.0, 1.5, 0.03, 5.0, rough) > usual
    assert object_odds(1.0, 3.0, 0.05, 5.0, rough) < usual
    assert object_odds(1.0, 1.5, 0.05, 1.0, rough) < usual
    # A crater's highlight comes after its shadow and speaks for it as much.
    assert object_odds(1.0, 1.5, 0.05, -5.0, rough) == usual
    assert object_odds(1.0, 1.5, 0.05, 5.0, smooth) > 99
    assert object_odds(1.0, 1.5, 0.05, 5.0, None) > 1e5


def test_doubtful_shadows_are_likelier_objects_among_sure_ones_than_among_doubtful_ones() -> None:
    doubtful, sure = np.full(20, 0.7), np.full(20, 50.0)
    alone = probabilities(doubtful)
    among = probabilities(np.concatenate([doubtful[:1], sure]))
    assert alone.max() < 0.35 and among[0] > 0.6
    # One shadow alone is judged as itself, nearly.
    assert abs(probabilities(np.array([1.0]))[0] - 0.5) < 1e-6
    assert len(probabilities(np.array([]))) == 0


def test_the_share_of_objects_is_found_again() -> None:
    """Odds drawn from the two populations that they tell apart: their probabilities come true."""
    rng = np.random.default_rng(5)
    true = rng.uniform(size=4000) < 0.2
    evidence = rng.normal(np.where(true, 1.0, -1.0), np.sqrt(2.0))
    told = probabilities(np.exp(evidence))
    assert abs(told.mean() - 0.2) < 0.03
    sure = told > 0.6
    assert abs(true[sure].mean() - told[sure].mean()) < 0.06


def test_a_shadow_that_leaves_the_swath_gives_a_least_height(tmp_path: Path) -> None:
    # Sonar 10 m up, a hill of 4 m at 26 m: its shadow ends at 43 m, the swath at 34.6 m.
    swath = make_swath(gaussian(4.0, 26, 25, 1.5), SURVEY, np.random.default_rng(2))
    table = build_strip(swath).objects
    row = int(np.argmax(table.shadow_length_m))
    assert table.lower_bound[row] and table.kind[row] == "hill"
    assert 2.0 < table.height_m[row] < 4.2
    assert abs(table.height_m[row] - 4.0) < 2 * table.sigma_m[row]
    write_objects_csv(tmp_path / "objects.csv", table)
    written = list(csv.DictReader((tmp_path / "objects.csv").open()))[row]
    assert written["bound"] == "lower"
