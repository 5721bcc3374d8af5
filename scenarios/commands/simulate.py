"""`bathynav simulate SCENARIO --out DIR`: make a survey and keep its truth apart."""

from __future__ import annotations

from pathlib import Path

import click

from scenarios.commands.console import (
    common_options,
    out_option,
    prepare_out,
    print_table,
    progress_bars,
    set_verbosity,
)


@click.command()
@click.argument("scenario")
@out_option
@click.option("--seed", type=click.IntRange(min=0), help="Use this seed, not the scenario's.")
@click.option("--picture", is_flag=True, help="Draw truth/simulation.png too.")
@common_options
def command(
    scenario: str, out: Path, seed: int | None, picture: bool, quiet: bool, verbose: bool
) -> None:
    """Simulate SCENARIO, a TOML file or a name that `bathynav scenarios` lists.

    \b
    bathynav simulate demo --out runs/demo/survey
    bathynav simulate my-survey.toml --out runs/mine --seed 7
    """
    set_verbosity(quiet, verbose)
    from scenarios.outputs import write_metrics
    from scenarios.schema import load_scenario, tree_of
    from scenarios.simulation import simulate, summary
    from scenarios.simulation_files import write_simulation

    config = load_scenario(scenario)
    if seed is not None:
        config = config.model_copy(update={"seed": seed})
    prepare_out(out)
    with progress_bars(quiet) as progress:
        simulation = simulate(config, progress)
        write_simulation(simulation, out, progress)
    if picture:
        from scenarios.plots_simulation import plot_simulation

        plot_simulation(out / "truth" / "simulation.png", simulation)
    metrics = summary(simulation)
    write_metrics(out, metrics, tree_of(config), seed=config.seed)
    if not quiet:
        rows = [(name, f"{value:.4g}") for name, value in metrics.items()]
        print_table(f"simulated {config.name} (seed {config.seed})", rows)
        click.echo(f"written to {out}; what only a judge may see is in {out / 'truth'}")
