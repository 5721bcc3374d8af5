"""A planted difference is found, no difference is not."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from perception.records import InputError, NoOverlapError
from scenarios.comparison import compare_folders


def _experiment(folder, seeds, **metrics):
    folder.mkdir()
    pq.write_table(pa.table({"seed": np.asarray(seeds), **metrics}), folder / "results.parquet")
    return folder


def test_pairing_finds_a_small_shift_under_large_common_scatter(tmp_path):
    rng = np.random.default_rng(3)
    scatter = rng.normal(0, 10, 60)
    a = _experiment(tmp_path / "a", np.arange(60), rms_m=scatter, same_m=scatter)
    b = _experiment(
        tmp_path / "b",
        np.arange(60)[::-1],
        rms_m=(scatter + 0.5 + rng.normal(0, 0.3, 60))[::-1],
        same_m=scatter[::-1],
    )
    found = {d.metric: d for d in compare_folders(a, b)}
    assert found["rms_m"].significant and found["rms_m"].pairs == 60
    assert found["rms_m"].low < 0.5 < found["rms_m"].high
    assert not found["same_m"].significant and found["same_m"].difference == 0.0


def test_without_common_seeds_the_same_shift_is_not_significant(tmp_path):
    rng = np.random.default_rng(3)
    scatter = rng.normal(0, 10, 60)
    a = _experiment(tmp_path / "a", np.arange(60), rms_m=scatter)
    b = _experiment(tmp_path / "b", np.arange(60) + 100, rms_m=rng.permutation(scatter) + 0.5)
    (found,) = compare_folders(a, b)
    assert found.pairs == 0 and not found.significant


def test_chance_is_called_significant_no_more_often_than_stated(tmp_path):
    rng = np.random.default_rng(9)
    alarms = 0
    for trial in range(60):
        names = {f"m{i}": rng.normal(size=25) for i in range(5)}
        others = {n: rng.normal(size=25) for n in names}
        a = _experiment(tmp_path / f"a{trial}", np.arange(25), **names)
        b = _experiment(tmp_path / f"b{trial}", np.arange(25), **others)
        alarms += any(d.significant for d in compare_folders(a, b))
    # Family-wise 5 % of 60 is 3; three sigma above is 8.
    assert alarms <= 8


def test_single_runs_give_differences_without_significance(tmp_path):
    for name, value in (("a", 1.0), ("b", 1.5)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.json").write_text(
            json.dumps({"map_mae_m": value, "seed": 1, "solved": True, "versions": {}})
        )
    (found,) = compare_folders(tmp_path / "a", tmp_path / "b")
    assert (found.metric, found.difference) == ("map_mae_m", 0.5) and not found.significant


def test_unlike_or_foreign_folders_are_refused(tmp_path):
    a = _experiment(tmp_path / "a", [1, 2], x=[1.0, 2.0])
    b = _experiment(tmp_path / "b", [1, 2], y=[1.0, 2.0])
    (tmp_path / "c").mkdir()
    with pytest.raises(NoOverlapError, match="no metric in common"):
        compare_folders(a, b)
    with pytest.raises(InputError, match="is an experiment and"):
        compare_folders(a, tmp_path / "c")
    with pytest.raises(InputError, match=r"metrics\.json: no such file"):
        compare_folders(tmp_path / "c", tmp_path / "c")
