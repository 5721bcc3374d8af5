"""Run a command as a user does, in this process: its exit status and what it printed."""

import sys
from dataclasses import dataclass

import pytest

from scenarios.commands import main


@dataclass(frozen=True)
class Outcome:
    """Exit status, standard output, standard error."""

    status: int
    out: str
    err: str

    @property
    def complaint(self) -> str:
        """Return the one line on standard error that says what failed."""
        lines = [line for line in self.err.splitlines() if line.startswith("bathynav: ")]
        assert len(lines) == 1 and "Traceback" not in self.err, self.err
        return lines[0]


def run_command(capsys: pytest.CaptureFixture[str], *arguments: object) -> Outcome:
    """Run `bathynav ARGUMENTS...` through its entry point."""
    kept, sys.argv = sys.argv, ["bathynav", *map(str, arguments)]
    try:
        with pytest.raises(SystemExit) as stop:
            main()
    finally:
        sys.argv = kept
    printed = capsys.readouterr()
    code = stop.value.code
    return Outcome(code if isinstance(code, int) else int(bool(code)), printed.out, printed.err)
