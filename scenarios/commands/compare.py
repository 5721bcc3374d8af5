"""`bathynav compare A B`: two runs or experiments, paired."""

from __future__ import annotations

import math
from pathlib import Path

import click

from scenarios.commands.console import common_options, set_verbosity


@click.command()
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path))
@common_options
def command(a: Path, b: Path, quiet: bool, verbose: bool) -> None:
    """Compare two output folders metric by metric; B minus A, with significance."""
    from scenarios.comparison import compare_folders

    set_verbosity(quiet, verbose)
    rows = compare_folders(a, b)
    header = ("metric", "A", "B", "B - A", "95 %", "p", "pairs", "")
    lines = [header]
    for r in rows:
        tested = math.isfinite(r.p_value)
        lines.append(
            (
                r.metric,
                f"{r.mean_a:.4g}",
                f"{r.mean_b:.4g}",
                f"{r.difference:+.4g}",
                f"{r.low:+.3g} to {r.high:+.3g}" if math.isfinite(r.low) else "-",
                f"{r.p_value:.2g}" if tested else "-",
                str(r.pairs or "-"),
                "differs" if r.significant else "",
            )
        )
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    for line in lines:
        cells = (t.ljust(w) for t, w in zip(line, widths, strict=True))
        click.echo("  ".join(cells).rstrip())
    if not any(math.isfinite(r.p_value) for r in rows) and not quiet:
        click.echo(
            "no significance: these are single runs; run both as experiments of several seeds "
            "(bathynav experiment) to tell a difference from chance"
            if all(r.pairs == 0 and not math.isfinite(r.low) for r in rows)
            else "no significance: no metric differs within the pairs, or there is one pair alone"
        )
