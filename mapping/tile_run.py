"""All tiles of a map: what is done is kept, the rest is made here or on a Dask cluster.

A tile is made by one process from the plan on disk and written to the store, then marked with the digest
of all it came from. Tiles share nothing, so their number of makers and their order change no bit.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from mapping.tile_figures import tile_figures
from mapping.tile_plan import TilePlan, load_plan, save_plan
from mapping.tile_store import FILLED, FUSED, TileStore
from mapping.tiles import fuse_tile
from perception.files import existing_file
from perception.records import BathynavError, Progress, silent

# Enough tiles under way to keep every worker busy, few enough that a lost scheduler loses little.
_TILES_PER_WORKER = 3

Tile = tuple[int, int]


class TilesLostError(BathynavError):
    """The cluster went away before all tiles were made; those made are kept."""


def fuse_tiles(
    plan: TilePlan, folder: Path, client: Any = None, progress: Progress = silent
) -> tuple[TileStore, list[dict[str, Any]], int]:
    """Make every tile of a plan that the folder does not hold yet.

    Parameters
    ----------
    client : a Dask client whose workers see `folder` and the strips' files; None makes the tiles here.

    Returns
    -------
    store, figures of all tiles in their order, and how many were made new.

    Raises
    ------
    TilesLostError
        The cluster went away; the same call goes on where it stopped.
    """
    store = TileStore.create(folder, plan)
    keys = {tile: plan.key(tile) for tile in plan.tiles()}
    path = Path(folder).absolute() / "plan.npz"
    save_plan(path, plan)
    stamp = existing_file(path).stat().st_mtime_ns
    work = functools.partial(make_tile, str(path), stamp)
    figures, made = run_tiles(store, keys, work, FUSED, client, progress)
    return store, figures, made


def run_tiles(
    store: TileStore,
    keys: Mapping[Tile, str],
    work: Callable[[Tile, str], Tile],
    stage: str,
    client: Any,
    progress: Progress,
) -> tuple[list[dict[str, Any]], int]:
    """Do a stage's work on every tile that is not marked with its key; return all figures and how many."""
    missing = [(tile, key) for tile, key in keys.items() if store.figures(tile, key, stage) is None]
    makers = _here if client is None else functools.partial(_on_cluster, client)
    label = {FUSED: "fusing tiles", FILLED: "filling gaps"}[stage]
    done = len(keys) - len(missing)
    progress(label, done, len(keys))
    for _ in makers(work, missing):
        done += 1
        progress(label, done, len(keys))
    return [store.figures(tile, key, stage) or {} for tile, key in keys.items()], len(missing)


def tiles_to_make(plan: TilePlan, folder: Path) -> int:
    """Return how many tiles of a plan a folder lacks: few are not worth a cluster."""
    store = TileStore.create(folder, plan)
    return sum(store.figures(tile, plan.key(tile)) is None for tile in plan.tiles())


def make_tile(plan_path: str, stamp: int, tile: Tile, key: str) -> Tile:
    """Make one tile, write it and mark it; the function that workers call."""
    plan = plan_of(plan_path, stamp)
    layers = fuse_tile(plan, tile)
    store = store_of(str(Path(plan_path).parent), stamp)
    store.unmark(tile)
    store.write(plan.slices(tile), layers)
    store.mark(tile, key, tile_figures(layers))
    return tile


@functools.lru_cache(maxsize=1)
def plan_of(path: str, stamp: int) -> TilePlan:
    """Return a plan, read once by each process; `stamp` tells it from an earlier one of that name."""
    return load_plan(Path(path))


@functools.lru_cache(maxsize=1)
def store_of(folder: str, stamp: int) -> TileStore:
    """Return the store in a folder, opened once by each process."""
    return TileStore(Path(folder))


def _here(work: Callable[[Tile, str], Tile], missing: list[tuple[Tile, str]]) -> Iterator[Tile]:
    for tile, key in missing:
        yield work(tile, key)


def _on_cluster(
    client: Any, work: Callable[[Tile, str], Tile], missing: list[tuple[Tile, str]]
) -> Iterator[Tile]:
    """Keep a bounded number of tiles under way; yield each as it is done."""
    from distributed import CancelledError, KilledWorker, as_completed

    if not missing:
        return
    workers = max(len(client.scheduler_info(n_workers=-1)["workers"]), 1)
    waiting = iter(missing)
    pending = as_completed(loop=client.loop)

    def submit() -> None:
        for tile, key in waiting:
            future: Future[Tile] = client.submit(
                work, tile, key, key=f"tile-{tile[0]}-{tile[1]}-{key}"
            )
            pending.add(future)
            return

    for _ in range(workers * _TILES_PER_WORKER):
        submit()
    try:
        for future in pending:
            yield future.result()
            future.release()
            submit()
    except (CancelledError, KilledWorker, OSError, TimeoutError) as error:
        raise TilesLostError(
            f"the cluster went away while tiles were fused ({error}); those done are kept: "
            "the same command goes on from there"
        ) from error
