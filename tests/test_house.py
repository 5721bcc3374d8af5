"""The house keeps its own rules: one way in, quick to answer, nothing of one machine in it."""

import importlib
import re
import subprocess
import sys
import time
import tomllib
from itertools import chain
from pathlib import Path

import pytest

from scenarios.benchmarks import BENCHMARKS
from scenarios.commands import VERBS, bathynav, main

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("perception", "mapping", "localization", "planning", "scenarios")


def test_imports_go_one_way():
    linter = Path(sys.executable).with_name("lint-imports")
    found = subprocess.run([linter], cwd=ROOT, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout


def test_gtsam_and_ompl_are_imported_in_their_own_modules_only():
    rooms = {"gtsam": r"mapping/pose_graph\w*\.py", "ompl": r"planning/ompl_planner\.py"}
    for library, room in rooms.items():
        for package in PACKAGES:
            for path in (ROOT / package).rglob("*.py"):
                name = path.relative_to(ROOT).as_posix()
                imports = re.search(rf"^\s*(import|from) {library}\b", path.read_text(), re.M)
                # Benchmarks measure the bare library beside ours.
                if imports and not name.startswith("scenarios/benchmarks/"):
                    assert re.fullmatch(room, name), f"{name} imports {library}"


def test_every_verb_has_its_command_and_help(capsys):
    for verb in VERBS:
        command = bathynav.get_command(None, verb)
        assert command is not None, f"no module for {verb!r}"
        assert command.help, f"{verb!r} has no help"


def test_help_answers_without_the_heavy_libraries():
    code = (
        "import sys; from scenarios.commands import bathynav\n"
        "try: bathynav(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'scipy', 'numba', 'gtsam', 'rasterio', 'matplotlib', 'pandas', 'xarray'}\n"
        "sys.exit(', '.join(heavy & set(sys.modules)) or 0)"
    )
    started_s = time.perf_counter()
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert found.returncode == 0, found.stderr
    assert time.perf_counter() - started_s < 10, "half a second on a quiet machine"


def test_every_benchmark_is_where_the_list_says():
    for name, (module, summary) in BENCHMARKS.items():
        assert summary, name
        assert callable(importlib.import_module(f"scenarios.benchmarks.{module}").run)


def test_an_unexpected_error_becomes_one_line(monkeypatch, capsys):
    def explode(**_):
        raise RuntimeError("two\nlines")

    monkeypatch.setattr("scenarios.commands.bathynav", explode)
    monkeypatch.setattr(sys, "argv", ["bathynav", "info"])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and "RuntimeError: two lines" in lines[0]


def test_constraints_are_pins_without_addresses_and_cover_the_dependencies():
    pins = [
        line.strip()
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if line.strip() and not line.startswith("#")
    ]
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.+_-]+", pin) for pin in pins)
    pinned = {pin.split("==")[0].lower().replace("_", "-") for pin in pins}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *chain(*project["optional-dependencies"].values())]
    missing = {name.lower().replace("_", "-") for name in wanted} - pinned
    assert not missing


def test_no_file_holds_a_path_of_one_machine():
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("not a git checkout")
    for name in listed.stdout.split():
        path = ROOT / name
        if path.suffix in {".py", ".md", ".toml", ".txt", ".html"} and path.exists():
            text = path.read_text(encoding="utf-8")
            assert not re.search(r"/(work|root|home)/\w", text), f"{name} names a machine's path"


def test_every_link_of_the_pages_leads_somewhere():
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]:
        text = page.read_text(encoding="utf-8")
        assert "@@" not in text, f"{page.name} has a gap to fill"
        for target in re.findall(r"\]\(([^)#\s]+)", text):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name} points to {target}"
