"""Scenario files: one TOML tree for single runs and sweeps, every key validated."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from perception.files import read_toml
from perception.records import InputError
from scenarios.sections import Scenario
from scenarios.world.components import KINDS

__all__ = [
    "LIBRARY",
    "Scenario",
    "library",
    "load_scenario",
    "rasters_from",
    "scenario_of",
    "tree_of",
]

LIBRARY = Path(__file__).parent / "library"


def library() -> dict[str, Path]:
    """Return the named scenarios, in alphabetical order with `demo` first."""
    found = {path.stem: path for path in sorted(LIBRARY.glob("*.toml"))}
    return {name: found[name] for name in sorted(found, key=lambda n: (n != "demo", n))}


def load_scenario(source: Path | str) -> Scenario:
    """Read a scenario file, or a named one of the library.

    Raises
    ------
    InputError
        No such file or name, no TOML, or a key that is unknown or wrong: one line names key, value
        and file.
    """
    path = Path(source)
    named = library()
    if not path.exists() and str(source) in named:
        path = named[str(source)]
    if not path.exists() and not path.suffix and path.parent == Path():
        raise InputError(f"{path}: no such scenario; there are {', '.join(named)}, or give a file")
    return scenario_of(rasters_from(read_toml(path), path.parent), str(path))


def rasters_from(tree: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return a tree whose `raster` components name their file from the root, not from `folder`.

    A resolved scenario is copied into other folders, where a relative path would lead nowhere.
    """
    world = tree.get("world")
    parts = world.get("terrain") if isinstance(world, dict) else None
    if not isinstance(world, dict) or not isinstance(parts, list):
        return tree

    def absolute(part: Any) -> Any:
        if isinstance(part, dict) and isinstance(part.get("path"), str):
            return {**part, "path": str((folder / part["path"]).resolve())}
        return part

    return {**tree, "world": {**world, "terrain": [absolute(part) for part in parts]}}


def scenario_of(tree: Mapping[str, Any], source: str) -> Scenario:
    """Validate a tree read from `source` (named in messages)."""
    try:
        return Scenario.model_validate(tree)
    except ValidationError as error:
        raise InputError(f"{source}: {_first_complaint(error, tree)}") from error


def tree_of(scenario: Scenario) -> dict[str, Any]:
    """Return the resolved scenario as plain TOML types; absent values are left out."""
    tree: dict[str, Any] = scenario.model_dump(mode="json", exclude_none=True)
    return tree


def _first_complaint(error: ValidationError, tree: Mapping[str, Any]) -> str:
    """Put the first of pydantic's complaints into one line: key, value, what is allowed."""
    first = error.errors()[0]
    # A component's place in the error names its kind as well, which is no key of the file.
    place = [part for part in first["loc"] if part not in KINDS]
    key = _dotted(place)
    if first["type"] == "extra_forbidden":
        near = difflib.get_close_matches(str(place[-1]), _siblings(first["loc"]), n=1, cutoff=0.5)
        hint = f"did you mean {near[0]}?" if near else "docs/scenarios.md lists the keys"
        return f"{key} = {first['input']!r} is not a known key; {hint}"
    if not place:
        return str(first["msg"]).removeprefix("Value error, ")
    if first["type"] == "missing":
        return f"{key} is missing; docs/scenarios.md lists the keys"
    message = str(first["msg"]).removeprefix("Value error, ")
    return f"{key} = {_short(first['input'])}: {message[0].lower()}{message[1:]}"


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _dotted(place: list[int | str]) -> str:
    text = ""
    for part in place:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def _siblings(place: tuple[int | str, ...]) -> list[str]:
    """Return the keys known where the unknown one stands."""
    model: type[BaseModel] = Scenario
    for part in place[:-1]:
        if isinstance(part, int):
            continue
        if part in KINDS:
            model = KINDS[part]
            continue
        inner = (
            _section_in(model.model_fields[part].annotation) if part in model.model_fields else None
        )
        if inner is not None:
            model = inner
    return list(model.model_fields)


def _section_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        found = _section_in(argument)
        if found is not None:
            return found
    return None
