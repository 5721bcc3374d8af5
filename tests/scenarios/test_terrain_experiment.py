"""Terrain matching as a task: known answers, refused keys, figures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from perception.records import InputError
from scenarios.benchmarks.navigation_bound import causal_bound
from scenarios.benchmarks.navigation_sets import SetConfig, make_set, surface_floor
from scenarios.plots_terrain import groups_of, plot_terrain
from scenarios.sweep import read_sweep
from scenarios.terrain_matching import SERIES, Track, experiment_of, scores, terrain_task

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "terrain-experiment.toml"


def test_the_example_of_the_docs_lays_out_its_grid() -> None:
    plan = read_sweep(EXAMPLE)
    assert plan.n_runs == 60
    for spec in plan.runs():
        experiment_of(spec.config, str(EXAMPLE))


@pytest.mark.parametrize(
    ("tree", "said"),
    [
        ({"filter": {"kind": "magic"}}, "filter.kind = 'magic'"),
        ({"ground": {"rms_slope_deg": -1.0}}, "ground.rms_slope_deg = -1.0"),
        ({"voyage": {"sonar": 1}}, "voyage.sonar"),
    ],
)
def test_a_wrong_key_is_named_with_its_value(tree: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        experiment_of(tree, "x.toml")


def test_a_run_is_scored_and_the_same_for_the_same_seed(tmp_path: Path) -> None:
    config = {
        "seed": 3,
        "ground": {"rms_slope_deg": 6.0, "extent_m": 1500.0},
        "voyage": {"duration_s": 240.0, "start_m": 20.0},
        "filter": {"kind": "particles", "particles": 500},
    }
    first, again = terrain_task(config, tmp_path), terrain_task(config, tmp_path)
    assert first == again
    assert first["false_fix"] == 0.0
    # Eighty pings over slopes of a tenth: metres, never better than the bound by much.
    assert 0.3 * first["bound_m"] < first["rms_m"] < 15.0
    assert len(json.loads(first["series_error_m"])) == SERIES


def test_scores_know_a_planted_error() -> None:
    drawn = make_set(SetConfig(extent_m=1000.0, duration_s=300.0), np.random.default_rng(0))
    n = len(drawn.truth_easting_m)
    truth = np.stack([drawn.truth_easting_m, drawn.truth_northing_m], axis=1)
    off = np.where(np.arange(n) < 70, 60.0, 3.0)
    place = truth + np.stack([off, np.zeros(n)], axis=1)
    status = ("searching",) * 50 + ("converged",) * (n - 50)
    told = scores(Track(place, np.tile(9.0 * np.eye(2), (n, 1, 1)), status), drawn, np.ones(n))
    assert told["converged_after_s"] == 150.0
    assert told["false_rows"] == 70.0
    assert told["cep50_m"] == pytest.approx(3.0)
    assert told["nees"] == pytest.approx((30 * 1.0 + 20 * 400.0) / 50)
    assert told["available"] == pytest.approx((n - 50) / n)
    assert told["lost"] == 0.0


def test_the_bound_of_a_plane_is_the_start_s_and_of_a_rough_floor_less() -> None:
    config = SetConfig(extent_m=1000.0, duration_s=300.0)
    flat = surface_floor(np.full((200, 200), 100.0), 5.0)
    drawn = make_set(config, np.random.default_rng(1), flat)
    bound = causal_bound(flat, config, drawn)
    assert bound[0] == pytest.approx(50.0 * np.sqrt(2), rel=1e-3)
    # Scale and heading error make dead reckoning grow.
    assert bound[-1] >= bound[0]
    x = 5.0 * np.arange(200)
    waves = 100 + 5 * np.sin(x / 31.4)[None, :] + 5 * np.cos(x / 47.7)[:, None]
    rough = surface_floor(waves, 5.0)
    fine = causal_bound(rough, config, make_set(config, np.random.default_rng(1), rough))
    # 400 soundings of 0.67 m on slopes of 0.11 give 0.3 m an axis; scale and heading, learnt on the
    # same way, some four times that.
    assert 0.4 < fine[-1] < 2.0


def _table(groups: int, runs: int) -> pa.Table:
    rng = np.random.default_rng(0)
    n = groups * runs
    series = [json.dumps(np.round(rng.exponential(5, SERIES), 3).tolist()) for _ in range(n)]
    time = json.dumps(np.linspace(0, 600, SERIES).tolist())
    columns: dict[str, Any] = {
        "status": ["done"] * n,
        "ground.rms_slope_deg": [float(1 + i // runs) for i in range(n)],
        "converged_after_s": [None if i % 3 == 0 else 10.0 * (i + 1) for i in range(n)],
        "series_time_s": [time] * n,
    }
    columns |= {f"series_{k}": series for k in ("error_m", "nees", "bound_m")}
    columns |= {k: rng.exponential(3, n) for k in ("cep50_m", "cep95_m", "bound_m")}
    columns |= {k: (rng.random(n) < 0.1).astype(float) for k in ("false_fix", "lost")}
    columns["available"] = rng.random(n)
    return pa.table(columns)


def test_groups_are_the_swept_values_and_every_figure_is_drawn(tmp_path: Path) -> None:
    table = _table(3, 4)
    groups = groups_of(table, {"ground.rms_slope_deg"})
    assert [g.name for g in groups] == ["rms_slope_deg 1", "rms_slope_deg 2", "rms_slope_deg 3"]
    assert all(len(g.rows) == 4 for g in groups)
    plot_terrain(tmp_path, table, {"ground.rms_slope_deg"})
    assert sorted(p.name for p in tmp_path.glob("*.png")) == [
        "terrain-cep.png", "terrain-consistency.png", "terrain-convergence.png",
        "terrain-error.png", "terrain-integrity.png",
    ]  # fmt: skip
