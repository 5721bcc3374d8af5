"""A map that outgrows memory: tiles of planted strips, memory against size, the slowest step.

Strips are planted, not simulated: a known surface and noise of the stated sigma, written as `bathynav strips`
writes them. What is measured is all that follows them: digest, plan, tiles on a local Dask cluster, COG with
overviews. The small run is one sixteenth of the large one; `BATHYNAV_TILES=1,4,16` measures all three, up to
128 km of track and 200 million cells (some minutes, 5 GB of disk).
"""

from __future__ import annotations

import logging
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from mapping.cog import Frame, write_cog
from mapping.fusion import fuse
from mapping.placed import placed
from mapping.tile_plan import FiledStrip, StripFile, TilePlan, filed, plan_tiles
from mapping.tile_run import fuse_tiles
from mapping.tile_store import TileStore
from perception.records import ElevationStrip, FloatArray, Progress
from perception.strip_files import read_strip, write_strip
from scenarios.benchmarks import Row, Table
from scenarios.cluster import open_cluster

logger = logging.getLogger(__name__)

_CRS = "EPSG:32630"
_ORIGIN_M = (500_000.0, 5_600_000.0)
_CELL_M, _STEP_M, _REACH_M, _APART_M = 0.25, 0.5, 100.0, 100.0
# Of the smallest size: length of lines, and how many; each four-fold doubles both.
_LENGTH_M, _LINES = 500.0, 16
_SAMPLE_S = 0.1


def run(progress: Progress) -> Table:
    """Measure the small size, or those that `BATHYNAV_TILES` lists."""
    sizes = [int(size) for size in os.environ.get("BATHYNAV_TILES", "1").split(",")]
    rows: list[Row] = []
    ground = _ground(np.random.default_rng(1))
    with tempfile.TemporaryDirectory(prefix="bathynav-tiles-") as folder:
        for done, size in enumerate(sizes, start=1):
            rows += _one_size(ground, Path(folder) / f"{size}x", size)
            progress("tiled maps", done, len(sizes))
    settings: dict[str, object] = {"seed": 1, "cell_m": _CELL_M, "sounding_spacing_m": _STEP_M, "tile_cells": 1024,
                "workers": os.cpu_count()}  # fmt: skip
    return Table("tiles", tuple(rows), settings)


@dataclass
class _Watch:
    """Seconds and greatest memory (resident, all processes) of the stages of a run."""

    seconds: dict[str, float] = field(default_factory=dict)
    peak_mb: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        stop, peak = threading.Event(), [0.0]

        def look() -> None:
            while not stop.wait(_SAMPLE_S):
                peak[0] = max(peak[0], _memory_mb())

        watcher = threading.Thread(target=look, daemon=True)
        watcher.start()
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = time.perf_counter() - start
            stop.set()
            watcher.join()
            self.peak_mb[name] = max(peak[0], _memory_mb())
            logger.info("%s: %.1f s, %.0f MB", name, self.seconds[name], self.peak_mb[name])


def _memory_mb() -> float:
    me = psutil.Process()
    total = 0
    for process in (me, *me.children(recursive=True)):
        try:
            total += process.memory_info().rss
        except psutil.NoSuchProcess:
            continue
    return total / 1e6


def _one_size(ground: FloatArray, folder: Path, size: int) -> list[Row]:
    scale = int(np.sqrt(size))
    folder.mkdir()
    watch = _Watch()
    with watch.stage("strips planted"):
        for index in range(_LINES * scale):
            strip = _planted(ground, index, _LENGTH_M * scale, np.random.default_rng((1, index)))
            write_strip(folder / f"strip-{index:03d}.nc", strip)
    with watch.stage("strips digested and placed"):
        plan = plan_tiles([_filed(p) for p in sorted(folder.glob("*.nc"))], _CELL_M, _CRS)
    with watch.stage("tiles fused"), open_cluster(hold_memory=True) as client:
        store, _, made = fuse_tiles(plan, folder / "tiles", client)
    with watch.stage("COG with overviews"):
        _write(folder / "map.tif", plan, store)
    rows = _figures(ground, plan, store, watch, size, made)
    if size == 1:
        rows += _in_one_piece(plan, store, sorted(folder.glob("*.nc")))
    return rows


def _figures(
    ground: FloatArray, plan: TilePlan, store: TileStore, watch: _Watch, size: int, made: int
) -> list[Row]:
    km = len(plan.strips) * _LENGTH_M * np.sqrt(size) / 1000
    cells = plan.shape[0] * plan.shape[1]
    case = f"{size}x: {km:.0f} km of track, {cells / 1e6:.0f} million cells, {made} tiles"
    rows = [Row(case, name, "time", seconds, "s") for name, seconds in watch.seconds.items()]
    after = {k: v for k, v in watch.peak_mb.items() if k != "strips planted"}
    worst = max(after, key=lambda k: after[k])
    rows.append(
        Row(case, "all processes", "peak memory", after[worst], "MB", "<= 4000", f"while: {worst}")
    )
    error, ratio = _against_truth(ground, plan, store)
    rows += [
        Row(case, "tiled map", "rms error against the planted surface", error, "m"),
        Row(case, "tiled map", "rms of error over sigma", ratio, "", "about 0.9",
            "0.92 of very many lines: Birge's ratio only ever widens sigma"),
    ]  # fmt: skip
    return rows


def _in_one_piece(plan: TilePlan, store: TileStore, paths: list[Path]) -> list[Row]:
    """Fuse the same strips in memory: the peer, and the proof that tiles change nothing."""
    watch = _Watch()
    with watch.stage("fuse"):
        grid = fuse([read_strip(path) for path in paths], _CELL_M)
    tiled = store.read("elevation", (slice(0, plan.shape[0]), slice(0, plan.shape[1])))
    apart = np.abs(tiled - grid.elevation_m.astype(np.float32))
    case = "1x in one piece, one process"
    return [
        Row(case, "mapping.fuse", "time", watch.seconds["fuse"], "s"),
        Row(case, "mapping.fuse", "peak memory", watch.peak_mb["fuse"], "MB"),
        Row(case, "tiled map", "largest difference", float(np.nanmax(apart)), "m", "0"),
    ]


def _ground(rng: np.random.Generator, size: int = 2048) -> FloatArray:
    """Return a periodic fractal surface on nodes `_STEP_M` apart."""
    k = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size))
    k[0, 0] = np.inf
    field_m = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(size, size))) * k**-1.8, s=(size, size))
    return (-35.0 + field_m / field_m.std()).astype(np.float32)


def _height(ground: FloatArray, east: FloatArray, north: FloatArray) -> FloatArray:
    """Interpolate the surface at places counted from the origin."""
    size = len(ground)
    row, col = north / _STEP_M, east / _STEP_M
    r, c = np.floor(row).astype(np.int64), np.floor(col).astype(np.int64)
    fr, fc = (row - r).astype(np.float32), (col - c).astype(np.float32)
    r0, r1, c0, c1 = r % size, (r + 1) % size, c % size, (c + 1) % size
    south = (1 - fc) * ground[r0, c0] + fc * ground[r0, c1]
    return (1 - fr) * south + fr * ((1 - fc) * ground[r1, c0] + fc * ground[r1, c1])


def _planted(
    ground: FloatArray, index: int, length_m: float, rng: np.random.Generator
) -> ElevationStrip:
    """Return a line north or south: the surface, white noise within a cell and an error of the whole line."""
    n = int(length_m / _STEP_M)
    across = np.arange(-_REACH_M, _REACH_M, _STEP_M) + _STEP_M / 2
    along = np.arange(n) * _STEP_M
    up = index % 2 == 0
    north = along if up else length_m - along
    east = np.full(n, index * _APART_M + _REACH_M) + np.cumsum(rng.normal(0, 0.02, n))
    heading = np.zeros(n) if up else np.full(n, np.pi)
    cells_e = east[:, None] + (1 if up else -1) * across
    height = _height(ground, cells_e, np.broadcast_to(north[:, None], cells_e.shape))
    sigma = (0.1 + 0.002 * np.abs(across) + np.zeros((n, 1))).astype(np.float32)
    # One error for all the line: what a cell's data of one pass share, and fusion does not average away.
    height = height + rng.normal() * sigma
    return ElevationStrip(
        elevation_m=height.astype(np.float32), sigma_m=sigma, across_m=across,
        echo=rng.standard_gamma(4.0, height.shape, dtype=np.float32) / 4,
        shadow=np.zeros(height.shape, bool), time_s=1.7e9 + index * 1e4 + along, ping=np.arange(n),
        easting_m=_ORIGIN_M[0] + east, northing_m=_ORIGIN_M[1] + north, depth_m=np.full(n, 15.0),
        heading_rad=heading, altitude_m=np.full(n, 20.0), altitude_sigma_m=np.full(n, 0.1), crs=_CRS,
        pass_index=index,
    )  # fmt: skip


def _filed(path: Path) -> FiledStrip:
    strip = read_strip(path)
    return filed(StripFile.of(path), placed(strip), strip.altitude_m)


def _write(path: Path, plan: TilePlan, store: TileStore) -> None:
    bands = ("elevation", "sigma", "count")
    frame = Frame(plan.west_m, plan.north_m, plan.cell_m, plan.shape, plan.crs)
    slices: Callable[[Any], Any] = plan.slices
    windows = (
        (slices(tile), {name: store.read(name, slices(tile)) for name in bands})
        for tile in plan.tiles()
    )
    write_cog(path, frame, bands, windows)


def _against_truth(ground: FloatArray, plan: TilePlan, store: TileStore) -> tuple[float, float]:
    """Return rms error, and rms of error over sigma, of a dozen tiles or so."""
    errors, ratios = [], []
    tiles = plan.tiles()
    for tile in tiles[:: max(1, len(tiles) // 13)]:
        rows, cols = where = plan.slices(tile)
        height, sigma = store.read("elevation", where), store.read("sigma", where)
        east = plan.west_m + (np.arange(cols.start, cols.stop) + 0.5) * plan.cell_m - _ORIGIN_M[0]
        north = plan.north_m - (np.arange(rows.start, rows.stop) + 0.5) * plan.cell_m - _ORIGIN_M[1]
        e, n = np.meshgrid(east, north)
        error = height - _height(ground, e, n)
        errors.append(np.nanmean(error**2))
        ratios.append(np.nanmean((error / sigma) ** 2))
    return float(np.sqrt(np.mean(errors))), float(np.sqrt(np.mean(ratios)))
