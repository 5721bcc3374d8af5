"""Heights to labelled regions: the paper's vision module.

smooth at the scale that noise and relief ask for   perception.scale
H and K with their errors                           perception.curvature
eight classes and their probabilities               perception.region_classes
connected regions, the doubtful and small merged    perception.region_labels
table and graph                                     perception.region_graph
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from perception.curvature import Curvature, Operator, curvature_of
from perception.records import FloatArray, Grid, InputError, Progress, RegionMap, silent
from perception.region_classes import classify
from perception.region_graph import region_table
from perception.region_labels import (
    apply_merge,
    label_classes,
    merge_regions,
    region_borders,
    region_sums,
)
from perception.scale import Smoothing, smooth, upsample

logger = logging.getLogger(__name__)

# Above this many cells the nine probability planes (36 bytes a cell) are left out unless asked for.
_PROBABILITY_CELLS = 4_000_000


@dataclass(frozen=True, slots=True)
class RegionConfig:
    """How a surface is segmented; None means derived from the data.

    Attributes
    ----------
    scale_m : smoothing (Gaussian sigma or equivalent) for the whole map; None chooses it per cell.
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
    """

    regions: RegionMap
    curvature: Curvature
    coarser: tuple[RegionMap, ...] = ()
    parents: tuple[npt.NDArray[np.int64], ...] = field(default=())


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
    progress("regions", 0, 1 + config.levels)
    smoothing = _smooth(grid, config)
    curvature = _curvature(grid, smoothing)
    progress("regions", 1, 1 + config.levels)
    finest = _regions(grid, curvature, config)
    progress("regions", 2, 1 + config.levels)
    coarser: list[RegionMap] = []
    parents: list[npt.NDArray[np.int64]] = []
    below = finest
    for level in range(1, config.levels):
        coarse_config = replace(config, keep_probability=False)
        least_scale_m = _level_scale(smoothing, grid, level)
        rough = _curvature(grid, _smooth(grid, config, least_scale_m))
        regions = _regions(grid, rough, coarse_config)
        parents.append(_parents(below, regions))
        coarser.append(regions)
        below = regions
        progress("regions", 2 + level, 1 + config.levels)
    return Segmentation(finest, curvature, tuple(coarser), tuple(parents))


def _smooth(grid: Grid, config: RegionConfig, least_scale_m: float = 0.0) -> Smoothing:
    """Smooth by the configured scale; a coarser level by no less than its own."""
    scale_m = config.scale_m
    if scale_m is not None:
        scale_m = max(scale_m, least_scale_m)
    return smooth(
        grid.elevation_m,
        grid.cell_m,
        grid.cell_north_m,
        grid.sigma_m,
        scale_m,
        config.operator,
        least_scale_m,
    )


def _level_scale(smoothing: Smoothing, grid: Grid, level: int) -> float:
    """Return the smoothing of a coarser level: double for each, from what the finest level took."""
    base = max(float(np.nanmedian(smoothing.scale_m)), np.sqrt(grid.cell_m * grid.cell_north_m))
    return base * 2.0**level


def _curvature(grid: Grid, smoothing: Smoothing) -> Curvature:
    mean, gauss, sigma_h, sigma_k = curvature_of(
        smoothing.derivatives, smoothing.gain, smoothing.noise_m, smoothing.step
    )
    scale = upsample(smoothing.scale_m, smoothing.step, grid.shape)
    scale[np.isnan(mean)] = np.nan
    noise = upsample(smoothing.noise_m, smoothing.step, grid.shape)
    return Curvature(mean, gauss, sigma_h, sigma_k, scale, noise)


def _regions(grid: Grid, curvature: Curvature, config: RegionConfig) -> RegionMap:
    keep = config.keep_probability
    if keep is None:
        keep = grid.elevation_m.size <= _PROBABILITY_CELLS
    planes = (curvature.H, curvature.K, curvature.sigma_H, curvature.sigma_K)
    code, certainty, probability = classify(
        planes, config.k_sigma, config.least_H_per_m, config.least_K_per_m2, keep
    )
    region, count = label_classes(code)
    sums = region_sums(
        region, count, grid.elevation_m, curvature.H, curvature.K, certainty, curvature.scale_m
    )
    class_of = np.zeros(count + 1, np.uint8)
    class_of[region.ravel()] = code.ravel()
    edges, border_m = region_borders(region, grid.cell_m, grid.cell_north_m)
    parent = merge_regions(
        edges,
        border_m,
        sums[:, 0] * grid.cell_m * grid.cell_north_m,
        _least_area(sums, grid, config),
        sums[:, 9] < config.seed_probability,
    )
    apply_merge(region, code, parent, class_of)
    region, count = label_classes(code)
    sums = region_sums(
        region, count, grid.elevation_m, curvature.H, curvature.K, certainty, curvature.scale_m
    )
    class_of = np.zeros(count + 1, np.uint8)
    class_of[region.ravel()] = code.ravel()
    edges, border_m = region_borders(region, grid.cell_m, grid.cell_north_m)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    return RegionMap(
        class_code=code,
        region=region,
        west_m=grid.west_m,
        north_m=grid.north_m,
        cell_m=grid.cell_m,
        crs=grid.crs,
        cell_height_m=grid.cell_height_m,
        probability=probability,
        table=region_table(sums, class_of, grid),
        edges=edges[order],
        border_m=border_m[order],
    )


def _least_area(
    sums: npt.NDArray[np.float64], grid: Grid, config: RegionConfig
) -> npt.NDArray[np.float64]:
    if config.least_area_m2 is not None:
        return np.full(len(sums), config.least_area_m2)
    scale_m = sums[:, 12] / np.maximum(sums[:, 0], 1)
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
