"""Absolute fixes: read in any order, refused by line."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from mapping.fixes import PositionFix, read_fixes, write_fixes
from perception.records import InputError

HEADER = "time,easting_m,northing_m,sigma_m\n"


def test_fixes_come_sorted_in_time_and_utc_is_meant_where_no_zone_is_given(tmp_path: Path) -> None:
    path = tmp_path / "fixes.csv"
    path.write_text(
        HEADER + "2026-01-01T00:01:00Z,3,4,0.5\n2026-01-01T00:00:00,1,2,0.4\n"
        "2026-01-01T01:00:30+01:00,5,6,0.6\n"
    )
    fixes = read_fixes(path)
    assert [f.easting_m for f in fixes] == [1.0, 5.0, 3.0]
    assert fixes[1].time_s - fixes[0].time_s == 30.0
    assert fixes[0].covariance_m2[0, 0] == pytest.approx(0.16)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("time,easting_m\n2026-01-01T00:00:00Z,1\n", "northing_m, sigma_m"),
        (HEADER, "holds no fix"),
        (HEADER + "2026-01-01T00:00:00Z,1,2,0\n", "line 2: sigma_m must be positive"),
        (HEADER + "2026-01-01T00:00:00Z,nan,2,1\n", "line 2: the position is not finite"),
        (HEADER + "soon,1,2,1\n", "line 2"),
    ],
)
def test_a_wrong_fix_is_named_by_its_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "fixes.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        read_fixes(path)


def test_reasons_with_commas_and_quotes_survive_the_csv(tmp_path: Path) -> None:
    fix = PositionFix(1.0, 2.0, 3.0, 0.1, 0.0, 0.2, "patch", False, 'too flat, "mud"', 4.5)
    write_fixes(tmp_path / "fixes.csv", [fix])
    with (tmp_path / "fixes.csv").open(newline="") as stream:
        row = next(csv.DictReader(stream))
    assert row["accepted"] == "false"
    assert row["reason"] == "too flat, 'mud'"
    assert float(row["protection_m"]) == 4.5


def test_what_locate_writes_is_read_back_without_what_it_refused(tmp_path: Path) -> None:
    good = PositionFix(20.0, 2.0, 3.0, 0.1, 0.05, 0.2, "profile", True, "fits", 4.5)
    bad = PositionFix(10.0, 9.0, 9.0, 0.1, 0.0, 0.2, "patch", False, "ambiguous", 4.5)
    write_fixes(tmp_path / "fixes.csv", [bad, good])
    (read,) = read_fixes(tmp_path / "fixes.csv")
    assert (read.time_s, read.easting_m, read.kind) == (20.0, 2.0, "profile")
    assert read.cov_en_m2 == pytest.approx(0.05)
    assert read.protection_m == pytest.approx(4.5)


def test_a_covariance_that_is_none_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "fixes.csv"
    path.write_text("time_s,easting_m,northing_m,cov_ee_m2,cov_en_m2,cov_nn_m2\n1,2,3,1,2,1\n")
    with pytest.raises(InputError, match="line 2: sigma_m must be positive"):
        read_fixes(path)


def test_fixes_none_of_which_was_accepted_are_no_fixes(tmp_path: Path) -> None:
    refused = PositionFix(
        10.0, 9.0, 9.0, 0.1, 0.0, 0.2, "profile", False, "the ground gives no fix"
    )
    write_fixes(tmp_path / "fixes.csv", [refused])
    with pytest.raises(InputError, match="no fix of 1 that was accepted"):
        read_fixes(tmp_path / "fixes.csv")
