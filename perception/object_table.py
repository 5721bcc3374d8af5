"""The table of objects and craters, and its file: one row per object and pass."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from perception.files import write_text
from perception.records import BoolArray, FloatArray, IntArray

_COLUMNS = ("easting_m", "northing_m", "kind", "height_m", "sigma_m", "slant_range_m",
            "shadow_length_m", "pass", "ping", "probability", "bound")  # fmt: skip


_TYPES = {"pass_index": np.int64, "ping": np.int64, "lower_bound": np.bool_}


@dataclass(frozen=True, slots=True)
class ObjectTable:
    """Objects of one pass (or of several, joined); one entry per row in every array.

    Attributes
    ----------
    kind : "hill" or "crater".
    height_m, sigma_m : extreme above (below) the surrounding floor, positive, and its 1-sigma.
    slant_range_m, shadow_length_m : where the longest shadow starts, and its slant length.
    pass_index, ping : pass, and the ping (in the order of the survey's files) abeam of the centre.
    across_m, along_m : centre of the footprint: signed ground range (starboard positive) and distance
        along the pass; `half_across_m`, `half_along_m` its half sizes at a tenth of the height;
        `shape` the exponent of the fitted profile (NaN where the plain shadow relation was used).
    gain : log likelihood over a flat floor.
    probability : that it is an object (or crater) and not the floor's own relief.
    lower_bound : the shadow runs out of the swath, and `height_m` is the least that it proves.
    drop_m : height of the sonar above the floor as taken: level with the floor below it.
    floor_sigma_m : the part of `sigma_m` that the unknown floor makes, under the object and at its shadow's
        end; a map that knows the floor takes it off (`mapping.object_floors`).
    """

    easting_m: FloatArray
    northing_m: FloatArray
    kind: tuple[str, ...]
    height_m: FloatArray
    sigma_m: FloatArray
    slant_range_m: FloatArray
    shadow_length_m: FloatArray
    pass_index: IntArray
    ping: IntArray
    across_m: FloatArray
    along_m: FloatArray
    half_across_m: FloatArray
    half_along_m: FloatArray
    shape: FloatArray
    gain: FloatArray
    probability: FloatArray
    lower_bound: BoolArray
    drop_m: FloatArray
    floor_sigma_m: FloatArray

    def __len__(self) -> int:
        return len(self.kind)

    @classmethod
    def of(cls, rows: list[ObjectRow]) -> ObjectTable:
        """Stack rows into a table; none give an empty one."""
        columns: dict[str, Any] = {}
        for f in fields(cls):
            values = [getattr(row, f.name) for row in rows]
            columns[f.name] = (
                tuple(values)
                if f.name == "kind"
                else np.array(values, dtype=_TYPES.get(f.name, float))
            )
        return cls(**columns)

    @classmethod
    def joined(cls, tables: list[ObjectTable]) -> ObjectTable:
        """Join the tables of several passes."""
        if not tables:
            return cls.of([])
        columns: dict[str, Any] = {}
        for f in fields(cls):
            parts = [getattr(table, f.name) for table in tables]
            columns[f.name] = sum(parts, ()) if f.name == "kind" else np.concatenate(parts)
        return cls(**columns)


@dataclass(frozen=True, slots=True)
class ObjectRow:
    """One object; attributes as in `ObjectTable`, and its `odds` before the pass's other shadows are known."""

    easting_m: float
    northing_m: float
    kind: str
    height_m: float
    sigma_m: float
    slant_range_m: float
    shadow_length_m: float
    pass_index: int
    ping: int
    across_m: float
    along_m: float
    half_across_m: float
    half_along_m: float
    shape: float = field(default=float("nan"))
    gain: float = field(default=0.0)
    probability: float = field(default=1.0)
    lower_bound: bool = field(default=False)
    drop_m: float = field(default=float("nan"))
    floor_sigma_m: float = field(default=0.0)
    odds: float = field(default=float("inf"))


def write_objects_csv(path: Path, table: ObjectTable) -> None:
    """Write `objects.csv` as the contract has it; no object gives the header alone."""
    lines = [",".join(_COLUMNS)]
    for i in range(len(table)):
        lines.append(
            f"{table.easting_m[i]:.3f},{table.northing_m[i]:.3f},{table.kind[i]},"
            f"{table.height_m[i]:.3f},{table.sigma_m[i]:.3f},{table.slant_range_m[i]:.3f},"
            f"{table.shadow_length_m[i]:.3f},{table.pass_index[i]},{table.ping[i]},"
            f"{table.probability[i]:.3f},{'lower' if table.lower_bound[i] else ''}"
        )
    write_text(path, "\n".join(lines) + "\n")
