"""The command line: `bathynav VERB`, verbs in the order of the flow.

Each verb is a module here with a click command named `command`; it is imported only when it is
called, so `bathynav --help` answers at once. A new verb is one module and one line in `VERBS`.
"""

from __future__ import annotations

import importlib
import logging
import os
import sys
from typing import Any

import click

from perception.records import BathynavError

VERBS = {
    "demo": "The main job on the built-in scenario, end to end.",
    "run": "The main job on a scenario file.",
    "simulate": "Make a survey: sonar file, navigation, prior map, truth.",
    "info": "Tell what a sonar file holds.",
    "strips": "Turn echoes into one elevation strip per pass.",
    "map": "Fuse the passes of a survey into one map.",
    "diff": "Tell how two maps differ.",
    "regions": "Segment a map into hills, valleys and ridges.",
    "locate": "Find the vehicle's position from terrain.",
    "plan": "Plan a route that stays near the bottom.",
    "experiment": "Run many scenarios, in parallel, resumable.",
    "compare": "Compare two runs or experiments, paired.",
    "report": "Write report.html from what a folder holds.",
    "replay": "Show a finished mission in the terminal.",
    "scenarios": "List the named scenarios.",
    "sensors": "List the sonars and sensors.",
    "benchmark": "Measure speed and accuracy beside peers.",
}


class _LazyVerbs(click.Group):
    """A group that knows its verbs' names and summaries without importing them."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [v for v in VERBS if _module_exists(v)]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in VERBS or not _module_exists(cmd_name):
            return None
        module = importlib.import_module(f"scenarios.commands.{_module_name(cmd_name)}")
        command: click.Command = module.command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        rows = [(verb, VERBS[verb]) for verb in self.list_commands(ctx)]
        if rows:
            with formatter.section("Commands"):
                formatter.write_dl(rows)


def _module_name(verb: str) -> str:
    # `map` and `diff` would do as module names, but a module called `map` reads as the builtin.
    return f"{verb}_command" if verb == "map" else verb


def _module_exists(verb: str) -> bool:
    folder = os.path.dirname(__file__)
    return os.path.exists(os.path.join(folder, f"{_module_name(verb)}.py"))


@click.group(cls=_LazyVerbs, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="bathynav")
@click.option("--debug", is_flag=True, help="Show tracebacks.")
def bathynav(debug: bool) -> None:
    """Turn side-scan echoes into a map, a position and a safe low route."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")


def main() -> None:
    """Run the command line: exit 0 done, 1 failed with one plain line, 2 wrong usage."""
    debug = "--debug" in sys.argv[1:]
    if debug:
        sys.argv.remove("--debug")
    try:
        status: Any = bathynav(standalone_mode=False)
    except click.exceptions.Abort:
        sys.exit(_fail("stopped by the user", 130))
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except BathynavError as error:
        if debug:
            raise
        sys.exit(_fail(str(error), 1))
    except MemoryError:
        if debug:
            raise
        sys.exit(_fail("out of memory; use a larger --cell or a smaller area", 1))
    except OSError as error:
        if debug:
            raise
        sys.exit(_fail(f"{error.filename or 'file'}: {error.strerror or error}", 1))
    except Exception as error:
        if debug:
            raise
        sys.exit(
            _fail(
                f"unexpected {type(error).__name__}: {error}; run again with --debug to see where",
                1,
            )
        )
    sys.exit(status if isinstance(status, int) else 0)


def _fail(message: str, status: int) -> int:
    click.echo(f"bathynav: {' '.join(message.split())}", err=True)
    return status
