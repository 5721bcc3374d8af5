"""`bathynav benchmark [NAME...]`: measure, beside peers."""

from __future__ import annotations

import importlib
import json
from dataclasses import asdict
from pathlib import Path

import click

from perception.files import write_text
from perception.records import InputError
from scenarios.benchmarks import BENCHMARKS, Table
from scenarios.commands.console import common_options, progress_bars, set_verbosity


@click.command()
@click.argument("names", nargs=-1)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("runs/benchmarks"),
    show_default=True,
    help="Folder for NAME.json.",
)
@click.option("--list", "only_list", is_flag=True, help="List the benchmarks and stop.")
@common_options
def command(names: tuple[str, ...], out: Path, only_list: bool, quiet: bool, verbose: bool) -> None:
    """Run the named benchmarks (all of them without a name) and print their tables."""
    set_verbosity(quiet, verbose)
    if only_list:
        for name, (_, summary) in BENCHMARKS.items():
            click.echo(f"{name:<20} {summary}")
        return
    unknown = [name for name in names if name not in BENCHMARKS]
    if unknown:
        raise InputError(f"no benchmark {unknown[0]!r}; there are {', '.join(BENCHMARKS)}")
    for name in names or BENCHMARKS:
        module = importlib.import_module(f"scenarios.benchmarks.{BENCHMARKS[name][0]}")
        with progress_bars(quiet) as progress:
            table: Table = module.run(progress)
        write_text(out / f"{name}.json", json.dumps(_record(table), indent=2) + "\n")
        if not quiet:
            print_rows(table)
            click.echo(f"written to {out / f'{name}.json'}")


def _record(table: Table) -> dict[str, object]:
    from scenarios.outputs import versions

    return {**asdict(table), "versions": versions()}


def print_rows(table: Table) -> None:
    """Print a table in aligned columns, as wide as its text."""
    header = ("case", "method", "figure", "value", "unit", "goal", "note")
    cells = [header]
    for row in table.rows:
        value = "-" if row.value is None else f"{row.value:.4g}"
        cells.append((row.case, row.method, row.figure, value, row.unit, row.goal, row.note))
    widths = [max(len(line[i]) for line in cells) for i in range(len(header))]
    click.echo(f"\n{table.name}")
    for line in cells:
        click.echo(
            "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip()
        )
