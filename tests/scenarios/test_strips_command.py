"""`bathynav strips`: files of the contract from a survey, and one plain line when it cannot be."""

from __future__ import annotations

import csv
import io
import json
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from perception.readers.netcdf import write_netcdf
from perception.strip_files import read_strip
from scenarios.commands import main
from tests.perception.echo_fixtures import Survey, gaussian, make_swath

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "sidescan"


@dataclass
class Done:
    returncode: int
    stdout: str
    stderr: str


def _run(*arguments: str | Path) -> Done:
    """Run the command as a shell would, in this process: importing everything anew takes seconds."""
    out, err = io.StringIO(), io.StringIO()
    argv = ["bathynav", "strips", *map(str, arguments)]
    with patch.object(sys, "argv", argv), redirect_stdout(out), redirect_stderr(err):
        try:
            main()
        except SystemExit as end:
            status = int(end.code or 0)
    return Done(status, out.getvalue(), err.getvalue())


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("survey") / "survey.nc"
    swath = make_swath(
        gaussian(1.4, 15, 15, 1.2), Survey(n_pings=120, n_samples=500), np.random.default_rng(0)
    )
    write_netcdf(path, swath)
    return path


def test_a_survey_becomes_strips_objects_pictures_and_metrics(survey: Path, tmp_path: Path) -> None:
    out = tmp_path / "strips"
    done = _run(survey, "--out", out)
    assert done.returncode == 0, done.stderr
    assert sorted(p.name for p in out.iterdir()) == [
        "bottom.csv", "config.toml", "contacts.html", "metrics.json", "objects.csv", "strip-000.nc",
        "strip-000.png",
    ]  # fmt: skip
    strip = read_strip(out / "strip-000.nc")
    assert np.nanmedian(strip.elevation_m) == pytest.approx(-30, abs=0.1)
    rows = list(csv.DictReader((out / "objects.csv").open()))
    assert [row["kind"] for row in rows] == ["hill"]
    assert float(rows[0]["height_m"]) == pytest.approx(1.4, rel=0.2)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["passes"] == 1 and metrics["hills"] == 1 and metrics["pings"] == 120
    assert "strip" in done.stdout


def test_a_second_run_starts_clean_and_says_nothing_when_quiet(
    survey: Path, tmp_path: Path
) -> None:
    out = tmp_path / "strips"
    out.mkdir()
    (out / "strip-007.nc").write_bytes(b"of an earlier, longer survey")
    done = _run(survey, "--out", out, "-q", "--cell", "0.5")
    assert done.returncode == 0 and done.stdout == ""
    assert not (out / "strip-007.nc").exists()
    assert np.diff(read_strip(out / "strip-000.nc").across_m) == pytest.approx(0.5)


def test_inputs_that_cannot_be_read_cost_no_strips_that_are_there(
    survey: Path, tmp_path: Path
) -> None:
    out = tmp_path / "strips"
    out.mkdir()
    (out / "strip-000.nc").write_bytes(b"of the last good run")
    for wrong in (
        (tmp_path / "survye.nc",), (survey, "--bottom", tmp_path / "none.csv"),
        (survey, "--install", tmp_path / "none.toml"),
    ):  # fmt: skip
        assert _run(*wrong, "--out", out).returncode == 1
        assert (out / "strip-000.nc").read_bytes() == b"of the last good run"


@pytest.mark.parametrize(
    "content, word", [(None, "no such file"), (b"", "is empty"), (b"\x07" * 4000, "")]
)
def test_a_bad_file_is_one_plain_line(content: bytes | None, word: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.xtf"
    if content is not None:
        path.write_bytes(content)
    done = _run(path, "--out", tmp_path / "out")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1 and "bad.xtf" in done.stderr and word in done.stderr
    assert not list((tmp_path / "out").glob("*.nc"))


def test_a_real_wreck_becomes_a_strip_with_shadow_where_the_image_has_it(tmp_path: Path) -> None:
    path = SHARED / "scotsman-iver2.xtf"
    if not path.exists():
        pytest.skip(f"needs {path.name} of the shared data")
    done = _run(path, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    strip = read_strip(tmp_path / "strip-000.nc")
    # The hull lies to starboard and throws a large shadow there; port has stones only.
    starboard = strip.shadow[:, strip.across_m > 0].mean()
    assert starboard > 0.05 and starboard > 4 * strip.shadow[:, strip.across_m < 0].mean()
    assert np.isfinite(strip.elevation_m).mean() > 0.9


def test_a_bottom_edited_by_hand_goes_into_strips_and_map(survey: Path, tmp_path: Path) -> None:
    assert _run(survey, "--out", tmp_path / "first", "-q").returncode == 0
    lines = (tmp_path / "first" / "bottom.csv").read_text().splitlines()
    edited = [lines[0]]
    for line in lines[1:]:
        cells = line.split(",")
        cells[4] = f"{float(cells[4]) - 1:.3f}"
        edited.append(",".join(cells))
    (tmp_path / "edited.csv").write_text("\n".join(edited) + "\n")
    given = ("--bottom", tmp_path / "edited.csv", "-q")
    assert _run(survey, "--out", tmp_path / "again", *given).returncode == 0
    first, again = (read_strip(tmp_path / name / "strip-000.nc") for name in ("first", "again"))
    assert np.median(first.altitude_m - again.altitude_m) == pytest.approx(1.0, abs=0.05)
    (tmp_path / "far.csv").write_text("ping,altitude_m\n3,99\n5,10\n")
    far = _run(survey, "--out", tmp_path / "far", "--bottom", tmp_path / "far.csv")
    assert far.returncode == 1 and "ping 3 is beyond its range" in far.stderr
    assert "left out" not in far.stderr
    wrong = _run(survey, "--out", tmp_path / "wrong", "--bottom", tmp_path / "none.csv")
    assert wrong.returncode == 1 and wrong.stderr.count("\n") == 1 and "none.csv" in wrong.stderr
