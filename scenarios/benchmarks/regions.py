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
from perception.regions import segment
from scenarios.benchmarks import Row, Table

Array = npt.NDArray[np.floating[Any]]

_SEEDS = (11, 12, 13)
_CELLS = 512
_NOISES_M = {0.0: ">= 0.99", 0.02: ">= 0.975", 0.10: ">= 0.945", 0.30: ">= 0.92"}
_FIXED_CELLS = (1, 2, 3, 4, 5, 6, 7, 8, 10, 12)
_LARGE = 4096


def bumps(
    n: int, rng: np.random.Generator, count: int = 60, relief_m: float = 31.0
) -> dict[str, Array]:
    """Return a sum of Gaussian bumps of 10 to 60 cells: heights `z`, exact `H` and `K`, (n, n) each."""
    x = np.arange(n) + 0.5
    sums = {name: np.zeros((n, n)) for name in "zpqrst"}
    for _ in range(count):
        (cx, cy), width, height = rng.uniform(0, n, 2), rng.uniform(10, 60), rng.uniform(-1, 1)
        u, v = (x - cx) / width, (cy - x) / width  # rows run south, y north
        g, h = np.exp(-(u**2) / 2), np.exp(-(v**2) / 2)
        g1, h1 = -u * g / width, -v * h / width
        g2, h2 = (u**2 - 1) * g / width**2, (v**2 - 1) * h / width**2
        parts = {"z": (h, g), "p": (h, g1), "q": (h1, g), "r": (h, g2), "s": (h1, g1), "t": (h2, g)}
        for name, (down, across) in parts.items():
            sums[name] += height * np.outer(down, across)
    z, p, q, r, s, t = (relief_m / np.ptp(sums["z"]) * sums[name] for name in "zpqrst")
    w2 = 1 + p**2 + q**2
    mean = ((1 + q**2) * r - 2 * p * q * s + (1 + p**2) * t) / (2 * w2**1.5)
    return {"z": z, "H": mean, "K": (r * t - s**2) / w2**2}


def _agreement(found: tuple[Array, Array], truth: dict[str, Array], rim: int) -> float:
    same = (np.sign(found[0]) == np.sign(truth["H"])) & (np.sign(found[1]) == np.sign(truth["K"]))
    return float(same[rim : len(same) - rim or None, rim : len(same) - rim or None].mean())


def _accuracy(progress: Progress) -> list[Row]:
    from scipy.ndimage import gaussian_filter

    rows = []
    for step, (noise_m, goal) in enumerate(_NOISES_M.items()):
        progress("signs under noise", step, len(_NOISES_M))
        ours: dict[int, list[float]] = {0: [], 16: []}
        fixed: dict[int, list[float]] = {0: [], 16: []}
        for seed in _SEEDS:
            rng = np.random.default_rng(seed)
            truth = bumps(_CELLS, rng)
            noisy = truth["z"] + rng.normal(0, noise_m, truth["z"].shape)
            curvature = segment(Grid(noisy, 0.0, float(_CELLS), 1.0)).curvature
            by_scale = [
                mean_and_gaussian(
                    derivatives_3x3(gaussian_filter(noisy, width), 1.0, 1.0, "least-squares")
                )
                for width in _FIXED_CELLS
            ]
            for rim in ours:
                ours[rim].append(_agreement((curvature.H, curvature.K), truth, rim))
                fixed[rim].append(max(_agreement(found, truth, rim) for found in by_scale))
        for rim, where in ((0, "all cells"), (16, "16 cells off the edge")):
            case = f"60 bumps, {100 * noise_m:g} cm noise, {where}"
            rows.append(
                Row(case, "bathynav", "sign agreement", float(np.mean(ours[rim])), "1", goal)
            )
            rows.append(
                Row(case, "Gaussian + 3x3", "sign agreement", float(np.mean(fixed[rim])), "1",
                    note="best fixed scale with hindsight")
            )  # fmt: skip
        if noise_m == 0.10:
            rows.append(_xdem_agreement(noisy, truth))
    progress("signs under noise", len(_NOISES_M), len(_NOISES_M))
    return rows


def _installed(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def _xdem_agreement(noisy: Array, truth: dict[str, Array]) -> Row:
    case = "60 bumps, 10 cm noise, 16 cells off the edge"
    xdem = _installed("xdem")
    if xdem is None:
        return Row(case, "xdem", "sign agreement", None, "1", note="not installed")
    names = ["profile_curvature", "tangential_curvature"]
    profile, tangential = xdem.terrain.get_terrain_attribute(noisy, names, resolution=1.0)
    # xdem's signs differ between its curvatures and versions: the better reading counts.
    best = max(
        _agreement((sign * (profile + tangential), profile * tangential), truth, 16)
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
    segment(Grid(fractal(2048, rng)[:1500, :1500], 0.0, 0.0, 1.0))  # compile in both precisions
    z = fractal(_LARGE, rng)
    case = f"{_LARGE} x {_LARGE} fractal"
    progress("large map", 0, 4)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    wall, cpu = _timed(lambda: segment(Grid(z, 0.0, 0.0, 1.0)))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    rows = [
        Row(case, "bathynav", "heights to regions, wall", wall, "s", "<= 4"),
        Row(case, "bathynav", "heights to regions, processor", cpu, "s"),
        Row(case, "bathynav", "memory at peak", peak / 1e6, "GB", "<= 1.5",
            f"{before / 1e6:.2f} GB before"),
    ]  # fmt: skip
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
    """Measure accuracy on three sets of bumps and speed on a large map, peers in the same run."""
    rows = _accuracy(progress) + _speed(progress)
    settings = {"seeds": _SEEDS, "cells": _CELLS, "large": _LARGE, "fixed_scales": _FIXED_CELLS}
    return Table("regions", tuple(rows), settings)
