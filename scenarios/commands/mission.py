"""What `demo` and `run` share: a mission with its table and report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from scenarios.commands.console import prepare_out, print_table

if TYPE_CHECKING:
    from scenarios.schema import Scenario

# Metric -> what the table at the end calls it, and its unit.
_HEADLINES = {
    "map_mae_m": ("map: mean absolute error", "m"),
    "map_to_soundings_ratio": ("map: error over that of interpolated soundings", ""),
    "map_within_1sigma": ("map: share of errors within 1 sigma", ""),
    "map_within_2sigma": ("map: share of errors within 2 sigma", ""),
    "track_rms_before_m": ("track: rms error as navigated", "m"),
    "track_rms_after_m": ("track: rms error after the pose graph", "m"),
    "nav_rms_without_fixes_m": ("position: rms error of dead reckoning", "m"),
    "nav_rms_with_fixes_m": ("position: rms error with terrain fixes", "m"),
    "nav_rms_second_half_m": ("position: the same, second half of the run", "m"),
    "route_solved": ("route: found", ""),
    "route_cost": ("route: cost", ""),
    "route_lower_bound": ("route: no route costs less than", ""),
    "route_mean_altitude_m": ("route: mean altitude", "m"),
    "route_min_true_altitude_m": ("route: least altitude over the true floor", "m"),
}


def run_and_tell(scenario: Scenario, out: Path, *, quiet: bool) -> int:
    """Run a mission, write its report and print its table."""
    from scenarios.pipeline import run_mission
    from scenarios.report.overview import plot_overview
    from scenarios.report.page import write_report

    prepare_out(out)

    def say(stage: str) -> None:
        if not quiet:
            click.echo(f"{stage} ...", err=True)

    metrics = run_mission(scenario, out, quiet=quiet, say=say)
    plot_overview(out, out / "overview.png")
    report = write_report(out)
    if not quiet:
        print_table(f"\n{scenario.name} (seed {scenario.seed})", _rows(metrics))
        click.echo(f"results in {out}\nreport  in {report}")
    return 0


def _rows(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    from scenarios.report.page import format_value

    rows = [
        (label, f"{format_value(metrics[key])} {unit}".rstrip())
        for key, (label, unit) in _HEADLINES.items()
        if key in metrics
    ]
    if metrics.get("route_reason"):
        rows.append(("route: why not", str(metrics["route_reason"])))
    for key, value in metrics.items():
        if key.endswith("_s") and key != "total_s":
            rows.append((f"seconds: {key.removesuffix('_s')}", f"{value:.1f}"))
    rows.append(("seconds: all stages", f"{metrics['total_s']:.1f}"))
    return rows
