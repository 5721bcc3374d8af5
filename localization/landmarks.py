"""Landmarks of a surface: the peaks and pits of its H-K region map, eight bytes each."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from perception.records import REGION_CLASSES, BoolArray, FloatArray, Grid, IntArray, RegionMap
from perception.regions import RegionConfig, segment

# Smoothing in cells: a map's landmarks are then some 0.4 % of its bytes, and noise of a third of the
# relief leaves most of them in place.
_SCALE_CELLS = 4.0
KINDS = tuple(REGION_CLASSES.index(name) for name in ("peak", "pit"))
# A landmark nearer to the border of the data than this many smoothing scales may be cut by it.
_BORDER_SCALES = 1.0
# Part of a landmark's region that must have been sounded, not filled.
_LEAST_SOUNDED = 0.7
# Largest number of the two bytes that a packed place and strength have each.
_WORD = 65_535


@dataclass(frozen=True, slots=True)
class Landmarks:
    """Peaks and pits of a surface, (n,) each.

    Attributes
    ----------
    easting_m, northing_m : centroids.
    kind : index into `REGION_CLASSES`.
    strength_per_m : size of the mean curvature.
    size_m : square root of the area.
    scale_m : smoothing that they were found at; only equal scales compare.
    area_m2 : of the surface they were found on.
    """

    easting_m: FloatArray
    northing_m: FloatArray
    kind: IntArray
    strength_per_m: FloatArray
    size_m: FloatArray
    scale_m: float
    area_m2: float

    def __len__(self) -> int:
        return len(self.kind)

    def packed(self) -> bytes:
        """Return the landmarks as eight bytes each: what a vehicle has to carry.

        Places are kept to a tenth of the scale, or on wider maps to what 16 bits tell apart.
        """
        west, south, step = 0.0, 0.0, 0.1 * self.scale_m
        if len(self):
            west, south = float(self.easting_m.min()), float(self.northing_m.min())
            extent = max(float(np.ptp(self.easting_m)), float(np.ptp(self.northing_m)))
            step = max(step, extent / _WORD)
        record = np.zeros(len(self), np.dtype("u2,u2,u1,u1,u2"))
        record["f0"] = np.round((self.easting_m - west) / step)
        record["f1"] = np.round((self.northing_m - south) / step)
        record["f2"] = self.kind
        size = 8 * np.log2(np.maximum(self.size_m / self.scale_m, 0.01)) + 100
        strength = -2000 * np.log2(np.maximum(self.strength_per_m, 1e-9))
        record["f3"] = np.round(np.clip(size, 0, 255))
        record["f4"] = np.round(np.clip(strength, 0, _WORD))
        head = np.array([west, south, step, self.scale_m, self.area_m2])
        return head.tobytes() + record.tobytes()

    @classmethod
    def unpacked(cls, data: bytes) -> Landmarks:
        """Read what `packed` wrote."""
        west, south, step, scale, area = np.frombuffer(data[:40])
        record = np.frombuffer(data[40:], np.dtype("u2,u2,u1,u1,u2"))
        return cls(
            easting_m=west + step * record["f0"],
            northing_m=south + step * record["f1"],
            kind=record["f2"].astype(np.int64),
            strength_per_m=2.0 ** (-record["f4"].astype(float) / 2000),
            size_m=scale * 2.0 ** ((record["f3"].astype(float) - 100) / 8),
            scale_m=float(scale),
            area_m2=float(area),
        )


def find_landmarks(grid: Grid, scale_m: float | None = None) -> Landmarks:
    """Segment a surface and take its landmarks; map and patch must be given the same scale.

    A landmark need not be certain: a false one costs little in the verification, a lost one is lost.
    So the signs of curvature count without tolerance and nothing is dissolved as doubtful.

    Parameters
    ----------
    scale_m : smoothing, Gaussian 1-sigma; None takes four cells.
    """
    scale = _SCALE_CELLS * max(grid.cell_m, grid.cell_north_m) if scale_m is None else scale_m
    config = RegionConfig(scale_m=scale, k_sigma=0.0, seed_probability=0.0, keep_probability=False)
    known = np.isfinite(grid.elevation_m)
    filled = replace(grid, elevation_m=_filled(grid, known, scale))
    return landmarks_of(segment(filled, config).regions, scale, known)


def _filled(grid: Grid, known: BoolArray, scale_m: float) -> FloatArray:
    """Fill holes smoothly: a shadow across a hill must not cut it in two."""
    if known.all() or not known.any():
        return grid.elevation_m
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    rough = grid.elevation_m[tuple(nearest)]
    width = (scale_m / grid.cell_north_m, scale_m / grid.cell_m)
    weight = ndimage.gaussian_filter(known.astype(float), width)
    level = ndimage.gaussian_filter(np.where(known, rough, 0.0), width)
    # Far inside a wide hole nothing weighs anything: the nearest height will do, it is not used.
    return np.where(known, rough, np.where(weight > 1e-3, level / np.maximum(weight, 1e-3), rough))


def landmarks_of(regions: RegionMap, scale_m: float, sounded: BoolArray | None = None) -> Landmarks:
    """Take the peaks and pits of a region map that lie clear of holes and borders.

    Parameters
    ----------
    scale_m : smoothing that the regions were made with.
    sounded : (rows, cols) cells that had a height before holes were filled; None all.
    """
    known = np.pad(regions.region > 0, 1)
    cell_north = regions.cell_m if regions.cell_height_m is None else regions.cell_height_m
    depth = ndimage.distance_transform_edt(known, sampling=(cell_north, regions.cell_m))
    depth = depth[1:-1, 1:-1]
    table = regions.table
    kind = np.asarray(table["class_code"])
    # A region that reaches the border goes on beyond it: its centroid is not the landmark's.
    inner = ndimage.minimum(depth, regions.region, np.arange(1, len(kind) + 1))
    east, north = np.asarray(table["easting_m"]), np.asarray(table["northing_m"])
    col = ((east - regions.west_m) / regions.cell_m).astype(int)
    row = ((regions.north_m - north) / cell_north).astype(int)
    rows, cols = depth.shape
    inside = depth[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)]
    cut = 1.5 * max(regions.cell_m, cell_north)
    use = np.isin(kind, KINDS) & (np.asarray(inner) > cut) & (inside > _BORDER_SCALES * scale_m)
    if sounded is not None:
        share = ndimage.mean(sounded, regions.region, np.arange(1, len(kind) + 1))
        use &= np.asarray(share) > _LEAST_SOUNDED
    return Landmarks(
        easting_m=east[use],
        northing_m=north[use],
        kind=kind[use].astype(np.int64),
        strength_per_m=np.abs(np.asarray(table["mean_H"], float))[use],
        size_m=np.sqrt(np.asarray(table["area_m2"], float))[use],
        scale_m=scale_m,
        area_m2=float(np.count_nonzero(regions.region)) * regions.cell_m * cell_north,
    )
