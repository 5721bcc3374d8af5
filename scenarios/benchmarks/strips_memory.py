"""Memory of `bathynav strips` on a file of 1x and of 10x: more lines, and one line that is longer, up to 30x.

Each case is the command itself in a process of its own, so that its peak of memory is its own.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from perception.records import Progress
from scenarios.benchmarks import Row, Table
from scenarios.benchmarks.sonar_files import write_lines

_PINGS, _TIMES = 600, 10
_LINE_M = 120.0
_PROGRAM = """
import resource, sys
from scenarios.commands import main
try:
    main()
except SystemExit as stop:
    if stop.code:
        raise
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def run(progress: Progress) -> Table:
    """Make strips of the four files."""
    cases = (
        ("1x", _PINGS, _LINE_M),
        ("10x, ten times as many lines", _TIMES * _PINGS, _LINE_M),
        ("10x, one line", _TIMES * _PINGS, 1e6),
        ("30x, one line", 3 * _TIMES * _PINGS, 1e6),
    )
    rows: list[Row] = []
    for number, (case, n, line_m) in enumerate(cases):
        progress("strips", number, len(cases))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "survey.xtf"
            write_lines(path, n, line_m, progress)
            began = time.perf_counter()
            peak = _peak_mb(path, Path(folder) / "strips")
            seconds = time.perf_counter() - began
        note = f"{n:,} pings"
        rows += [
            Row(case, "bathynav strips", "peak memory", peak, "MB", "as 1x", note),
            Row(case, "bathynav strips", "time, start included", seconds, "s", "", note),
        ]
    progress("strips", len(cases), len(cases))
    return Table("strips-memory", tuple(rows), {"pings": _PINGS, "line_m": _LINE_M})


def _peak_mb(path: Path, out: Path) -> float:
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, "strips", str(path), "--out", str(out), "-q"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return float(done.stdout.split()[-1])
