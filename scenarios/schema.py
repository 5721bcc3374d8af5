"""Scenario files: one TOML tree for single runs and sweeps, every key validated.

Lengths are metres; places in a scenario are metres east and north of the world's origin
(`world.origin_easting_m`, `world.origin_northing_m`), so that a scenario can be moved as a whole.
Angles are degrees and azimuths are from grid north: this is a file, not an inside.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from perception.files import read_toml
from perception.records import InputError
from scenarios.world.components import KINDS, Component

LIBRARY = Path(__file__).parent / "library"

Place = tuple[float, float]


class Section(BaseModel):
    """A table of a scenario: frozen, no unknown key, no NaN or infinity."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class AlbedoSection(Section):
    """How strongly the floor scatters, apart from its shape."""

    rms_db: float = Field(
        default=1.0, ge=0, le=20, description="slow texture of the floor's strength, dB"
    )
    length_m: float = Field(default=25.0, gt=0, description="longest wavelength of that texture, m")
    patches: int = Field(default=0, ge=0, description="number of round patches of another strength")
    patch_db: float = Field(
        default=4.0, ge=0, description="strength of a patch, dB; half are weaker"
    )
    patch_radius_m: float = Field(default=20.0, gt=0, description="radius of a patch, m")


class WorldSection(Section):
    """The true sea floor."""

    size_east_m: float = Field(default=600.0, gt=0, le=20000, description="extent to the east, m")
    size_north_m: float = Field(default=480.0, gt=0, le=20000, description="extent to the north, m")
    depth_m: float = Field(default=60.0, gt=0, description="mean depth of the floor, m")
    cell_m: float = Field(default=0.25, gt=0, description="cell of the true floor, m")
    truth_cell_m: float = Field(default=0.5, gt=0, description="cell of truth/elevation.tif, m")
    crs: str = Field(default="EPSG:32630", description="projected CRS of the survey, in metres")
    origin_easting_m: float = Field(
        default=560000.0, description="easting of the world's middle, m"
    )
    origin_northing_m: float = Field(
        default=5550000.0, description="northing of the world's middle, m"
    )
    datum: str = Field(default="mean sea level", description="name of the vertical datum")
    terrain: tuple[Component, ...] = Field(default=(), description="landforms, added up in order")
    albedo: AlbedoSection = AlbedoSection()


class VehicleSection(Section):
    """How the vehicle moves."""

    speed_m_s: float = Field(default=1.5, gt=0, le=10, description="speed over ground, m/s")
    roll_rms_deg: float = Field(default=1.0, ge=0, le=30, description="rms of roll, degrees")
    pitch_rms_deg: float = Field(
        default=0.7, ge=0, le=30, description="rms of pitch beside the path's"
    )
    yaw_rms_deg: float = Field(default=0.5, ge=0, le=30, description="rms of yaw about the course")
    heave_rms_m: float = Field(default=0.05, ge=0, le=5, description="rms of heave, m")
    motion_period_s: float = Field(
        default=8.0, gt=0, description="mean period of attitude and heave, s"
    )
    wander_rms_m: float = Field(default=0.5, ge=0, description="rms of the track off its line, m")
    wander_length_m: float = Field(
        default=80.0, gt=0, description="wavelength of that wandering, m"
    )
    crab_deg: float = Field(default=1.0, description="mean heading minus course, degrees")
    follow_length_m: float = Field(
        default=12.0, gt=0, description="smoothing of the followed floor, m"
    )


class NavigationSection(Section):
    """What the vehicle knows of its place: dead reckoning that drifts, and surface fixes."""

    random_walk_m_per_sqrt_km: float = Field(
        default=4.0, ge=0, description="drift an axis, m per root km"
    )
    heading_bias_deg: float = Field(
        default=0.4, ge=0, description="1-sigma of a constant heading error"
    )
    heading_noise_deg: float = Field(
        default=0.1, ge=0, description="1-sigma of heading noise, degrees"
    )
    speed_scale: float = Field(
        default=0.004, ge=0, description="1-sigma of the speed's scale error"
    )
    start_sigma_m: float = Field(default=1.0, ge=0, description="1-sigma of the start, m an axis")
    depth_bias_m: float = Field(
        default=0.05, ge=0, description="1-sigma of a constant depth error, m"
    )
    depth_noise_m: float = Field(default=0.02, ge=0, description="1-sigma of depth noise, m")
    altimeter_noise: float = Field(
        default=0.01, ge=0, description="1-sigma of altitude, part of it"
    )
    fixes: Literal["none", "ends", "passes"] = Field(
        default="ends",
        description="surface fixes: none, at both ends of the survey, or of every pass",
    )
    fix_sigma_m: float = Field(default=1.5, gt=0, description="1-sigma of a surface fix, m an axis")
    tide_amplitude_m: float = Field(default=0.0, ge=0, description="amplitude of the tide, m")
    tide_period_s: float = Field(default=44714.0, gt=0, description="period of the tide, s (M2)")


class SonarSection(Section):
    """The side-scan sonar, its water and its recorder."""

    frequency_khz: float = Field(default=450.0, gt=1, description="centre frequency, kHz")
    range_m: float = Field(default=50.0, gt=1, description="greatest slant range, m")
    samples: int = Field(default=1024, ge=16, le=32768, description="samples a side")
    ping_period_s: float = Field(default=0.3, gt=0, description="seconds from ping to ping")
    horizontal_beam_deg: float = Field(default=0.8, gt=0, le=20, description="one-way -3 dB width")
    vertical_beam_deg: float = Field(default=55.0, gt=0, le=120, description="one-way -3 dB width")
    tilt_deg: float = Field(default=30.0, ge=0, le=90, description="beam's axis below the horizon")
    azimuths: int = Field(default=5, ge=1, le=101, description="directions summed across the beam")
    lambert_exponent: float = Field(default=2.0, ge=0, le=6, description="power of cos(incidence)")
    nadir_lobe_db: float | None = Field(
        default=3.0,
        description="specular lobe at normal incidence over Lambert, dB; left out if absent",
    )
    nadir_lobe_deg: float = Field(
        default=8.0, gt=0, description="width of that lobe in slope, degrees"
    )
    looks: float = Field(
        default=1.0, gt=0, description="looks averaged in a sample: speckle Gamma(L, 1/L)"
    )
    texture_shape: float | None = Field(
        default=None, gt=0, description="shape of K-distributed texture; Rayleigh speckle if absent"
    )
    sound_speed_m_s: float = Field(
        default=1500.0, gt=1300, lt=1700, description="speed of sound, m/s"
    )
    temperature_c: float = Field(
        default=10.0, ge=-2, le=40, description="of the water, for absorption"
    )
    salinity_psu: float = Field(
        default=35.0, ge=0, le=45, description="of the water, for absorption"
    )
    tvg_log: float = Field(
        default=30.0, ge=0, description="recorder's gain, dB per decade of range"
    )
    tvg_absorption_scale: float = Field(
        default=0.85, ge=0, description="absorption that the gain assumes, part of the true"
    )
    snr_db: float = Field(
        default=20.0,
        description="flat floor over noise at the greatest range and the mission's altitude, dB",
    )
    leakage_db: float = Field(default=-28.0, le=0, description="side-lobe echo in shadows, dB")
    surface_db: float | None = Field(
        default=-18.0,
        description="first surface echo over the floor's at that range, dB; none if absent",
    )
    multipath_db: float | None = Field(
        default=-26.0, description="second bottom echo at twice the altitude, dB; none if absent"
    )
    dropouts: float = Field(
        default=0.0, ge=0, le=1, description="part of pings that are lost to noise"
    )
    motion_during_echo: bool = Field(
        default=True, description="the beam turns while the echo is under way"
    )
    port_order: Literal["near-to-far", "far-to-near"] = Field(
        default="near-to-far", description="order of port samples in the file"
    )


class Block(Section):
    """Parallel lines flown to and fro."""

    heading_deg: float = Field(default=90.0, description="azimuth of the first line, degrees")
    count: int = Field(default=1, ge=1, description="number of lines")
    spacing_m: float = Field(default=40.0, gt=0, description="from line to line, m")
    length_m: float = Field(default=300.0, gt=0, description="of each line, m")
    east_m: float = Field(default=0.0, description="middle of the block, m east")
    north_m: float = Field(default=0.0, description="middle of the block, m north")


class MissionSection(Section):
    """The survey's lines."""

    block: tuple[Block, ...] = Field(default=(), description="blocks of parallel lines, in order")
    lines: tuple[tuple[float, float, float, float], ...] = Field(
        default=(), description="further lines, each east, north, east, north, m"
    )
    altitude_m: float = Field(default=15.0, gt=0, description="height above the floor, m")
    follow: Literal["terrain", "depth"] = Field(
        default="terrain",
        description="follow the floor, or keep the depth of the mean floor's altitude",
    )
    turns: Literal["skip", "record"] = Field(default="skip", description="whether turns are pinged")
    start: str = Field(default="2026-05-01T08:00:00Z", description="UTC of the first ping")
    files: Literal["one", "per-line"] = Field(
        default="one", description="survey.xtf, or one file a line"
    )


class PriorSection(Section):
    """The map that the vehicle brings along: coarse, old and wrong in a stated way."""

    cell_m: float = Field(default=2.0, gt=0, description="cell of the prior map, m")
    white_sigma_m: float = Field(default=0.1, ge=0, description="independent error of each cell, m")
    correlated_sigma_m: float = Field(
        default=0.2, ge=0, description="rms of the correlated error, m"
    )
    correlated_length_m: float = Field(default=60.0, gt=0, description="its longest wavelength, m")
    datum_offset_m: float = Field(default=0.0, description="prior minus true height, everywhere, m")
    change_rms_m: float = Field(default=0.0, ge=0, description="rms of the floor's change since, m")
    change_length_m: float = Field(
        default=30.0, gt=0, description="longest wavelength of the change, m"
    )
    holes: int = Field(default=0, ge=0, description="number of round holes without data")
    hole_radius_m: float = Field(default=15.0, gt=0, description="radius of a hole, m")


class MapSection(Section):
    """Options of `bathynav map`."""

    cell_m: float | None = Field(
        default=None, gt=0, description="cell of the map, m; the data's if absent"
    )
    method: Literal["joint", "shadow"] = Field(default="joint", description="how heights are found")
    prior: bool = Field(default=False, description="whether the prior map is used")
    fixes: bool = Field(default=True, description="whether the surface fixes are used")


class LocateSection(Section):
    """The return: the run that `bathynav locate` follows, and its options."""

    track: Literal["return", "survey"] = Field(
        default="return",
        description="nav.csv of a run back over the ground, or of the survey itself",
    )
    legs: tuple[Place, ...] = Field(
        default=(), description="waypoints of the return, m east and north"
    )
    altitude_m: float = Field(default=15.0, gt=0, description="height above the floor, m")
    hours_later: float = Field(default=24.0, gt=0, description="hours from the survey's start")
    start_sigma_m: float = Field(default=50.0, ge=0, description="1-sigma of the start, m an axis")
    row_period_s: float = Field(default=1.0, gt=0, description="seconds from row to row of nav.csv")
    beam_noise: float = Field(
        default=0.01, ge=0, description="1-sigma of a beam, part of its range"
    )
    beam_dropouts: float = Field(
        default=0.01, ge=0, le=1, description="part of beams without a return"
    )
    beam_outliers: float = Field(
        default=0.0, ge=0, le=1, description="part of beams that are wrong"
    )
    side_scan: bool = Field(
        default=True, description="whether the return is pinged too: return.xtf"
    )
    map: Literal["prior", "survey"] = Field(
        default="prior", description="match against the prior map or against the survey's own"
    )


class PlanSection(Section):
    """The route that is asked for, and the vehicle's limits (defaults of the contract)."""

    start: Place = Field(default=(-100.0, 0.0), description="start of the route, m east and north")
    goal: Place = Field(default=(100.0, 0.0), description="goal of the route, m east and north")
    turn_radius_m: float = Field(default=10.0, gt=0, description="least radius of a turn, m")
    pitch_up_deg: float = Field(default=30.0, gt=0, lt=90, description="steepest climb, degrees")
    pitch_down_deg: float = Field(default=30.0, gt=0, lt=90, description="steepest dive, degrees")
    floor_m: float = Field(default=5.0, ge=0, description="least altitude, m")
    ceiling_m: float = Field(default=20.0, gt=0, description="greatest altitude, m")
    speed_m_s: float = Field(default=1.5, gt=0, description="speed along the route, m/s")
    depth_max_m: float | None = Field(
        default=None, gt=0, description="greatest depth, m; none if absent"
    )
    weights: Literal["regions", "none"] = Field(
        default="regions", description="region weights of the cost"
    )
    risk: float = Field(
        default=0.01, gt=0, lt=1, description="chance of a breach over the whole route"
    )


class Scenario(Section):
    """A whole scenario; its tables are the sections of the file."""

    name: str = Field(default="scenario", description="name of the scenario")
    summary: str = Field(default="", description="one line that tells what it is for")
    seed: int = Field(default=0, ge=0, description="seed of every random draw")
    world: WorldSection = WorldSection()
    vehicle: VehicleSection = VehicleSection()
    sonar: SonarSection = SonarSection()
    navigation: NavigationSection = NavigationSection()
    mission: MissionSection = MissionSection()
    prior: PriorSection = PriorSection()
    map: MapSection = MapSection()
    locate: LocateSection = LocateSection()
    plan: PlanSection = PlanSection()

    @model_validator(mode="after")
    def _has_lines(self) -> Scenario:
        if not self.mission.block and not self.mission.lines:
            raise ValueError("mission has no line; give [[mission.block]] or mission.lines")
        return self


def library() -> dict[str, Path]:
    """Return the named scenarios, in alphabetical order with `demo` first."""
    found = {path.stem: path for path in sorted(LIBRARY.glob("*.toml"))}
    return {name: found[name] for name in sorted(found, key=lambda n: (n != "demo", n))}


def load_scenario(source: Path | str) -> Scenario:
    """Read a scenario file, or a named one of the library.

    Raises
    ------
    InputError
        No such file or name, no TOML, or a key that is unknown or wrong: one line names key, value
        and file.
    """
    path = Path(source)
    named = library()
    if not path.exists() and str(source) in named:
        path = named[str(source)]
    if not path.exists() and not path.suffix and path.parent == Path():
        raise InputError(f"{path}: no such scenario; there are {', '.join(named)}, or give a file")
    return scenario_of(rasters_from(read_toml(path), path.parent), str(path))


def rasters_from(tree: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return a tree whose `raster` components name their file from the root, not from `folder`.

    A resolved scenario is copied into other folders, where a relative path would lead nowhere.
    """
    world = tree.get("world")
    parts = world.get("terrain") if isinstance(world, dict) else None
    if not isinstance(world, dict) or not isinstance(parts, list):
        return tree

    def absolute(part: Any) -> Any:
        if isinstance(part, dict) and isinstance(part.get("path"), str):
            return {**part, "path": str((folder / part["path"]).resolve())}
        return part

    return {**tree, "world": {**world, "terrain": [absolute(part) for part in parts]}}


def scenario_of(tree: Mapping[str, Any], source: str) -> Scenario:
    """Validate a tree read from `source` (named in messages)."""
    try:
        return Scenario.model_validate(tree)
    except ValidationError as error:
        raise InputError(f"{source}: {_first_complaint(error, tree)}") from error


def tree_of(scenario: Scenario) -> dict[str, Any]:
    """Return the resolved scenario as plain TOML types; absent values are left out."""
    tree: dict[str, Any] = scenario.model_dump(mode="json", exclude_none=True)
    return tree


def _first_complaint(error: ValidationError, tree: Mapping[str, Any]) -> str:
    """Put the first of pydantic's complaints into one line: key, value, what is allowed."""
    first = error.errors()[0]
    # A component's place in the error names its kind as well, which is no key of the file.
    place = [part for part in first["loc"] if part not in KINDS]
    key = _dotted(place)
    if first["type"] == "extra_forbidden":
        near = difflib.get_close_matches(str(place[-1]), _siblings(first["loc"]), n=1, cutoff=0.5)
        hint = f"did you mean {near[0]}?" if near else "docs/scenarios.md lists the keys"
        return f"{key} = {first['input']!r} is not a known key; {hint}"
    if not place:
        return str(first["msg"]).removeprefix("Value error, ")
    if first["type"] == "missing":
        return f"{key} is missing; docs/scenarios.md lists the keys"
    message = str(first["msg"]).removeprefix("Value error, ")
    return f"{key} = {_short(first['input'])}: {message[0].lower()}{message[1:]}"


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _dotted(place: list[int | str]) -> str:
    text = ""
    for part in place:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def _siblings(place: tuple[int | str, ...]) -> list[str]:
    """Return the keys known where the unknown one stands."""
    model: type[BaseModel] = Scenario
    for part in place[:-1]:
        if isinstance(part, int):
            continue
        if part in KINDS:
            model = KINDS[part]
            continue
        inner = (
            _section_in(model.model_fields[part].annotation) if part in model.model_fields else None
        )
        if inner is not None:
            model = inner
    return list(model.model_fields)


def _section_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        found = _section_in(argument)
        if found is not None:
            return found
    return None
