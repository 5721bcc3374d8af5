"""`bathynav run SCENARIO.toml`: the main job on a scenario file."""

from __future__ import annotations

from pathlib import Path

import click

from scenarios.commands.console import common_options, out_option, set_verbosity


@click.command()
@click.argument("scenario")
@out_option
@click.option("--seed", type=click.IntRange(min=0), help="Use this seed, not the scenario's.")
@common_options
def command(scenario: str, out: Path, seed: int | None, quiet: bool, verbose: bool) -> int:
    """Run SCENARIO (a TOML file, or a name that `bathynav scenarios` lists) end to end.

    An interrupted run goes on at the stage where it stopped; a finished one is run anew.
    """
    from scenarios.commands.mission import run_and_tell
    from scenarios.schema import load_scenario

    set_verbosity(quiet, verbose)
    config = load_scenario(scenario)
    if seed is not None:
        config = config.model_copy(update={"seed": seed})
    return run_and_tell(config, out, quiet=quiet)
