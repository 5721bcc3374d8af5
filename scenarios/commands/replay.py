"""`bathynav replay DIR`: a finished mission in the terminal."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import click

from scenarios.commands.console import FiniteRange, common_options, set_verbosity

_FRAMES_A_SECOND = 10


@click.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option(
    "--seconds", default=12.0, show_default=True, type=FiniteRange(min=0.1), help="Length."
)
@common_options
def command(folder: Path, seconds: float, quiet: bool, verbose: bool) -> None:
    """Play the vehicle's track over the map; in a pipe, print ten moments as lines."""
    from scenarios.replay import LEGEND, find_mission, frames

    set_verbosity(quiet, verbose)
    grid, track = find_mission(folder)
    if not sys.stdout.isatty():
        for frame in frames(grid, track, 80, 20, 10):
            click.echo(frame.caption)
        return
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    console = Console()
    rows, columns = max(console.height - 4, 5), max(console.width - 1, 20)
    n_frames = max(2, round(seconds * _FRAMES_A_SECOND))
    with Live(console=console, auto_refresh=False) as live:
        for frame in frames(grid, track, columns, rows, n_frames):
            live.update(Text("\n".join((*frame.lines, frame.caption, LEGEND))), refresh=True)
            time.sleep(seconds / n_frames)
