"""Regions: signs of H and K under noise against fixed scales and peers, and seconds for large maps."""

from __future__ import annotations

import importlib
import resource
from collections.abc import Callable
from time import perf_counter, process_time
from typing import Any

import numpy as np
import numpy.typing as npt

from perception.curvature import derivatives_3x3, mean_and_gaussian
from perception.records import Grid, Progress, silent
from perception.region_detail import curvature_at
from perception.regions import RegionConfig, segment
from scenarios.benchmarks import Row, Table
from scenarios.benchmarks.region_terrains import EXACT, TERRAINS, Truth, bumps, of_formula, turned

Array = npt.NDArray[np.floating[Any]]

# Never looked at while the method was made.
_SEEDS = range(101, 111)
_TERRAIN_SEEDS = range(101, 104)
_DRAWS = 12
_CELLS = 512
_NOISES_M = {0.0: ">= 0.99", 0.02: ">= 0.975", 0.10: ">= 0.945", 0.30: ">= 0.92"}
_FIXED_CELLS = (1, 2, 3, 4, 5, 6, 7, 8, 10, 12)
_LARGE = 4096


def _agreement(found: tuple[Array, Array], truth: dict[str, Array], rim: int) -> float:
    same = (np.sign(found[0]) == np.sign(truth["H"])) & (np.sign(found[1]) == np.sign(truth["K"]))
    return float(same[rim : len(same) - rim or None, rim : len(same) - rim or None].mean())


def _fixed(noisy: Array) -> list[tuple[Array, Array]]:
    """Return H and K after Gaussians of every fixed width, the classical way."""
    from scipy.ndimage import gaussian_filter

    return [
        mean_and_gaussian(derivatives_3x3(gaussian_filter(noisy, width), 1.0, 1.0, "least-squares"))
        for width in _FIXED_CELLS
    ]


def _signs(
    make: Callable[[int, np.random.Generator], Truth], n: int, noise_m: float, seeds: range
) -> tuple[list[float], list[float]]:
    """Return the share of right signs by seed: ours, and the best fixed scale's with hindsight."""
    ours, fixed = [], []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        truth = make(n, rng)
        noisy = truth["z"] + rng.normal(0, noise_m, truth["z"].shape)
        found = curvature_at(Grid(noisy, 0.0, float(n), 1.0), None, 0.0, "difference")
        ours.append(_agreement((found.H, found.K), truth, 0))
        fixed.append(max(_agreement(pair, truth, 0) for pair in _fixed(noisy)))
    return ours, fixed


def _accuracy(progress: Progress) -> list[Row]:
    rows = []
    jobs: list[tuple[str, Any, int, float, range]] = [
        ("60 bumps", bumps, _CELLS, noise_m, _SEEDS) for noise_m in _NOISES_M
    ]
    jobs += [(name, make, 256, 0.10, _TERRAIN_SEEDS) for name, make in TERRAINS.items()]
    for step, (name, make, n, noise_m, seeds) in enumerate(jobs):
        progress("signs under noise", step, len(jobs))
        ours, fixed = _signs(make, n, noise_m, seeds)
        case = f"{name}, {100 * noise_m:g} cm noise, {len(seeds)} maps"
        goal = _NOISES_M[noise_m] if name == "60 bumps" else ""
        rows += [
            Row(case, "bathynav", "sign agreement, mean", float(np.mean(ours)), "1", goal),
            Row(case, "bathynav", "sign agreement, worst", float(np.min(ours)), "1"),
            Row(case, "Gaussian + 3x3", "sign agreement, mean", float(np.mean(fixed)), "1",
                note="best fixed scale of each map with hindsight"),
        ]  # fmt: skip
    rng = np.random.default_rng(_SEEDS[0])
    truth = bumps(_CELLS, rng)
    rows.append(_xdem_agreement(truth["z"] + rng.normal(0, 0.1, truth["z"].shape), truth))
    progress("signs under noise", len(jobs), len(jobs))
    return rows


def _exact() -> list[Row]:
    """Return the largest error inside the edge, of H by its own size and of K by that of H^2."""
    rows = []
    for name, formula in EXACT.items():
        worst = 0.0
        for azimuth_deg in (0.0, 17.0, 45.0):
            truth = of_formula(101, turned(formula, np.radians(azimuth_deg)), None)
            found = curvature_at(Grid(truth["z"], 0.0, 101.0, 1.0), None, 0.0, "difference")
            size = max(float(np.abs(truth["H"]).max()), float(np.sqrt(np.abs(truth["K"]).max())))
            size = size if size > 1e-7 else 1.0  # a plane has no size of its own
            for mine, true, unit in ((found.H, truth["H"], size), (found.K, truth["K"], size**2)):
                worst = max(worst, float(np.abs(mine - true)[2:-2, 2:-2].max() / unit))
        rows.append(Row(name, "bathynav", "largest error over size", worst, "1", "<= 0.005",
                        "turned by 0, 17, 45 deg; no noise"))  # fmt: skip
    return rows


def _honesty(progress: Progress) -> list[Row]:
    """Return empirical over predicted sigma of H, over draws of noise on one surface."""
    truth = bumps(256, np.random.default_rng(5))
    rng = np.random.default_rng(6)
    means, variances = [], []
    for draw in range(_DRAWS):
        progress("sigma of H", draw, _DRAWS)
        noisy = Grid(truth["z"] + rng.normal(0, 0.1, truth["z"].shape), 0.0, 256.0, 1.0)
        found = curvature_at(noisy, None, 0.0, "difference")
        means.append(found.H)
        variances.append(np.square(found.sigma_H))
    progress("sigma of H", _DRAWS, _DRAWS)
    ratio = np.sqrt(np.var(means, axis=0, ddof=1)[20:-20, 20:-20].mean()
                    / np.mean(variances, axis=0)[20:-20, 20:-20].mean())  # fmt: skip
    case = f"60 bumps on 256 x 256, 10 cm noise, {_DRAWS} draws"
    return [Row(case, "bathynav", "empirical over predicted sigma of H", float(ratio), "1",
                "0.9 to 1.1", "20 cells off the edge, scale chosen anew each time")]  # fmt: skip


def _installed(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def _xdem_agreement(noisy: Array, truth: dict[str, Array]) -> Row:
    case = "60 bumps, 10 cm noise, one map"
    xdem = _installed("xdem")
    if xdem is None:
        return Row(case, "xdem", "sign agreement", None, "1", note="not installed")
    names = ["profile_curvature", "tangential_curvature"]
    profile, tangential = xdem.terrain.get_terrain_attribute(noisy, names, resolution=1.0)
    # xdem's signs differ between its curvatures and versions: the better reading counts.
    best = max(
        _agreement((sign * (profile + tangential), profile * tangential), truth, 0)
        for sign in (-1, 1)
    )
    return Row(case, "xdem", "sign agreement", best, "1", note="3 x 3, no scale")


def fractal(n: int, rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """Return power-law terrain, spectrum f^-4, 20 m rms, with 10 cm of noise, (n, n)."""
    from scipy import fft

    f = np.hypot(fft.fftfreq(n)[:, None], fft.rfftfreq(n)).astype(np.float32)
    f[0, 0] = 1
    z = fft.irfft2(fft.rfft2(rng.normal(size=(n, n)).astype(np.float32)) * f**-2, s=(n, n))
    z *= 20 / z.std()
    return (z - z.mean() + rng.normal(0, 0.1, (n, n))).astype(np.float32)


def _timed(work: Callable[[], Any]) -> tuple[float, float]:
    wall, cpu = perf_counter(), process_time()
    work()
    return perf_counter() - wall, process_time() - cpu


def _speed(progress: Progress) -> list[Row]:
    rng = np.random.default_rng(1)
    segment(
        Grid(np.ascontiguousarray(fractal(2048, rng)[:1500, :1500]), 0.0, 0.0, 1.0)
    )  # compile in both precisions
    z = fractal(_LARGE, rng)
    case = f"{_LARGE} x {_LARGE} fractal"
    progress("large map", 0, 4)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    wall, cpu = _timed(lambda: segment(Grid(z, 0.0, 0.0, 1.0)))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    rows = [
        Row(case, "bathynav", "heights to regions, wall", wall, "s", "<= 4", "compiled before"),
        Row(case, "bathynav", "heights to regions, processor", cpu, "s"),
        Row(case, "bathynav", "memory at peak", peak / 1e6, "GB", "<= 1.5",
            f"{before / 1e6:.2f} GB before"),
    ]  # fmt: skip
    wall, cpu = _timed(lambda: segment(Grid(z, 0.0, 0.0, 1.0), RegionConfig(detail_m=0.0)))
    rows += [
        Row(case, "bathynav", "the same at the finest detail, wall", wall, "s"),
        Row(case, "bathynav", "the same at the finest detail, processor", cpu, "s"),
    ]
    progress("large map", 1, 4)
    for step, (name, figure, work) in enumerate(_peers(z), start=2):
        seconds = None if work is None else _timed(work)[0]
        note = "not installed" if work is None else ""
        rows.append(Row(case, name, figure, seconds, "s", note=note))
        progress("large map", min(step, 4), 4)
    progress("large map", 4, 4)
    return rows


def _peers(z: npt.NDArray[np.float32]) -> list[tuple[str, str, Callable[[], Any] | None]]:
    """Return what the peers do of the same job: curvature alone, or labels alone."""
    xdem, measure = _installed("xdem"), _installed("skimage.measure")
    wbw = _installed("whitebox_workflows")
    names = ["profile_curvature", "tangential_curvature"]
    return [
        (
            "xdem",
            "two curvatures, 3 x 3",
            None if xdem is None else lambda: xdem.terrain.get_terrain_attribute(z, names, resolution=1.0),
        ),
        ("whitebox-workflows", "H and K", None if wbw is None else lambda: _whitebox(wbw, z)),
        (
            "scikit-image",
            "labels of eight classes alone",
            None if measure is None else lambda: measure.label(_rough_classes(z)),
        ),
    ]  # fmt: skip


def _whitebox(wbw: Any, z: npt.NDArray[np.float32]) -> None:
    import tempfile
    from pathlib import Path

    from mapping.rasters import write_bands

    environment = wbw.WbEnvironment()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "z.tif"
        write_bands(path, {"elevation": z}, Grid(z, 0.0, 0.0, 1.0, crs="EPSG:32631"))
        raster = environment.read_raster(str(path))
        environment.mean_curvature(raster)
        environment.gaussian_curvature(raster)


def _rough_classes(z: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    mean, gauss = mean_and_gaussian(derivatives_3x3(z, 1.0, 1.0))
    classes: npt.NDArray[np.uint8] = (1 + 2 * (mean > 0) + (gauss > 0)).astype(np.uint8)
    return classes


def run(progress: Progress = silent) -> Table:
    """Measure exactness, honesty, signs on maps not seen before, and speed; peers in the same run."""
    # Speed first: memory at its peak is the process's, not the step's.
    speed = _speed(progress)
    rows = _exact() + _honesty(progress) + _accuracy(progress) + speed
    settings = {
        "seeds": list(_SEEDS),
        "terrain_seeds": list(_TERRAIN_SEEDS),
        "cells": _CELLS,
        "large": _LARGE,
        "fixed_scales": _FIXED_CELLS,
    }
    return Table("regions", tuple(rows), settings)
