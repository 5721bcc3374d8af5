"""Several looks at one place: what a pass saw at two places at once is settled by passes that saw them apart.

The founding paper: returns that arrive together are ambiguous, but from one position only; as the vehicle moves, or
comes again from elsewhere, the same two surfaces are told apart. Strips flag such samples (`perception.layover`);
here the look that agrees with a clear one joins it, the look that does not is left out, and where no pass saw a
cell clearly all of them stand, their disagreement in sigma, and the cell stays flagged. A height inferred in a
shadow is no clear look: it stands beside the others, and settles nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapping.flag_layer import FlagRows, mostly, mostly_clear, vote
from mapping.gridding import Window
from mapping.passes import add_weighted
from mapping.placed import PassRaster, PlacedStrip
from perception.quality import CellFlag
from perception.records import BoolArray

# An ambiguous look this many combined sigma from the clear ones was of another surface.
_AGREES = 2.0


def with_ambiguity(
    raster: PassRaster,
    strip: PlacedStrip,
    flags: FlagRows,
    blocks: Sequence[tuple[int, int, Window]],
    cell_m: float,
    window: Window,
) -> PassRaster:
    """Return a pass's raster on a window with its ambiguous and its clear cells marked.

    Parameters
    ----------
    flags, blocks : the strip's quality flags and `mapping.placed.boxes`.
    """
    rows, cols = raster.height_m.shape
    part = Window(window.row + raster.row0, window.col + raster.col0, rows, cols)
    votes = vote(strip, flags, blocks, cell_m, part)
    return replace(raster, ambiguous=mostly(votes, CellFlag.AMBIGUOUS), clear=mostly_clear(votes))


def settle(
    rasters: Sequence[PassRaster], keep: Sequence[BoolArray], shape: tuple[int, int]
) -> None:
    """Take from `keep`, in place, the ambiguous looks that clear ones of the same cell contradict."""
    if not any(r.ambiguous is not None and r.ambiguous.any() for r in rasters):
        return
    weight, total, number = (np.zeros(shape) for _ in range(3))
    for r, k in zip(rasters, keep, strict=True):
        clear = k if r.clear is None else k & r.clear
        add_weighted(r.height_m, r.variance_m2, clear, weight[r.window], total[r.window],
                     number[r.window])  # fmt: skip
    for r, k in zip(rasters, keep, strict=True):
        if r.ambiguous is None:
            continue
        there = k & r.ambiguous & (weight[r.window] > 0)
        w, h = weight[r.window][there], total[r.window][there]
        apart = np.abs(r.height_m[there] - h / w)
        k[there] = apart < _AGREES * np.sqrt(r.variance_m2[there] + 1 / w)
