"""Benchmark `navigation-montecarlo`: how often is a fix false, over many terrains and all errors drawn.

Ten synthetic kinds of terrain of different relief and roughness, drawn anew for each run, and two real
ones where the shared data lie beside the clone: the Davos terrain model and the Vancouver island chart,
each resampled to 4 x 4 km on cells of 5 m and scaled to 15 m relief. Half of the sets have a white map
error, half one correlated over 10 to 200 m; one in four has one beam in ten wild. Each mission lasts 15
minutes.

`BATHYNAV_RUNS` sets the number of runs (default 48; the false-fix rate of 0.1 % needs 3,000), or the
first and the one after the last, as 1500:3000, so that two processes can share the work.
`BATHYNAV_RUNS_OUT` names a folder: each run is written there as it ends (`montecarlo.jsonl`), runs found
there are not repeated, and with `BATHYNAV_RUNS=0` the table is of what the folder holds.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage, stats

from localization.estimate import CONVERGED
from localization.navfile import nav_table
from localization.navigator import Navigator
from localization.terrain import terrain_map
from perception.records import FloatArray, Progress
from scenarios.benchmarks import Row, Table
from scenarios.benchmarks.navigation_sets import (
    Floor,
    NavigationSet,
    SetConfig,
    make_set,
    surface_floor,
)
from scenarios.locating import reach

_SYNTHETIC = tuple(
    SetConfig(relief_m=relief, hurst=hurst, outer_m=outer, duration_s=900.0)
    for relief, hurst, outer in (
        (15.0, 1.0, 1500.0), (15.0, 0.7, 1500.0), (15.0, 1.4, 1500.0), (5.0, 1.0, 800.0),
        (5.0, 0.6, 400.0), (2.0, 1.0, 1500.0), (1.0, 1.0, 1500.0), (1.0, 0.6, 600.0),
        (0.3, 0.8, 800.0), (0.001, 1.0, 1500.0),
    )
)  # fmt: skip
# Seeds of the runs: none of them was looked at while the estimator was built.
_STREAM = 20261122
_DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "bathymetry"
# A fix is false when it claims less than this and is off by more than that.
_CLAIMED_M, _OFF_M = 10.0, 25.0


@dataclass(frozen=True, slots=True)
class Outcome:
    """One run: what was drawn and what came of it.

    Attributes
    ----------
    run, terrain, error_length_m, outliers : index, kind of ground and what was drawn.
    false_rows : rows whose claimed sigma is below 10 m and whose error is above 25 m.
    worst_false_m, worst_false_sigma_m : error and claimed sigma of the worst of them, 0 without one.
    breaches : rows whose error exceeds their protection level.
    closest : largest error over protection level.
    rows, converged_rows, converged : rows, those converged, and whether the last one is.
    error_m, sigma_m, nees : of the last row.
    """

    run: int
    terrain: int
    error_length_m: float
    outliers: float
    false_rows: int
    worst_false_m: float
    worst_false_sigma_m: float
    breaches: int
    closest: float
    rows: int
    converged_rows: int
    converged: bool
    error_m: float
    sigma_m: float
    nees: float
    seconds: float


def run(progress: Progress) -> Table:
    """Draw, navigate and count."""
    first, _, last = os.environ.get("BATHYNAV_RUNS", "48").rpartition(":")
    folder = os.environ.get("BATHYNAV_RUNS_OUT")
    kept = None if folder is None else Path(folder) / "montecarlo.jsonl"
    outcomes = [] if kept is None else read_outcomes(kept)
    done = {o.run for o in outcomes}
    todo = [k for k in range(int(first or 0), int(last)) if k not in done]
    for i, outcome in enumerate(_runs(todo)):
        progress("Monte Carlo", i, len(todo))
        outcomes.append(outcome)
        if kept is not None:
            kept.parent.mkdir(parents=True, exist_ok=True)
            with kept.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(asdict(outcome)) + "\n")
    progress("Monte Carlo", len(todo), len(todo))
    return table_of(outcomes)


def read_outcomes(path: Path) -> list[Outcome]:
    """Read the runs that a folder holds; a line cut off by a kill is left out."""
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").split("\n")[:-1]
    return [Outcome(**json.loads(line)) for line in lines]


def table_of(outcomes: list[Outcome]) -> Table:
    """Count over runs; the bound on the rate is exact (Clopper & Pearson 1934, one-sided)."""
    n, terrains = len(outcomes), len({o.terrain for o in outcomes})
    false = sum(o.false_rows > 0 for o in outcomes)
    bound = float(stats.beta.ppf(0.95, false + 1, n - false)) if n > false else 1.0
    rows = max(sum(o.rows for o in outcomes), 1)
    squares = [o.nees for o in outcomes if o.converged]
    figures = (
        ("runs with a false fix", float(false), "", "<= 0.1 %"),
        ("false-fix rate", false / max(n, 1), "", "<= 0.001"),
        ("false-fix rate, 95 % upper bound", bound, "", ""),
        ("rows of false fixes", float(sum(o.false_rows for o in outcomes)), "", ""),
        ("rows outside the protection level", sum(o.breaches for o in outcomes) / rows, "", "1e-5 by model"),
        ("runs that converged", len(squares) / max(n, 1), "", ""),
        ("normalised error squared, converged runs", float(np.mean(squares)) if squares else None, "", "2 expected"),
    )  # fmt: skip
    case = f"{n} runs, {terrains} terrains"
    return Table(
        "navigation-montecarlo",
        tuple(Row(case, "bathynav", name, v, u, g) for name, v, u, g in figures),
        {"runs": n, "terrains": terrains},
    )


def _runs(todo: list[int]) -> Iterator[Outcome]:
    real = _real_floors()
    kinds = len(_SYNTHETIC) + len(real)
    for k in todo:
        rng = np.random.default_rng([k, _STREAM])
        kind = k % kinds
        floor = None if kind < len(_SYNTHETIC) else real[kind - len(_SYNTHETIC)]
        base = _SYNTHETIC[kind] if floor is None else SetConfig(duration_s=900.0)
        config = _with_errors(base, rng)
        began = time.process_time()
        drawn = make_set(config, rng, floor)
        yield _once(drawn, config, (k, kind), rng, began)


def _with_errors(base: SetConfig, rng: np.random.Generator) -> SetConfig:
    length = float(np.exp(rng.uniform(np.log(10.0), np.log(200.0)))) if rng.random() < 0.5 else 0.0
    wild = 0.1 if rng.random() < 0.25 else 0.0
    return replace(base, error_length_m=length, outliers=wild)


def _once(
    drawn: NavigationSet,
    config: SetConfig,
    index: tuple[int, int],
    rng: np.random.Generator,
    began_s: float,
) -> Outcome:
    """Navigate one set and judge every row."""
    nav = nav_table(drawn.nav)
    navigator = Navigator(terrain_map(drawn.prior, None, reach(nav)), nav.sensors, rng)
    estimates = [navigator.update(m) for m in nav]
    error = np.array([(e.easting_m, e.northing_m) for e in estimates])
    error -= np.stack([drawn.truth_easting_m, drawn.truth_northing_m], axis=1)
    away = np.hypot(*error.T)
    covariance = np.array([e.covariance_m2 for e in estimates])
    claimed = np.sqrt(np.linalg.eigvalsh(covariance)[:, -1])
    protection = np.array([e.protection_m for e in estimates])
    false = (claimed < _CLAIMED_M) & (away > _OFF_M)
    worst = int(np.argmax(np.where(false, away, -1.0)))
    converged = np.array([e.status == CONVERGED for e in estimates])
    return Outcome(
        run=index[0],
        terrain=index[1],
        error_length_m=config.error_length_m,
        outliers=config.outliers,
        false_rows=int(false.sum()),
        worst_false_m=float(away[worst]) if false.any() else 0.0,
        worst_false_sigma_m=float(claimed[worst]) if false.any() else 0.0,
        breaches=int(np.sum(away > protection)),
        closest=float(np.max(away / protection)),
        rows=len(away),
        converged_rows=int(converged.sum()),
        converged=bool(converged[-1]),
        error_m=float(away[-1]),
        sigma_m=float(claimed[-1]),
        nees=float(error[-1] @ np.linalg.solve(covariance[-1], error[-1])),
        seconds=time.process_time() - began_s,
    )


def _real_floors() -> list[Floor]:
    """Resample the real terrains to 4 km of 5 m cells and scale them to 15 m relief, 100 m deep."""
    floors = []
    if (_DATA / "davosdorf.tif").exists():
        from mapping.rasters import read_map

        floors.append(_scaled(read_map(_DATA / "davosdorf.tif").elevation_m[:400, :400]))
    if (_DATA / "topobathy.npz").exists():
        with np.load(_DATA / "topobathy.npz") as stored:
            floors.append(_scaled(np.asarray(stored["topo"], float)[:90, :90]))
    return floors


def _scaled(height_m: FloatArray) -> Floor:
    filled = np.where(np.isfinite(height_m), height_m, np.nanmedian(height_m))
    side = 800 / np.array(filled.shape)
    fine = ndimage.zoom(filled, side, order=3)
    fine = (fine - fine.mean()) / fine.std() * 15.0
    return surface_floor(np.clip(100.0 - fine, 55.0, 160.0), 5.0)
