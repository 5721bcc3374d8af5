"""Sonar files to one map that may outgrow memory: strips on disk, then tiles.

    passes one at a time -> strip files; coarse strips -> registration and graph -> poses
    strip files at corrected poses -> tiles in a Zarr store, on Dask

docs/any-size.md has the flow, what it costs and where its limits lie.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mapping.compare import same_frame
from mapping.fixes import PositionFix
from mapping.fusion import default_cell, fuse
from mapping.placed import PlacedStrip, position_variance
from mapping.survey import correct_survey, tie_to_map
from mapping.survey_check import steady
from mapping.survey_records import CorrectedSurvey, SurveyConfig
from mapping.textures import MatchConfig
from mapping.tile_figures import map_figures
from mapping.tile_fill import fill_tiles, with_fill
from mapping.tile_plan import TILE_CELLS, TilePlan, as_planned, filed, plan_tiles
from mapping.tile_run import fuse_tiles, tiles_to_make
from mapping.tile_store import FILL_LAYERS, TileStore
from perception.objects import ObjectTable
from perception.readers import Survey
from perception.records import ElevationStrip, Grid, Progress, Trajectory, silent
from scenarios.cluster import open_cluster
from scenarios.map_loop import check_prior
from scenarios.pass_files import FiledPass, file_passes
from scenarios.report.contacts import Contact
from scenarios.survey_map import corrected_objects, identity, navigated_track, whole_track

# A map of more cells than this is made in tiles without being asked: in one piece it would take some
# hundred bytes a cell and pass, several GB.
MOST_CELLS_AT_ONCE = 25_000_000
# Likewise for the joint method, which takes 1.6 kB a cell; it may still be asked for up to the limit above.
MOST_JOINT_CELLS = 6_000_000
_TILES_MADE_HERE = 8
# Pictures and a prior map's tie look at every so manieth cell, this many at most.
_PICTURE_CELLS = 4_000_000


@dataclass(frozen=True, slots=True)
class TiledSurvey:
    """What a survey became, its map in a store.

    Attributes
    ----------
    plan, store : the tiles; `figures` of the whole map, `made` tiles that this run made.
    filled : cells whose gaps were filled; None where that was not asked for.
    track, raw_track, corrected, objects, contacts : as in `SurveyMap`; the strips of `corrected` are coarse.
    """

    plan: TilePlan
    store: TileStore
    figures: dict[str, Any]
    made: int
    track: Trajectory
    raw_track: Trajectory
    corrected: CorrectedSurvey
    objects: tuple[ObjectTable, ...]
    contacts: tuple[tuple[Contact, ...], ...] = ()
    filled: int | None = None

    @property
    def strips(self) -> tuple[ElevationStrip, ...]:
        return self.corrected.strips

    def overview(self, name: str = "elevation") -> Grid:
        """Return every k-th cell of a layer, few enough for a picture, with sigma where it is heights."""
        rows, cols = self.plan.shape
        step = max(1, int(np.ceil(np.sqrt(rows * cols / _PICTURE_CELLS))))
        layers = {name: _thin(self.plan, self.store, name, step)}
        if name == "elevation":
            layers["sigma"] = _thin(self.plan, self.store, "sigma", step)
            if self.filled is not None:
                fill = (_thin(self.plan, self.store, layer, step) for layer in FILL_LAYERS)
                layers = with_fill(layers, *fill)
        # Each value is of the north-western cell of its square: that cell's centre is the wide cell's.
        edge_m = 0.5 * (step - 1) * self.plan.cell_m
        return Grid(
            layers[name].astype(float), self.plan.west_m - edge_m, self.plan.north_m + edge_m,
            step * self.plan.cell_m, self.plan.crs, layers.get("sigma"), datum=self.plan.datum,
        )  # fmt: skip


def _thin(plan: TilePlan, store: TileStore, name: str, step: int) -> np.ndarray:
    """Return every `step`-th cell, read a row of tiles at a time."""
    parts = []
    for top in range(0, plan.shape[0], plan.tile_cells):
        first = -(-top // step) * step
        rows = slice(top, min(top + plan.tile_cells, plan.shape[0]))
        part = store.read(name, (rows, slice(0, plan.shape[1])))
        parts.append(part[first - top :: step, ::step])
    return np.concatenate(parts)


def map_tiles(
    survey: Survey,
    folder: Path,
    *,
    fixes: Sequence[PositionFix] = (),
    prior: Grid | None = None,
    cell_m: float | None = None,
    tile_cells: int = TILE_CELLS,
    fill_m: float | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
    progress: Progress = silent,
) -> TiledSurvey:
    """Turn the passes of a survey into a map in tiles, in bounded memory.

    Parameters
    ----------
    prior : a map to tie the track to, by a draft of this survey of few enough cells to hold.
    fill_m : fill gaps up to this far from data; None leaves them.
    folder : where strips and tiles are kept; a later call with the same survey and settings goes on there.
    scheduler : address of a Dask cluster that sees `folder`; None starts a local one of `workers`.
    """
    check_prior(prior, survey.crs, survey.datum)
    if scheduler is not None:
        # A cluster that does not answer is told before the work, not after it.
        with open_cluster(scheduler):
            pass
    passes = file_passes(survey, folder / "strips", identity(survey), progress=progress)
    thin = [one.thin for one in passes]
    # Rounded as a survey in one piece rounds the cell it derives: else squares differ by a hair.
    config = SurveyConfig(
        match=MatchConfig(cell_m=steady(float(np.median([one.cell_m for one in passes]))))
    )
    corrected = correct_survey(thin, fixes, config, progress=progress)
    if prior is not None:
        corrected = _tied_in_the_plane(survey, thin, corrected, prior)
    track = whole_track(survey, corrected.trajectory)
    cell = cell_m or default_cell([_columns(one) for one in passes])
    strips = [
        filed(one.file, _placed(one, corrected, index), one.thin.altitude_m)
        for index, one in enumerate(passes)
    ]
    strips = as_planned(strips, folder / "plan.npz")
    plan = plan_tiles(strips, cell, survey.crs, survey.datum, tile_cells)
    # A local cluster takes seconds to start: a handful of tiles is made here in that time.
    alone = scheduler is None and tiles_to_make(plan, folder) <= _TILES_MADE_HERE
    with nullcontext() if alone else open_cluster(scheduler, workers, hold_memory=True) as client:
        store, tiles, made = fuse_tiles(plan, folder, client, progress)
        filled = None
        if fill_m is not None:
            filled = fill_tiles(plan, store, fill_m, client, progress)
    raw = navigated_track(survey)
    return TiledSurvey(
        plan=plan,
        store=store,
        figures=map_figures(tiles, plan.shape[0] * plan.shape[1], cell),
        made=made,
        track=track,
        raw_track=raw,
        corrected=corrected,
        objects=tuple(corrected_objects(one.objects, raw, track) for one in passes),
        contacts=tuple(one.contacts for one in passes),
        filled=filled,
    )


def _tied_in_the_plane(
    survey: Survey, strips: Sequence[ElevationStrip], corrected: CorrectedSurvey, prior: Grid
) -> CorrectedSurvey:
    east_m, north_m = expected_size(survey)
    cell_m = max(default_cell(strips), float(np.sqrt(east_m * north_m / _PICTURE_CELLS)))
    # Thin strips bear the flags of any of their samples: too many to settle looks by.
    coarse = [replace(strip, flags=None) for strip in corrected.strips]
    draft = fuse(coarse, cell_m, survey.crs, corrected.trajectory)
    same_frame(draft, prior)
    return tie_to_map(strips, corrected, draft, prior)


def _columns(one: FiledPass) -> ElevationStrip:
    """Return a strip of two columns as far apart as the whole strip's: all that a cell's choice asks of it."""
    step = float(np.median(np.diff(one.across_m))) if len(one.across_m) > 1 else 1.0
    two = np.zeros((len(one.thin.time_s), 2), np.float32)
    return replace(
        one.thin,
        elevation_m=two,
        sigma_m=two,
        echo=two,
        shadow=two > 0,
        across_m=np.array([0, step]),
        flags=None,
    )


def _placed(one: FiledPass, corrected: CorrectedSurvey, index: int) -> PlacedStrip:
    strip = corrected.strips[index]
    return PlacedStrip(
        across_m=one.across_m,
        easting_m=strip.easting_m,
        northing_m=strip.northing_m,
        heading_rad=strip.heading_rad,
        position_m2=position_variance(strip.ping, corrected.trajectory),
        reach_m=one.reach_m,
        height_m=float(corrected.height_m[index]),
        height_sigma_m=float(corrected.height_sigma_m[index]),
    )


def expected_size(survey: Survey) -> tuple[float, float]:
    """Return about how far a survey's map will reach east and north, m, from the pings' headers alone."""
    pings = survey.pings
    used = pings.pass_index >= 0
    reach_m = float(np.median((pings.sample_m * pings.samples)[used]))
    east, north = (
        float(np.ptp(v[used])) + 2 * reach_m for v in (pings.easting_m, pings.northing_m)
    )
    return east, north


def expected_cells(survey: Survey, cell_m: float | None, method: str = "joint") -> int:
    """Return about how many cells a survey's map will have, likewise.

    Where no cell is asked for, about the one that the method would choose.
    """
    pings = survey.pings
    used = pings.pass_index >= 0
    if cell_m is None:
        step = np.hypot(np.diff(pings.easting_m[used]), np.diff(pings.northing_m[used]))
        along_m, sample_m = float(np.median(step)), float(np.median(pings.sample_m[used]))
        reach_m = float(np.median((pings.sample_m * pings.samples)[used]))
        if method == "joint":
            cell_m = max(2 * along_m, reach_m / 100)
        else:
            cell_m = max(along_m, 2 * sample_m, reach_m / 500)
    east, north = expected_size(survey)
    return int(east * north / max(cell_m, 1e-3) ** 2)
