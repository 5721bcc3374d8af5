"""Gaps of a tiled map filled, tile by tile with a rim, from the store and into layers of their own."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterator
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mapping.fill import SEARCH, Variogram, fill_gaps, learn_variogram
from mapping.tile_plan import TilePlan
from mapping.tile_run import Tile, plan_of, run_tiles, store_of
from mapping.tile_store import FILLED, TileStore
from perception.files import existing_file
from perception.records import FloatArray, Progress, silent

# Tiles that stand for the whole map when its roughness is learned.
_LEARNED_TILES = 24


def fill_tiles(
    plan: TilePlan,
    store: TileStore,
    reach_m: float,
    client: Any = None,
    progress: Progress = silent,
) -> int:
    """Fill the gaps of a fused map up to `reach_m` from data; return how many cells were filled.

    The layers `fill` and `fill_sigma` hold the filled cells; those of data stay as they are. What is filled
    already with the same reach from the same tiles is kept.
    """
    variogram = learn_variogram(_sample(plan, store), plan.cell_m, reach_m)
    path = Path(store.folder).absolute() / "plan.npz"
    stamp = existing_file(path).stat().st_mtime_ns
    keys = _keys(plan, _rim(plan, reach_m), reach_m, variogram)
    work = functools.partial(make_fill, str(path), stamp, reach_m, variogram)
    figures, _ = run_tiles(store, keys, work, FILLED, client, progress)
    return sum(int(said.get("filled", 0)) for said in figures)


def make_fill(
    plan_path: str, stamp: int, reach_m: float, variogram: Variogram, tile: Tile, key: str
) -> Tile:
    """Fill one tile, write it and mark it; the function that workers call."""
    plan = plan_of(plan_path, stamp)
    store = store_of(str(Path(plan_path).parent), stamp)
    where = plan.slices(tile)
    outer = tuple(
        slice(max(part.start - _rim(plan, reach_m), 0), min(part.stop + _rim(plan, reach_m), size))
        for part, size in zip(where, plan.shape, strict=True)
    )
    rows, cols = outer
    height, sigma = (
        store.read(name, (rows, cols)).astype(float) for name in ("elevation", "sigma")
    )
    inner = tuple(
        slice(part.start - out.start, part.stop - out.start)
        for part, out in zip(where, outer, strict=True)
    )
    filled, filled_sigma = (
        np.asarray(layer[inner], np.float32)
        for layer in fill_gaps(height, sigma, plan.cell_m, reach_m, variogram)
    )
    store.unmark(tile, FILLED)
    store.write(where, {"fill": filled, "fill_sigma": filled_sigma})
    store.mark(tile, key, {"filled": int(np.isfinite(filled).sum())}, FILLED)
    return tile


def with_fill(
    layers: dict[str, npt.NDArray[Any]], fill: FloatArray, fill_sigma: FloatArray
) -> dict[str, npt.NDArray[Any]]:
    """Return a tile's layers with its filled cells in place and a layer `filled`, 1 where they are."""
    there = np.isfinite(fill)
    return layers | {
        "elevation": np.where(there, fill, layers["elevation"]),
        "sigma": np.where(there, fill_sigma, layers["sigma"]),
        "filled": there.astype(np.float32),
    }


def _rim(plan: TilePlan, reach_m: float) -> int:
    """Return the cells around a tile that decide what its gaps are filled with."""
    return int(np.ceil(SEARCH * reach_m / plan.cell_m)) + 1


def _sample(plan: TilePlan, store: TileStore) -> Iterator[FloatArray]:
    tiles = plan.tiles()
    for tile in tiles[:: max(1, len(tiles) // _LEARNED_TILES)]:
        yield store.read("elevation", plan.slices(tile))


def _keys(plan: TilePlan, rim: int, reach_m: float, variogram: Variogram) -> dict[Tile, str]:
    """Return for each tile the digest of all that decides how it is filled: the tiles within the rim, and how."""
    fused = {tile: plan.key(tile).encode() for tile in plan.tiles()}
    near = -(-rim // plan.tile_cells)
    around = [(i, j) for i in range(-near, near + 1) for j in range(-near, near + 1)]
    keys = {}
    for row, col in fused:
        digest = hashlib.blake2b(repr((reach_m, astuple(variogram))).encode(), digest_size=16)
        for i, j in around:
            digest.update(fused.get((row + i, col + j), b"none"))
        keys[row, col] = digest.hexdigest()
    return keys
