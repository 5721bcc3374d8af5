"""Objects and craters: planted heights, kinds and places asked back from pings with one look."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from perception.fitting import Patch, Starts, fit_patch
from perception.objects import ObjectTable, write_objects_csv
from perception.silhouette_likelihood import HIGHLIGHT_CAP
from perception.silhouettes import Form, Scene, predict
from perception.strips import build_strip
from tests.perception.echo_fixtures import (
    Height,
    Survey,
    boulder,
    box,
    cylinder,
    echo_power,
    flat,
    gaussian,
    make_swath,
)

SURVEY = Survey(n_pings=160, n_samples=600)


def _found(height: Height, seed: int = 0, survey: Survey = SURVEY) -> ObjectTable:
    return build_strip(make_swath(height, survey, np.random.default_rng(seed))).objects


@pytest.mark.parametrize(
    "name, height, kind, truth, x, tolerance",
    [
        # Tolerances: 2.5 of the claimed sigma of such an object at one look; the height is the median of three.
        ("smooth hill", gaussian(1.3, 15, 20, 1.1), "hill", 1.3, 15.0, 0.15),
        ("half sphere", boulder(1.0, -16, 20), "hill", 1.0, -16.0, 0.12),
        ("box", box(1.0, 18, 20, 1.0, 1.2), "hill", 1.0, 18.0, 0.15),
        ("pole-like cylinder", cylinder(1.2, 17, 20, 0.7), "hill", 1.2, 17.0, 0.15),
        ("smooth crater", gaussian(-2.0, -18, 20, 1.6), "crater", 2.0, -18.0, 0.15),
        ("steep pit", cylinder(-1.2, 17, 20, 2.2), "crater", 1.2, 17.0, 0.2),
    ],
)
def test_height_kind_and_place_come_back(
    name: str, height: Height, kind: str, truth: float, x: float, tolerance: float
) -> None:
    looks = [_found(height, seed) for seed in range(3)]
    table = looks[0]
    assert len(table) == 1, f"{name}: {len(table)} objects"
    assert all(look.kind == (kind,) for look in looks)
    assert abs(np.median([look.height_m[0] for look in looks]) / truth - 1) < tolerance
    assert abs(table.across_m[0] - x) < 1.0 and abs(table.along_m[0] - 20) < 0.5
    # The survey runs north from (1000, 5000): starboard is east.
    assert abs(table.easting_m[0] - (1000 + x)) < 1.0
    assert abs(table.northing_m[0] - 5020) < 0.5
    assert abs(int(table.ping[0]) - 80) <= 3


def test_a_flat_floor_has_no_objects() -> None:
    for seed in range(3):
        assert len(_found(flat, seed)) == 0


def test_heights_scale_with_the_world() -> None:
    """Doubling altitude, ranges and object doubles the height."""
    small = _found(gaussian(1.2, 14, 20, 1.0))
    large = _found(
        gaussian(2.4, 28, 40, 2.0),
        survey=Survey(
            n_pings=160, n_samples=600, altitude_m=20, sample_m=0.12, spacing_m=0.5,
            gain_slope_db_per_m=0.05,
        ),
    )  # fmt: skip
    assert large.height_m[0] == pytest.approx(2 * small.height_m[0], rel=0.1)


@pytest.mark.slow
def test_forty_objects_meet_the_reach_and_their_sigma() -> None:
    rng = np.random.default_rng(11)
    errors, scores, kinds = [], [], []
    for seed in range(10):
        items = []
        for place, side in ((8.0, -1), (8.0, 1), (30.0, -1), (30.0, 1)):
            x, size = side * rng.uniform(12, 20), rng.uniform(0.8, 1.5)
            shape = rng.choice(["hill", "boulder", "box", "crater"])
            make = {
                "hill": gaussian(size, x, place, size * rng.uniform(0.7, 1.0)),
                "boulder": boulder(size, x, place),
                "box": box(size, x, place, size * 0.8, size),
                "crater": gaussian(-1.4 * size, x, place, 1.4 * size * rng.uniform(0.75, 1.0)),
            }[str(shape)]
            items.append((x, place, 1.4 * size if shape == "crater" else size, shape, make))

        def ground(a: np.ndarray, b: np.ndarray, items: list = items) -> np.ndarray:  # type: ignore[type-arg]
            return np.sum([item[4](a, b) for item in items], axis=0)

        table = _found(ground, seed)
        for x, place, size, shape, _ in items:
            near = np.hypot(table.across_m - x, table.along_m - place)
            best = int(np.argmin(near))
            assert near[best] < 2.5
            errors.append(table.height_m[best] / size - 1)
            scores.append((table.height_m[best] - size) / table.sigma_m[best])
            kinds.append((table.kind[best] == "crater") == (shape == "crater"))
    assert np.median(np.abs(errors)) <= 0.05
    assert np.percentile(np.abs(errors), 90) <= 0.15
    assert np.mean(kinds) >= 0.98
    # Forty objects: +-7 % of chance. These pings have no beam spread, for which sigma makes room.
    assert 0.5 < np.mean(np.abs(scores) < 1) < 0.9


def test_the_model_of_the_fit_agrees_with_independent_facets() -> None:
    """The fitted family against the tests' own ray geometry: same shadow, same highlight."""
    survey = Survey(n_samples=600, noise=0.0)
    hill = gaussian(1.5, 15, 0, 1.2)
    reference = echo_power(hill, 0.0, 10.0, 1, survey) / np.maximum(
        echo_power(flat, 0.0, 10.0, 1, survey), 1e-12
    )
    parameters = np.array([15, 0, np.log(1.5), np.log(1.2), np.log(1.2), 0.0, np.log(2.0)])
    model = predict(
        parameters, Form(1.0, 2.0, 0.0),
        Scene(np.array([10.0]), np.array([0.0]), 0.0, 0.06, 0.0, 0.03, np.zeros(1), 0.0), np.zeros((1, 600)),
    )[0]  # fmt: skip
    far = slice(200, 550)
    smooth = np.convolve(reference[far], np.ones(5) / 5, mode="same")
    model5 = np.convolve(model[far], np.ones(5) / 5, mode="same")
    difference = np.minimum(smooth, HIGHLIGHT_CAP) - np.minimum(model5, HIGHLIGHT_CAP)
    assert np.mean(np.abs(difference)) < 0.03
    # Shadow's length to two samples.
    assert abs(int((smooth < 0.2).sum()) - int((model5 < 0.2).sum())) <= 2


def _swinging(looked_rad: np.ndarray, told_rad: np.ndarray, rng: np.random.Generator) -> Patch:
    """A half sphere of 1.2 m, 30 m off, by pings 0.45 m apart that look where `looked_rad` says."""
    along = 0.45 * np.arange(24)
    shape = np.array([30.0, 5.0, np.log(1.2), np.log(1.1), np.log(1.1), np.log(0.5), np.log(2.0)])
    scene = Scene(np.full(24, 12.0), along, 29.0, 0.06, 0.02, 0.04, looked_rad, 0.004)
    echo = predict(shape, Form(1.0, 2.0, 2.0), scene, np.zeros((24, 110)))
    return Patch(echo * rng.exponential(size=echo.shape), along, scene.drop_m, 29.0, 0.06, 1.0, 0.02,
                 told_rad, 0.004)  # fmt: skip


def test_headings_that_swing_place_the_pings_and_a_bad_compass_is_not_believed() -> None:
    """A boat yaws by half a degree: 0.3 m at 30 m. Told, it helps; where it is noise, the echo says so."""
    rng = np.random.default_rng(8)
    parameters = np.array([
        [30.0 + 0.3 * size, 5.0 + beside, 0.1, np.log(size), np.log(size), np.log(beta), np.log(1.9), 0, 0, 0]
        for size in (0.4, 0.7, 1.0) for beside in (-0.3, 0.3) for beta in (1.0, 2.0, 5.0)
    ])  # fmt: skip
    starts = Starts(np.ones(len(parameters)), np.full(len(parameters), 2.0), parameters)
    errors: dict[str, list[float]] = {"told": [], "bad compass": []}
    for _ in range(4):
        yaw, none = rng.normal(0, np.deg2rad(0.5), 24), np.zeros(24)
        for case, looked, told in (("told", yaw, yaw), ("bad compass", none, yaw)):
            fit = fit_patch(_swinging(looked, told, rng), starts)
            assert fit is not None
            errors[case].append(fit.height_m / 1.2 - 1)
    for case, error in errors.items():
        assert np.median(np.abs(error)) < 0.1, case


def test_objects_csv_has_the_columns_of_the_contract(tmp_path: Path) -> None:
    table = _found(box(1.0, 18, 20, 1.0, 1.2))
    write_objects_csv(tmp_path / "objects.csv", table)
    rows = list(csv.DictReader((tmp_path / "objects.csv").open()))
    assert list(rows[0]) == [
        "easting_m", "northing_m", "kind", "height_m", "sigma_m", "slant_range_m",
        "shadow_length_m", "pass", "ping", "probability", "bound",
    ]  # fmt: skip
    assert float(rows[0]["height_m"]) == pytest.approx(float(table.height_m[0]), abs=0.001)
    write_objects_csv(tmp_path / "none.csv", ObjectTable.of([]))
    assert (tmp_path / "none.csv").read_text().count("\n") == 1
    assert len(ObjectTable.joined([table, ObjectTable.of([]), table])) == 2 * len(table)
