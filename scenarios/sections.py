"""The sections of a scenario: what each key means, its unit, default and limits.

Lengths are metres; places are metres east and north of the world's origin
(`world.origin_easting_m`, `world.origin_northing_m`), so that a scenario can be moved as a whole.
Angles are degrees and azimuths are from grid north: this is a file, not an inside.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from perception.sonars import SONARS
from scenarios.world.components import Component

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

    model: str | None = Field(
        default=None,
        description="a side-scan that `bathynav sensors` lists: frequency, beam, tilt, range and "
        "samples follow its sheet where they are not given",
    )
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

    @model_validator(mode="before")
    @classmethod
    def _follow_sheet(cls, given: Any) -> Any:
        if not isinstance(given, dict) or not isinstance(given.get("model"), str):
            return given
        sheets = {sonar.name: sonar for sonar in SONARS if sonar.kind == "side-scan"}
        sheet = sheets.get(given["model"])
        if sheet is None:
            raise ValueError(
                f"model {given['model']!r} is no side-scan; there are {', '.join(sheets)}"
            )
        range_m = given.get("range_m", sheet.range_m)
        samples = 1024
        if isinstance(range_m, (int, float)):
            samples = min(max(round(range_m / sheet.resolution_m), 16), 32768)
        return {
            "frequency_khz": sheet.frequency_hz / 1000.0,
            "horizontal_beam_deg": sheet.horizontal_deg,
            "vertical_beam_deg": sheet.vertical_deg,
            "tilt_deg": sheet.tilt_deg,
            "range_m": sheet.range_m,
            "samples": samples,
            **given,
        }

    @model_validator(mode="after")
    def _hears_before_it_pings(self) -> SonarSection:
        least_s = 2.0 * self.range_m / self.sound_speed_m_s
        if self.ping_period_s < least_s:
            raise ValueError(
                f"ping_period_s = {self.ping_period_s:g} is shorter than the echo from "
                f"range_m = {self.range_m:g} takes ({least_s:.3f} s)"
            )
        return self


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


class RegionsSection(Section):
    """Options of `bathynav regions`."""

    scale_m: float | None = Field(
        default=None, gt=0, description="size of the landforms that count, m; the noise's if absent"
    )


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
    regions: RegionsSection = RegionsSection()
    locate: LocateSection = LocateSection()
    plan: PlanSection = PlanSection()

    @model_validator(mode="after")
    def _has_lines(self) -> Scenario:
        if not self.mission.block and not self.mission.lines:
            raise ValueError("mission has no line; give [[mission.block]] or mission.lines")
        return self
