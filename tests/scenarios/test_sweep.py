"""A sweep file is laid out the same way every time, and says what is wrong with it."""

import numpy as np
import pytest

from perception.records import InputError
from scenarios.sweep import read_sweep

HEAD = '[sweep]\ntask = "arithmetic"\n'


def _plan(tmp_path, text):
    path = tmp_path / "sweep.toml"
    path.write_text(text)
    return read_sweep(path)


def test_a_grid_is_every_combination_in_the_order_of_the_file(tmp_path):
    plan = _plan(
        tmp_path,
        "mean = 0\n" + HEAD + 'method = "grid"\nrepeats = 2\n[sweep.keys]\n'
        'mean = { values = [1, 2] }\n"a.b" = { values = ["x", "y", "z"] }\n',
    )
    runs = list(plan.runs())
    assert plan.n_runs == len(runs) == 12
    assert runs[0].settings == runs[1].settings == {"mean": 1, "a.b": "x"}
    assert runs[-1].config["mean"] == 2 and runs[-1].config["a"] == {"b": "z"}
    assert len({r.key for r in runs}) == 12, "repeats differ by their seed"


def test_seeds_are_the_children_that_spawn_gives(tmp_path):
    plan = _plan(tmp_path, HEAD + "runs = 5\nseed = 42\n")
    children = np.random.SeedSequence(42).spawn(5)
    expected = [int(c.generate_state(1, np.uint64)[0]) >> 1 for c in children]
    assert [r.seed for r in plan.runs()] == expected


def test_a_latin_hypercube_fills_every_stratum_once(tmp_path):
    plan = _plan(
        tmp_path,
        HEAD + 'method = "latin-hypercube"\nruns = 50\n[sweep.keys]\n'
        "a = { uniform = [0, 50] }\nb = { uniform = [100, 150] }\n",
    )
    for name, low in (("a", 0), ("b", 100)):
        drawn = [r.settings[name] - low for r in plan.runs()]
        assert sorted(int(v) for v in drawn) == list(range(50))


def test_draws_follow_the_distribution_they_name(tmp_path):
    plan = _plan(
        tmp_path,
        HEAD + "runs = 4000\n[sweep.keys]\nn = { normal = [3, 2] }\n"
        "l = { log_uniform = [1, 100] }\ni = { integers = [2, 4] }\n",
    )
    rows = [r.settings for r in plan.runs()]
    n = np.array([r["n"] for r in rows])
    assert abs(n.mean() - 3) < 4 * 2 / np.sqrt(4000) and abs(n.std() - 2) < 0.1
    assert abs(np.mean(np.log10([r["l"] for r in rows])) - 1) < 0.05
    assert {r["i"] for r in rows} == {2, 3, 4}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mean = 1\n", r"has no \[sweep\] table"),
        (HEAD + "rums = 3\n", "no key 'rums' .value 3.; did you mean 'runs'"),
        (HEAD + "runs = 0\n", "runs = 0"),
        (HEAD + 'method = "grid"\n[sweep.keys]\na = { values = [] }\n', "the grid is empty"),
        (HEAD + 'method = "grid"\n[sweep.keys]\na = { uniform = [0, 1] }\n', "a grid needs values"),
        (HEAD + "[sweep.keys]\na = { }\n", "needs exactly one of"),
        (HEAD + "[sweep.keys]\na = { log_uniform = [0, 1] }\n", "needs positive bounds"),
        ("[sweep", "not valid TOML"),
    ],
)
def test_a_wrong_sweep_is_refused_naming_the_key(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        _plan(tmp_path, text)
