"""A survey: all pings' headers in memory, in one projected frame; samples read pass by pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from perception.geodesy import (
    GEOGRAPHIC,
    LOCAL_CRS,
    convergence,
    metric_crs,
    scale_error,
    transform,
    utm_crs,
    wrap,
)
from perception.passes import PassConfig, Track, split_passes
from perception.readers.compass import compass_warning, heading_offsets
from perception.readers.places import refuse_two_places
from perception.readers.raw import PingFlag, RawFile, plural, spread_rows
from perception.readers.repair import mend_clock, mend_headings, mend_positions
from perception.records import BoolArray, FloatArray, InputError, IntArray, Swath

if TYPE_CHECKING:
    from perception.installation import Installation

FEWEST_PINGS = 10
# A ping with this many times the usual samples is a corrupt count, and would cost memory in every row.
_MOST_TIMES_USUAL = 8.0
_SURFACE_M = 0.05


@dataclass(frozen=True, slots=True)
class PingTable:
    """Headers of all side-scan pings of a survey in input order; row i is ping i. All (n,).

    Attributes
    ----------
    time_s : seconds since 1970 UTC, or of the file's clock (`Survey.utc`).
    easting_m, northing_m, depth_m : the sonar's position in the survey's CRS and below the surface
        (below the vertical datum once a tide is given); depth NaN unknown.
    heading_rad : clockwise from grid north; pitch_rad bow up; roll_rad starboard down.
    altitude_hint_m : what the file calls altitude; NaN unknown.
    sample_m : slant range from sample to sample; start_m : where the first one begins.
    samples : of the longer side. speed_m_s : over ground.
    pass_index : number of the pass, -1 for a ping that cannot be used or belongs to none.
    usable : whether position, samples and range are all there.
    file, row : index of the file, and of the ping in it. number : the file's own ping number or -1.
    flags : bits of `PingFlag`.
    """

    time_s: FloatArray
    easting_m: FloatArray
    northing_m: FloatArray
    depth_m: FloatArray
    heading_rad: FloatArray
    pitch_rad: FloatArray
    roll_rad: FloatArray
    altitude_hint_m: FloatArray
    sample_m: FloatArray
    start_m: FloatArray
    samples: IntArray
    sound_speed_m_s: FloatArray
    scan_angle_rad: FloatArray
    pass_index: IntArray
    usable: BoolArray
    file: IntArray
    row: IntArray
    number: IntArray
    flags: IntArray

    def __len__(self) -> int:
        return len(self.time_s)


@dataclass(frozen=True)
class Survey:
    """Sonar files as one sequence of pings, split into passes.

    Attributes
    ----------
    crs : projected CRS of all positions, in metres; a local engineering CRS where the files have
        metres without a zone.
    utc : whether times are absolute.
    defects : plain sentences with counts: what the files have wrong and what was made of it.
    warnings : those defects that change what a map means (no zone, no depth): for the user's eye.
    datum : vertical datum as the installation names it; empty unknown.
    """

    crs: str
    utc: bool
    defects: tuple[str, ...]
    warnings: tuple[str, ...]
    pings: PingTable
    files: tuple[RawFile, ...]
    n_passes: int
    datum: str = ""

    @classmethod
    def of(
        cls,
        files: Sequence[RawFile],
        crs: str | None = None,
        installation: Installation | None = None,
        config: PassConfig | None = None,
    ) -> Survey:
        """Bring scanned files into one frame, mend what can be mended, split into passes."""
        defects: list[str] = []
        warnings: list[str] = []
        files = _without_twins(files, warnings)
        _refuse_without_pings(files)
        target = _target_crs(files, crs, warnings)
        tables = []
        for number, raw in enumerate(files):
            found = list(raw.defects)
            tables.append(_table_of(raw, number, target, found))
            prefix = f"{raw.path.name}: " if len(files) > 1 else ""
            defects += [prefix + text for text in found]
        table = _joined(tables)
        if installation is not None:
            table = installation.apply(table, all(raw.utc for raw in files))
        _refuse_unusable(files, table)
        refuse_two_places(
            [raw.path.name for raw in files],
            table.file, table.easting_m, table.northing_m, table.usable,
        )  # fmt: skip
        _check_scale(files, table, target, warnings)
        if not np.isfinite(table.depth_m).any():
            warnings.append(
                "depth is unknown or zero throughout: elevations are relative to the sonar"
            )
        table, n_passes = _split(table, files, config or PassConfig())
        # Of the headings as install.toml leaves them; what the files say of themselves is a defect apart.
        odd = compass_warning(
            *heading_offsets(table.time_s, table.easting_m, table.northing_m,
                             table.heading_rad, table.pass_index),
            0.0 if installation is None else installation.compass.declination_deg,
        )  # fmt: skip
        warnings += [odd] if odd else []
        warnings += _unlike_depths(files, table)
        return cls(
            crs=target,
            utc=all(raw.utc for raw in files),
            defects=(*warnings, *defects),
            warnings=tuple(warnings),
            pings=table,
            files=tuple(files),
            n_passes=n_passes,
            datum="" if installation is None else installation.datum,
        )

    @property
    def n_pings(self) -> int:
        return len(self.pings)

    def rows(self, index: int) -> IntArray:
        """Return the indices into `pings` of pass `index`, in order."""
        if not 0 <= index < self.n_passes:
            raise IndexError(f"pass {index} of {self.n_passes}")
        return np.flatnonzero(self.pings.pass_index == index)

    def swath(self, index: int, part: slice | None = None) -> Swath:
        """Read the samples of one pass from its file(s).

        Parameters
        ----------
        index : number of the pass, from 0.
        part : pings of the pass to read, default all: for stages that stream within a pass.
        """
        rows = self.rows(index)[part or slice(None)]
        return self.read(rows, pass_index=index)

    def read(self, rows: IntArray, pass_index: int = -1) -> Swath:
        """Read the samples of any pings, by their indices into `pings`."""
        table = self.pings
        lead = _lead_samples(table, rows)
        width = int((table.samples[rows] + lead).max(initial=1))
        port = np.full((len(rows), width), np.nan, np.float32)
        starboard = np.full((len(rows), width), np.nan, np.float32)
        for number in np.unique(table.file[rows]):
            mine = np.flatnonzero(table.file[rows] == number)
            inner = int(table.samples[rows[mine]].max(initial=1))
            sides = self.files[number].samples(table.row[rows[mine]], inner)
            for out, values in zip((port, starboard), sides, strict=True):
                _place(out, values, mine, lead[mine])
        first = self.files[int(table.file[rows[0]])] if len(rows) else self.files[0]
        scanning = np.isfinite(table.scan_angle_rad[rows]).any()
        taken = {
            f.name: getattr(table, f.name)[rows]
            for f in fields(Swath)
            if f.name in _SHARED and f.name not in ("scan_angle_rad", "pass_index")
        }
        return Swath(
            **taken,
            ping=rows,
            port=port,
            starboard=starboard,
            crs=self.crs,
            source=first.path.name,
            sonar=first.sonar,
            frequency_hz=first.frequency_hz,
            utc=self.utc,
            pass_index=pass_index,
            scan_angle_rad=table.scan_angle_rad[rows] if scanning else None,
        )


# A grid's metres may differ from true ones by this part before it is told, and before it is refused.
_SCALE_TOLD, _SCALE_REFUSED = 0.005, 0.02
_SHARED = {f.name for f in fields(PingTable)}


def _lead_samples(table: PingTable, rows: IntArray) -> IntArray:
    """Return the empty samples before each ping's first: a recording that began after a delay."""
    with np.errstate(invalid="ignore", divide="ignore"):
        lead = np.nan_to_num(table.start_m[rows] / table.sample_m[rows])
    # Half a sample at most is lost by rounding; a delay longer than eight recordings is corrupt.
    return np.asarray(np.clip(np.round(lead), 0, 8 * table.samples[rows]).astype(np.int64))


def _place(out: FloatArray, values: FloatArray, lines: IntArray, lead: IntArray) -> None:
    width = values.shape[1]
    for shift in np.unique(lead):
        chosen = lead == shift
        stop = min(shift + width, out.shape[1])
        out[lines[chosen], shift:stop] = values[chosen, : stop - shift]


def _target_crs(files: Sequence[RawFile], crs: str | None, warnings: list[str]) -> str:
    """Choose the survey's CRS: the one given, or what suits the first valid position."""
    if crs is not None:
        return metric_crs(crs)
    for raw in files:
        placed = np.flatnonzero(np.isfinite(raw.pings.x + raw.pings.y))
        if len(placed) == 0:
            continue
        if raw.crs == GEOGRAPHIC:
            # The middle one of the first few: a first fix is the one most often wrong.
            first = placed[:9]
            return utm_crs(
                float(np.median(raw.pings.x[first])), float(np.median(raw.pings.y[first]))
            )
        if raw.crs:
            return metric_crs(raw.crs)
        warnings.append(
            "navigation is in metres of an unknown zone: a local grid is used; "
            "give --crs EPSG:N where the zone is known"
        )
        return LOCAL_CRS
    raise InputError(
        f"{_names(files)}: none of {plural(sum(len(raw.pings) for raw in files), 'ping')} has a valid "
        "position (all zero or NaN); give a file with navigation"
    )


def _check_scale(
    files: Sequence[RawFile], table: PingTable, target: str, warnings: list[str]
) -> None:
    """Refuse a CRS whose metres are none where the survey lies: ranges are true metres, and would not fit."""
    middle = (float(np.nanmedian(table.easting_m)), float(np.nanmedian(table.northing_m)))
    off = float(scale_error(np.array(middle[:1]), np.array(middle[1:]), target)[0])
    if not abs(off) > _SCALE_TOLD:
        return
    what = (
        f"{_names(files)}: {target} is made for another place: its distances are {100 * off:+.1f} % "
        "off where the survey lies; give --crs EPSG:N of the survey's own zone, or leave it out"
    )
    if abs(off) > _SCALE_REFUSED:
        raise InputError(what)
    warnings.append(what)


def _names(files: Sequence[RawFile]) -> str:
    return ", ".join(str(raw.path) for raw in files)


def _without_twins(files: Sequence[RawFile], warnings: list[str]) -> list[RawFile]:
    """Leave out records that are there already: counted twice, one pass would pass for two that agree."""
    kept: list[RawFile] = []
    for raw in files:
        twin = next((other for other in kept if _same_record(raw, other)), None)
        if twin is None:
            kept.append(raw)
        else:
            warnings.append(f"{raw.path.name}: is the record of {twin.path.name} again: left out")
    return kept


def _same_record(one: RawFile, other: RawFile) -> bool:
    """Return whether two files hold the same pings; two frequencies of one dive share all but their echoes."""
    n = len(one.pings)
    if n == 0 or n != len(other.pings):
        return False
    for name in ("time_s", "x", "y", "range_m"):
        if not np.array_equal(getattr(one.pings, name), getattr(other.pings, name), equal_nan=True):
            return False
    rows, width = spread_rows(n, 8), int(max(one.pings.samples.max(), other.pings.samples.max()))
    mine, theirs = one.samples(rows, width), other.samples(rows, width)
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(mine, theirs, strict=True))


def _refuse_without_pings(files: Sequence[RawFile]) -> None:
    """Refuse files that are sound but hold no side-scan, and say what they do hold."""
    if any(len(raw.pings) for raw in files):
        return
    held = "; ".join(
        ", ".join(f"{n:,} {kind}" for kind, n in (raw.packets or {}).items()) or "nothing"
        for raw in files
    )
    raise InputError(
        f"{_names(files)}: holds no side-scan ({held}); give a file with side-scan channels"
    )


def _table_of(raw: RawFile, number: int, target: str, defects: list[str]) -> PingTable:
    """Bring one file's pings into the survey's frame and mend them."""
    pings = raw.pings
    n = len(pings)
    time_s, clock_filled = mend_clock(pings.time_s, defects)
    east, north = transform(pings.x, pings.y, raw.crs or target, target)
    east, north, misplaced = mend_positions(time_s, east, north, defects)
    turned = convergence(east, north, target) if n and not misplaced.all() else np.zeros(n)
    # A ping without a position has the other zeros of an empty record too: told once, above.
    hollow = misplaced & (np.nan_to_num(pings.heading_deg) == 0)
    heading_rad = np.radians(np.where(hollow, np.nan, pings.heading_deg))
    heading_rad, heading_filled = mend_headings(
        time_s, heading_rad, east, north, turned, hollow, defects
    )
    depth_m = np.where(misplaced & (pings.depth_m == 0), np.nan, pings.depth_m)
    # A pressure sensor at the surface swings about zero: that is as little a depth as zero itself.
    if not np.any(np.abs(np.nan_to_num(depth_m)) > _SURFACE_M):
        depth_m = np.full(n, np.nan)
    depth_m = _filled(time_s, depth_m)
    samples = _sane_samples(pings.samples, defects)
    with np.errstate(invalid="ignore", divide="ignore"):
        sample_m = (pings.range_m - pings.start_m) / np.where(samples > 0, samples, np.nan)
    usable = ~misplaced & (samples > 0) & np.isfinite(sample_m) & (sample_m > 0)
    empty = int((~misplaced & ~usable).sum())
    if empty:
        defects.append(f"no samples or no slant range in {plural(empty, 'ping')}: in no pass")
    flags = (
        misplaced * int(PingFlag.POSITION_FILLED)
        | clock_filled * int(PingFlag.CLOCK_FILLED)
        | heading_filled * int(PingFlag.HEADING_FILLED)
        | ~np.isfinite(depth_m) * int(PingFlag.NO_DEPTH)
        | (samples == 0) * int(PingFlag.NO_SAMPLES)
    )
    angle = raw.scan_angle_deg
    return PingTable(
        time_s=time_s,
        easting_m=east,
        northing_m=north,
        depth_m=depth_m,
        heading_rad=wrap(heading_rad) % (2 * np.pi),
        pitch_rad=np.radians(np.nan_to_num(pings.pitch_deg)),
        roll_rad=np.radians(np.nan_to_num(pings.roll_deg)),
        altitude_hint_m=pings.altitude_m,
        sample_m=sample_m,
        start_m=np.nan_to_num(pings.start_m),
        samples=samples,
        sound_speed_m_s=pings.sound_speed_m_s,
        scan_angle_rad=np.full(n, np.nan) if angle is None else np.radians(angle),
        pass_index=np.full(n, -1, np.int64),
        usable=usable,
        file=np.full(n, number, np.int64),
        row=np.arange(n),
        number=pings.number,
        flags=flags.astype(np.int64),
    )


def _filled(time_s: FloatArray, values: FloatArray) -> FloatArray:
    """Interpolate the gaps of a quantity that is mostly there; all NaN stays so."""
    known = np.isfinite(values)
    if known.all() or not known.any() or np.any(np.diff(time_s[known]) < 0):
        return values
    return np.where(known, values, np.interp(time_s, time_s[known], values[known]))


def _sane_samples(samples: IntArray, defects: list[str]) -> IntArray:
    some = samples[samples > 0]
    if len(some) == 0:
        return samples
    wild = samples > _MOST_TIMES_USUAL * max(float(np.median(some)), 128.0)
    if wild.any():
        defects.append(
            f"an impossible number of samples in {plural(int(wild.sum()), 'ping')}: in no pass"
        )
    return np.where(wild, 0, samples)


def _joined(tables: Sequence[PingTable]) -> PingTable:
    if len(tables) == 1:
        return tables[0]
    columns: dict[str, Any] = {
        f.name: np.concatenate([getattr(t, f.name) for t in tables]) for f in fields(PingTable)
    }
    return PingTable(**columns)


def _unlike_depths(files: Sequence[RawFile], table: PingTable) -> list[str]:
    """Tell of files without depth among files with it: their heights have another zero."""
    known = [
        bool(np.isfinite(table.depth_m[table.file == number]).any()) for number in range(len(files))
    ]
    without = [raw.path.name for raw, there in zip(files, known, strict=True) if not there]
    if not without or len(without) == len(files):
        return []
    named = ", ".join(without[:3]) + (" ..." if len(without) > 3 else "")
    return [
        f"no depth in {named}, but in the other files: heights there are relative to the sonar; "
        "map those files apart"
    ]


def _refuse_unusable(files: Sequence[RawFile], table: PingTable) -> None:
    usable = int(table.usable.sum())
    if usable >= FEWEST_PINGS:
        return
    if len(table) >= FEWEST_PINGS and not np.isfinite(table.easting_m).any():
        raise InputError(
            f"{_names(files)}: none of {plural(len(table), 'ping')} has a valid position in this CRS; "
            "give another --crs"
        )
    raise InputError(
        f"{_names(files)}: {usable} usable of {plural(len(table), 'side-scan ping')}, at least "
        f"{FEWEST_PINGS} are needed; give a longer recording"
    )


def _split(table: PingTable, files: Sequence[RawFile], config: PassConfig) -> tuple[PingTable, int]:
    rows = np.flatnonzero(table.usable)
    track = Track(
        time_s=table.time_s[rows],
        easting_m=table.easting_m[rows],
        northing_m=table.northing_m[rows],
        heading_rad=table.heading_rad[rows],
        range_m=table.sample_m[rows] * table.samples[rows] + table.start_m[rows],
        samples=table.samples[rows],
        image=all(raw.scan_angle_deg is None for raw in files),
    )
    split = split_passes(track, config)
    pass_index = np.full(len(table), -1, np.int64)
    pass_index[rows] = split.pass_index
    flags = table.flags.copy()
    flags[rows[split.turning]] |= int(PingFlag.TURNING)
    flags[rows[split.stopped]] |= int(PingFlag.STOPPED)
    return replace(table, pass_index=pass_index, flags=flags), int(pass_index.max(initial=-1)) + 1
