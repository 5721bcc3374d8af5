"""Where the sensors sit and what the water does: install.toml, tide, sound speed.

The effects themselves are in `perception.corrections`; `Installation.apply` is their order.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.corrections import (
    Arm,
    Poses,
    Table,
    column_speed,
    straight_layback,
    with_declination,
    with_lever_arm,
    with_mounting,
    with_sound_speed,
    with_tide,
    with_tow,
    without_latency,
)
from perception.files import existing_file, read_toml, utc_seconds
from perception.records import InputError

# Sound in water: beyond these a figure is a slip of unit or column.
_SLOWEST_M_S, _FASTEST_M_S = 1300.0, 1700.0


@dataclass(frozen=True, slots=True)
class SonarMount:
    """The sonar on the vehicle: lever arm (m, forward-starboard-down) and turn of its own axes."""

    offset_m: Arm = (0.0, 0.0, 0.0)
    heading_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    depth_m: float | None = (
        None  # a fixed depth below the surface: pole mounts, files without depth
    )


@dataclass(frozen=True, slots=True)
class Sensor:
    """A sensor's lever arm and how late its values are in the file: valid `latency_s` before."""

    offset_m: Arm = (0.0, 0.0, 0.0)
    latency_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Lag:
    """How late a sensor's values are in the file."""

    latency_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Compass:
    """`declination_deg` is added to headings that are magnetic in the file (east positive)."""

    declination_deg: float = 0.0
    latency_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Tow:
    """A towed sonar: positions in the file are the ship's, the sonar follows its track behind.

    `layback_m` is horizontal; without it, it comes of `cable_out_m` and the sonar's depth by a straight
    cable. `offset_m` is the tow point on the ship. `heading` is `recorded`, or `track` for a
    fish without a compass.
    """

    towed: bool = False
    layback_m: float | None = None
    cable_out_m: float | None = None
    offset_m: Arm = (0.0, 0.0, 0.0)
    heading: str = "recorded"


@dataclass(frozen=True, slots=True)
class Vertical:
    """Name of the vertical datum that tide heights refer to, kept to the map."""

    datum: str = ""


@dataclass(frozen=True, slots=True)
class Installation:
    """Everything that install.toml and the options say; the defaults change nothing."""

    sonar: SonarMount = field(default_factory=SonarMount)
    navigation: Sensor = field(default_factory=Sensor)
    depth: Lag = field(default_factory=Lag)
    attitude: Lag = field(default_factory=Lag)
    compass: Compass = field(default_factory=Compass)
    tow: Tow = field(default_factory=Tow)
    vertical: Vertical = field(default_factory=Vertical)
    tide: Table | None = None
    sound_speed_m_s: float | None = None
    sound_profile: Table | None = None

    @property
    def datum(self) -> str:
        return self.vertical.datum

    def apply(self, poses: Poses, utc: bool = True) -> Poses:
        """Return the poses with every effect applied, in the order in which they act.

        Raises
        ------
        InputError
            A tide that does not cover the survey, or a survey whose clock has no date.
        """
        if self.tide is not None and not utc:
            raise InputError(
                f"{self.tide.source}: the survey's clock has no date, so no tide can be looked up; "
                "leave --tide out"
            )
        poses = without_latency(
            poses,
            navigation_s=self.navigation.latency_s,
            depth_s=self.depth.latency_s,
            attitude_s=self.attitude.latency_s,
            compass_s=self.compass.latency_s,
        )
        poses = with_declination(poses, self.compass.declination_deg)
        poses = self._at_the_sonar(poses)
        mount = self.sonar
        poses = with_mounting(poses, mount.heading_deg, mount.pitch_deg, mount.roll_deg)
        if self.tide is not None:
            if not np.isfinite(poses.depth_m).any():
                raise InputError(
                    f"{self.tide.source}: the survey has no depth that a tide could correct; give "
                    "[sonar] depth_m in install.toml, or leave --tide out"
                )
            poses = with_tide(poses, self.tide)
        if self.sound_speed_m_s is not None:
            poses = with_sound_speed(poses, np.full(len(poses.time_s), self.sound_speed_m_s))
        elif self.sound_profile is not None:
            poses = with_sound_speed(poses, column_speed(poses, self.sound_profile))
        return poses

    def _at_the_sonar(self, poses: Poses) -> Poses:
        """Carry positions and depth to the sonar: along the tow, or by the rigid lever arm."""
        n = len(poses.time_s)
        fixed_m = None if self.sonar.depth_m is None else np.full(n, self.sonar.depth_m)
        if fixed_m is not None:
            poses = replace(poses, depth_m=fixed_m)
        if self.tow.towed:
            tow = self.tow
            layback_m = (
                straight_layback(float(tow.cable_out_m or 0.0), poses.depth_m, tow.offset_m[2])
                if tow.layback_m is None
                else np.full(n, tow.layback_m)
            )
            return with_tow(
                poses, layback_m, tow.offset_m, self.navigation.offset_m, tow.heading == "track"
            )
        poses = with_lever_arm(poses, self.navigation.offset_m, self.sonar.offset_m)
        # A fixed depth is the sonar's own: the lever arm must not move it again.
        return poses if fixed_m is None else replace(poses, depth_m=fixed_m)


def read_installation(
    install: Path | None = None, tide: Path | None = None, sound_speed: str | None = None
) -> Installation | None:
    """Read install.toml and the options beside it; None where nothing is given.

    Parameters
    ----------
    sound_speed : a value in m/s, or the name of a profile CSV (`depth_m`, `speed_m_s`).

    Raises
    ------
    InputError
        An unknown or wrong key (named), a bad table, an impossible sound speed.
    """
    if install is None and tide is None and sound_speed is None:
        return None
    installation = Installation() if install is None else _from_toml(Path(install))
    if tide is not None:
        installation = replace(installation, tide=read_tide(Path(tide)))
    if sound_speed is not None:
        # The option replaces whichever form install.toml had.
        chosen = {"sound_speed_m_s": None, "sound_profile": None} | _sound(str(sound_speed))
        installation = replace(installation, **chosen)
    return installation


def _sound(text: str, folder: Path = Path()) -> dict[str, Any]:
    """Return the setting for a speed, or for a profile's name as seen from `folder`."""
    try:
        speed = float(text)
    except ValueError:
        return {"sound_profile": read_profile(folder / text)}
    if not _SLOWEST_M_S <= speed <= _FASTEST_M_S:
        raise InputError(
            f"--sound-speed {text}: must lie between {_SLOWEST_M_S:g} and {_FASTEST_M_S:g} m/s; "
            "give metres a second or a profile CSV"
        )
    return {"sound_speed_m_s": speed}


def read_tide(path: Path) -> Table:
    """Read a tide table: CSV with `time` (ISO 8601, UTC unless it says otherwise) and `height_m`."""
    return _read_table(path, "time", "height_m", utc_seconds)


def read_profile(path: Path) -> Table:
    """Read a sound speed profile: CSV with `depth_m` (down from the surface) and `speed_m_s`."""
    table = _read_table(path, "depth_m", "speed_m_s", float)
    wrong = (table.value < _SLOWEST_M_S) | (table.value > _FASTEST_M_S)
    if wrong.any():
        raise InputError(
            f"{path}: speed_m_s {table.value[wrong][0]:g} lies outside {_SLOWEST_M_S:g} to "
            f"{_FASTEST_M_S:g} m/s; mend the row"
        )
    return table


def _read_table(path: Path, at: str, value: str, parse: Callable[[str], float]) -> Table:
    path = existing_file(path)
    points: list[tuple[float, float]] = []
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as stream:
        rows = csv.DictReader(stream)
        for name in (at, value):
            if name not in (rows.fieldnames or ()):
                raise InputError(f"{path}: lacks the column {name}; it must have {at} and {value}")
        for line, row in enumerate(rows, start=2):
            try:
                point = (parse(row[at]), float(row[value]))
            except (TypeError, ValueError) as error:
                raise InputError(
                    f"{path}: line {line}: {error}; mend or remove the line"
                ) from error
            if not np.isfinite(point).all():
                raise InputError(f"{path}: line {line}: is not finite; mend or remove the line")
            points.append(point)
    if not points:
        raise InputError(f"{path}: holds no row; it must have {at} and {value}")
    where, what = np.array(sorted(points)).T
    return Table(where, what, str(path))


_SECTIONS: dict[str, type] = {
    "sonar": SonarMount,
    "navigation": Sensor,
    "depth": Lag,
    "attitude": Lag,
    "compass": Compass,
    "tow": Tow,
    "vertical": Vertical,
}


def _from_toml(path: Path) -> Installation:
    sections: dict[str, Any] = {}
    for name, content in read_toml(path).items():
        if name == "sound_speed":
            sections |= _sound(str(content), path.parent)
            continue
        kind = _SECTIONS.get(name)
        if kind is None:
            raise InputError(
                f"{path}: unknown key {name!r}; there are {', '.join([*_SECTIONS, 'sound_speed'])}"
            )
        if not isinstance(content, dict):
            raise InputError(f"{path}: {name} must be a table [{name}], got {content!r}")
        sections[name] = _section(path, name, kind, content)
    found = Installation(**sections)
    if found.tow.towed and found.tow.layback_m is None and found.tow.cable_out_m is None:
        raise InputError(f"{path}: [tow] towed needs layback_m or cable_out_m; give one")
    return found


def _section(path: Path, name: str, kind: type, content: dict[str, Any]) -> Any:
    known = {f.name: f for f in fields(kind)}
    for key, value in content.items():
        where = f"{path}: {name}.{key}"
        if key not in known:
            raise InputError(f"{where}: unknown key; [{name}] has {', '.join(known)}")
        _check(where, key, value)
    taken = {k: tuple(map(float, v)) if isinstance(v, list) else v for k, v in content.items()}
    return kind(**taken)


def _check(where: str, key: str, value: Any) -> None:
    """Refuse a value of the wrong kind or an impossible size, naming what is wanted."""
    if key == "offset_m":
        three = isinstance(value, list) and len(value) == 3
        if not three or not all(_is_number(v) and abs(v) <= 1000.0 for v in value):
            raise InputError(
                f"{where}: must be [forward, starboard, down] in metres (each at most 1000), "
                f"got {value!r}"
            )
    elif key == "towed":
        if not isinstance(value, bool):
            raise InputError(f"{where}: must be true or false, got {value!r}")
    elif key == "heading":
        if value not in ("recorded", "track"):
            raise InputError(f'{where}: must be "recorded" or "track", got {value!r}')
    elif key == "datum":
        if not isinstance(value, str):
            raise InputError(f"{where}: must be a text, got {value!r}")
    elif not _is_number(value):
        raise InputError(f"{where}: must be a number, got {value!r}")
    else:
        low, high = _LIMITS[key]
        if not low <= value <= high:
            raise InputError(f"{where}: must lie between {low:g} and {high:g}, got {value:g}")


_LIMITS = {
    "latency_s": (-60.0, 60.0),
    "declination_deg": (-180.0, 180.0),
    "heading_deg": (-180.0, 180.0),
    "pitch_deg": (-90.0, 90.0),
    "roll_deg": (-180.0, 180.0),
    "depth_m": (-100.0, 12000.0),
    "layback_m": (0.0, 20000.0),
    "cable_out_m": (0.0, 20000.0),
}


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and np.isfinite(value)
