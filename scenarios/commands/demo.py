"""`bathynav demo`: the main job on the built-in scenario, end to end."""

from __future__ import annotations

from pathlib import Path

import click

from scenarios.commands.console import common_options, set_verbosity


@click.command()
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("runs/demo"),
    show_default=True,
    help="Folder for the results.",
)
@click.option("--seed", type=click.IntRange(min=0), help="Use this seed, not the scenario's.")
@common_options
def command(out: Path, seed: int | None, quiet: bool, verbose: bool) -> int:
    """Simulate a survey, map it, segment it, find a position on it and plan a low route."""
    from scenarios.commands.mission import run_and_tell
    from scenarios.schema import load_scenario

    set_verbosity(quiet, verbose)
    scenario = load_scenario("demo")
    if seed is not None:
        scenario = scenario.model_copy(update={"seed": seed})
    return run_and_tell(scenario, out, quiet=quiet)
