"""The store of a tiled map: a Zarr group of the map's layers, and a mark for every tile that is done.

FOLDER/map.zarr      elevation, sigma, count, echo, flags, one chunk a tile; y and x; CF attributes
FOLDER/plan.npz      the plan, for the workers
FOLDER/marks/        ROW-COL.json: the tile's key and figures, written after its chunks
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import zarr
from pyproj import CRS

from mapping.tile_plan import TilePlan
from mapping.tiles import LAYERS, Layers
from perception.files import write_text
from perception.records import InputError

# layer: (units, long name, CF standard name); heights of filled cells lie apart from data.
_ATTRIBUTES = {
    "elevation": ("m", "height of the sea floor above the vertical datum", ""),
    "sigma": ("m", "1-sigma of the cell's mean height", ""),
    "count": ("1", "number of data", ""),
    "echo": ("dB", "echo level over nominal", ""),
    "flags": ("1", "quality flags, bits as in flags.tif", ""),
    "fill": ("m", "height of filled cells, which hold no data", ""),
    "fill_sigma": ("m", "1-sigma of filled cells", ""),
}
FILL_LAYERS = ("fill", "fill_sigma")
# A store's marks by stage: tiles fused, tiles filled.
FUSED, FILLED = "marks", "fill-marks"


class TileStore:
    """The layers of a tiled map on disk, read and written by rasters' slices, rows from the north."""

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)
        self._group = zarr.open_group(str(self.folder / "map.zarr"), mode="r+")

    @classmethod
    def create(cls, folder: Path, plan: TilePlan) -> TileStore:
        """Open the store of a plan; one of another frame is removed first."""
        folder = Path(folder)
        frame = _frame(plan)
        path = folder / "map.zarr"
        if path.exists() and _frame_of(path) != frame:
            clear(folder)
        if not path.exists():
            folder.mkdir(parents=True, exist_ok=True)
            _create(path, plan, frame)
        return cls(folder)

    def write(self, where: tuple[slice, slice], layers: Layers | None) -> None:
        """Write a tile's layers; None empties it.

        Raises
        ------
        InputError
            The disk is full or may not be written.
        """
        try:
            for name in LAYERS if layers is None else layers:
                array: Any = self._group[name]
                array[where] = array.fill_value if layers is None else layers[name]
        except OSError as error:
            raise _unwritable(self.folder, error) from error

    def read(self, name: str, where: tuple[slice, slice]) -> npt.NDArray[np.float32]:
        """Read part of a layer."""
        array: Any = self._group[name]
        return np.asarray(array[where], np.float32)

    def mark(
        self, tile: tuple[int, int], key: str, figures: Mapping[str, Any], stage: str = FUSED
    ) -> None:
        """Note that a tile's chunks are written."""
        said = {"key": key, "figures": dict(figures)}
        write_text(self._mark(tile, stage), json.dumps(said) + "\n")

    def unmark(self, tile: tuple[int, int], stage: str = FUSED) -> None:
        """Take a tile's mark away before its chunks are overwritten.

        A run killed between the two would leave them under the key of what was there before, and a later
        run of that key would take them for its own.

        Raises
        ------
        InputError
            The folder may not be written.
        """
        try:
            self._mark(tile, stage).unlink(missing_ok=True)
        except OSError as error:
            raise _unwritable(self.folder, error) from error

    def figures(self, tile: tuple[int, int], key: str, stage: str = FUSED) -> dict[str, Any] | None:
        """Return a tile's figures; None where it is not there as the key has it."""
        try:
            said = json.loads(self._mark(tile, stage).read_text(encoding="utf-8"))
        except (FileNotFoundError, ValueError):
            return None
        figures: dict[str, Any] | None = said["figures"] if said.get("key") == key else None
        return figures

    def _mark(self, tile: tuple[int, int], stage: str) -> Path:
        return self.folder / stage / f"{tile[0]}-{tile[1]}.json"


def clear(folder: Path) -> None:
    """Remove a store's tiles and marks."""
    for name in (FUSED, FILLED, "map.zarr"):
        shutil.rmtree(Path(folder) / name, ignore_errors=True)


def _frame(plan: TilePlan) -> list[Any]:
    window = plan.window
    lattice = [plan.cell_m, plan.crs, window.row, window.col, *plan.shape, plan.tile_cells]
    # A store of an older version lacks a layer.
    return [*lattice, *LAYERS]


def _frame_of(path: Path) -> Any:
    try:
        return zarr.open_group(str(path), mode="r").attrs.get("frame")
    except (OSError, ValueError, KeyError):
        return None


def _create(path: Path, plan: TilePlan, frame: list[Any]) -> None:
    try:
        # The frame is written last: a store that was being made when the run was killed is made anew.
        group = zarr.open_group(str(path), mode="w")
        for name in (*LAYERS, *FILL_LAYERS):
            units, long_name, _ = _ATTRIBUTES[name]
            group.create_array(
                name, shape=plan.shape, chunks=(plan.tile_cells, plan.tile_cells), dtype="float32",
                fill_value=0.0 if name == "count" else np.nan, dimension_names=("y", "x"),
                attributes={"units": units, "long_name": long_name, "grid_mapping": "crs"},
            )  # fmt: skip
        rows, cols = plan.shape
        axes = {
            "x": (plan.west_m + (np.arange(cols) + 0.5) * plan.cell_m, "easting"),
            "y": (plan.north_m - (np.arange(rows) + 0.5) * plan.cell_m, "northing"),
        }
        for name, (values, long_name) in axes.items():
            attributes = {"units": "m", "long_name": long_name,
                          "standard_name": f"projection_{name}_coordinate"}  # fmt: skip
            axis = group.create_array(
                name,
                shape=values.shape,
                dtype="float64",
                dimension_names=(name,),
                attributes=attributes,
            )
            axis[:] = values
        crs = group.create_array("crs", shape=(), dtype="int32")
        crs.attrs.update(CRS.from_user_input(plan.crs).to_cf() if plan.crs else {})
        group.attrs.update({"Conventions": "CF-1.11", "vertical_datum": plan.datum, "frame": frame})
    except OSError as error:
        raise _unwritable(path, error) from error


def _unwritable(path: Path, error: OSError) -> InputError:
    return InputError(
        f"{path}: cannot be written ({error.strerror or error}); "
        "give --out a folder that can be written and has room"
    )
