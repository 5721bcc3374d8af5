"""Figures of a tiled map: what each tile tells, and what the tiles tell together.

Sums and extremes add up exactly. Medians come of histograms whose bins are one per cent wide, so they are
right to half a per cent.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np

from mapping.flag_layer import NO_FLAGS, flag_figures, flagged_cells
from mapping.quality import ONE_D_95, S44_ORDERS
from mapping.tiles import Layers
from perception.records import FloatArray

# Bins of sigma from a millimetre, of depth from a centimetre, of data per cell from one: 1 % steps.
_STEP = np.log(1.01)
_BINS = {"sigma": (1e-3, 1400), "depth": (1e-2, 1400), "count": (1.0, 1400)}


def tile_figures(layers: Layers | None) -> dict[str, Any]:
    """Return what a tile adds to the map's figures; empty where it holds nothing."""
    if layers is None:
        return {}
    seen = np.isfinite(layers["elevation"])
    if not seen.any():
        return {"cells": 0}
    height, sigma = layers["elevation"][seen].astype(float), layers["sigma"][seen].astype(float)
    depth = np.maximum(-height, 0.0)
    vertical = ONE_D_95 * sigma
    return {
        "cells": int(seen.sum()),
        "elevation_min_m": float(height.min()),
        "elevation_max_m": float(height.max()),
        "sigma": _histogram("sigma", sigma),
        "depth": _histogram("depth", depth),
        "count": _histogram("count", layers["count"][seen]),
        "flags": _flagged(layers),
        "s44": {
            order: int((vertical <= np.hypot(a, b * depth)).sum())
            for order, (a, b, _, _) in S44_ORDERS.items()
        },
    }


def _flagged(layers: Layers) -> dict[str, int]:
    """Return how many cells bear each flag; nothing of layers without flags."""
    if "flags" not in layers:
        return {}
    known = np.nan_to_num(layers["flags"], nan=NO_FLAGS).astype(np.uint8)
    return flagged_cells(known)


def _histogram(name: str, values: FloatArray) -> dict[str, int]:
    """Count values by bin, only bins that hold any; -1 holds what is below the first."""
    low, number = _BINS[name]
    with np.errstate(divide="ignore"):
        at = np.floor(np.log(np.maximum(values, 0.0) / low) / _STEP)
    at = np.clip(at, -1, number - 1).astype(int)
    which, times = np.unique(at, return_counts=True)
    return {str(k): int(n) for k, n in zip(which, times, strict=True)}


def _median(name: str, histograms: list[dict[str, int]]) -> float:
    """Return the median of what the histograms counted."""
    low, number = _BINS[name]
    total = np.zeros(number + 1, np.int64)
    for histogram in histograms:
        for at, times in histogram.items():
            total[int(at) + 1] += times
    middle = int(np.searchsorted(np.cumsum(total), 0.5 * total.sum()))
    return float(low * np.exp((middle - 0.5) * _STEP)) if middle else 0.0


def map_figures(tiles: Iterable[dict[str, Any]], cells: int, cell_m: float) -> dict[str, Any]:
    """Return the figures of the whole map, named as `survey_quality` and the map's metrics name them.

    Parameters
    ----------
    tiles : figures of all tiles.
    cells : of the map's rectangle.
    """
    full = [tile for tile in tiles if tile.get("cells")]
    mapped = sum(tile["cells"] for tile in full)
    if not mapped:
        return {"cells": 0, "mapped_m2": 0.0, "coverage_of_rectangle": 0.0}
    shares = {
        f"s44_{order}_vertical_share": sum(tile["s44"][order] for tile in full) / mapped
        for order in S44_ORDERS
    }
    return {
        "cells": mapped,
        "area_m2": mapped * cell_m**2,
        "elevation_min_m": min(tile["elevation_min_m"] for tile in full),
        "elevation_max_m": max(tile["elevation_max_m"] for tile in full),
        "sigma_median_m": _median("sigma", [tile["sigma"] for tile in full]),
        "depth_median_m": _median("depth", [tile["depth"] for tile in full]),
        "mapped_m2": mapped * cell_m**2,
        "coverage_of_rectangle": mapped / cells,
        "median_data_per_cell": _median("count", [tile["count"] for tile in full]),
        **flag_figures(_added(tile["flags"] for tile in full), mapped),
        **shares,
    }


def _added(counts: Iterable[dict[str, int]]) -> dict[str, int]:
    total: Counter[str] = Counter()
    for count in counts:
        total.update(count)
    return dict(total)
