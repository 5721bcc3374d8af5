"""Write docs/scenarios.md from the schema, so that the page never drifts from it.

python -m scenarios.schema_page > docs/scenarios.md
"""

from __future__ import annotations

import sys
from typing import Any

from pydantic import BaseModel

from scenarios.schema import Scenario
from scenarios.sections import AlbedoSection, Block
from scenarios.world.components import KINDS

_HEAD = """\
# Scenario files

A scenario is a TOML file with the tables below. It drives `bathynav simulate`, `run` and `demo`, and a
sweep is a scenario with a `[sweep]` table. Unknown keys and values out of range are refused with
one line that names key, value and file. Every key has a default except those marked *required*;
a scenario needs at least one `[[mission.block]]` or a line in `mission.lines`.

`bathynav scenarios` lists the named ones, `bathynav scenarios NAME` prints one to start from, and
`scenario.toml` beside every result is the resolved file: all defaults filled in.

Lengths are metres, places are metres east and north of the world's origin, azimuths are degrees
clockwise from grid north. *None* as a default means that the key is left out.

This page is written from the schema (`python -m scenarios.schema_page > docs/scenarios.md`) and a
test holds the two together.
"""


def schema_page() -> str:
    """Return the page as Markdown."""
    parts = [_HEAD, "## Top level\n", _table(Scenario, skip_sections=True)]
    for name, field in Scenario.model_fields.items():
        model = field.annotation
        if isinstance(model, type) and issubclass(model, BaseModel):
            parts += [f"\n## [{name}]\n", f"{_summary(model)}\n", _table(model, skip_sections=True)]
        if name == "world":
            parts += [
                "\n### [world.albedo]\n",
                f"{_summary(AlbedoSection)}\n",
                _table(AlbedoSection),
            ]
            parts += [_terrain()]
        if name == "mission":
            parts += ["\n### [[mission.block]]\n", f"{_summary(Block)}\n", _table(Block)]
    return "\n".join(parts)


def _terrain() -> str:
    parts = ["\n### [[world.terrain]]\n", "Each entry has a `kind`; what they add is summed.\n"]
    shown: dict[type[BaseModel], list[str]] = {}
    for kind, model in KINDS.items():
        shown.setdefault(model, []).append(kind)
    for model, kinds in shown.items():
        title = ", ".join(f"`{kind}`" for kind in kinds)
        parts += [f"\n#### kind = {title}\n", f"{_summary(model)}\n", _table(model)]
    return "\n".join(parts)


def _summary(model: type[BaseModel]) -> str:
    return " ".join((model.__doc__ or "").split())


def _table(model: type[BaseModel], skip_sections: bool = False) -> str:
    lines = ["| key | default | meaning |", "|---|---|---|"]
    for name, field in model.model_fields.items():
        kind = field.annotation
        is_section = isinstance(kind, type) and issubclass(kind, BaseModel)
        if name == "kind" or (skip_sections and is_section):
            continue
        default = "*required*" if field.is_required() else _plain(field.default)
        lines.append(f"| `{name}` | {default} | {field.description or ''}{_choices(kind)} |")
    return "\n".join(lines)


def _plain(value: Any) -> str:
    if value is None:
        return "*None*"
    if value == ():
        return "none"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, str):
        return f'`"{value}"`'
    return f"`{list(value) if isinstance(value, tuple) else value}`"


def _choices(kind: Any) -> str:
    """Return the words that a key allows, where it allows a few words only."""
    words = [a for a in getattr(kind, "__args__", ()) if isinstance(a, str)]
    return f" ({', '.join(words)})" if words else ""


if __name__ == "__main__":
    sys.stdout.write(schema_page())
