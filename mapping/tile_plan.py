"""The plan of a tiled map: lattice, tiles and placed strips, on disk for whoever makes a tile."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import netCDF4
import numpy as np
import numpy.typing as npt

from mapping.fusion import map_window
from mapping.gridding import Window
from mapping.placed import PlacedStrip, boxes
from perception.files import existing_file, whole_file
from perception.records import BoolArray, FloatArray, InputError

logger = logging.getLogger(__name__)

# Part of every tile's key: raise it when the same strips would give another map.
_METHOD = 3
# A tile of 1,024 cells holds some 40 MB of sums while it is made, and 12 MB in the store.
TILE_CELLS = 1024
# Lattices beyond this are a mistake of units rather than a survey.
_MOST_CELLS = 10**13
_POSES = ("easting_m", "northing_m", "heading_rad", "position_m2", "altitude_m")


@dataclass(frozen=True, slots=True)
class StripFile:
    """A strip as `perception.strip_files` writes it, whose rows are read when they are wanted.

    Attributes
    ----------
    path : NetCDF file with `elevation_m`, `sigma_m` and `echo` (lines, columns).
    digest : of the file's content: what was made of it stays true while this does.
    """

    path: Path
    digest: str

    @classmethod
    def of(cls, path: Path) -> StripFile:
        """Return the file with its digest, reading it once."""
        with existing_file(path).open("rb") as stream:
            return cls(Path(path), hashlib.file_digest(stream, "blake2b").hexdigest()[:32])

    def rows(self, first: int, last: int, names: Sequence[str]) -> tuple[FloatArray, ...]:
        """Return the named variables of lines first to last - 1, NaN where there is no data."""
        with self._opened() as data:
            return tuple(np.asarray(data[name][first:last], np.float32) for name in names)

    def flags(self, first: int, last: int) -> tuple[npt.NDArray[np.uint8], BoolArray]:
        """Return the flags of those lines, none where the file has no such variable, and where a height is."""
        with self._opened() as data:
            seen = np.isfinite(data["elevation_m"][first:last])
            if "flags" not in data.variables:
                return np.zeros(seen.shape, np.uint8), seen
            return np.asarray(data["flags"][first:last], np.uint8), seen

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        try:
            with netCDF4.Dataset(self.path) as data:
                data.set_auto_mask(False)  # NaN is no data, with or without a mask
                yield data
        except (OSError, IndexError) as error:
            raise InputError(
                f"{self.path}: cannot be read as a strip ({error}); run the same command again to "
                "make it anew"
            ) from error


@dataclass(frozen=True, slots=True)
class FiledStrip:
    """A placed strip whose rows lie in a file, and the altitudes by which its echoes are weighted."""

    file: StripFile
    strip: PlacedStrip
    altitude_m: FloatArray


def filed(file: StripFile, strip: PlacedStrip, altitude_m: FloatArray) -> FiledStrip:
    """Return a placed strip that takes its rows from a file."""

    def rows(first: int, last: int) -> tuple[FloatArray, FloatArray]:
        height, sigma = file.rows(first, last, ("elevation_m", "sigma_m"))
        return height, sigma

    return FiledStrip(file, replace(strip, rows=rows), np.asarray(altitude_m, float))


@dataclass(frozen=True)
class TilePlan:
    """What a tiled map is made of.

    Attributes
    ----------
    cell_m, crs, datum : frame of the map.
    window : all cells of the map, on the lattice whose edges are multiples of the cell.
    tile_cells : cells on a tile's side.
    strips : in the order of the passes.
    """

    cell_m: float
    crs: str
    datum: str
    window: Window
    tile_cells: int
    strips: tuple[FiledStrip, ...]

    @property
    def shape(self) -> tuple[int, int]:
        return self.window.rows, self.window.cols

    @property
    def west_m(self) -> float:
        return self.window.col * self.cell_m

    @property
    def north_m(self) -> float:
        return (self.window.row + self.window.rows) * self.cell_m

    def tiles(self) -> list[tuple[int, int]]:
        """Return all tiles as (row, column), from the north-west."""
        rows, cols = (-(-size // self.tile_cells) for size in self.shape)
        return [(i, j) for i in range(rows) for j in range(cols)]

    def slices(self, tile: tuple[int, int]) -> tuple[slice, slice]:
        """Return where a tile lies in the map's rasters, rows from the north."""
        starts = (tile[0] * self.tile_cells, tile[1] * self.tile_cells)
        rows, cols = (
            slice(start, min(start + self.tile_cells, size))
            for start, size in zip(starts, self.shape, strict=True)
        )
        return rows, cols

    def core(self, tile: tuple[int, int]) -> Window:
        """Return a tile's cells on the lattice."""
        rows, cols = self.slices(tile)
        south = self.window.row + self.window.rows - rows.stop
        return Window(
            south, self.window.col + cols.start, rows.stop - rows.start, cols.stop - cols.start
        )

    def outer(self, tile: tuple[int, int], halo: int = 1) -> Window:
        """Return a tile's cells with those around it that its own depend on, within the map."""
        grown = self.core(tile).grown(halo).common(self.window)
        assert grown is not None
        return grown

    @cached_property
    def boxes(self) -> list[list[tuple[int, int, Window]]]:
        """The blocks of lines of each strip, and the cells they may touch."""
        return [boxes(one.strip, self.cell_m) for one in self.strips]

    def touching(self, tile: tuple[int, int]) -> list[int]:
        """Return the strips that a tile is made of, in order."""
        outer, (owner, row, col, rows, cols) = self.outer(tile), self._block_table
        apart = (
            (row >= outer.row + outer.rows) | (row + rows <= outer.row)
            | (col >= outer.col + outer.cols) | (col + cols <= outer.col)
        )  # fmt: skip
        found: list[int] = np.unique(owner[~apart]).tolist()
        return found

    @cached_property
    def _block_table(self) -> npt.NDArray[np.int64]:
        """Strip, row, column, rows and columns (5, blocks) of all blocks: long surveys have very many."""
        table = [
            (index, box.row, box.col, box.rows, box.cols)
            for index, blocks in enumerate(self.boxes)
            for _, _, box in blocks
        ]
        return np.array(table, np.int64).reshape(-1, 5).T

    def key(self, tile: tuple[int, int]) -> str:
        """Return the digest of all that decides a tile's content."""
        digest = hashlib.blake2b(digest_size=16)
        core, outer = self.core(tile), self.outer(tile)
        digest.update(repr((_METHOD, self.cell_m, core, outer)).encode())
        for index in self.touching(tile):
            digest.update(self._digests[index])
        return digest.hexdigest()

    @cached_property
    def _digests(self) -> list[bytes]:
        return [_digest(one) for one in self.strips]


def _digest(one: FiledStrip) -> bytes:
    """Return the digest of a strip: its rows, where it lies, how high and how sure."""
    digest = hashlib.blake2b(one.file.digest.encode(), digest_size=16)
    for array in _placing(one).values():
        digest.update(np.asarray(array, float).tobytes())
    return digest.digest()


# A strip's place is the same where lengths differ by no more than a hundredth of a millimetre, headings by no more
# than that over ten kilometres, variances by no more than a part of them.
_SAME_M, _SAME_RAD, _SAME_VARIANCE = 1e-5, 1e-9, 1e-6


def as_planned(strips: Sequence[FiledStrip], path: Path) -> list[FiledStrip]:
    """Return strips at the very poses of an earlier plan, where they lie the same but for a graph's last digits.

    A graph solved again ends some 1e-11 m aside, and no tile has to be made anew for that. Poses are compared and
    not rounded, for rounding has edges; and the earlier ones stay, so that no number of runs creeps away.

    Parameters
    ----------
    path : as `save_plan` wrote it. Without one, or with one that cannot be read, strips are as they are.
    """
    if not path.exists():
        return list(strips)
    try:
        with np.load(path, allow_pickle=False) as data:
            said = {one["digest"]: (i, one) for i, one in enumerate(_head(data)["strips"])}
            # One strip at a time: the poses of a long survey are many.
            return [
                _as_said(one, data, *said[one.file.digest]) if one.file.digest in said else one
                for one in strips
            ]
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        logger.info("%s: not read (%s), so all poses count as new", path, error)
        return list(strips)


def _as_said(one: FiledStrip, data: Any, index: int, said: dict[str, Any]) -> FiledStrip:
    earlier = _strip_of(data, index, said)
    if not _lie_alike(one, earlier):
        return one
    return filed(one.file, earlier.strip, earlier.altitude_m)


def _lie_alike(one: FiledStrip, other: FiledStrip) -> bool:
    pairs = zip(_placing(one).items(), _placing(other).values(), strict=True)
    return all(
        np.shape(ours) == np.shape(theirs)
        and np.allclose(
            ours,
            theirs,
            rtol=_SAME_VARIANCE if name == "position_m2" else 0.0,
            atol={"heading_rad": _SAME_RAD, "position_m2": 0.0}.get(name, _SAME_M),
            equal_nan=True,
        )
        for (name, ours), theirs in pairs
    )


def plan_tiles(
    strips: Sequence[FiledStrip],
    cell_m: float,
    crs: str,
    datum: str = "",
    tile_cells: int = TILE_CELLS,
) -> TilePlan:
    """Lay tiles over all that the strips saw.

    Raises
    ------
    InputError
        No strip holds a height, or the lattice has more cells than any survey.
    """
    window = map_window([one.strip for one in strips], cell_m, _MOST_CELLS)
    return TilePlan(float(cell_m), crs, datum, window, int(tile_cells), tuple(strips))


def _poses(one: FiledStrip) -> dict[str, FloatArray]:
    return {
        name: one.altitude_m if name == "altitude_m" else getattr(one.strip, name)
        for name in _POSES
    }


def _placing(one: FiledStrip) -> dict[str, Any]:
    """Return all that decides where a strip's rows come to lie and what they count."""
    names = ("across_m", "reach_m", "height_m", "height_sigma_m")
    return _poses(one) | {name: getattr(one.strip, name) for name in names}


def save_plan(path: Path, plan: TilePlan) -> None:
    """Write a plan for the workers, whole or not at all."""
    head = {
        "cell_m": plan.cell_m, "crs": plan.crs, "datum": plan.datum, "tile_cells": plan.tile_cells,
        "window": [plan.window.row, plan.window.col, plan.window.rows, plan.window.cols],
        "strips": [
            {"path": str(one.file.path.absolute()), "digest": one.file.digest,
             "height_m": one.strip.height_m, "height_sigma_m": one.strip.height_sigma_m}
            for one in plan.strips
        ],
    }  # fmt: skip
    arrays: dict[str, Any] = {"head": np.array(json.dumps(head))}
    for index, one in enumerate(plan.strips):
        arrays |= {f"{index}/{name}": values for name, values in _poses(one).items()}
        arrays |= {f"{index}/across_m": one.strip.across_m, f"{index}/reach_m": one.strip.reach_m}
    with whole_file(path) as temporary:
        np.savez(temporary, **arrays)


def load_plan(path: Path) -> TilePlan:
    """Read what `save_plan` wrote."""
    with np.load(path, allow_pickle=False) as data:
        head = _head(data)
        strips = [_strip_of(data, index, said) for index, said in enumerate(head["strips"])]
    return TilePlan(
        head["cell_m"], head["crs"], head["datum"], Window(*head["window"]), head["tile_cells"],
        tuple(strips),
    )  # fmt: skip


def _head(data: Any) -> dict[str, Any]:
    head: dict[str, Any] = json.loads(str(data["head"]))
    return head


def _strip_of(data: Any, index: int, said: dict[str, Any]) -> FiledStrip:
    arrays = {name: data[f"{index}/{name}"] for name in (*_POSES, "across_m", "reach_m")}
    strip = PlacedStrip(
        across_m=arrays["across_m"],
        easting_m=arrays["easting_m"],
        northing_m=arrays["northing_m"],
        heading_rad=arrays["heading_rad"],
        position_m2=arrays["position_m2"],
        reach_m=arrays["reach_m"],
        height_m=said["height_m"],
        height_sigma_m=said["height_sigma_m"],
    )
    return filed(StripFile(Path(said["path"]), said["digest"]), strip, arrays["altitude_m"])
