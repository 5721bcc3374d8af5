"""Passes on disk: what a killed run left half done is not taken for an older run's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from perception.readers import open_survey
from perception.readers.netcdf import write_netcdf
from scenarios import pass_files
from scenarios.pass_files import file_passes
from tests.perception.echo_fixtures import Survey as Pings
from tests.perception.echo_fixtures import flat, make_swath


def test_a_run_killed_before_its_mark_leaves_none_of_an_older_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The strip is the same for both, so its digest alone would let the killed run's objects pass."""
    swath = make_swath(flat, Pings(n_pings=80, n_samples=300), np.random.default_rng(0))
    write_netcdf(tmp_path / "line.nc", swath)
    survey, folder = open_survey([tmp_path / "line.nc"]), tmp_path / "strips"
    made: list[int] = []
    written = pass_files._written
    monkeypatch.setattr(
        pass_files, "_written", lambda *a, **more: made.append(1) or written(*a, **more)
    )
    file_passes(survey, folder, ("A",))
    file_passes(survey, folder, ("A",))
    assert len(made) == 1

    def killed(*arguments: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(pass_files, "write_text", killed)
        with pytest.raises(KeyboardInterrupt):
            file_passes(survey, folder, ("B",))
    file_passes(survey, folder, ("A",))
    assert len(made) == 3
