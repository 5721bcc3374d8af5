"""Benchmark `navigation`: position from terrain on sets of the stated kind, beside bound and peers.

Sets come from `scenarios.benchmarks.navigation_sets` (a generator that shares nothing with the
estimator) and go through the same objects as `bathynav locate`. Errors are of the causal estimate over
the second half of the hour. The Cramer-Rao bound is of the same set: true slopes, white noise.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from localization.estimate import CONVERGED, LOST
from localization.measurements import beam_vectors, soundings_of
from localization.navfile import NavTable, nav_table
from localization.navigator import Navigator
from localization.particles import ParticleFilter
from localization.terrain import TerrainMap, terrain_map
from perception.records import FloatArray, Progress
from scenarios.benchmarks import Row, Table
from scenarios.benchmarks.navigation_bound import causal_bound
from scenarios.benchmarks.navigation_sets import (
    NavigationSet,
    SetConfig,
    degraded,
    make_set,
    prior_map,
    spectral_floor,
)

RUNS = 3
# A fix is false when it claims less than this and is off by more than that.
_CLAIMED_M, _OFF_M = 10.0, 25.0


@dataclass(frozen=True, slots=True)
class Case:
    """One kind of set, the goal for its rms error, and what is done to it after it is drawn."""

    name: str
    config: SetConfig
    goal: str
    harm: str = ""


CASES = (
    Case("rough, 15 m relief", SetConfig(), "<= 0.9"),
    Case("rough, map error over 50 m", SetConfig(error_length_m=50.0), "<= 0.9"),
    Case("flat, 1 m relief", SetConfig(relief_m=1.0), "<= 5"),
    Case("featureless", SetConfig(relief_m=1e-3), "no fix"),
    Case("one beam in ten wild", SetConfig(outliers=0.1), "<= 1.2"),
    Case("depth steps by 10 m", SetConfig(), "recovers", "step"),
    Case("300 s without ranges", SetConfig(), "recovers", "gap"),
    Case("start 350 m off", SetConfig(), "recovers", "off"),
    Case("map of other ground", SetConfig(), "no fix", "wrong map"),
)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Figures of one run; `nees` is the mean normalised error squared over the second half."""

    rms_m: float
    sigma_m: float
    nees: float
    false_rows: int
    converged_s: float
    lost_rows: int
    bound_m: float


def run(progress: Progress) -> Table:
    """Measure all cases, then the time of an update."""
    rows: list[Row] = []
    for k, case in enumerate(CASES):
        outcomes = []
        for seed in range(RUNS):
            progress("navigation sets", k * RUNS + seed, len(CASES) * RUNS)
            outcomes.append(run_once(case, seed))
        rows += _rows(case, outcomes)
    rows += _timing_rows()
    progress("navigation sets", len(CASES) * RUNS, len(CASES) * RUNS)
    return Table("navigation", tuple(rows), {"runs": RUNS, "duration_s": SetConfig().duration_s})


def _rows(case: Case, outcomes: list[Outcome]) -> list[Row]:
    def of(name: str) -> FloatArray:
        return np.array([getattr(o, name) for o in outcomes], float)

    seconds = of("converged_s")
    found = bool(np.isfinite(seconds).any())
    figures = (
        ("rms error", float(np.sqrt(np.mean(of("rms_m") ** 2))), "m", case.goal),
        ("reported sigma", float(np.mean(of("sigma_m"))), "m", ""),
        ("normalised error squared", float(np.mean(of("nees"))), "", "2 expected"),
        ("false fixes", float(of("false_rows").sum()), "rows", "0"),
        ("rows lost", float(of("lost_rows").sum()), "rows", ""),
        ("converged after", float(np.nanmedian(seconds)) if found else None, "s", ""),
    )
    rows = [Row(case.name, "bathynav", n, v, u, g) for n, v, u, g in figures]
    bound = float(np.sqrt(np.mean(of("bound_m") ** 2)))
    return [*rows, Row(case.name, "Cramer-Rao bound", "rms error", bound, "m")]


def run_once(case: Case, seed: int) -> Outcome:
    """Draw a set, harm it as the case says, navigate it, and score the second half."""
    rng = np.random.default_rng([seed, 2024])
    drawn = make_set(case.config, rng)
    bound = cramer_rao(case.config, drawn, np.random.default_rng([seed, 2024]))
    drawn = _harmed(drawn, case, rng)
    nav, terrain = nav_table(drawn.nav), terrain_map(drawn.prior)
    navigator = Navigator(terrain, nav.sensors, np.random.default_rng(seed))
    estimates = [navigator.update(m) for m in nav]
    error = np.array(
        [
            (e.easting_m - x, e.northing_m - y)
            for e, x, y in zip(
                estimates, drawn.truth_easting_m, drawn.truth_northing_m, strict=True
            )
        ]
    )
    covariance = np.array([e.covariance_m2 for e in estimates])
    status = np.array([e.status for e in estimates])
    half = len(error) // 2
    away = np.hypot(*error.T)
    claimed = np.sqrt(np.linalg.eigvalsh(covariance)[:, -1])
    square = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    converged = np.flatnonzero(status == CONVERGED)
    return Outcome(
        rms_m=float(np.sqrt(np.mean(away[half:] ** 2))),
        sigma_m=float(np.mean(np.sqrt(np.trace(covariance[half:], axis1=1, axis2=2)))),
        nees=float(square[half:].mean()),
        false_rows=int(np.sum((claimed < _CLAIMED_M) & (away > _OFF_M))),
        converged_s=float(nav.time_s[converged[0]]) if len(converged) else np.nan,
        lost_rows=int(np.sum(status == LOST)),
        bound_m=bound,
    )


def _harmed(drawn: NavigationSet, case: Case, rng: np.random.Generator) -> NavigationSet:
    nav = drawn.nav
    half = len(nav["time_s"]) // 2
    if case.harm == "step":
        late = np.arange(len(nav["depth_m"])) >= half
        return degraded(drawn, depth_m=nav["depth_m"] + 10.0 * late)
    if case.harm == "gap":
        beams = {name: values.copy() for name, values in nav.items() if name[:4] == "beam"}
        for values in beams.values():
            values[half - 150 : half - 50] = np.nan
        return degraded(drawn, **beams)
    if case.harm == "off":
        return degraded(
            drawn, easting_m=nav["easting_m"] + 250.0, northing_m=nav["northing_m"] - 250.0
        )
    if case.harm == "wrong map":
        other = spectral_floor(case.config, rng)
        return replace(drawn, prior=prior_map(other, case.config, rng))
    return drawn


def cramer_rao(config: SetConfig, drawn: NavigationSet, rng: np.random.Generator) -> float:
    """Bound on the rms error of a causal estimate over the second half, m."""
    floor = spectral_floor(config, rng.spawn(4)[0])
    bound = causal_bound(floor, config, drawn)
    return float(np.sqrt(np.mean(bound[len(bound) // 2 :] ** 2)))


def _timing_rows() -> list[Row]:
    """Time one update of 2,000 particles and 4 beams, ours and the peers', in one process."""
    from scenarios.benchmarks.navigation_peers import particles_update_ms, stonesoup_update_ms

    drawn = make_set(SetConfig(duration_s=600.0), np.random.default_rng(1))
    nav, terrain = nav_table(drawn.nav), terrain_map(drawn.prior)
    ours = update_ms(nav, terrain)
    rows = [
        Row("2,000 particles, 4 beams", "bathynav", "update", ours, "ms", "<= 0.15",
            "predict, weigh, resample; median"),
    ]  # fmt: skip
    for name, measure in (("particles", particles_update_ms), ("stonesoup", stonesoup_update_ms)):
        try:
            value = measure(nav, terrain)
        except ImportError:
            rows.append(
                Row("2,000 particles, 4 beams", name, "update", None, "ms", note="not installed")
            )
            continue
        note = f"{value / ours:.0f} times ours"
        rows.append(Row("2,000 particles, 4 beams", name, "update", value, "ms", note=note))
    return rows


def update_ms(nav: NavTable, terrain: TerrainMap) -> float:
    """Median time of predict and update over a track, ms."""
    pf = ParticleFilter(terrain, 2000, np.random.default_rng(0), wide=2000)
    pf.start(np.zeros(5), np.diag([50.0, 50.0, 0.0087, 0.005, 1.0]) ** 2)
    vectors, fractions = beam_vectors(nav.sensors.beams), np.full(4, 0.01)
    measurements = list(nav)
    soundings = [soundings_of(m, vectors, fractions, 0.02) for m in measurements]
    taken = []
    for before, m, s in zip(measurements[:-1], measurements[1:], soundings[1:], strict=True):
        began = time.perf_counter()
        pf.predict(m.easting_m - before.easting_m, m.northing_m - before.northing_m, 1e-3)
        pf.update(s, m.easting_m, m.northing_m, 4.5, 1e-6)
        taken.append(time.perf_counter() - began)
    return 1e3 * float(np.median(taken[5:]))
