"""Runs in processes of their own: a server that forks one child per run and watches over it.

A run needs a fresh process (libraries keep global state: OMPL's seed is set once a process), must
not take others down when it crashes, hangs or eats memory, and may not cost the second that
importing takes. So each worker starts one server, which imports once and forks for every run.

The server speaks lines of JSON on its standard input and output:
``{"task", "config", "folder", "time_limit_s", "memory_limit_mb"}`` in, one record out.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import select
import signal
import subprocess
import sys
import time
import traceback
from pathlib import Path
from typing import Any

_POLL_S = 0.02  # how often a run's memory is looked at


class RunServer:
    """The worker's side: start the server, send runs, start it anew if it dies."""

    def __init__(self, preload: tuple[str, ...]) -> None:
        self._preload = preload
        self._process: subprocess.Popen[str] | None = None

    def run(self, request: dict[str, Any]) -> dict[str, Any]:
        """Run one request and return its record (status, metrics, error, seconds, peak memory)."""
        for _ in range(2):
            server = self._started()
            assert server.stdin is not None and server.stdout is not None
            try:
                server.stdin.write(json.dumps(request) + "\n")
                server.stdin.flush()
                answer = server.stdout.readline()
            except BrokenPipeError:
                answer = ""
            if answer:
                record: dict[str, Any] = json.loads(answer)
                return record
            self.close()
        error = "the run's server died twice"
        return {"status": "crashed", "error": error, "metrics": {}, "seconds": 1.0}

    def close(self) -> None:
        """Stop the server and whatever it runs."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def _started(self) -> subprocess.Popen[str]:
        if self._process is None or self._process.poll() is not None:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "scenarios.run_server", *self._preload],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                env={
                    **os.environ,
                    "OPENBLAS_NUM_THREADS": "1",
                    "OMP_NUM_THREADS": "1",
                    "NUMBA_NUM_THREADS": "1",
                },
            )
        return self._process


def serve(preload: tuple[str, ...]) -> None:
    """Answer requests until standard input closes."""
    _die_with_parent()
    for name in ("scenarios.tasks", *preload):
        importlib.import_module(name)
    answers = os.fdopen(os.dup(1), "w")
    # Whatever a library prints must not be taken for an answer.
    os.dup2(2, 1)
    for line in sys.stdin:
        record = _run_forked(json.loads(line))
        answers.write(json.dumps(record) + "\n")
        answers.flush()


def _die_with_parent() -> None:
    """Ask the kernel to end this process when its parent is killed: no orphans after kill -9."""
    import ctypes

    pr_set_pdeathsig = 1
    libc = ctypes.CDLL(None, use_errno=True)
    if hasattr(libc, "prctl"):
        libc.prctl(pr_set_pdeathsig, signal.SIGKILL)


def _run_forked(request: dict[str, Any]) -> dict[str, Any]:
    started_s = time.monotonic()
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reader)
        _child(request, writer)
    os.close(writer)
    try:
        output, verdict = _watch(child, reader, request, started_s)
    finally:
        os.close(reader)
    _, status, usage = os.wait4(child, 0)
    record = _record_of(output, verdict, status)
    record["seconds"] = time.monotonic() - started_s
    record.setdefault("peak_memory_mb", usage.ru_maxrss / 1024)
    return record


def _child(request: dict[str, Any], writer: int) -> None:
    """Run the task and leave: the only way out of a forked child is os._exit."""
    _die_with_parent()
    try:
        from scenarios.tasks import find_task

        metrics = find_task(request["task"])(request["config"], Path(request["folder"]))
        record: dict[str, Any] = {"status": "done", "metrics": metrics, "error": ""}
    except MemoryError:
        record = {"status": "memory", "metrics": {}, "error": "out of memory"}
    except Exception as error:
        lines = traceback.format_exception_only(error)
        record = {"status": "failed", "metrics": {}, "error": "".join(lines).strip()}
        if not hasattr(error, "args") or os.environ.get("BATHYNAV_DEBUG"):
            traceback.print_exc()
    record["peak_memory_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    with os.fdopen(writer, "w") as stream:
        stream.write(json.dumps(record))
    os._exit(0)


def _watch(
    child: int, reader: int, request: dict[str, Any], started_s: float
) -> tuple[bytes, dict[str, Any] | None]:
    """Read what the child reports; kill it past its limits and return the verdict."""
    time_limit_s, memory_limit_mb = request["time_limit_s"], request["memory_limit_mb"]
    output = b""
    while True:
        ready, _, _ = select.select([reader], [], [], _POLL_S)
        if ready:
            chunk = os.read(reader, 1 << 16)
            if not chunk:
                return output, None
            output += chunk
            continue
        if time.monotonic() - started_s > time_limit_s:
            os.kill(child, signal.SIGKILL)
            error = f"ran longer than time_limit_s = {time_limit_s:g}"
            return b"", {"status": "timeout", "error": error}
        resident_mb = _resident_mb(child)
        if resident_mb > memory_limit_mb:
            os.kill(child, signal.SIGKILL)
            error = f"took more memory than memory_limit_mb = {memory_limit_mb:g}"
            return b"", {"status": "memory", "error": error}


def _resident_mb(process: int) -> float:
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return 0.0  # it has just ended; the pipe tells how
    return pages * resource.getpagesize() / 2**20


def _record_of(output: bytes, verdict: dict[str, Any] | None, status: int) -> dict[str, Any]:
    if verdict is not None:
        return {**verdict, "metrics": {}}
    if output:
        record: dict[str, Any] = json.loads(output)
        return record
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        how = f"killed by signal {number} ({signal.Signals(number).name})"
    else:
        how = f"ended with status {os.WEXITSTATUS(status)} without a result"
    return {"status": "crashed", "error": how, "metrics": {}}


if __name__ == "__main__":
    serve(tuple(sys.argv[1:]))
