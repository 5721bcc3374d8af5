"""`bathynav info FILE...`: what sonar files hold, and what they have wrong."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from perception.records import BathynavError
from scenarios.commands.console import (
    common_options,
    print_table,
    progress_bars,
    set_verbosity,
)

if TYPE_CHECKING:
    from perception.readers import RawFile, Survey
    from perception.records import FloatArray, IntArray


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--crs", default=None, help="Projected CRS in metres, such as EPSG:32619.")
@common_options
def command(files: tuple[Path, ...], crs: str | None, quiet: bool, verbose: bool) -> int:
    """Tell what sonar files hold: pings, ranges, track, gaps, defects. Writes nothing.

    Each file is told by itself, then several as the one survey that they make. Exit 0 where every
    file could be told, 1 where one cannot be used.
    """
    from perception.readers import scan_file

    set_verbosity(quiet, verbose)
    failures = []
    good: list[RawFile] = []
    with progress_bars(quiet) as progress:
        for path in files:
            try:
                raw = scan_file(path, progress)
                rows = describe(raw, crs)
            except BathynavError as error:
                if len(files) == 1:
                    raise
                failures.append(error)
                click.echo(f"bathynav: {' '.join(str(error).split())}", err=True)
                continue
            if len(raw.pings):
                good.append(raw)
            if not quiet:
                print_table(str(path), rows)
    if len(good) > 1 and not quiet:
        print_table(f"survey of {len(good)} files", describe_survey(good, crs))
    return 1 if failures else 0


def describe_survey(files: list[RawFile], crs: str | None) -> list[tuple[str, str]]:
    """Return (name, value) rows for several files read as one survey, in the order given."""
    from perception.readers import Survey

    try:
        survey = Survey.of(files, crs)
    except BathynavError as error:
        # Files told side by side need not belong together: that is news, not a failure.
        return [("survey", f"these files do not make one: {error}")]
    return _pings(survey) + _track(survey)


def describe(raw: RawFile, crs: str | None) -> list[tuple[str, str]]:
    """Return (name, value) rows for one file.

    A sound file of a kind that need not hold side-scan is told too; one that should and does not
    raises `InputError`.
    """
    from perception.readers import Survey

    rows = [("format", raw.format), ("sonar", raw.sonar or "not named")]
    rows.append(("records", _counts(raw)))
    if len(raw.pings) == 0:
        rows += [("note", note) for note in raw.notes]
        rows.append(("side-scan", "none: this file cannot be mapped"))
        rows += [("defect", text) for text in raw.defects]
        return rows
    survey = Survey.of([raw], crs)
    rows += _pings(survey) + _image(raw, survey) + _track(survey) + _vertical(survey)
    rows += [("note", note) for note in raw.notes]
    rows += [("defect", text) for text in (*survey.defects, *_altitude_defect(survey))]
    return rows


def _counts(raw: RawFile) -> str:
    return ", ".join(f"{n:,} {kind}" for kind, n in (raw.packets or {}).items())


def _pings(survey: Survey) -> list[tuple[str, str]]:
    import numpy as np

    table = survey.pings
    rows = [
        ("pings", f"{survey.n_pings:,}, {int(table.usable.sum()):,} usable, "
                  f"{int((table.pass_index >= 0).sum()):,} in passes"),
        ("passes", f"{survey.n_passes:,}"),
    ]  # fmt: skip
    for index in range(min(survey.n_passes, 12)):
        mine = survey.rows(index)
        heading = np.unwrap(table.heading_rad[mine])
        rows.append((
            f"  pass {index}",
            f"pings {mine[0]} to {mine[-1]} ({len(mine):,}), {_length_m(survey, mine):.1f} m, heading "
            f"{np.degrees(heading.mean()) % 360:.1f} deg (grid)",
        ))  # fmt: skip
    if survey.n_passes > 12:
        rows.append(("  ...", f"and {survey.n_passes - 12} more"))
    return rows


def _image(raw: RawFile, survey: Survey) -> list[tuple[str, str]]:
    import numpy as np

    table = survey.pings
    used = table.usable
    sides = [
        name
        for name, counts in (
            ("port", raw.pings.port_samples), ("starboard", raw.pings.starboard_samples)
        )
        if counts.any()
    ]  # fmt: skip
    range_m = table.start_m + table.sample_m * table.samples
    frequency = "" if np.isnan(raw.frequency_hz) else f", {raw.frequency_hz / 1e3:g} kHz"
    return [
        ("channels", f"{' and '.join(sides)}, {raw.bits or 'unknown'}{frequency}"),
        ("samples", f"{_span(table.samples[used], '', 0)} a side"),
        ("slant range", _span(range_m[used], "m", 2)),
        ("sample", _span(100 * table.sample_m[used], "cm of slant range", 2)),
        ("sound speed", _span(table.sound_speed_m_s[used], "m/s", 1)),
    ]


def _track(survey: Survey) -> list[tuple[str, str]]:
    import numpy as np

    from perception.geodesy import GEOGRAPHIC, is_local, transform

    table = survey.pings
    used = np.flatnonzero(table.usable)
    time_s = table.time_s
    clock = f"{_utc(time_s.min())} to {_utc(time_s.max())} UTC" if survey.utc else "no date"
    duration_s = float(np.ptp(time_s))
    step_s = np.diff(time_s)
    # The mean between gaps: a clock that moves in steps makes the commonest interval shorter than the true one.
    running = (
        step_s[(step_s >= 0) & (step_s <= max(5.0, 10 * float(np.median(step_s))))]
        if len(step_s)
        else step_s
    )
    rate = f", a ping every {running.mean():.3g} s" if len(running) else ""
    length_m = _length_m(survey, used)
    speed = f", {length_m / duration_s:.2f} m/s on average" if duration_s > 0 else ""
    east, north = table.easting_m[used], table.northing_m[used]
    rows = [
        ("time", f"{clock}, {duration_s:.1f} s{rate}"),
        ("track", f"{length_m:.1f} m{speed}"),
        ("CRS", "local metric grid, no place on Earth" if is_local(survey.crs) else survey.crs),
        ("easting", _span(east, "m", 1)),
        ("northing", _span(north, "m", 1)),
    ]
    if not is_local(survey.crs):
        lon, lat = transform(east, north, survey.crs, GEOGRAPHIC)
        rows.append(
            ("position", f"latitude {_span(lat, 'deg', 6)}, longitude {_span(lon, 'deg', 6)}")
        )
    gaps = step_s[step_s > max(5.0, 10 * float(np.median(step_s)))] if len(step_s) else step_s
    longest = f", the longest {gaps.max():.1f} s" if len(gaps) else ""
    rows.append(("gaps", f"{len(gaps)}{longest}"))
    return rows


def _vertical(survey: Survey) -> list[tuple[str, str]]:
    import numpy as np

    table = survey.pings
    return [
        ("depth", _span(table.depth_m[table.usable], "m", 2)),
        ("altitude field", _span(table.altitude_hint_m[table.usable], "m", 2)),
        ("pitch", _span(np.degrees(table.pitch_rad[table.usable]), "deg", 1)),
        ("roll", _span(np.degrees(table.roll_rad[table.usable]), "deg", 1)),
    ]


def _altitude_defect(survey: Survey) -> list[str]:
    """Compare the altitude field with the echoes' own first return, on some pings of the file."""
    import numpy as np

    from perception.readers.orientation import first_return_fractions
    from perception.readers.raw import spread_rows

    table = survey.pings
    used = np.flatnonzero(table.usable)
    hinted = used[np.isfinite(table.altitude_hint_m[used])]
    if len(hinted) < 0.5 * len(used):
        return ["no altitude field: altitude comes from the first return"]
    rows = hinted[spread_rows(len(hinted), 100)]
    swath = survey.read(rows)
    returns = np.full((2, len(rows)), np.nan)
    for side, levels in enumerate((swath.port, swath.starboard)):
        counts = table.samples[rows]
        echoes = [line[:count] for line, count in zip(levels, counts, strict=True)]
        returns[side] = first_return_fractions(echoes) * counts
    returns *= swath.sample_m
    ratio = returns / swath.altitude_hint_m
    ratio = ratio[np.isfinite(ratio)]
    if len(ratio) < 20:
        return []
    factor = float(np.median(ratio))
    if 0.85 < factor < 1.15:
        return []
    return [
        f"first returns come at {factor:.2f} times the altitude field: it is a hint and no more"
    ]


def _length_m(survey: Survey, rows: IntArray) -> float:
    """Return the way sailed as `strips` measures it: the stairs of coarse positions do not lengthen it."""
    from perception.geometry import progress_along

    table = survey.pings
    way = progress_along(table.easting_m[rows], table.northing_m[rows], table.time_s[rows])
    return float(way[-1] - way[0]) if len(way) else 0.0


def _span(values: FloatArray | IntArray, unit: str, digits: int) -> str:
    import numpy as np

    finite = np.asarray(values, float)
    finite = finite[np.isfinite(finite)]
    if len(finite) == 0:
        return "not recorded"
    low, high = f"{finite.min():.{digits}f}", f"{finite.max():.{digits}f}"
    return f"{low if low == high else f'{low} to {high}'} {unit}".strip()


def _utc(time_s: float) -> str:
    from datetime import UTC, datetime

    return datetime.fromtimestamp(float(time_s), UTC).strftime("%Y-%m-%d %H:%M:%S")
