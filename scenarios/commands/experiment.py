"""`bathynav experiment`: many runs of a scenario, in parallel, resumable."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from scenarios.commands.console import (
    common_options,
    out_option,
    prepare_out,
    print_table,
    progress_bars,
    set_verbosity,
)

if TYPE_CHECKING:
    from scenarios.sweep import SweepPlan


@click.command()
@click.argument("sweep", type=click.Path(path_type=Path))
@out_option
@click.option("--scheduler", help="Address of a Dask scheduler (tcp://HOST:PORT).")
@click.option("--workers", type=click.IntRange(min=1), help="Size of the local cluster.")
@common_options
def command(
    sweep: Path,
    out: Path,
    scheduler: str | None,
    workers: int | None,
    quiet: bool,
    verbose: bool,
) -> None:
    """Run the scenario in SWEEP.toml as its [sweep] table says.

    What is finished is kept: the same command goes on where a killed one stopped.
    """
    from scenarios.experiments import run_experiment
    from scenarios.results import write_results
    from scenarios.sweep import read_sweep

    set_verbosity(quiet, verbose)
    plan = read_sweep(sweep)
    prepare_out(out)
    with progress_bars(quiet) as progress:
        state = run_experiment(plan, out, scheduler, workers, progress)
    write_results(plan, out)
    summary = _summarise(plan, out)
    if not quiet:
        print_table(f"{plan.path.name}: {state.n_runs} runs, {state.n_new} of them new", summary)
        click.echo(f"results in {out / 'results.parquet'}, figures in {out}")


def _summarise(plan: SweepPlan, out: Path) -> list[tuple[str, str]]:
    """Write metrics.json and the figures; return the table's rows."""
    from scenarios import results
    from scenarios.outputs import write_metrics
    from scenarios.plots_experiments import plot_experiment

    table = results.read_results(out)
    passed = sum(table.column("passed").to_pylist())
    low, high = results.share_interval(passed, plan.n_runs)
    metrics: dict[str, Any] = {
        "runs": plan.n_runs,
        "runs_done": table.column("status").to_pylist().count("done"),
        "runs_passed": passed,
        "pass_share": passed / plan.n_runs,
        "pass_share_low": low,
        "pass_share_high": high,
    }
    rows = [
        (
            "passed",
            f"{passed} of {plan.n_runs} ({passed / plan.n_runs:.1%}; 95 %: {low:.1%} to {high:.1%})",
        )
    ]
    for name in results.metric_names(table, set(plan.sweep.keys)):
        mean, low, high = results.mean_interval(results.numbers(table, name))
        metrics |= {f"{name}_mean": mean, f"{name}_mean_low": low, f"{name}_mean_high": high}
        rows.append((name, f"mean {mean:.4g} (95 %: {low:.4g} to {high:.4g})"))
    causes = results.failures_by_cause(table)
    rows += [(f"{count} x", cause) for cause, count in causes.items()]
    plot_experiment(out, table, set(plan.sweep.keys), causes)
    if plan.sweep.task == "terrain":
        from scenarios.plots_terrain import plot_terrain

        plot_terrain(out, table, set(plan.sweep.keys))
    config = {**plan.scenario, "sweep": plan.sweep.model_dump(mode="json", exclude_none=True)}
    write_metrics(out, metrics, config, plan.sweep.seed)
    return rows
