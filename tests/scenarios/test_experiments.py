"""Many runs: nothing lost, nothing different, one bad run harms no other."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pyarrow.parquet as pq
import pytest

from perception.records import InputError
from scenarios import results
from scenarios.experiments import SchedulerLostError, record_path, run_experiment
from scenarios.results import read_results, write_results
from scenarios.run_server import RunServer
from scenarios.sweep import read_sweep

SWEEP = """
mean = 2.0
draws = 50
[sweep]
task = "arithmetic"
runs = {runs}
seed = 7
time_limit_s = 60
memory_limit_mb = 900
[sweep.keys]
sigma = {{ uniform = [0.5, 2.0] }}
[sweep.criteria]
mean_error = {{ at_most = 0.3 }}
"""


def _sweep_file(tmp_path, runs):
    path = tmp_path / "sweep.toml"
    path.write_text(SWEEP.format(runs=runs))
    return path


def _command(*arguments):
    return [sys.executable, "-c", "from scenarios.commands import main; main()", *arguments]


def _results_bytes(path, out, **options):
    plan = read_sweep(path)
    run_experiment(plan, out, **options)
    write_results(plan, out)
    return (out / "results.parquet").read_bytes()


@pytest.fixture(scope="module")
def address():
    """A running cluster, shared: starting one takes seconds."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0", host="127.0.0.1"
    ) as cluster:
        yield cluster.scheduler_address


def test_one_worker_two_workers_and_a_cluster_by_address_give_the_same_bytes(tmp_path, address):
    path = _sweep_file(tmp_path, 24)
    one = _results_bytes(path, tmp_path / "one", n_workers=1)
    two = _results_bytes(path, tmp_path / "two", n_workers=2)
    assert one == two
    assert _results_bytes(path, tmp_path / "far", scheduler=address) == one
    assert pq.read_table(tmp_path / "one" / "results.parquet").num_rows == 24


def test_a_sweep_killed_twice_resumes_to_the_bytes_of_an_undisturbed_one(tmp_path):
    path = _sweep_file(tmp_path, 150)
    undisturbed = _results_bytes(path, tmp_path / "whole", n_workers=2)
    out = tmp_path / "killed"
    command = _command("experiment", str(path), "--out", str(out), "--workers", "1")
    finished = 0
    for _ in range(2):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + 60
        target = finished + 5
        while finished < target and time.monotonic() < deadline:
            time.sleep(0.02)
            finished = len(list(out.glob("runs/*/*/record.json")))
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        assert finished >= target
    assert finished < 150, "the kill came too late to test anything"
    assert _results_bytes(path, out, n_workers=2) == undisturbed


def test_a_crash_a_hang_and_a_memory_hog_are_reported_and_disturb_no_other_run():
    server = RunServer(("numpy",))

    def run(fault):
        config = {"seed": 1, "fault": fault}
        return server.run(
            {
                "task": "arithmetic",
                "config": config,
                "folder": "/nowhere",
                "time_limit_s": 5.0 if fault == "memory" else 1.0,
                "memory_limit_mb": 400.0,
            }
        )

    try:
        first = run("")
        assert first["status"] == "done"
        crash, hang, hog, error = run("crash"), run("hang"), run("memory"), run("error")
        assert crash["status"] == "crashed" and "SIGABRT" in crash["error"]
        assert hang["status"] == "timeout" and "time_limit_s = 1" in hang["error"]
        assert hog["status"] == "memory" and "memory_limit_mb = 400" in hog["error"]
        assert error["status"] == "failed" and "the fault that was asked for" in error["error"]
        assert run("")["metrics"] == first["metrics"]
    finally:
        server.close()


def test_half_a_record_counts_as_none_and_is_run_again(tmp_path, address):
    path = _sweep_file(tmp_path, 4)
    out = tmp_path / "out"
    whole = _results_bytes(path, out, scheduler=address)
    spec = next(read_sweep(path).runs())
    record = record_path(out, spec.key)
    record.write_text(record.read_text()[:40])
    assert _results_bytes(path, out, scheduler=address) == whole


def test_a_folder_of_another_sweep_or_version_is_refused(tmp_path, address):
    out = tmp_path / "out"
    _results_bytes(_sweep_file(tmp_path, 2), out, scheduler=address)
    with pytest.raises(InputError, match="holds another sweep"):
        run_experiment(read_sweep(_sweep_file(tmp_path, 3)), out)
    marker = json.loads((out / "sweep.json").read_text())
    marker["versions"]["numpy"] = "0.1"
    (out / "sweep.json").write_text(json.dumps(marker))
    with pytest.raises(InputError, match="another version of numpy"):
        run_experiment(read_sweep(_sweep_file(tmp_path, 2)), out)


def test_a_scheduler_that_does_not_answer_is_said_in_one_line(tmp_path):
    plan = read_sweep(_sweep_file(tmp_path, 2))
    with pytest.raises(
        SchedulerLostError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"
    ):
        run_experiment(plan, tmp_path / "out", scheduler="tcp://127.0.0.1:9")


def test_half_a_parquet_file_is_said_with_the_way_out(tmp_path, address):
    out = tmp_path / "out"
    _results_bytes(_sweep_file(tmp_path, 3), out, scheduler=address)
    file = out / "results.parquet"
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(InputError, match="not a whole Parquet file"):
        read_results(out)


def test_intervals_hold_their_share_of_planted_means():
    rng = np.random.default_rng(5)
    held = 0
    for _ in range(400):
        _, low, high = results.mean_interval(rng.normal(1.0, 2.0, 20))
        held += low <= 1.0 <= high
    # Binomial(400, 0.95): three sigma is 13.
    assert abs(held - 380) <= 13
    low, high = results.share_interval(0, 1000)
    assert low == 0.0 and high < 0.004
