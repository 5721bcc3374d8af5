"""The map thinned to fewer nodes, for searches that look far and need not look closely."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy import ndimage

from perception.records import BoolArray, FloatArray
from planning.field import search
from planning.surface import BAR, BOTTOM, LOWER, WEIGHT, Surface

# Nodes of the thinned map, about; a search's time goes with it.
NODES = 90_000


@dataclass(frozen=True, slots=True)
class Thin:
    """The thinned map; nodes lie at `shift_m` plus multiples of `cell_m`.

    Attributes
    ----------
    stack : (rows, cols, layers) means of the surface's stack over blocks.
    barred : (rows, cols) True where barred ground parts the block.
    upper : (rows, cols) greatest height.
    """

    stack: FloatArray
    barred: BoolArray
    upper: FloatArray
    cell_m: tuple[float, float]
    shift_m: FloatArray
    surface: Surface

    @property
    def lower(self) -> FloatArray:
        return self.stack[..., LOWER]

    @property
    def bottom(self) -> FloatArray:
        return self.stack[..., BOTTOM]

    @property
    def weight(self) -> FloatArray:
        return self.stack[..., WEIGHT]

    def node(self, point: tuple[float, float]) -> tuple[int, int]:
        """Return the node nearest to a local position."""
        rows, cols = self.barred.shape
        col = round((point[0] - self.shift_m[0]) / self.cell_m[0])
        row = round((point[1] - self.shift_m[1]) / self.cell_m[1])
        return min(max(row, 0), rows - 1), min(max(col, 0), cols - 1)


def thinned(surface: Surface, nodes: int = NODES) -> Thin:
    """Return the map thinned to about so many nodes: means of blocks, barred if a line of it is."""
    rows, cols = surface.shape
    block = max(1, math.ceil(math.sqrt(rows * cols / nodes)))
    stack = _blocks(surface.stack, block)
    stack[..., LOWER] = np.maximum(stack[..., LOWER], surface.bottom_most_m)
    stack[..., BAR] = 0.0
    barred = surface.barred.copy()
    if block > 1:
        # A thin wall must not leak in the mean: any line of barred cells that parts the block bars it.
        share = _blocks(_walls(surface.barred).astype(np.float32)[..., None], block)
        barred = share[..., 0] > 0.5 / block
    upper = np.minimum(stack[..., BOTTOM] + surface.limits.ceiling_m, surface.top_m)
    cell = (block * surface.cell_m[0], block * surface.cell_m[1])
    shift = 0.5 * (block - 1) * np.array(surface.cell_m)
    return Thin(stack, barred, upper, cell, shift, surface)


@njit(cache=True, nogil=True)
def _blocks(values, block):  # type: ignore[no-untyped-def]
    """Return means of block x block cells; the last row and column of blocks may be partial."""
    rows, cols, layers = values.shape
    out = np.zeros((-(-rows // block), -(-cols // block), layers), np.float32)
    for i in range(out.shape[0]):
        total = np.zeros((out.shape[1], layers))
        last = min((i + 1) * block, rows)
        for r in range(i * block, last):
            for c in range(cols):
                for k in range(layers):
                    total[c // block, k] += values[r, c, k]
        for j in range(out.shape[1]):
            cells = (last - i * block) * (min((j + 1) * block, cols) - j * block)
            for k in range(layers):
                out[i, j, k] = total[j, k] / cells
    return out


def _walls(barred: BoolArray) -> BoolArray:
    if not barred.any():
        return barred
    return np.asarray(ndimage.binary_closing(barred, iterations=1) | barred)


def cost_to_go(thin: Thin, goal: tuple[int, int]) -> FloatArray:
    """Return the limit-free cost from every thinned node to the goal."""
    return search(thin_surface(thin).reversed(), goal, None, 16).cost


def thin_surface(thin: Thin) -> Surface:
    """Return the thinned map as a surface of its own, its first node at the origin."""
    return Surface(
        bottom_m=thin.bottom, lower_m=thin.lower, barred=thin.barred, stack=thin.stack,
        origin_m=(0.0, 0.0), cell_m=thin.cell_m, top_m=thin.surface.top_m,
        limits=thin.surface.limits, terms=thin.surface.terms,
    )  # fmt: skip
