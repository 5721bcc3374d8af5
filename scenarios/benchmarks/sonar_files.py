"""Reading sonar files: pings a second and memory on a file of 1x and of 10x, beside pyxtf's own reader.

Each case runs in a process of its own, so that its peak of memory is its own.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from pyxtf import XTFFileHeader, XTFPingHeader
from pyxtf.xtf_ctypes import XTFPingChanHeader

from perception.records import Progress
from scenarios.benchmarks import Row, Table

_PINGS, _SAMPLES = 10_000, 1024
_TIMES = 10
_RATE_HZ, _SPEED_M_S, _LINE_M = 5.0, 2.0, 400.0
# What follows is run in a fresh interpreter: imports first, then the memory that they cost is the base.
_OURS = """
import resource, sys, time
from pathlib import Path
import scipy.ndimage, pyproj
from perception.readers import open_survey
import perception.readers.xtf
pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32619")
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
base, began = peak(), time.perf_counter()
survey = open_survey([Path(sys.argv[1])])
scanned = time.perf_counter()
pings = sum(survey.swath(i).n_pings for i in range(survey.n_passes))
print(survey.n_pings / (scanned - began), pings / (time.perf_counter() - scanned), peak() - base)
"""
_PEER = """
import resource, sys, time
import pyxtf
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
base, began = peak(), time.perf_counter()
_, packets = pyxtf.xtf_read(sys.argv[1])
pings = len(packets[pyxtf.XTFHeaderType.sonar])
print(pings / (time.perf_counter() - began), 0.0, peak() - base)
"""


def run(progress: Progress) -> Table:
    """Write the two files, read each by both readers."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for number, times in enumerate((1, _TIMES)):
            path = Path(folder) / f"{times}.xtf"
            n = times * _PINGS
            write_lines(path, n, _LINE_M, progress)
            case = f"{n:,} pings of 2 x {_SAMPLES:,}"
            progress("reading", number, 2)
            scan, samples, grown = _measured(_OURS, path)
            goal = "> 5,000"
            rows += [
                Row(case, "bathynav", "headers and passes", scan, "pings/s", goal),
                Row(case, "bathynav", "samples, pass by pass", samples, "pings/s", goal),
                Row(case, "bathynav", "memory above the imports", grown, "MB"),
            ]
            if times == 1:  # ten times as much would take ten times the memory, as it loads all
                rate, _, peer_grown = _measured(_PEER, path)
                rows += [
                    Row(case, "pyxtf.xtf_read", "whole file", rate, "pings/s"),
                    Row(case, "pyxtf.xtf_read", "memory above the imports", peer_grown, "MB"),
                ]
            path.unlink()
        progress("reading", 2, 2)
    return Table(
        "sonar-files", tuple(rows), {"pings": _PINGS, "samples": _SAMPLES, "times": _TIMES}
    )


def _measured(program: str, path: Path) -> tuple[float, float, float]:
    done = subprocess.run(
        [sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=True
    )
    first, second, grown = (float(word) for word in done.stdout.split()[-3:])
    return first, second, grown


def write_lines(path: Path, n: int, line_m: float, progress: Progress) -> None:
    """Write `n` pings on lines of `line_m`, 40 m apart, up and down, 5 Hz at 2 m/s; the echoes are noise."""
    rng = np.random.default_rng(0)
    header = XTFFileHeader()
    header.NavUnits, header.NumberOfSonarChannels = 0, 2
    for i in range(2):
        header.ChanInfo[i].TypeOfChannel = i + 1
        header.ChanInfo[i].BytesPerSample = 2
    level = np.where(np.arange(_SAMPLES) < 200, 50, 3000)
    echoes = [
        (level * rng.exponential(1.0, _SAMPLES)).clip(0, 60000).astype("<u2") for _ in range(64)
    ]
    per_line = int(line_m / _SPEED_M_S * _RATE_HZ)
    with path.open("wb") as stream:
        stream.write(bytes(header))
        for i in range(n):
            stream.write(_ping(i, per_line, line_m, echoes[i % 64]))
            if i % 5000 == 0:
                progress("writing", i, n)


def _ping(i: int, per_line: int, line_m: float, echo: np.ndarray) -> bytes:
    line, along = divmod(i, per_line)
    north_m = along * _SPEED_M_S / _RATE_HZ
    ping = XTFPingHeader()
    ping.Year, ping.Month, ping.Day = 2024, 1, 1 + int(i / _RATE_HZ) // 86400
    seconds = i / _RATE_HZ % 86400
    ping.Hour, ping.Minute = int(seconds // 3600), int(seconds // 60 % 60)
    ping.Second, ping.HSeconds = int(seconds % 60), int(seconds % 1 * 100)
    ping.PingNumber, ping.NumChansToFollow, ping.SoundVelocity = i, 2, 1500.0
    ping.SensorXcoordinate = 500000.0 + 40.0 * line
    ping.SensorYcoordinate = 5e6 + (north_m if line % 2 == 0 else line_m - north_m)
    ping.SensorHeading = 180.0 * (line % 2)
    ping.SensorDepth, ping.SensorPrimaryAltitude = 20.0, 10.0
    body = b""
    for number in range(2):
        channel = XTFPingChanHeader()
        channel.ChannelNumber, channel.NumSamples = number, _SAMPLES
        channel.SlantRange, channel.TimeDuration = 50.0, 50.0 / 750
        body += bytes(channel) + (echo if number else echo[::-1]).tobytes()
    ping.NumBytesThisRecord = 256 + len(body)
    return bytes(ping) + body
