"""Collect pictures and numbers of an output folder into one page."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from perception.files import write_text
from perception.records import InputError
from scenarios.outputs import read_metrics, versions
from scenarios.report.units import label_and_unit

# Stage folder -> title, and what a reader should know before looking.
STAGES: dict[str, tuple[str, str]] = {
    "simulate": (
        "Simulated survey",
        "The echoes that the vehicle recorded. Truth is used for scoring only.",
    ),
    "strips": (
        "Echoes to strips",
        "Each ping is cut into nominal, highlight and shadow; highlight then shadow is a hill, "
        "shadow then highlight a crater.",
    ),
    "map": (
        "Map and track",
        "All passes fused on one grid, with the track before and after the pose graph, and the "
        "1-sigma of every cell.",
    ),
    "regions": (
        "Regions",
        "The map's surface by the signs of mean and Gaussian curvature.",
    ),
    "locate": (
        "Position from terrain",
        "Dead reckoning, fixes against the prior map, and the filtered position.",
    ),
    "plan": (
        "Route",
        "The route near the bottom, its altitude and the point where its clearance is least.",
    ),
    "diff": ("Difference of two maps", "Where two maps differ, and by how much."),
}

# Picture file -> what it shows; pictures of single passes go by the name without their number.
CAPTIONS: dict[str, str] = {
    "strip": "One pass: the echoes by ping and slant range with the bottom track, the levels cut from "
    "them, and the elevation strip.",
    "map": "Elevation with shaded relief; the track as navigated and as corrected.",
    "sigma": "1-sigma of every cell's height, all causes together.",
    "mosaic": "Echo mosaic: how strongly the ground returns, gain and angle taken out.",
    "difference": "The first map, the second minus the first with changed places outlined, and the "
    "histogram.",
    "regions": "Hills, valleys and ridges by the signs of mean (H) and Gaussian (K) curvature.",
    "legend": "Which signs of H and K make which class.",
    "locate": "The track on the prior map, how well the position is known and when it may be trusted, "
    "and the offset from dead reckoning.",
    "observability": "Where the ground can fix a vehicle, and how well.",
    "route": "The route from above, and its height over the ground with what must be kept clear.",
    "blocked": "No route: the path that breaks least, and the place that blocks.",
}

# Pictures that open a section; the others of the folder are folded away.
_FIRST = 4


@dataclass(frozen=True, slots=True)
class Picture:
    caption: str
    data: str


@dataclass(frozen=True, slots=True)
class Number:
    label: str
    value: str
    unit: str


@dataclass(frozen=True, slots=True)
class Section:
    name: str
    title: str
    lead: str
    pictures: list[Picture] = field(default_factory=list)
    more_pictures: list[Picture] = field(default_factory=list)
    metrics: list[Number] = field(default_factory=list)
    files: list[str] = field(default_factory=list)


def write_report(folder: Path) -> Path:
    """Write `report.html` into `folder` from its stage subfolders, or from itself as one stage.

    Raises
    ------
    InputError
        The folder holds nothing that bathynav wrote.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the --out folder of another command")
    sections = [_section(folder / name, name) for name in STAGES if (folder / name).is_dir()]
    whole = (folder / "metrics.json").exists()
    metrics = read_metrics(folder) if whole else {}
    if not sections:
        if not whole:
            raise InputError(
                f"{folder}: holds no metrics.json and no stage folder ({', '.join(STAGES)}); "
                "give the --out folder of another command"
            )
        sections = [_section(folder, folder.resolve().name)]
    path = folder / "report.html"
    write_text(path, _render(folder, metrics, sections))
    return path


def _section(folder: Path, name: str) -> Section:
    title, lead = STAGES.get(name, (name, ""))
    pictures = sorted(folder.glob("*.png"), key=_picture_order)
    metrics = read_metrics(folder) if (folder / "metrics.json").exists() else {}
    return Section(
        name=name,
        title=title,
        lead=lead,
        pictures=[_picture(p) for p in pictures[:_FIRST]],
        more_pictures=[_picture(p) for p in pictures[_FIRST:]],
        metrics=_numbers(metrics),
        files=[
            p.name
            for p in sorted(folder.iterdir())
            if p.is_file() and p.suffix != ".png" and not p.name.startswith(".")
        ],
    )


def _picture_order(path: Path) -> tuple[bool, str]:
    """Sort pictures of single passes behind those of the whole stage."""
    return path.stem[-1:].isdigit(), path.name


def _picture(path: Path) -> Picture:
    plain = path.stem.replace("-", " ").replace("_", " ").capitalize()
    kind = path.stem.rstrip("0123456789").rstrip("-_")
    caption = f"{plain}. {CAPTIONS[kind]}" if kind in CAPTIONS else plain
    return Picture(caption, base64.b64encode(path.read_bytes()).decode("ascii"))


def _numbers(metrics: dict[str, Any]) -> list[Number]:
    rows = []
    for key, value in metrics.items():
        if key in ("config", "versions", "seed") or isinstance(value, (dict, list)):
            continue
        label, unit = label_and_unit(key)
        rows.append(Number(label, format_value(value), unit))
    return rows


def format_value(value: Any) -> str:
    """Return a metric as text: four digits, and a dash for what is not known."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return f"{value:.4g}"
    return str(value)


def _render(folder: Path, metrics: dict[str, Any], sections: list[Section]) -> str:
    import tomli_w
    from jinja2 import Environment, PackageLoader

    page = Environment(loader=PackageLoader("scenarios", "report"), autoescape=True)
    config = folder / "config.toml"
    return page.get_template("page.html").render(
        title=_title(metrics, folder),
        subtitle=metrics.get("config", {}).get("summary", "") or "What this folder holds.",
        sections=sections,
        # A mission's own pictures; a single stage's are in its section.
        pictures=[_picture(p) for p in sorted(folder.glob("*.png"))]
        if sections[0].name != folder.resolve().name
        else [],
        headline=_numbers(metrics) if len(sections) > 1 or sections[0].name in STAGES else [],
        versions=metrics.get("versions", versions()),
        seed="–" if metrics.get("seed") is None else metrics["seed"],
        config=config.read_text(encoding="utf-8")
        if config.exists()
        else tomli_w.dumps(metrics.get("config", {})),
    )


def _title(metrics: dict[str, Any], folder: Path) -> str:
    name = metrics.get("config", {}).get("name", "")
    return str(name) if name else folder.resolve().name
