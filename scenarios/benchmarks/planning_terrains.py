"""Terrains that force a detour, for the benchmarks of planning; two from real heights where they are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from perception.records import FloatArray, Grid

# Cells along a side.
N = 1000
_DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "bathymetry"


@dataclass(frozen=True, slots=True)
class Case:
    """A terrain with its ends."""

    name: str
    grid: Grid
    start: tuple[float, float]
    goal: tuple[float, float]


def _case(name: str, z: FloatArray, start: tuple[int, int], goal: tuple[int, int]) -> Case:
    grid = Grid(z, 500_000.0, 4_100_000.0, 1.0, crs="EPSG:32632")
    e, n = grid.centres()
    return Case(name, grid, (e[start[1]], n[start[0]]), (e[goal[1]], n[goal[0]]))


def canyon_terrain(seed: int, rim_m: float, n: int = N, floor_m: float = -60.0) -> FloatArray:
    """Return a meandering canyon cut into a plateau, with rough ground; walls of 25 to 40 deg."""
    rng = np.random.default_rng(seed)
    row, col = np.mgrid[:n, :n].astype(float)
    middle = n / 2 + 0.3 * n * np.sin(2 * np.pi * (row / n * 1.4 + rng.uniform()))
    across = np.abs(col - middle)
    wall = (rim_m - floor_m) / (1 + np.exp(-(across - 0.055 * n) / 16.0))
    rough = 30.0 * ndimage.gaussian_filter(rng.normal(size=(n, n)), 20)
    return np.asarray(
        floor_m + wall + rough + 3.0 * ndimage.gaussian_filter(rng.normal(size=(n, n)), 4)
    )


def _lowest(z: FloatArray, rows: slice) -> tuple[int, int]:
    part = z[rows]
    r, c = np.unravel_index(int(np.nanargmin(part)), part.shape)
    return int(r) + rows.start, int(c)


def _real(name: str, z: FloatArray, cell_m: float) -> Case:
    """Return real heights as a sea floor of 1,000 x 1,000 cells of 1 m, slopes as they are."""
    scale = N / min(z.shape)
    side = min(z.shape)
    fine = ndimage.zoom(z[:side, :side], scale, order=3)[:N, :N] / (cell_m / (1.0 / scale))
    fine = fine - np.nanmax(fine) - 10.0
    a, b = _lowest(fine, slice(40, 140)), _lowest(fine, slice(N - 140, N - 40))
    return _case(name, fine, a, b)


def cases() -> list[Case]:
    """Return the benchmark's terrains."""
    out = []
    for seed, rim in ((1, 20.0), (2, 20.0), (3, -25.0), (4, -35.0)):
        z = canyon_terrain(seed, rim)
        kind = "walls above water" if rim > 0 else f"walls of {rim + 60:.0f} m"
        out.append(
            _case(
                f"canyon {seed}, {kind}",
                z,
                _lowest(z, slice(8, 20)),
                _lowest(z, slice(N - 20, N - 8)),
            )
        )
    if (_DATA / "davosdorf.tif").exists():
        from mapping.rasters import read_map

        real = read_map(_DATA / "davosdorf.tif")
        out.append(_real("davosdorf (real)", real.elevation_m, real.cell_m))
    if (_DATA / "topobathy.npz").exists():
        heights = np.load(_DATA / "topobathy.npz")["topo"].astype(float)
        # 2 arc-minutes, some 2.5 km a cell: relief exaggerated tenfold to give slopes at all.
        out.append(_real("topobathy (real, x10)", heights * 10.0, 2500.0))
    return out
