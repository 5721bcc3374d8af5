"""Passes on disk: what a killed run left half done, or another version, is made anew."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from perception.readers import Survey, open_survey
from perception.readers.netcdf import write_netcdf
from scenarios import pass_files
from scenarios.pass_files import file_passes
from tests.perception.echo_fixtures import Survey as Pings
from tests.perception.echo_fixtures import flat, make_swath


def _line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Survey, Path, list[int]]:
    """Return a survey of one pass, where its strip is filed, and a list that grows as one is made."""
    swath = make_swath(flat, Pings(n_pings=80, n_samples=300), np.random.default_rng(0))
    write_netcdf(tmp_path / "line.nc", swath)
    made: list[int] = []
    written = pass_files._written
    monkeypatch.setattr(
        pass_files, "_written", lambda *a, **more: made.append(1) or written(*a, **more)
    )
    return open_survey([tmp_path / "line.nc"]), tmp_path / "strips", made


def test_a_run_killed_before_its_mark_leaves_none_of_an_older_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The strip is the same for both, so its digest alone would let the killed run's objects pass."""
    survey, folder, made = _line(tmp_path, monkeypatch)
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


def test_a_strip_of_another_method_is_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    survey, folder, made = _line(tmp_path, monkeypatch)
    file_passes(survey, folder, ("A",))
    monkeypatch.setattr(pass_files, "_METHOD", pass_files._METHOD + 1)
    file_passes(survey, folder, ("A",))
    file_passes(survey, folder, ("A",))
    assert len(made) == 2


def test_objects_cut_short_or_of_other_columns_are_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    survey, folder, made = _line(tmp_path, monkeypatch)
    file_passes(survey, folder, ("A",))
    (path,) = folder.glob("*.objects.npz")
    whole = path.read_bytes()
    with np.load(path) as data:
        columns = {**data, "contacts": np.array('[{"unheard_of": 1}]'), "snippet_ends": [0]}
    for count, left in enumerate((whole[: len(whole) // 2], b"", b"PK", None), start=2):
        if left is None:
            np.savez(path, **columns)
        else:
            path.write_bytes(left)
        file_passes(survey, folder, ("A",))
        assert len(made) == count and path.read_bytes() == whole
