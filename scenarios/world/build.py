"""Compose the true sea floor: landforms first, objects on top, albedo beside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from perception.records import FloatArray, Grid, InputError
from scenarios.sections import AlbedoSection, WorldSection
from scenarios.world import components, shapes
from scenarios.world.fields import spectral_field
from scenarios.world.objects import SeaObject, add_box, add_round, scatter

_CRATERS = {"pockmark"}


@dataclass(frozen=True, slots=True)
class World:
    """The truth: heights, scattering strength (power ratio, 1 nominal) and objects."""

    floor: Grid
    albedo: FloatArray
    objects: tuple[SeaObject, ...]


def build_world(
    config: WorldSection,
    *,
    rng: np.random.Generator,
    rasters: Mapping[str, Grid] | None = None,
) -> World:
    """Compose the world of a scenario.

    Parameters
    ----------
    config : the scenario's [world].
    rng : every component draws from its own child stream, so adding one leaves the others alone.
    rasters : the grids named by `raster` components, read by the caller.
    """
    frame = frame_of(config)
    terrain_rng, albedo_rng = rng.spawn(2)
    # Streams of a component depend on its place in the list; keep them apart from the albedo's.
    streams = terrain_rng.spawn(len(config.terrain))
    pairs = list(zip(config.terrain, streams, strict=True))
    elevation_m = np.full(frame.shape, -config.depth_m)
    for part, stream in pairs:
        elevation_m += _landform(part, config, frame, stream, rasters or {})
    objects: list[SeaObject] = []
    for part, stream in pairs:
        _add_objects(part, config, frame, elevation_m, objects, stream)
    if elevation_m.max() >= 0:
        raise InputError(
            f"world.depth_m = {config.depth_m:g}: the terrain rises {elevation_m.max():.1f} m above "
            "the surface; give a greater depth_m"
        )
    floor = replace(frame, elevation_m=elevation_m)
    return World(floor, _albedo(config.albedo, frame, albedo_rng), tuple(objects))


def frame_of(config: WorldSection, cell_m: float | None = None) -> Grid:
    """Return the empty grid of a world, its edges at multiples of the cell."""
    cell = config.cell_m if cell_m is None else cell_m
    west = np.floor((config.origin_easting_m - 0.5 * config.size_east_m) / cell) * cell
    east = np.ceil((config.origin_easting_m + 0.5 * config.size_east_m) / cell) * cell
    south = np.floor((config.origin_northing_m - 0.5 * config.size_north_m) / cell) * cell
    north = np.ceil((config.origin_northing_m + 0.5 * config.size_north_m) / cell) * cell
    shape = (round((north - south) / cell), round((east - west) / cell))
    if shape[0] * shape[1] > 100_000_000:
        raise InputError(
            f"world.cell_m = {config.cell_m:g}: {shape[0]} x {shape[1]} cells are more than this "
            "simulator holds (1e8); give a larger cell_m or a smaller world"
        )
    return Grid(
        np.zeros(shape), float(west), float(north), cell, crs=config.crs, datum=config.datum
    )


def _local_axes(config: WorldSection, frame: Grid) -> tuple[FloatArray, FloatArray]:
    easting_m, northing_m = frame.centres()
    east = (easting_m - config.origin_easting_m)[None, :]
    north = (northing_m - config.origin_northing_m)[:, None]
    return east, north


def _landform(
    part: components.Component,
    config: WorldSection,
    frame: Grid,
    rng: np.random.Generator,
    rasters: Mapping[str, Grid],
) -> FloatArray | float:
    """Return what one component adds to the heights; objects add theirs later."""
    east, north = _local_axes(config, frame)
    match part:
        case components.Fractal():
            return spectral_field(
                frame,
                rms=part.rms_m,
                slope=part.slope,
                longest_m=part.longest_m,
                shortest_m=max(part.shortest_m, 2.0 * config.cell_m),
                rng=rng,
            )
        case components.Plane():
            return shapes.plane(east, north, slope_deg=part.slope_deg, toward_deg=part.toward_deg)
        case components.Canyon():
            _, off = _axis(part, east, north)
            return -part.depth_m * shapes.trough(off, width_m=part.width_m, wall_m=part.wall_m)
        case components.Ridge():
            along, off = _axis(part, east, north)
            crest = shapes.trough(off, width_m=part.width_m, wall_m=part.wall_m)
            for gap_m in part.gaps_m:
                gap = shapes.trough(along - gap_m, width_m=part.gap_width_m, wall_m=part.wall_m)
                crest = crest * (1.0 - gap)
            return part.height_m * crest
        case components.SandWaves():
            _, off = _axis(part, east, north)
            return shapes.sand_waves(
                off, height_m=part.height_m, length_m=part.length_m, asymmetry=part.asymmetry
            )
        case components.Raster():
            return _raster_relief(part, rasters[part.path], east, north)
        case _:
            return 0.0


def _axis(
    part: components.Canyon | components.Ridge | components.SandWaves,
    east: FloatArray,
    north: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    return shapes.along_and_off(
        east,
        north,
        east_m=part.east_m,
        north_m=part.north_m,
        azimuth_deg=part.azimuth_deg,
        meander_m=part.meander_m,
        meander_length_m=part.meander_length_m,
    )


def _raster_relief(
    part: components.Raster, source: Grid, east: FloatArray, north: FloatArray
) -> FloatArray:
    """Lay a raster's relief out around the origin; its holes are filled with their nearest height."""
    heights = source.elevation_m
    missing = np.isnan(heights)
    if missing.any():
        nearest = ndimage.distance_transform_edt(
            missing, return_distances=False, return_indices=True
        )
        heights = heights[tuple(nearest)]
    relief = heights - heights.mean()
    if part.rms_m is not None:
        relief = relief * (part.rms_m / max(float(relief.std()), 1e-12))
    cell = source.cell_m if part.cell_m is None else part.cell_m
    rows, cols = relief.shape
    if rows * cell < np.ptp(north) or cols * cell < np.ptp(east):
        raise InputError(
            f"{part.path}: covers {cols * cell:.0f} x {rows * cell:.0f} m, less than the world's "
            f"{np.ptp(east):.0f} x {np.ptp(north):.0f} m; give a larger cell_m or a smaller world"
        )
    row = 0.5 * (rows - 1) - north / cell
    col = 0.5 * (cols - 1) + east / cell
    row, col = np.broadcast_arrays(row, col)
    return ndimage.map_coordinates(relief, [row, col], order=3, mode="nearest")


def _add_objects(
    part: components.Component,
    config: WorldSection,
    frame: Grid,
    elevation_m: FloatArray,
    objects: list[SeaObject],
    rng: np.random.Generator,
) -> None:
    """Add a component's objects to the heights and to the list, in place."""
    e0, n0 = config.origin_easting_m, config.origin_northing_m
    if isinstance(part, components.Object):
        kind = "crater" if part.shape in _CRATERS else "hill"
        radius_m = 0.5 * part.length_m if part.shape == "box" else part.radius_m
        item = SeaObject(
            kind, e0 + part.east_m, n0 + part.north_m, part.height_m, radius_m, part.shape
        )
        if part.shape == "box":
            add_box(
                elevation_m,
                frame,
                item,
                length_m=part.length_m,
                width_m=part.width_m,
                azimuth_deg=part.azimuth_deg,
            )
        else:
            add_round(elevation_m, frame, item)
        objects.append(item)
    elif isinstance(part, components.Scatter):
        shape = part.kind.removesuffix("s")
        places = scatter(
            count=part.count,
            centre_m=(e0 + part.east_m, n0 + part.north_m),
            size_m=(part.size_east_m, part.size_north_m),
            spacing_m=part.spacing_m,
            taken=[(o.easting_m, o.northing_m) for o in objects],
            rng=rng,
        )
        for easting_m, northing_m in places:
            height_m = rng.uniform(part.height_min_m, max(part.height_max_m, part.height_min_m))
            aspect = rng.uniform(part.aspect_min, max(part.aspect_max, part.aspect_min))
            kind = "crater" if shape in _CRATERS else "hill"
            item = SeaObject(kind, easting_m, northing_m, height_m, aspect * height_m, shape)
            add_round(elevation_m, frame, item)
            objects.append(item)


def _albedo(config: AlbedoSection, frame: Grid, rng: np.random.Generator) -> FloatArray:
    """Return the floor's scattering strength as a power ratio (rows, cols), 1 nominal."""
    field_rng, patch_rng = rng.spawn(2)
    db = spectral_field(
        frame,
        rms=config.rms_db,
        slope=1.5,
        longest_m=config.length_m,
        shortest_m=max(config.length_m / 8.0, 4.0 * frame.cell_m),
        rng=field_rng,
    )
    easting_m, northing_m = frame.centres()
    for index in range(config.patches):
        e = patch_rng.uniform(frame.west_m, frame.east_m)
        n = patch_rng.uniform(frame.south_m, frame.north_m)
        distance = np.hypot((easting_m - e)[None, :], (northing_m - n)[:, None])
        # The edge of a patch of sediment is sharp to a metre or so.
        inside = np.clip((config.patch_radius_m - distance) + 0.5, 0.0, 1.0)
        db += (1 if index % 2 else -1) * config.patch_db * inside
    return 10.0 ** (db / 10.0)
