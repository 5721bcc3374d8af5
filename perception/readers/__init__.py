"""Sonar files of every format behind one `Survey`; a new format is one module and one line here."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from perception.files import existing_file
from perception.readers.raw import PingFlag, RawFile
from perception.readers.survey import PingTable, Survey
from perception.records import InputError, Progress, silent

if TYPE_CHECKING:
    from perception.installation import Installation

__all__ = ["FORMATS", "PingFlag", "PingTable", "RawFile", "Survey", "open_survey", "scan_file"]

# Module, and what users call the format. Each module has `recognises(path, head)`, which looks at
# the name and the first bytes, and `scan(path, progress) -> RawFile`. The first that recognises
# a file reads it, so formats with a sure mark come before those known by their name alone.
FORMATS = {
    "xtf": "XTF (Triton)",
    "starfish": "StarFish logdoc",
    "humminbird": "Humminbird DAT/SON",
    "netcdf": "NetCDF of pings",
    "jsf": "JSF (EdgeTech)",
    "lowrance": "Lowrance SL2/SL3",
}
_HEAD_BYTES = 4096


def format_of(path: Path) -> tuple[str, ModuleType]:
    """Return the format's name and reader of a file.

    Raises
    ------
    InputError
        Missing, empty or unreadable file, or one that no reader recognises.
    """
    path = Path(path)
    if not path.is_dir():
        path = existing_file(path)
    head = b""
    if path.is_file():
        with path.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
    for name in FORMATS:
        module = importlib.import_module(f"perception.readers.{name}")
        if module.recognises(path, head):
            return name, module
    if path.is_dir():
        raise InputError(f"{path}: is a folder without a sonar record; name a sonar file")
    start = head[:4].hex(" ") or "nothing"
    raise InputError(
        f"{path}: is no sonar file that bathynav reads (it starts with {start}); "
        f"give one of {', '.join(FORMATS.values())}"
    )


def scan_file(path: Path, progress: Progress = silent) -> RawFile:
    """Scan one file's packet headers; samples stay in the file until they are asked for.

    Raises
    ------
    InputError
        The file cannot be read, or is of no known format.
    """
    _, module = format_of(Path(path))
    raw: RawFile = module.scan(Path(path), progress)
    return raw


def open_survey(
    paths: Sequence[Path],
    crs: str | None = None,
    installation: Installation | None = None,
    progress: Progress = silent,
) -> Survey:
    """Open the files of one survey, in the order given.

    Parameters
    ----------
    paths : sonar files; pings are numbered through all of them from 0.
    crs : projected CRS in metres; default the UTM zone (WGS 84) of the first valid position.
    installation : lever arms, mounting, latencies, tow, tide, sound speed.

    Returns
    -------
    Survey
        Headers of all pings in memory; samples are read pass by pass with `Survey.swath`.

    Raises
    ------
    InputError
        A file that cannot be read, fewer than 10 usable side-scan pings, an unusable CRS.
    """
    if not paths:
        raise InputError("no sonar file was named; give at least one")
    return Survey.of([scan_file(Path(path), progress) for path in paths], crs, installation)
