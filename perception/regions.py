"""Heights to labelled regions: the paper's vision module.

smooth at the scale that noise and relief ask for   perception.scale
H and K with their errors                           perception.curvature
the level of detail that the classes are read at    perception.region_detail
eight classes and their probabilities               perception.region_classes
connected regions and their borders                 perception.region_labels
the doubtful and small merged                       perception.region_merging
table and graph                                     perception.region_graph
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from perception.curvature import Curvature, Operator
from perception.records import (
    REGION_CLASSES,
    FloatArray,
    Grid,
    InputError,
    Progress,
    RegionMap,
    silent,
)
from perception.region_classes import classify
from perception.region_detail import (
    box_curvature,
    candidates,
    curvature_at,
    next_level,
    tiles,
    typical_cells,
)
from perception.region_graph import region_table
from perception.region_labels import (
    COUNT,
    MAX_P,
    SUM_SCALE,
    fold_borders,
    fold_sums,
    label_and_sum,
    region_borders,
    write_merge,
)
from perception.region_merging import join_equal, merge_regions

logger = logging.getLogger(__name__)

# Above this many cells the nine probability planes (36 bytes a cell) are left out unless asked for.
_PROBABILITY_CELLS = 4_000_000
_FLAT = REGION_CLASSES.index("flat")


@dataclass(frozen=True, slots=True)
class RegionConfig:
    """How a surface is segmented; None means derived from the data.

    Attributes
    ----------
    scale_m : smoothing (Gaussian sigma or equivalent) for the whole map; None chooses it per cell.
    detail_m : least scale of the classes, m; 0 the finest that the noise allows; None the finest that
        gives regions of a useful size. H and K are not touched by it. Not used with `scale_m`.
    window_m : instead of all that, one quadratic by least squares over a box of this width about each
        cell, unweighted; a box of three cells is the classical 3 x 3 fit.
    operator : derivatives by central differences or by a 3 x 3 least-squares fit.
    k_sigma : H or K within this many of its sigma of zero counts as zero.
    least_H_per_m, least_K_per_m2 : tolerances never fall below these.
    seed_probability : a region without a cell this certain of its class is dissolved (hysteresis).
    least_area_m2 : smaller regions join a neighbour; None takes 9 cells, or where the surface is
        smoothed a disc of the smoothing's radius.
    levels : levels of detail; each coarser one doubles the least scale.
    keep_probability : keep the probability of every class; None keeps it on maps below 4 million cells.
    """

    scale_m: float | None = None
    detail_m: float | None = None
    window_m: float | None = None
    operator: Operator = "difference"
    k_sigma: float = 2.0
    least_H_per_m: float = 0.0
    least_K_per_m2: float = 0.0
    seed_probability: float = 0.5
    least_area_m2: float | None = None
    levels: int = 1
    keep_probability: bool | None = None

    def __post_init__(self) -> None:
        if self.scale_m is not None and not (np.isfinite(self.scale_m) and self.scale_m >= 0):
            raise InputError(f"the scale must be zero or more metres, got {self.scale_m}")
        if self.detail_m is not None and not (np.isfinite(self.detail_m) and self.detail_m >= 0):
            raise InputError(f"the detail must be zero or more metres, got {self.detail_m}")
        if self.window_m is not None and not (np.isfinite(self.window_m) and self.window_m > 0):
            raise InputError(f"the window must be some metres wide, got {self.window_m}")
        if self.window_m is not None and self.scale_m is not None:
            raise InputError("a window and a scale exclude each other; give one of them")
        if self.levels < 1:
            raise InputError(f"levels must be at least 1, got {self.levels}")


@dataclass(frozen=True, slots=True)
class Segmentation:
    """A region map with the curvature it rests on, and coarser levels of detail.

    Attributes
    ----------
    coarser : one region map per further level, finest first.
    parents : parents[k][r] is the region of level k + 1 (numbered from 1) that holds most of region
        r + 1 of level k; level 0 is `regions`.
    detail_m : least scale the classes of `regions` were read at; 0 the curvature's own.
    """

    regions: RegionMap
    curvature: Curvature
    coarser: tuple[RegionMap, ...] = ()
    parents: tuple[npt.NDArray[np.int64], ...] = field(default=())
    detail_m: float = 0.0


def segment(
    grid: Grid, config: RegionConfig | None = None, progress: Progress = silent
) -> Segmentation:
    """Segment a surface into regions of one curvature class.

    Parameters
    ----------
    grid : heights up; `sigma_m`, where there is one, bounds the noise of each cell.

    Returns
    -------
    Segmentation
        Cells without a height have class and region 0 and NaN curvature.

    Raises
    ------
    InputError
        No cell has a height.
    """
    config = config or RegionConfig()
    if not np.isfinite(grid.elevation_m).any():
        raise InputError("the map holds no height at all (every cell is NaN); nothing to segment")
    steps = 2 + config.levels
    progress("regions", 0, steps)
    detail_m = _detail(grid, config)
    progress("regions", 1, steps)
    if config.window_m is None:
        curvature = curvature_at(grid, config.scale_m, 0.0, config.operator)
    else:
        curvature = box_curvature(grid, config.window_m)
    progress("regions", 2, steps)
    read = curvature
    if detail_m > 0:
        read = curvature_at(grid, config.scale_m, detail_m, config.operator)
    finest = _regions(grid, read, config)
    base_m = max(
        float(np.nanmedian(read.scale_m)), detail_m, np.sqrt(grid.cell_m * grid.cell_north_m)
    )
    del read
    progress("regions", 3, steps)
    coarser: list[RegionMap] = []
    parents: list[npt.NDArray[np.int64]] = []
    below = finest
    for level in range(1, config.levels):
        rough = curvature_at(grid, config.scale_m, base_m * 2.0**level, config.operator)
        regions = _regions(grid, rough, replace(config, keep_probability=False))
        parents.append(_parents(below, regions))
        coarser.append(regions)
        below = regions
        progress("regions", 3 + level, steps)
    return Segmentation(finest, curvature, tuple(coarser), tuple(parents), detail_m)


def _detail(grid: Grid, config: RegionConfig) -> float:
    """Return the least scale the classes are read at, m: the finest that gives regions of a useful size."""
    if config.scale_m is not None or config.window_m is not None:
        return 0.0
    if config.detail_m is not None:
        return config.detail_m
    trial = replace(config, keep_probability=False)
    shown = tiles(grid)
    scales = candidates(grid)
    level = 0
    while level < len(scales) - 1:
        sizes = []
        for tile in shown:
            read = curvature_at(tile, None, scales[level], config.operator)
            regions = _regions(tile, read, trial)
            area_m2, code = regions.table["area_m2"], regions.table["class_code"]
            sizes.append(area_m2[code != _FLAT] / (grid.cell_m * grid.cell_north_m))
        step = next_level(typical_cells(sizes))
        if step == 0:
            break
        level = min(level + step, len(scales) - 1)
    return scales[level]


def _regions(grid: Grid, curvature: Curvature, config: RegionConfig) -> RegionMap:
    keep = config.keep_probability
    if keep is None:
        keep = grid.elevation_m.size <= _PROBABILITY_CELLS
    planes = (curvature.H, curvature.K, curvature.sigma_H, curvature.sigma_K)
    code, certainty, probability = classify(
        planes, config.k_sigma, config.least_H_per_m, config.least_K_per_m2, keep
    )
    labels = label_and_sum(
        code, (grid.elevation_m, curvature.H, curvature.K, certainty, curvature.scale_m)
    )
    edges, border_m = region_borders(labels.region, grid.cell_m, grid.cell_north_m)
    sums = labels.sums
    parent = merge_regions(
        edges,
        border_m,
        sums[:, COUNT] * grid.cell_m * grid.cell_north_m,
        _least_area(sums, grid, config),
        sums[:, MAX_P] < config.seed_probability,
    )
    number, class_of = join_equal(edges, parent, labels.class_of)
    write_merge(labels.region, code, number, class_of)
    edges, border_m = fold_borders(edges, border_m, number)
    return RegionMap(
        class_code=code,
        region=labels.region,
        west_m=grid.west_m,
        north_m=grid.north_m,
        cell_m=grid.cell_m,
        crs=grid.crs,
        cell_height_m=grid.cell_height_m,
        probability=probability,
        table=region_table(fold_sums(sums, number), class_of, grid),
        edges=edges,
        border_m=border_m,
    )


def _least_area(
    sums: npt.NDArray[np.float64], grid: Grid, config: RegionConfig
) -> npt.NDArray[np.float64]:
    if config.least_area_m2 is not None:
        return np.full(len(sums), config.least_area_m2)
    scale_m = sums[:, SUM_SCALE] / np.maximum(sums[:, COUNT], 1)
    # What is narrower than the smoothing's own footprint cannot be a feature of the surface.
    return np.maximum(9 * grid.cell_m * grid.cell_north_m, np.pi * scale_m**2)


def _parents(fine: RegionMap, coarse: RegionMap) -> npt.NDArray[np.int64]:
    """Return for every fine region the coarse one that holds most of it."""
    n_coarse = int(coarse.region.max()) + 1
    pair = fine.region.astype(np.int64).ravel() * n_coarse + coarse.region.ravel()
    key, cells = np.unique(pair[fine.region.ravel() > 0], return_counts=True)
    order = np.lexsort((-cells, key // n_coarse))
    key = key[order]
    first = np.r_[True, np.diff(key // n_coarse) > 0]
    return key[first] % n_coarse


def weight_map(regions: RegionMap, weight_of_class: npt.NDArray[np.floating]) -> FloatArray:
    """Return the expected weight of each cell, (rows, cols), from a weight for each of the 9 codes.

    Weighted by class probability where the map keeps it, else the class's own; NaN no data.
    """
    weights = np.asarray(weight_of_class, np.float64)
    if regions.probability is None:
        expected = weights[regions.class_code]
    else:
        expected = np.einsum("c,cij->ij", weights, regions.probability.astype(np.float64))
    return np.where(regions.class_code > 0, expected, np.nan)
