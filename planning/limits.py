"""What the vehicle can do: the table `[vehicle]` of a TOML file.

The defaults are those of a small survey AUV of the torpedo kind (REMUS 100, Iver3 and Gavia classes:
1 to 2.5 m/s, turning circles of 10 to 20 m, pitch held within about 30 deg by the autopilot).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path

from perception.files import read_toml
from perception.records import InputError


@dataclass(frozen=True, slots=True)
class VehicleLimits:
    """Limits that every route keeps everywhere.

    Attributes
    ----------
    turn_radius_m : least horizontal turning radius; 0 turns on the spot.
    pitch_up_deg, pitch_down_deg : steepest climb and dive.
    floor_m, ceiling_m : least and greatest altitude above the bottom.
    speed_m_s : speed along the path, for times and rates.
    depth_max_m : greatest depth below the surface; infinite where not given.
    climb_rate_m_s, dive_rate_m_s : greatest vertical speeds; infinite where not given. At `speed_m_s`
        they are further limits on the pitch.
    sigma_position_m, sigma_depth_m : 1-sigma of the vehicle's own position (each axis) and depth;
        they add to the map's sigma in the clearance.
    start_heading_deg, goal_heading_deg : headings at the ends, clockwise from grid north; NaN free.
    """

    turn_radius_m: float = 10.0
    pitch_up_deg: float = 30.0
    pitch_down_deg: float = 30.0
    floor_m: float = 5.0
    ceiling_m: float = 20.0
    speed_m_s: float = 1.5
    depth_max_m: float = math.inf
    climb_rate_m_s: float = math.inf
    dive_rate_m_s: float = math.inf
    sigma_position_m: float = 0.0
    sigma_depth_m: float = 0.0
    start_heading_deg: float = math.nan
    goal_heading_deg: float = math.nan

    def __post_init__(self) -> None:
        for name in ("turn_radius_m", "floor_m", "sigma_position_m", "sigma_depth_m"):
            _require(getattr(self, name) >= 0, name, getattr(self, name), "not be negative")
        for name in ("speed_m_s", "climb_rate_m_s", "dive_rate_m_s", "depth_max_m"):
            _require(getattr(self, name) > 0, name, getattr(self, name), "be positive")
        for name in ("pitch_up_deg", "pitch_down_deg"):
            value = getattr(self, name)
            _require(0 < value < 90, name, value, "lie between 0 and 90")
        if not self.ceiling_m > self.floor_m:
            raise InputError(
                f"ceiling_m ({self.ceiling_m:g}) must lie above floor_m ({self.floor_m:g}); "
                "raise the ceiling or lower the floor in the vehicle's file"
            )

    @property
    def slope_up(self) -> float:
        """Steepest climb as rise over horizontal run, from pitch and climb rate."""
        return _slope(self.pitch_up_deg, self.climb_rate_m_s, self.speed_m_s)

    @property
    def slope_down(self) -> float:
        """Steepest dive as fall over horizontal run, positive."""
        return _slope(self.pitch_down_deg, self.dive_rate_m_s, self.speed_m_s)


def _require(good: bool, name: str, value: float, rule: str) -> None:
    if not good:
        raise InputError(f"vehicle limit {name} must {rule}, got {value:g}")


def _slope(pitch_deg: float, rate_m_s: float, speed_m_s: float) -> float:
    sine = math.sin(math.radians(pitch_deg))
    if rate_m_s < speed_m_s:
        sine = min(sine, rate_m_s / speed_m_s)
    return sine / math.sqrt(1.0 - sine * sine)


def read_vehicle(path: Path | None) -> VehicleLimits:
    """Read `vehicle.toml`; None gives the defaults.

    Raises
    ------
    InputError
        No table `[vehicle]`, an unknown key, a value that is no number, or limits that contradict.
    """
    if path is None:
        return VehicleLimits()
    document = read_toml(path)
    table = document.get("vehicle")
    if not isinstance(table, dict):
        raise InputError(f"{path}: has no table [vehicle]; put the limits under that heading")
    known = {f.name for f in fields(VehicleLimits)}
    for key, value in table.items():
        if key not in known:
            raise InputError(
                f"{path}: unknown key {key!r} in [vehicle]; there are {', '.join(sorted(known))}"
            )
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"{path}: {key} must be a number, got {value!r}")
    try:
        return VehicleLimits(**{key: float(value) for key, value in table.items()})
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
