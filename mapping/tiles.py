"""One tile of a map: heights, sigma, count and echo of its cells, from the strips that touch it.

A tile's cells depend on its own and on a rim of one cell (the slope, for sigma), and gridding gives a cell
the same sums in whichever window it lies. So tiles need no blending: the tiled map *is* the map in one piece.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from mapping.flag_layer import added, decided, mostly, mostly_clear, no_votes, vote
from mapping.fusion import combine
from mapping.mosaic import echo_sigma, level_db
from mapping.placed import PassRaster, PlacedStrip, on_window
from mapping.tile_plan import FiledStrip, TilePlan
from perception.quality import CellFlag
from perception.records import FloatArray

Layers = dict[str, npt.NDArray[np.float32]]

# A tile's layers, in the order of the store: NaN no data; count 0.
LAYERS = ("elevation", "sigma", "count", "echo", "flags")
_RIM = 1


def fuse_tile(plan: TilePlan, tile: tuple[int, int]) -> Layers | None:
    """Fuse what touches a tile; None where no strip gives a height or an echo.

    Returns
    -------
    dict of `LAYERS` to (rows, cols) float32, rows north to south; echo in dB, flags of `CellFlag`.
    """
    outer, core = plan.outer(tile, _RIM), plan.core(tile)
    heights: list[PassRaster] = []
    echoes: list[PassRaster] = []
    inner = core.within(outer)
    votes = no_votes(core)
    open_, clear = (np.zeros((core.rows, core.cols), bool) for _ in range(2))
    for index in plan.touching(tile):
        one, blocks = plan.strips[index], plan.boxes[index]
        height = on_window(one.strip, blocks, plan.cell_m, outer)
        echo = on_window(_echoes(one), blocks, plan.cell_m, core)
        own = vote(one.strip, one.file.flags, blocks, plan.cell_m, outer)
        folded = mostly(own, CellFlag.AMBIGUOUS)
        votes = added(votes, own[inner])
        seen = mostly_clear(own)
        open_ |= folded[inner]
        clear |= seen[inner]
        if height is not None:
            where = height.window
            heights.append(replace(height, ambiguous=folded[where], clear=seen[where]))
        if echo is not None:
            echoes.append(echo)
    if not heights and not echoes:
        return None
    mean, sigma, count = combine(heights, (outer.rows, outer.cols), plan.cell_m)
    power, _, _ = combine(echoes, (core.rows, core.cols), plan.cell_m)
    layers = {
        "elevation": mean[inner],
        "sigma": sigma[inner],
        "count": count[inner],
        "echo": level_db(power),
        "flags": np.where(np.isfinite(mean[inner]), decided(votes, open_ & ~clear), np.nan),
    }
    return {name: np.ascontiguousarray(layers[name][::-1], np.float32) for name in LAYERS}


def _echoes(one: FiledStrip) -> PlacedStrip:
    """Return the strip with echo power for heights, and the sigma that weights it; no offset is theirs."""

    def rows(first: int, last: int) -> tuple[FloatArray, FloatArray]:
        (echo,) = one.file.rows(first, last, ("echo",))
        echo = np.where(echo >= 0, echo, np.nan)
        return echo, echo_sigma(one.strip.across_m, one.altitude_m[first:last])

    nowhere = np.zeros_like(one.strip.position_m2)
    return replace(one.strip, rows=rows, position_m2=nowhere, height_m=0.0, height_sigma_m=0.0)
