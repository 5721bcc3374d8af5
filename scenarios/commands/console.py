"""What every command shares: verbosity, progress bars, output folders."""

from __future__ import annotations

import logging
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from perception.records import InputError, Progress, silent

if TYPE_CHECKING:
    from perception.readers import Survey

# The file by which a folder is known for the results of a command.
_MARKS = {
    "strip-000.nc": "strips", "map.tif": "map", "regions.tif": "regions", "fixes.csv": "locate", "route.csv": "plan",
    "survey.xtf": "simulate",
}  # fmt: skip
# A log is told of a long step this often.
_LINE_SECONDS = 15.0


class FiniteRange(click.FloatRange):
    """A number within bounds; click's own range takes `nan` and `inf` for numbers of any range."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        if not math.isfinite(number := click.FLOAT.convert(value, param, ctx)):
            self.fail(f"{value} is no number to reckon with.", param, ctx)
        return float(super().convert(number, param, ctx))


def common_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add -q and -v to a command; they arrive as `quiet` and `verbose`."""
    command = click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")(command)
    return click.option("-v", "--verbose", is_flag=True, help="Tell what is done, step by step.")(
        command
    )


def out_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the required --out DIR; it arrives as `out`."""
    return click.option(
        "--out", required=True, type=click.Path(path_type=Path), help="Folder for the results."
    )(command)


def set_verbosity(quiet: bool, verbose: bool) -> None:
    """Choose the level of the libraries' log."""
    level = logging.ERROR if quiet else logging.INFO if verbose else logging.WARNING
    logging.getLogger().setLevel(level)
    # Third parties tell their own stories at INFO; ours are the ones asked for.
    for name in ("numba", "matplotlib", "distributed"):
        logging.getLogger(name).setLevel(max(level, logging.WARNING))
    # GDAL's own words (CPLE_...) mean nothing to a user, and its failures arrive as exceptions besides.
    for name in ("rasterio", "fiona", "pyogrio"):
        logging.getLogger(name).setLevel(logging.WARNING if verbose else logging.CRITICAL)


def prepare_out(out: Path) -> Path:
    """Make the output folder and prove that it can be written, before any work is done.

    A command that fails leaves no empty folder of its own making behind. Where another command's results lie
    there already, a line on standard error tells that its metrics.json goes.
    """
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    context = click.get_current_context(silent=True)
    if context is not None:
        _tell_of_other_results(out, str(context.info_name))
        context.call_on_close(lambda: _remove_empty(made))
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / ".bathynav-probe"
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise InputError(
            f"{out}: cannot be used as output folder ({error.strerror}); "
            "give --out a folder that can be written"
        ) from error
    return out


def _tell_of_other_results(out: Path, verb: str) -> None:
    others = [maker for mark, maker in _MARKS.items() if maker != verb and (out / mark).exists()]
    if others and (out / "metrics.json").exists():
        click.echo(
            f"note: {out}: holds results of {' and '.join(others)}; its metrics.json and config.toml are "
            "written over; give each command a folder of its own",
            err=True,
        )


def _remove_empty(folders: list[Path]) -> None:
    """Remove folders, innermost first, as far as they are empty."""
    for folder in folders:
        if not folder.is_dir() or any(folder.iterdir()):
            return
        folder.rmdir()


@contextmanager
def progress_bars(quiet: bool = False) -> Iterator[Progress]:
    """Yield a `Progress` that draws one bar per label on a terminal; a pipe is told a line now and then with `-v`."""
    if quiet:
        yield silent
        return
    if not sys.stderr.isatty():
        yield progress_lines() if logging.getLogger().isEnabledFor(logging.INFO) else silent
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    columns = (
        TextColumn("{task.description:<28}"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Bars(*columns, console=Console(stderr=True)) as bars:
        tasks: dict[str, Any] = {}

        def report(label: str, done: int, total: int) -> None:
            if label not in tasks:
                tasks[label] = bars.add_task(label, total=total)
            bars.update(tasks[label], completed=done, total=total)

        yield report


def progress_lines(clock: Callable[[], float] = time.monotonic) -> Progress:
    """Return a `Progress` for logs: no bar, one line on standard error at most every `_LINE_SECONDS`.

    A command that is done before says nothing; one that takes minutes tells what it is at and what is left of it.
    """
    told = clock()
    began: dict[str, tuple[float, int]] = {}

    def report(label: str, done: int, total: int) -> None:
        nonlocal told
        now = clock()
        start, first = began.setdefault(label, (now, done))
        if now - told < _LINE_SECONDS or done >= total:
            return
        told = now
        line = f"{label}: {done} of {total}"
        if done > first:
            left = (now - start) * (total - done) / (done - first)
            line += f" after {now - start:.0f} s, about {left:.0f} s left"
        click.echo(line, err=True)

    return report


def print_table(title: str, rows: list[tuple[str, str]]) -> None:
    """Print name and value pairs, aligned, without colour or wrapping."""
    click.echo(title)
    width = max((len(name) for name, _ in rows), default=0)
    for name, value in rows:
        click.echo(f"  {name:<{width}}  {value}")


def tell_of(survey: Survey) -> None:
    """Say what is wrong with a survey and with each of its files, a line each on standard error."""
    for warning in survey.warnings:
        click.echo(f"note: {warning}", err=True)
    for file in survey.files:
        for defect in file.defects:
            click.echo(f"note: {file.path.name}: {defect}", err=True)
