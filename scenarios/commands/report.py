"""`bathynav report DIR`: report.html from what a folder holds."""

from __future__ import annotations

from pathlib import Path

import click

from scenarios.commands.console import common_options, set_verbosity


@click.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@common_options
def command(folder: Path, quiet: bool, verbose: bool) -> None:
    """Write report.html, one file without network, into DIR."""
    from scenarios.report.page import write_report

    set_verbosity(quiet, verbose)
    path = write_report(folder)
    if not quiet:
        click.echo(f"report in {path}")
