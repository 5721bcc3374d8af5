"""The whole way from a scenario to a route, stage by stage, each as its own command writes it.

A stage is a line of the command line and the folder it fills, so everything a mission does can be
done by hand, and any stage's folder can be used on its own.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli_w

from perception.files import write_text
from perception.records import InputError, NoPathError
from scenarios.outputs import read_metrics, versions, write_metrics
from scenarios.schema import Scenario, scenario_of, tree_of

_MARK = ".stage.json"  # in a stage's folder: which mission filled it
STAGES = ("simulate", "strips", "map", "regions", "locate", "plan")


@dataclass(frozen=True, slots=True)
class Stage:
    """One stage: its name (and folder), the command line that fills the folder."""

    name: str
    arguments: tuple[str, ...]


def mission_stages(scenario: Scenario, out: Path) -> list[Stage]:
    """Return the command lines of a mission, in the order of the flow."""
    survey, simulated = _survey_files(scenario, out), out / "simulate"
    map_tif = out / "map" / "map.tif"
    stages = [Stage("simulate", ("simulate", str(out / "scenario.toml")))]
    stages.append(Stage("strips", ("strips", *survey)))
    options: list[str] = ["--method", scenario.map.method, "--crs", scenario.world.crs]
    if scenario.map.cell_m is not None:
        options += ["--cell", repr(scenario.map.cell_m)]
    if scenario.map.fixes and scenario.navigation.fixes != "none":
        options += ["--fixes", str(simulated / "surface-fixes.csv")]
    if scenario.navigation.tide_amplitude_m > 0:
        options += ["--tide", str(simulated / "tide.csv")]
    if scenario.map.prior:
        options += ["--prior", str(simulated / "prior.tif")]
    stages.append(Stage("map", ("map", *survey, *options)))
    scale = scenario.regions.scale_m
    size = () if scale is None else ("--scale", repr(scale))
    stages.append(Stage("regions", ("regions", str(map_tif), *size)))
    stages.append(Stage("locate", _locate_line(scenario, out)))
    stages.append(Stage("plan", _plan_line(scenario, out)))
    return stages


def _survey_files(scenario: Scenario, out: Path) -> list[str]:
    folder = out / "simulate"
    if scenario.mission.files == "one":
        return [str(folder / "survey.xtf")]
    lines = sum(b.count for b in scenario.mission.block) + len(scenario.mission.lines)
    return [str(folder / f"survey-{i + 1:03d}.xtf") for i in range(lines)]


def _locate_line(scenario: Scenario, out: Path) -> tuple[str, ...]:
    simulated = out / "simulate"
    ground = simulated / "prior.tif" if scenario.locate.map == "prior" else out / "map" / "map.tif"
    line = ["locate", "--map", str(ground), "--nav", str(simulated / "nav.csv")]
    if scenario.locate.side_scan and scenario.locate.track == "return":
        line += ["--swath", str(simulated / "return.xtf")]
    return tuple(line)


def _plan_line(scenario: Scenario, out: Path) -> tuple[str, ...]:
    def place(offset: tuple[float, float]) -> str:
        east = scenario.world.origin_easting_m + offset[0]
        north = scenario.world.origin_northing_m + offset[1]
        return f"{east:.3f},{north:.3f}"

    plan = scenario.plan
    line = ["plan", "--map", str(out / "map" / "map.tif")]
    line += ["--start", place(plan.start), "--goal", place(plan.goal)]
    line += ["--vehicle", str(out / "vehicle.toml"), "--risk", repr(plan.risk)]
    line += ["--objects", str(out / "map" / "objects.gpkg")]
    if plan.weights == "none":
        line += ["--region-weights", "none"]
    else:
        line += ["--regions", str(out / "regions" / "regions.tif")]
    return tuple(line)


def run_mission(
    scenario: Scenario,
    out: Path,
    *,
    until: str = "",
    quiet: bool = False,
    say: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Run the stages of a mission into `out` and return its metrics.

    A stage that was finished by an interrupted run of the same scenario is not run again; a
    finished mission is run anew.

    Parameters
    ----------
    until : last stage to run; all if empty.
    say : told the name of each stage before it starts.

    Raises
    ------
    InputError
        `until` is no stage.
    """
    if until and until not in STAGES:
        raise InputError(f"until = {until!r} is no stage; there are {', '.join(STAGES)}")
    _refuse_foreign(out)
    if (out / "metrics.json").exists():
        _start_clean(out)
    write_text(out / "scenario.toml", tomli_w.dumps(tree_of(scenario)))
    write_text(out / "vehicle.toml", tomli_w.dumps({"vehicle": _vehicle(scenario)}))
    stages = mission_stages(scenario, out)
    if until:
        stages = stages[: STAGES.index(until) + 1]
    seconds: dict[str, float] = {}
    key = ""
    for stage in stages:
        say(stage.name)
        key = _digest(key, stage.arguments, tree_of(scenario))
        seconds[stage.name] = _run_stage(stage, out, key, quiet)
    metrics = _mission_metrics(out, [s.name for s in stages], seconds)
    write_metrics(out, metrics, tree_of(scenario), scenario.seed)
    return metrics


def _refuse_foreign(out: Path) -> None:
    """Refuse a folder in which a stage's subfolder was not made by a mission: it would be replaced."""
    for name in STAGES:
        folder = out / name
        if folder.is_dir() and any(folder.iterdir()) and not (folder / _MARK).exists():
            raise InputError(
                f"{folder}: holds files that no mission wrote; give --out a new or empty folder"
            )


def _start_clean(out: Path) -> None:
    """Remove what an earlier, finished mission left; nothing that bathynav did not write."""
    for name in STAGES:
        shutil.rmtree(out / name, ignore_errors=True)
    for name in ("metrics.json", "report.html", "scenario.toml", "vehicle.toml", "config.toml"):
        (out / name).unlink(missing_ok=True)


def _vehicle(scenario: Scenario) -> dict[str, float]:
    names = (
        "turn_radius_m", "pitch_up_deg", "pitch_down_deg", "floor_m", "ceiling_m", "speed_m_s",
        "depth_max_m",
    )  # fmt: skip
    values = {name: getattr(scenario.plan, name) for name in names}
    return {name: value for name, value in values.items() if value is not None}


def _digest(before: str, *parts: Any) -> str:
    text = json.dumps([before, versions(), *parts], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def _run_stage(stage: Stage, out: Path, key: str, quiet: bool) -> float:
    """Run one stage into its folder unless its mark is there; return its seconds."""
    from scenarios.commands import bathynav

    folder = out / stage.name
    mark = folder / _MARK
    if mark.exists():
        done = json.loads(mark.read_text(encoding="utf-8"))
        if done["key"] == key:
            return float(done["seconds"])
    shutil.rmtree(folder, ignore_errors=True)
    # Marked before it is filled: a killed stage's folder is known for a mission's own.
    write_text(mark, json.dumps({"key": "", "seconds": 0.0}) + "\n")
    began = time.perf_counter()
    line = [*stage.arguments, "--out", str(folder)]
    try:
        # The stage's own table would drown the mission's; its bars, on standard error, stay.
        with contextlib.redirect_stdout(io.StringIO()):
            # `map` comes after `strips` here and takes its passes up.
            line = [*line, "--quiet"] if quiet else line
            bathynav.main(line, standalone_mode=False, obj={"keep_passes": True})
    except NoPathError:
        # A route that cannot exist is a result: the folder's metrics.json says why.
        if stage.name != "plan":
            raise
    seconds = time.perf_counter() - began
    write_text(mark, json.dumps({"key": key, "seconds": seconds}) + "\n")
    return seconds


def _mission_metrics(out: Path, stages: list[str], seconds: dict[str, float]) -> dict[str, Any]:
    from scenarios.scores import score_mission

    metrics: dict[str, Any] = dict(score_mission(out, stages))
    if "plan" in stages:
        plan = read_metrics(out / "plan")
        metrics |= {
            "route_solved": plan["solved"],
            "route_reason": plan["reason"] or None,
            "route_cost": plan["cost"],
            "route_lower_bound": plan["lower_bound"],
            "route_length_m": plan["length_m"],
            "route_mean_altitude_m": plan["mean_altitude_m"],
            "route_min_margin_m": plan["min_clearance_margin_m"],
        }
    metrics |= {f"{name}_s": value for name, value in seconds.items()}
    metrics["total_s"] = sum(seconds.values())
    return metrics


def mission_task(config: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Run a mission as one run of an experiment; `until` in the config names the last stage."""
    until = str(config.pop("until", ""))
    metrics = run_mission(scenario_of(config, "sweep"), folder, until=until, quiet=True)
    # Seconds differ from one computation to the next; an experiment's results must not.
    return {k: v for k, v in metrics.items() if not k.endswith("_s") and v is not None}
