"""`bathynav scenarios`: list the named scenarios."""

from __future__ import annotations

import click

from scenarios.commands.console import common_options, set_verbosity


@click.command()
@click.argument("name", required=False)
@common_options
def command(name: str | None, quiet: bool, verbose: bool) -> None:
    """List the named scenarios; with a NAME, print that scenario's file to start one's own from."""
    from perception.records import InputError
    from scenarios.schema import library, load_scenario

    set_verbosity(quiet, verbose)
    named = library()
    if name is not None:
        if name not in named:
            raise InputError(f"no scenario {name!r}; there are {', '.join(named)}")
        click.echo(named[name].read_text(encoding="utf-8"), nl=False)
        return
    width = max(len(known) for known in named)
    for known, path in named.items():
        click.echo(f"{known:<{width}}  {load_scenario(path).summary}")
