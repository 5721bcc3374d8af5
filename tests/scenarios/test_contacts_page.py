"""The contact report: self-contained, complete, and honest about what it cannot say."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from perception.object_table import ObjectRow, ObjectTable
from perception.strips import PassResult, build_strip
from scenarios.report.contacts import contacts_of, moved, pictured, touching, write_contacts
from tests.perception.echo_fixtures import Survey, box, make_swath

CRS = "EPSG:32619"


def test_the_page_holds_every_contact_and_needs_no_network(tmp_path: Path) -> None:
    swath = make_swath(
        box(1.0, 15, 10, 0.8, 0.8), Survey(n_pings=80, n_samples=500), np.random.default_rng(5)
    )
    contacts = contacts_of(build_strip(swath))
    assert len(contacts) == 1
    least = replace(contacts[0], lower_bound=True, probability=0.5)
    other = replace(contacts[0], kind="crater", pass_index=1)
    write_contacts(tmp_path / "contacts.html", [*contacts, least, other], "survey.xtf", CRS)
    page = (tmp_path / "contacts.html").read_text()
    assert page.count("<article>") == 3 and "3 contacts: 2 hills, 1 craters" in page
    assert f"{contacts[0].height_m:.2f} m &plusmn; {contacts[0].sigma_m:.2f} m" in page
    assert page.count("at least") == 1 and page.count("disputed") == 3
    pictures = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    assert len(pictures) == 3 and base64.b64decode(pictures[0])[:8] == b"\x89PNG\r\n\x1a\n"
    assert "http" not in page and "<script" not in page


def test_no_contact_is_said_in_words(tmp_path: Path) -> None:
    write_contacts(tmp_path / "contacts.html", [], "a <b>", CRS)
    page = (tmp_path / "contacts.html").read_text()
    assert "No contact stands out" in page and "a &lt;b&gt;" in page


def test_only_contacts_that_the_page_shows_keep_their_pictures() -> None:
    swath = make_swath(
        box(1.0, 15, 10, 0.8, 0.8), Survey(n_pings=80, n_samples=500), np.random.default_rng(5)
    )
    contact = contacts_of(build_strip(swath))[0]
    many = [replace(contact, probability=i / 1000) for i in range(900)]
    kept = pictured(many)
    assert [replace(c, snippet=contact.snippet) for c in kept] == many
    assert [bool(c.snippet) for c in kept] == [False] * 500 + [True] * 400
    assert pictured(many[:600]) == many[:600]


def _row(
    across_m: float, along_m: float, slant_range_m: float, shadow_length_m: float
) -> ObjectRow:
    return ObjectRow(
        easting_m=0.0, northing_m=0.0, kind="hill", height_m=1.0, sigma_m=0.1,
        slant_range_m=slant_range_m, shadow_length_m=shadow_length_m, pass_index=0, ping=0,
        across_m=across_m, along_m=along_m, half_across_m=1.0, half_along_m=1.5,
    )  # fmt: skip


def test_objects_whose_footprints_or_shadows_touch_are_one_contact() -> None:
    hull, mast, in_shadow = _row(20, 50, 22, 4), _row(22, 52.5, 24, 9), _row(29, 54, 32, 2)
    apart, other_side = _row(20, 60, 22, 4), _row(-20, 50, 22, 4)
    groups = touching(ObjectTable.of([hull, apart, mast, other_side, in_shadow]))
    # The mast touches the hull, and what stands in the mast's shadow touches the mast.
    assert [list(group) for group in groups] == [[0, 2, 4], [1], [3]]
    assert touching(ObjectTable.of([])) == []


def low_beside_high() -> PassResult:
    low, high = box(0.7, 15, 10, 0.8, 0.8), box(1.2, 16, 13.2, 0.8, 0.8)
    swath = make_swath(
        lambda x, y: low(x, y) + high(x, y), Survey(n_pings=90, n_samples=500),
        np.random.default_rng(5),
    )  # fmt: skip
    return build_strip(swath)


def test_a_contact_is_told_by_its_highest_part_and_names_the_others(tmp_path: Path) -> None:
    result = low_beside_high()
    wide = replace(result.objects, half_along_m=result.objects.half_along_m + 1.0)
    contacts = contacts_of(replace(result, objects=wide))
    assert len(result.objects) == 2 and len(contacts) == 1
    assert contacts[0].height_m == result.objects.height_m.max() and len(contacts[0].parts) == 1
    write_contacts(tmp_path / "contacts.html", contacts, "survey.xtf", CRS)
    page = (tmp_path / "contacts.html").read_text()
    assert "hill of 2 parts" in page and page.count("<dt>part</dt>") == 1


def test_a_contact_whose_picture_was_let_go_has_none_on_the_page(tmp_path: Path) -> None:
    swath = make_swath(
        box(1.0, 15, 10, 0.8, 0.8), Survey(n_pings=80, n_samples=500), np.random.default_rng(5)
    )
    contact = contacts_of(build_strip(swath))[0]
    bare = replace(contact, snippet=b"", probability=0.2)
    write_contacts(tmp_path / "contacts.html", [contact, bare], "survey.xtf", CRS)
    page = (tmp_path / "contacts.html").read_text()
    assert page.count("<article>") == 2 and page.count("<img") == 1 and 'base64,"' not in page


def test_two_objects_of_one_ping_at_one_range_move_each_to_its_own_side() -> None:
    swath = make_swath(
        box(1.0, 15, 10, 0.8, 0.8), Survey(n_pings=80, n_samples=500), np.random.default_rng(5)
    )
    contact = contacts_of(build_strip(swath))[0]
    sides = [replace(contact, ping=0, slant_range_m=22.0, kind="hill", across_m=x)
             for x in (20.0, -20.0)]  # fmt: skip
    table = ObjectTable.of([_row(20, 50, 22, 4), _row(-20, 50, 22, 4)])
    there = replace(table, easting_m=np.array([120.0, 80.0]))
    assert [look.easting_m for look in moved(sides, there)] == [120.0, 80.0]


def test_a_maps_page_tells_the_heights_of_its_own_list_and_whose_looks_they_are(
    tmp_path: Path,
) -> None:
    result = low_beside_high()
    # Wide enough to touch.
    table = replace(result.objects, half_along_m=result.objects.half_along_m + 1.0)
    (contact,) = contacts_of(replace(result, objects=table))
    assert len(table) == 2 and len(contact.parts) == 1
    # What `mapping.object_floors` changes.
    mended = replace(table, height_m=table.height_m + 0.25, sigma_m=table.sigma_m / 2)
    (look,) = moved([contact], mended, np.array([7, 7]))
    top = int(np.flatnonzero(table.height_m == contact.height_m)[0])
    assert look.height_m == mended.height_m[top] and look.sigma_m == mended.sigma_m[top]
    assert (
        f"{mended.height_m[1 - top]:.2f} m &plusmn; {mended.sigma_m[1 - top]:.2f} m"
        in look.parts[0]
    )
    other = replace(look, pass_index=1, object_number=8)
    third = replace(look, pass_index=2)
    write_contacts(tmp_path / "contacts.html", [look, other, third], "survey.xtf", CRS, {8})
    page = (tmp_path / "contacts.html").read_text()
    assert "3 looks of single passes at 2 objects (objects.gpkg): 3 hills" in page
    assert page.count("<dt>object</dt><dd>7</dd>") == 2
    assert page.count("overruled: other passes saw plain ground here") == 1
