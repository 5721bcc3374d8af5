"""Passes on disk: strips made one at a time, kept as files, taken up again by a later run.

Of a pass that is filed only what registration needs stays in memory: the strip on coarse columns, the reach of
its heights, its objects.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from mapping.placed import reach_of
from mapping.textures import default_cell, thinned
from mapping.tile_plan import StripFile
from perception.files import whole_file, write_text
from perception.objects import ObjectTable
from perception.readers import Survey
from perception.records import ElevationStrip, FloatArray, Progress, silent
from perception.strip_files import read_strip, write_strip
from perception.strips import PassResult, StripConfig, build_strip
from scenarios.passes import each_pass
from scenarios.report.contacts import Contact, contacts_of, pictured

# Part of every pass's key: raise it when the same echoes would give another strip, objects or contacts.
_METHOD = 3
# Registration compares strips on this part of its cell; finer columns stay on disk.
_THIN = 0.6
# As in `scenarios.survey_map`.
_PICTURES_A_PASS = 100


@dataclass(frozen=True, slots=True)
class FiledPass:
    """One pass whose strip lies in a file.

    Attributes
    ----------
    file : the whole strip.
    thin : the strip on columns wide enough for registration.
    across_m : (m,) columns of the whole strip; reach_m : (n, 2) its least and greatest with a height.
    cell_m : cell on which registration compares it.
    """

    file: StripFile
    thin: ElevationStrip
    across_m: FloatArray
    reach_m: FloatArray
    objects: ObjectTable
    cell_m: float
    contacts: tuple[Contact, ...] = ()


def file_passes(
    survey: Survey,
    folder: Path,
    identity: tuple[object, ...],
    config: StripConfig | None = None,
    progress: Progress = silent,
) -> list[FiledPass]:
    """Turn every pass into a strip file in `folder`, one pass in memory at a time.

    Parameters
    ----------
    identity : what tells this survey from another; a pass that was filed under it is not made again.

    Errors are those of `each_pass`.
    """

    def key_of(index: int) -> str:
        text = repr((_METHOD, identity, config, index))
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    def path_of(index: int) -> Path:
        return folder / f"strip-{index:03d}.nc"

    def taken_up_or_built(index: int) -> FiledPass | PassResult:
        kept = _taken_up(path_of(index), key_of(index))
        return build_strip(survey.swath(index), config) if kept is None else kept

    # Written outside `each_pass`: a full disk is no pass to leave out.
    return [
        made
        if isinstance(made, FiledPass)
        else _written(made, path_of(index), key_of(index), survey.utc)
        for index, made in each_pass(survey, taken_up_or_built, progress)
    ]


def _written(result: PassResult, path: Path, key: str, utc: bool) -> FiledPass:
    """Write a pass; its mark comes last, so that what a killed run left half done is made anew."""
    path.with_suffix(".json").unlink(missing_ok=True)  # an older key's, whose files are overwritten
    write_strip(path, result.strip, utc)
    contacts = tuple(pictured(contacts_of(result), _PICTURES_A_PASS))
    _write_objects(path.with_suffix(".objects.npz"), result.objects, contacts)
    file = StripFile.of(path)
    write_text(path.with_suffix(".json"), json.dumps({"key": key, "digest": file.digest}) + "\n")
    return _filed(file, result.strip, result.objects, contacts)


def _taken_up(path: Path, key: str) -> FiledPass | None:
    """Return a pass that was filed under this key; None where it is not there whole."""
    try:
        said = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
        if said["key"] != key or StripFile.of(path).digest != said["digest"]:
            return None
        objects, contacts = _read_objects(path.with_suffix(".objects.npz"))
    except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile):
        # Cut short, or with other columns than this version's: made anew like one that is not there.
        return None
    return _filed(StripFile(path, said["digest"]), read_strip(path), objects, contacts)


def _filed(
    file: StripFile, strip: ElevationStrip, objects: ObjectTable, contacts: tuple[Contact, ...]
) -> FiledPass:
    cell_m = default_cell([strip])
    across_m = np.asarray(strip.across_m, float)
    return FiledPass(
        file, thinned(strip, _THIN * cell_m), across_m, reach_of(strip), objects, cell_m, contacts
    )


def _write_objects(path: Path, table: ObjectTable, contacts: tuple[Contact, ...]) -> None:
    """Write a pass's objects, and the echoes that show them one behind the other."""
    columns: dict[str, Any] = {f.name: np.asarray(getattr(table, f.name)) for f in fields(table)}
    columns["kind"] = np.array(table.kind, dtype="U16")
    said = [{k: v for k, v in asdict(c).items() if k != "snippet"} for c in contacts]
    columns["contacts"] = np.array(json.dumps(said))
    columns["snippets"] = np.frombuffer(b"".join(c.snippet for c in contacts), np.uint8)
    columns["snippet_ends"] = np.cumsum([len(c.snippet) for c in contacts], dtype=np.int64)
    with whole_file(path) as temporary:
        np.savez(temporary, **columns)


def _read_objects(path: Path) -> tuple[ObjectTable, tuple[Contact, ...]]:
    with np.load(path, allow_pickle=False) as data:
        columns: dict[str, Any] = {f.name: data[f.name] for f in fields(ObjectTable)}
        said = json.loads(str(data["contacts"]))
        ends, echoes = data["snippet_ends"].tolist(), data["snippets"].tobytes()
    columns["kind"] = tuple(str(kind) for kind in columns["kind"])
    contacts = tuple(
        Contact(**{k: _hashable(v) for k, v in one.items()}, snippet=echoes[first:last])
        for one, first, last in zip(said, [0, *ends], ends, strict=False)
    )
    return ObjectTable(**columns), contacts


def _hashable(value: Any) -> Any:
    """Return a value as it was before JSON made lists of its tuples."""
    return tuple(_hashable(v) for v in value) if isinstance(value, list) else value
