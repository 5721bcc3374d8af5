"""Contacts of two surveys: what was planted to change is told, what was not stays the same."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from mapping.contact_changes import (
    PassContacts,
    contact_changes,
    read_contacts,
    write_contact_changes,
)
from perception.records import InputError

Row = tuple[float, float, str, float, float]


def _survey(*rows: Row, which: int = 0) -> PassContacts:
    east, north, kind, height, sigma = zip(*rows, strict=True)
    return PassContacts(np.array(east), np.array(north), tuple(kind), np.array(height),
                        np.array(sigma), np.full(len(rows), which))  # fmt: skip


def test_appeared_vanished_and_changed_are_told_apart() -> None:
    before = _survey(
        (0, 0, "hill", 1.0, 0.1), (50, 0, "hill", 2.0, 0.1), (0, 90, "crater", 1.0, 0.1)
    )
    after = _survey((1, 0, "hill", 1.1, 0.1), (50, 1, "hill", 1.0, 0.1), (90, 90, "hill", 0.7, 0.1))
    found = {c.status: c for c in contact_changes([before], [after])}
    assert set(found) == {"appeared", "vanished", "changed", "same"}
    assert found["same"].moved_m == pytest.approx(1.0)
    assert found["changed"].difference_m == pytest.approx(-1.0)
    assert found["changed"].difference_sigma_m == pytest.approx(np.hypot(0.1, 0.1))
    assert found["appeared"].easting_m == 90 and found["appeared"].difference_m == pytest.approx(
        0.7
    )
    # A crater that is gone has been filled: the floor there is higher.
    assert found["vanished"].difference_m == pytest.approx(1.0)


def test_what_a_survey_did_not_see_has_neither_come_nor_gone() -> None:
    before, after = _survey((0, 0, "hill", 1, 0.1)), _survey((50, 0, "hill", 1, 0.1))
    west = contact_changes([before], [after], covered_before=lambda e, n: e < 20,
                           covered_after=lambda e, n: e > 20)  # fmt: skip
    assert [c.status for c in west] == ["not surveyed before", "not surveyed again"]


def test_swapping_the_surveys_swaps_the_changes() -> None:
    rng = np.random.default_rng(3)
    surveys = [
        _survey(*((float(e), float(n), "hill", float(h), 0.1)
                  for e, n, h in zip(*rng.uniform(0, 80, (2, 12)), rng.uniform(0.5, 2, 12), strict=True)))
        for _ in range(2)
    ]  # fmt: skip
    there, back = (
        contact_changes([surveys[0]], [surveys[1]]),
        contact_changes([surveys[1]], [surveys[0]]),
    )
    count = [sorted(c.status for c in changes) for changes in (there, back)]
    swap = {"appeared": "vanished", "vanished": "appeared"}
    assert sorted(swap.get(s, s) for s in count[0]) == count[1]
    assert sum(c.difference_m for c in there) == pytest.approx(-sum(c.difference_m for c in back))


def test_unchanged_ground_reports_changes_as_rarely_as_its_sigmas_say() -> None:
    rng = np.random.default_rng(4)
    places = [(60.0 * (i % 20), 60.0 * (i // 20)) for i in range(400)]

    def look() -> PassContacts:
        noise = rng.normal(0, 1, (400, 3))
        return _survey(*((e + d[0], n + d[1], "hill", 1.5 + 0.1 * d[2], 0.1)
                         for (e, n), d in zip(places, noise, strict=True)))  # fmt: skip

    changes = contact_changes([look()], [look()], beyond_sigma=2.0)
    states = [c.status for c in changes]
    assert states.count("appeared") == states.count("vanished") <= 2
    # Two sigma: 4.6 % of 400 within three deviations of chance.
    assert 6 <= states.count("changed") <= 31


def test_files_come_back_and_wrong_ones_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "objects.csv"
    path.write_text(
        "easting_m,northing_m,kind,height_m,sigma_m,pass\n1,2,hill,1,.1,0\n9,2,hill,1,.1,3\n"
    )
    tables = read_contacts(path)
    assert [int(t.pass_index[0]) for t in tables] == [0, 3]
    write_contact_changes(tmp_path, contact_changes(tables, []), "EPSG:32619")
    rows = list(csv.DictReader((tmp_path / "contact-changes.csv").open()))
    assert [row["status"] for row in rows] == ["vanished"] * 2 and rows[0]["height_after_m"] == ""
    assert (tmp_path / "contact-changes.gpkg").stat().st_size > 0
    write_contact_changes(tmp_path, [], "EPSG:32619")
    path.write_text("easting_m,northing_m\n1,2\n")
    with pytest.raises(InputError, match="lacks the column kind"):
        read_contacts(path)
    path.write_text("easting_m,northing_m,kind,height_m,sigma_m,pass\n1,2,hill,tall,.1,0\n")
    with pytest.raises(InputError, match="no number"):
        read_contacts(path)
