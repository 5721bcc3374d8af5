"""`contacts.html`: every object found, with the echo that shows it; one file that opens without a network."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import connected_components

from perception.files import write_text
from perception.geodesy import GEOGRAPHIC, is_local, transform
from perception.object_table import ObjectTable
from perception.records import FloatArray, IntArray
from perception.strips import PassResult

# A snippet shows so many shadow lengths (and at least metres) about its object, on so many dots a side.
_LEAST_M, _MOST_DOTS = 3.0, 180
# Beyond this many contacts a page is no report; the least likely are left to objects.csv.
_MOST = 400
# A card names so many parts.
_MOST_PARTS = 8
# Contacts of two passes and kinds nearer than this (or their own size) dispute each other.
_SAME_M = 2.0


@dataclass(frozen=True, slots=True)
class Contact:
    """One object of one pass as the page shows it; metres, `snippet` a PNG.

    `parts` : what touches it, in words: a wreck's hull, mast and holes are one contact, told by its highest part.
    `object_number` : the row of objects.gpkg, from 1, that several passes' looks share; 0 of a pass alone.
    """

    easting_m: float
    northing_m: float
    kind: str
    height_m: float
    sigma_m: float
    lower_bound: bool
    probability: float
    slant_range_m: float
    shadow_length_m: float
    across_m: float
    half_size_m: float
    pass_index: int
    ping: int
    snippet: bytes
    parts: tuple[str, ...] = ()
    object_number: int = 0


def contacts_of(result: PassResult) -> list[Contact]:
    """Return the contacts of one pass with their echo snippets; objects that touch are one contact."""
    table = result.objects
    contacts = []
    for members in touching(table):
        i, *others = _by_rank(table, members)
        contacts.append(replace(_contact(result, int(i)), parts=_parts(table, others)))
    return contacts


def _by_rank(table: ObjectTable, rows: IntArray) -> IntArray:
    """Return rows, the highest first; the least height of a shadow that leaves the swath tells less than a measured one."""
    rank = np.where(table.lower_bound[rows], 0.5, 1.0) * table.height_m[rows]
    return rows[np.argsort(-rank)]


def _contact(result: PassResult, i: int) -> Contact:
    table = result.objects
    return Contact(
        easting_m=float(table.easting_m[i]),
        northing_m=float(table.northing_m[i]),
        kind=table.kind[i],
        height_m=float(table.height_m[i]),
        sigma_m=float(table.sigma_m[i]),
        lower_bound=bool(table.lower_bound[i]),
        probability=float(table.probability[i]),
        slant_range_m=float(table.slant_range_m[i]),
        shadow_length_m=float(table.shadow_length_m[i]),
        across_m=float(table.across_m[i]),
        half_size_m=float(max(table.half_across_m[i], table.half_along_m[i])),
        pass_index=int(table.pass_index[i]),
        ping=int(table.ping[i]),
        snippet=_snippet(result, i),
    )


def touching(table: ObjectTable) -> list[IntArray]:
    """Return the rows of one pass in groups whose footprints or shadows touch, in the order of the rows.

    Each object takes a rectangle of one side's echo: its footprint along the track, and in slant range from half a
    footprint before its shadow to the shadow's end.
    """
    if not len(table):
        return []
    near = table.slant_range_m - table.half_across_m
    far = table.slant_range_m + table.shadow_length_m
    low, high = table.along_m - table.half_along_m, table.along_m + table.half_along_m
    same_side = np.sign(table.across_m)[:, None] == np.sign(table.across_m)
    meet = same_side & (near[:, None] <= far) & (near <= far[:, None])
    meet &= (low[:, None] <= high) & (low <= high[:, None])
    count, group = connected_components(meet, directed=False)
    return [np.flatnonzero(group == number) for number in range(count)]


def _parts(table: ObjectTable, rows: Sequence[int] | IntArray) -> tuple[str, ...]:
    """Return the parts of a contact in words, the highest first."""
    return tuple(
        f"{table.kind[i]}, {'at least ' if table.lower_bound[i] else ''}"
        f"{table.height_m[i]:.2f} m &plusmn; {table.sigma_m[i]:.2f} m, ping {table.ping[i]}"
        for i in rows
    )


def pictured(contacts: Sequence[Contact], most: int = _MOST) -> list[Contact]:
    """Return the contacts with pictures of the likeliest `most` only, once twice as many have one."""
    if sum(bool(contact.snippet) for contact in contacts) <= 2 * most:
        return list(contacts)
    ranked = sorted(range(len(contacts)), key=lambda i: -contacts[i].probability)
    unseen = set(ranked[most:])
    return [
        replace(c, snippet=b"") if i in unseen and c.snippet else c for i, c in enumerate(contacts)
    ]


def moved(
    contacts: Sequence[Contact], table: ObjectTable, numbers: IntArray | None = None
) -> list[Contact]:
    """Return a pass's contacts as its objects are in `table`, the same ones on a corrected track and a map's floor.

    Parameters
    ----------
    numbers : (rows of `table`,) the `object_number` of each.
    """
    # Port and starboard of one ping may have the same kind at the same sample.
    rows = {
        (int(ping), float(range_m), kind, bool(across_m > 0)): k
        for k, (ping, range_m, kind, across_m) in enumerate(
            zip(table.ping, table.slant_range_m, table.kind, table.across_m, strict=True)
        )
    }
    at = [rows[c.ping, c.slant_range_m, c.kind, c.across_m > 0] for c in contacts]
    touches = {int(i): members for members in touching(table) for i in members}
    return [
        replace(
            c,
            easting_m=float(table.easting_m[k]),
            northing_m=float(table.northing_m[k]),
            height_m=float(table.height_m[k]),
            sigma_m=float(table.sigma_m[k]),
            parts=_parts(table, _by_rank(table, touches[k][touches[k] != k])),
            object_number=0 if numbers is None else int(numbers[k]),
        )
        for c, k in zip(contacts, at, strict=True)
    ]


def _snippet(result: PassResult, i: int) -> bytes:
    """Return a PNG of the echo about object `i`: along the track to the right, range upwards, square dots."""
    table = result.objects
    echo = result.echo[int(table.across_m[i] > 0)]
    start_m, length_m = float(table.slant_range_m[i]), float(table.shadow_length_m[i])
    half_m = max(_LEAST_M, float(table.half_along_m[i]) * 2, 0.75 * length_m)
    middle_m = start_m + 0.4 * length_m
    step_m = max(2 * half_m / _MOST_DOTS, result.sample_m)
    lines = np.arange(table.along_m[i] - half_m, table.along_m[i] + half_m, step_m)
    ranges = np.arange(middle_m - half_m, middle_m + half_m, step_m)
    rows = np.searchsorted(result.along_m, lines)
    columns = np.round(ranges / result.sample_m - 0.5).astype(int)
    inside = ((rows > 0) & (rows < len(echo)))[:, None] & (
        (columns >= 0) & (columns < echo.shape[1])
    )
    values = echo[np.clip(rows, 0, len(echo) - 1)[:, None], np.clip(columns, 0, echo.shape[1] - 1)]
    return _png(np.where(inside, values, np.nan))


def _png(ratio: FloatArray) -> bytes:
    """Draw power over nominal in decibels, -15 black to 10 white; what was not heard is blue."""
    from matplotlib import colormaps, image

    grey = colormaps["gray"].with_extremes(bad="#20304a")
    with np.errstate(divide="ignore", invalid="ignore"):
        decibels = 10 * np.log10(np.maximum(ratio, 1e-3))
    buffer = io.BytesIO()
    image.imsave(buffer, np.ma.masked_invalid(decibels.T), vmin=-15, vmax=10, cmap=grey,
                 origin="lower", format="png")  # fmt: skip
    return buffer.getvalue()


def write_contacts(
    path: Path,
    contacts: Sequence[Contact],
    title: str,
    crs: str,
    overruled: Collection[int] = (),
) -> None:
    """Write the page, likeliest contacts first; no contact gives a page that says so.

    Parameters
    ----------
    overruled : numbers of the objects at whose place other passes saw plain ground.
    """
    ranked = sorted(contacts, key=lambda contact: -contact.probability)
    shown, disputed = ranked[:_MOST], _disputed(ranked)
    places = _places(shown, crs)
    cards = "\n".join(
        _card(number, contact, place, _marks(contact, disputed, overruled))
        for number, (contact, place) in enumerate(zip(shown, places, strict=True), start=1)
    )
    hills = sum(contact.kind == "hill" for contact in contacts)
    said = f"{_counted(contacts)}: {hills} hills, {len(contacts) - hills} craters"
    if len(contacts) > len(shown):
        said += f"; the {len(shown)} likeliest are shown, all are in objects.csv"
    said += "."
    if not contacts:
        said = "No contact stands out of the floor's own relief."
    write_text(
        path,
        _PAGE.format(
            title=html.escape(title), said=said, crs=html.escape(_short(crs)), cards=cards
        ),
    )


def _counted(contacts: Sequence[Contact]) -> str:
    """Return how many contacts there are, and of how many objects where passes were brought together."""
    numbers = {contact.object_number for contact in contacts} - {0}
    if not numbers:
        return f"{len(contacts)} contacts"
    return f"{len(contacts)} looks of single passes at {len(numbers)} objects (objects.gpkg)"


def _marks(contact: Contact, disputed: Collection[Contact], overruled: Collection[int]) -> str:
    """Return what other passes have against a contact."""
    said = []
    if contact in disputed:
        said.append("disputed: another pass saw the other kind")
    if contact.object_number in overruled:
        said.append("overruled: other passes saw plain ground here")
    return "".join(f'<b class="mark">{mark}</b>' for mark in said)


def _disputed(contacts: Sequence[Contact]) -> set[Contact]:
    """Return contacts at whose place another pass saw the other kind."""
    found: set[Contact] = set()
    places = np.array([(c.easting_m, c.northing_m) for c in contacts]).reshape(-1, 2)
    kinds = np.array([contact.kind for contact in contacts])
    passes = np.array([contact.pass_index for contact in contacts])
    for contact in contacts:
        others = (kinds != contact.kind) & (passes != contact.pass_index)
        away = np.hypot(*(places[others] - (contact.easting_m, contact.northing_m)).T)
        if away.size and away.min() < max(_SAME_M, contact.half_size_m):
            found.add(contact)
    return found


def _places(contacts: Sequence[Contact], crs: str) -> list[str]:
    """Return latitude and longitude in words; empty on a local grid."""
    if not contacts or is_local(crs):
        return [""] * len(contacts)
    east = np.array([contact.easting_m for contact in contacts])
    north = np.array([contact.northing_m for contact in contacts])
    lon, lat = transform(east, north, crs, GEOGRAPHIC)
    return [f"{y:.6f}, {x:.6f}" for x, y in zip(lon, lat, strict=True)]


def _short(crs: str) -> str:
    return crs if len(crs) < 40 else "local metric grid"


def _card(number: int, contact: Contact, place: str, mark: str) -> str:
    picture = ""
    if contact.snippet:
        data = base64.b64encode(contact.snippet).decode("ascii")
        picture = f'<img alt="echo of contact {number}" src="data:image/png;base64,{data}">'
    what = "height" if contact.kind == "hill" else "depth"
    least = "at least " if contact.lower_bound else ""
    side = "starboard" if contact.across_m > 0 else "port"
    rows = [
        (what, f"{least}{contact.height_m:.2f} m &plusmn; {contact.sigma_m:.2f} m"),
        ("position", f"{contact.easting_m:.2f} E, {contact.northing_m:.2f} N"),
        ("latitude, longitude", place),
        ("slant range", f"{contact.slant_range_m:.2f} m to {side}"),
        ("shadow", f"{contact.shadow_length_m:.2f} m{', runs out of the swath' if least else ''}"),
        ("pass, ping", f"{contact.pass_index}, {contact.ping}"),
        ("object", str(contact.object_number or "")),
        ("probability", f"{contact.probability:.0%}"),
        *(("part", part) for part in contact.parts[:_MOST_PARTS]),
    ]
    of = f" of {1 + len(contact.parts)} parts" if contact.parts else ""
    lines = "".join(f"<dt>{name}</dt><dd>{value}</dd>" for name, value in rows if value)
    return (
        f"<article>{picture}"
        f"<div><h2>{number}. {contact.kind}{of}</h2>{mark}<dl>{lines}</dl></div></article>"
    )


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>Contacts: {title}</title>
<style>
body {{ font: 15px/1.4 system-ui, sans-serif; margin: 2rem auto; max-width: 72rem; padding: 0 1rem;
  color: #1c2733; background: #f5f6f7; }}
main {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(30rem, 1fr)); gap: 1rem; }}
article {{ display: flex; gap: 1rem; background: #fff; border: 1px solid #d8dde2; border-radius: 6px;
  padding: .8rem; break-inside: avoid; }}
img {{ width: 200px; height: 200px; object-fit: contain; image-rendering: pixelated; background: #20304a; }}
h2 {{ margin: 0 0 .4rem; font-size: 1.05rem; }}
dl {{ display: grid; grid-template-columns: auto 1fr; gap: .1rem .8rem; margin: 0; font-size: .88rem; }}
dt {{ color: #5a6772; }} dd {{ margin: 0; font-variant-numeric: tabular-nums; }}
.mark {{ display: block; color: #a02020; font-size: .85rem; margin-bottom: .3rem; }}
</style></head><body>
<h1>Contacts</h1>
<p>{title}. {said} Positions in {crs}. Each picture has the track to the right and range upwards, to one scale
on both axes: black is shadow, white a highlight. Heights are above the surrounding floor, with 1-sigma;
the probability is that of an object against the floor's own relief. Objects of one pass whose footprints or
shadows touch are one contact, told by its highest part; objects.csv lists every part.</p>
<main>
{cards}
</main></body></html>
"""
