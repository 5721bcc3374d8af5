"""`rounds.csv`: every figure of a round stands under its own name."""

from __future__ import annotations

import csv
from dataclasses import fields
from pathlib import Path

from mapping.round_files import write_rounds
from mapping.survey_records import Round


def test_each_column_holds_the_field_that_it_names(tmp_path: Path) -> None:
    said = Round("map", 24.0, 31, 29, 28, 7, 12.5, 0.25, 40.0, 9.0, 6, 5)
    write_rounds(tmp_path / "rounds.csv", [said])
    (row,) = csv.DictReader((tmp_path / "rounds.csv").open(encoding="utf-8"))
    assert row.pop("round") == "1" and row.pop("floor") == "map"
    for field in fields(Round):
        if field.name != "floor":
            assert float(row.pop(field.name)) == getattr(said, field.name), field.name
    assert not row
