"""One map from many passes: registration, pose graph and gridding, each beside a peer or a simpler way."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mapping.graph_files import read_g2o
from mapping.gridding import Spacing, Window, bin_lines
from mapping.keyframes import Keyframes
from mapping.pose_graph import GraphConfig, Link, build, gauss_newton
from mapping.pose_graph_sets import dead_reckoned, gtsam_factors, gtsam_values, optimise
from mapping.pose_graph_solve import solve
from mapping.registration import match
from mapping.textures import texture
from perception.records import ElevationStrip, FloatArray, Progress
from scenarios.benchmarks import Row, Table

_SETS = Path(__file__).resolve().parents[3] / "shared" / "data" / "pose_graphs"


def run(progress: Progress) -> Table:
    """Measure each stage once warm; the figures are wall seconds of one process."""
    stages: tuple[Callable[[], list[Row]], ...] = (_registration, _graph, _gridding, _public_sets)
    rows: list[Row] = []
    for done, stage in enumerate(stages, start=1):
        rows += stage()
        progress("mapping benchmark", done, len(stages))
    return Table("mapping", tuple(rows), {"seed": 1, "strip": "200 x 500", "soundings": 10_000_000})


def _seconds(work: Callable[[], Any], times: int = 3) -> float:
    best = np.inf
    for _ in range(times):
        start = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - start)
    return float(best)


def _strip(
    rng: np.random.Generator, ground: FloatArray, shift_m: tuple[float, float]
) -> ElevationStrip:
    """Return a strip of 200 lines and 500 columns over a periodic ground, at a shifted position."""
    across = (np.arange(500) - 249.5) * 0.2
    along = np.arange(200) * 0.5
    rows = np.round((along + 100.0) * 5).astype(int) % len(ground)
    cols = np.round((across + 150.0) * 5).astype(int) % len(ground)
    height = ground[rows][:, cols]
    slope = np.gradient(height, 0.2, axis=1) * np.sign(across)
    n, m = height.shape
    return ElevationStrip(
        elevation_m=height + 0.2 * rng.normal(size=(n, m)),
        sigma_m=np.full((n, m), 0.2),
        across_m=across,
        echo=np.exp(3.0 * np.clip(slope, -0.5, 0.5)) * rng.gamma(4.0, 0.25, (n, m)),
        shadow=np.zeros((n, m), bool),
        time_s=along,
        ping=np.arange(n),
        easting_m=np.full(n, 1000.0 + shift_m[0]),
        northing_m=1000.0 + along + shift_m[1],
        depth_m=np.full(n, 20.0),
        heading_rad=np.zeros(n),
        altitude_m=np.full(n, 15.0),
        altitude_sigma_m=np.full(n, 0.1),
        crs="EPSG:32630",
    )


def _ground(rng: np.random.Generator, size: int = 1500) -> FloatArray:
    k = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size))
    k[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.normal(size=(size, size))) * k**-1.8
    field = np.fft.irfft2(spectrum, s=(size, size))
    return -35.0 + field / field.std()


def _registration() -> list[Row]:
    rng = np.random.default_rng(1)
    ground = _ground(rng)
    planted = (1.3, -0.8)
    first, second = _strip(rng, ground, (0.0, 0.0)), _strip(rng, ground, planted)
    centre = (1000.0, 1050.0)
    textures = texture(first), texture(second)
    found = match(*textures, centre, 90.0, 6.0, 0.75)
    case = "two strips 200 x 500"
    rows = [
        Row(case, "match", "time", 1e3 * _seconds(lambda: match(*textures, centre, 90.0, 6.0, 0.75)),
            "ms", "<= 50"),
        Row(case, "texture", "time", 1e3 * _seconds(lambda: texture(first)), "ms", "",
            "once a strip and round"),
        Row(case, "match", "error", float(np.hypot(*(found.shift_m - planted))), "m", "",
            f"accepted: {found.accepted}"),
    ]  # fmt: skip
    try:
        import small_gicp
    except ImportError:
        return [*rows, Row(case, "small_gicp", "time", None, "ms", note="not installed")]
    clouds = []
    for strip in (first, second):
        east, north = strip.positions()
        clouds.append(
            np.column_stack([east.ravel() - 1000, north.ravel() - 1000, strip.elevation_m.ravel()])
        )

    def align() -> Any:
        return small_gicp.align(
            clouds[0], clouds[1], downsampling_resolution=1.0, max_correspondence_distance=4.0
        )

    theirs = align().T_target_source[:2, 3]
    return [
        *rows,
        Row(case, "small_gicp", "time", 1e3 * _seconds(align), "ms"),
        Row(case, "small_gicp", "error", float(np.hypot(*(-theirs - planted))), "m", "",
            "heights alone"),
    ]  # fmt: skip


def _graph(passes: int = 100, per_pass: int = 100) -> list[Row]:
    """Time 100 passes of 2,000 pings, a keyframe per 20 pings, with links between neighbours."""
    rng = np.random.default_rng(1)
    k = passes * per_pass
    strip = np.repeat(np.arange(passes), per_pass)
    step = np.tile(np.arange(per_pass), passes)
    north = np.where(strip % 2 == 0, step, per_pass - 1 - step) * 10.0
    way = np.full(k, 10.0)
    way[::per_pass] = 50.0
    way[0] = np.nan
    keyframes = Keyframes(
        strip=strip, line=step * 20, easting_m=strip * 45.0, northing_m=north,
        heading_rad=np.where(strip % 2 == 0, 0.0, np.pi), time_s=np.arange(k) * 7.0, way_m=way,
        jump_m=np.zeros(k), starts=np.arange(0, k + 1, per_pass),
    )  # fmt: skip
    links = []
    for i in range(0, k - per_pass, 4):
        j = (int(strip[i]) + 1) * per_pass + per_pass - 1 - int(step[i])
        shift = rng.normal(0, 0.3, 2)
        half = np.array([22.5, 0.0])
        links.append(Link(i, j, half, -half, shift, 0.09 * np.eye(2)))
    case = f"graph of {k} keyframes, {len(links)} registrations"
    plain = _seconds(lambda: solve(keyframes, links, robust=False), 1)
    robust = _seconds(lambda: solve(keyframes, links), 1)
    factors, start, _ = build(keyframes, links, (), GraphConfig())
    bare = _seconds(lambda: _bare_gtsam(factors, start), 1)
    return [
        Row(case, "bare GTSAM, factors at hand", "solve and all marginals", bare, "s"),
        Row(case, "solve over bare GTSAM", "ratio", plain / bare, "", "<= 1.5"),
        Row(case, "solve and all marginals", "time", plain, "s", "<= 60 with registration"),
        Row(case, "the same with GNC", "time", robust, "s"),
    ]


def _bare_gtsam(factors: Any, start: Any) -> None:
    """Solve the same factors with GTSAM alone, and ask every marginal that a survey needs."""
    import gtsam as typed_gtsam

    gtsam: Any = typed_gtsam
    result = gtsam.GaussNewtonOptimizer(factors, start, gauss_newton()).optimize()
    marginals = gtsam.Marginals(factors, result)
    keys = result.keys()
    for key in keys:
        if chr(gtsam.Symbol(key).chr()) not in "gm":
            marginals.marginalCovariance(key)


def _gridding(n: int = 10_000_000) -> list[Row]:
    rng = np.random.default_rng(1)
    lines, columns, side = n // 1000, 1000, 1000
    across = np.linspace(-60.0, 60.0, columns)
    east = rng.uniform(100.0, 900.0, lines)
    north = rng.uniform(100.0, 900.0, lines)
    heading = rng.uniform(0.0, 2 * np.pi, lines)
    height = rng.normal(-30.0, 1.0, (lines, columns))
    sigma = np.full((lines, columns), 0.2)
    nothing = np.zeros(lines)

    def ours() -> Any:
        return bin_lines(
            height, sigma, east, north, heading, across, nothing, Spacing(1, 1, 1.0), 1.0,
            Window(0, 0, side, side), (0, 0),
        )  # fmt: skip

    ours()
    x = east[:, None] + np.cos(heading)[:, None] * across
    y = north[:, None] - np.sin(heading)[:, None] * across
    index = (y.astype(int) * side + x.astype(int)).ravel()

    def bare() -> Any:
        return np.bincount(index, height.ravel(), minlength=side * side), np.bincount(
            index, minlength=side * side
        )

    case = "10 million soundings, 1 m cells"
    return [
        Row(case, "bin_lines, from poses to five sums", "time", _seconds(ours, 2), "s",
            "<= 2 x bincount"),
        Row(case, "numpy bincount x 2, cells known", "time", _seconds(bare, 2), "s"),
    ]  # fmt: skip


def _public_sets() -> list[Row]:
    # The peer of this benchmark, not a solver of ours.
    import gtsam as typed_gtsam

    gtsam: Any = typed_gtsam

    rows = []
    for name in ("intel", "manhattan", "kitti_00", "smallGrid3D", "sphere2500"):
        path = _SETS / f"{name}.g2o"
        if not path.exists():
            rows.append(Row(name, "optimise", "error", None, "", note="set not there"))
            continue
        graph = read_g2o(path)
        start = time.perf_counter()
        optimum = optimise(graph)
        seconds = time.perf_counter() - start
        factors = gtsam_factors(graph)
        held = factors.clone()
        values = gtsam_values(graph if len(graph.key) else dead_reckoned(graph))
        first = int(graph.edge[0, 0])
        at, prior, size = (
            (values.atPose2, gtsam.PriorFactorPose2, 3)
            if graph.planar
            else (values.atPose3, gtsam.PriorFactorPose3, 6)
        )
        held.add(prior(first, at(first), gtsam.noiseModel.Isotropic.Sigma(size, 1e-3)))
        start = time.perf_counter()
        theirs = gtsam.LevenbergMarquardtOptimizer(held, values).optimize()
        bare = time.perf_counter() - start
        rows += [
            Row(name, "optimise", "error", optimum.error, "half chi2", "<= GTSAM's LM"),
            Row(name, "optimise", "time", seconds, "s"),
            Row(name, "GTSAM LM from the file", "error", factors.error(theirs), "half chi2"),
            Row(name, "GTSAM LM from the file", "time", bare, "s"),
        ]
    return rows
