"""Fifty random starts, goals and seeds through the command: solved or refused, checked from the files."""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path

import numpy as np
from click.testing import CliRunner
from scipy import ndimage

from mapping.rasters import write_map
from perception.records import Grid, Progress
from scenarios.benchmarks import Row, Table
from scenarios.benchmarks.planning_terrains import cases
from scenarios.benchmarks.route_check import check_route

_SEEDS = 50


def _ends(grid: Grid, rng: np.random.Generator) -> list[str]:
    """Return two places of known ground deep enough to start from, apart by a third of the map."""
    z = grid.elevation_m
    free = ndimage.binary_erosion(np.isfinite(z) & (z < -8.0), iterations=3)
    rows, cols = np.nonzero(free)
    while True:
        i, j = rng.integers(0, len(rows), 2)
        if np.hypot(rows[i] - rows[j], cols[i] - cols[j]) > z.shape[0] / 3:
            break
    east, north = grid.centres()
    return [f"{east[cols[k]]},{north[rows[k]]}" for k in (i, j)]


def run(progress: Progress) -> Table:
    """Plan fifty times over the benchmark's terrains, and check what was written."""
    from scenarios.commands.plan import command

    everything = cases()
    outcomes: dict[str, int] = {"solved": 0, "refused with a reason": 0, "failed": 0}
    margins, seconds, broken, reasons = [], [], 0, []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for k, case in enumerate(everything):
            write_map(folder / f"{k}.tif", case.grid)
        for seed in range(_SEEDS):
            progress("seeds", seed, _SEEDS)
            k = seed % len(everything)
            chart, out = folder / f"{k}.tif", folder / "out"
            start, goal = _ends(everything[k].grid, np.random.default_rng(seed))
            line = ["--map", str(chart), "--start", start, "--goal", goal, "--out", str(out),
                    "--seed", str(seed), "--no-picture", "-q"]  # fmt: skip
            line += ["--region-weights", "none"] if seed % 2 else []
            began = time.process_time()
            result = CliRunner().invoke(command, line, standalone_mode=False)
            seconds.append(time.process_time() - began)
            metrics = json.loads((out / "metrics.json").read_text())
            if metrics["solved"]:
                outcomes["solved"] += 1
                found = check_route(out / "route.csv", chart)
                margins.append(found.least_margin_m)
                broken += int(
                    not found.least_margin_m >= 0
                    or found.greatest_altitude_m > 20.0
                    or found.least_radius_m < 10.0
                    or max(found.steepest_up_deg, found.steepest_down_deg) > 30.0
                )
            elif metrics["reason"]:
                outcomes["refused with a reason"] += 1
                reasons.append(metrics["reason"][:120])
            else:
                outcomes["failed"] += 1
                reasons.append(repr(result.exception)[:120])
    name = f"{_SEEDS} seeds over {len(everything)} terrains"
    rows = [Row(name, "bathynav plan", what, float(n), "1") for what, n in outcomes.items()]
    rows += [
        Row(name, "independent check", "routes that break a limit", float(broken), "1", "0"),
        Row(name, "independent check", "least margin of all", min(margins, default=None), "m", ">= 0"),
        Row(name, "bathynav plan", "processor time, median", float(np.median(seconds)), "s"),
        Row(name, "bathynav plan", "processor time, most", float(np.max(seconds)), "s"),
    ]  # fmt: skip
    rows += [Row(name, "bathynav plan", "refusal", None, "", "", text) for text in reasons]
    return Table("planning-seeds", tuple(rows), {"seeds": _SEEDS})
