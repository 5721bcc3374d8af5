"""Rays: the echoes of a pass as lines of power, one per stack of pings and side, ready to invert."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from perception.records import BoolArray, FloatArray, IntArray, Swath


@dataclass(frozen=True, slots=True)
class Look:
    """One pass as the joint inversion sees it.

    Attributes
    ----------
    swath : pings with corrected poses (easting, northing, depth, heading).
    altitude_m : (n,) first return, the *least* slant range of either side; NaN where none was found.
    altitude_sigma_m : (n,) its 1-sigma.
    shadow_port, shadow_starboard : (n, m) True in acoustic shadow, or None to let the inversion judge.
    usable : (n,) False for pings to leave out (turning, no bottom, damaged), or None for all.
    """

    swath: Swath
    altitude_m: FloatArray
    altitude_sigma_m: FloatArray
    shadow_port: BoolArray | None = None
    shadow_starboard: BoolArray | None = None
    usable: BoolArray | None = None

    def __post_init__(self) -> None:
        n = self.swath.n_pings
        for name in ("altitude_m", "altitude_sigma_m", "usable"):
            value = getattr(self, name)
            if value is not None and len(value) != n:
                raise ValueError(
                    f"Look.{name} must have one value per ping ({n}), got {len(value)}"
                )
        for name in ("shadow_port", "shadow_starboard"):
            value = getattr(self, name)
            if value is not None and value.shape != self.swath.port.shape:
                raise ValueError(
                    f"Look.{name} must have the swath's shape {self.swath.port.shape}, "
                    f"got {value.shape}"
                )


@dataclass(frozen=True, slots=True)
class Rays:
    """One side of one pass as stacked lines of echo power.

    Attributes
    ----------
    easting_m, northing_m, up_m : (n,) position of the sonar; `up_m` is its height above the datum.
    azimuth_rad : (n,) horizontal direction of looking, clockwise from grid north.
    tilt_rad : (n,) angle by which roll turns the beam outward.
    power : (n, m) mean echo power, negative where unknown; sample k is centred at
        ``(k + 0.5) * sample_m``.
    sample_m : (n,).
    side : 0 port, 1 starboard.
    look : index of the pass.
    """

    easting_m: FloatArray
    northing_m: FloatArray
    up_m: FloatArray
    azimuth_rad: FloatArray
    tilt_rad: FloatArray
    power: FloatArray
    sample_m: FloatArray
    side: int
    look: int

    @property
    def reach_m(self) -> float:
        return float(np.max(self.sample_m) * self.power.shape[1])


@dataclass(frozen=True, slots=True)
class Soundings:
    """The bottom track of one pass; all (n,): sonar position, heading, least slant range, sigma."""

    easting_m: FloatArray
    northing_m: FloatArray
    up_m: FloatArray
    heading_rad: FloatArray
    range_m: FloatArray
    sigma_m: FloatArray


# Echoes within this part of the first return's range still belong to the transmit pulse and water.
_WATER = 0.98


def ping_spacing_m(swath: Swath) -> float:
    """Return the typical distance sailed from ping to ping."""
    steps = np.hypot(np.diff(swath.easting_m), np.diff(swath.northing_m))
    total = float(np.nansum(steps))
    return total / max(len(steps), 1) if total > 0 else 1.0


def usable_pings(look: Look) -> BoolArray:
    """Return (n,) True where position and heading are known and the caller did not object."""
    swath = look.swath
    good = np.isfinite(swath.easting_m) & np.isfinite(swath.northing_m)
    good &= np.isfinite(swath.heading_rad) & np.isfinite(swath.sample_m) & (swath.sample_m > 0)
    return good if look.usable is None else good & look.usable


def sonar_height_m(swath: Swath) -> FloatArray:
    """Return the sonar's height above the datum; zero (heights relative to it) without a depth."""
    return -np.nan_to_num(np.asarray(swath.depth_m, float))


def stack_rays(look: Look, index: int, cell_m: float) -> list[Rays]:
    """Return the rays of both sides, pings stacked so that rays lie about a cell apart.

    Powers are averaged, so stacking takes speckle out without a bias; a side that is all NaN is
    left out.
    """
    swath = look.swath
    good = np.flatnonzero(usable_pings(look))
    size = max(1, round(0.75 * cell_m / ping_spacing_m(swath)))
    n = len(good) // size
    if n == 0:
        return []
    chosen = good[: n * size].reshape(n, size)
    # A stack across a gap would sit where no ping was.
    whole = chosen[:, -1] - chosen[:, 0] < 3 * size
    chosen = chosen[whole]

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(values, float)[chosen].mean(axis=1)

    heading = np.unwrap(np.asarray(swath.heading_rad, float))
    out = []
    for side, echo in enumerate((swath.port, swath.starboard)):
        power = _stacked_power(echo, chosen)
        if not np.any(power >= 0):
            continue
        m = power.shape[1]
        first = np.nanmin(
            np.where(np.isfinite(look.altitude_m[chosen]), look.altitude_m[chosen], np.inf), axis=1
        )
        first = np.where(np.isfinite(first), first, 0.0)
        sample = mean(swath.sample_m)
        water = (np.arange(m) + 1)[None] * sample[:, None] < _WATER * first[:, None]
        power[water] = -1.0
        sign = 1 if side else -1
        out.append(
            Rays(
                mean(swath.easting_m), mean(swath.northing_m), mean(sonar_height_m(swath)),
                mean(heading) + sign * np.pi / 2,
                # Starboard down turns the starboard beam towards nadir and the port beam outward.
                -sign * mean(np.nan_to_num(swath.roll_rad)),
                power, sample, side, index,
            )
        )  # fmt: skip
    return out


def _stacked_power(echo: FloatArray, chosen: IntArray) -> FloatArray:
    """Return the mean power of stacks (n, m) as float32, -1 where a sample is unknown in any."""
    total = np.zeros((len(chosen), echo.shape[1]), np.float32)
    for k in range(chosen.shape[1]):
        total += np.square(echo[chosen[:, k]], dtype=np.float32)
    total /= chosen.shape[1]
    total[~np.isfinite(total)] = -1.0
    return total


def of_unit_level(rays: list[Rays]) -> list[Rays]:
    """Return the rays with powers divided by their common median: the recorder's unit is arbitrary."""
    lit = [float(np.median(r.power[r.power > 0])) for r in rays if np.any(r.power > 0)]
    if not lit:
        return rays
    level = float(np.median(lit))
    return [
        replace(r, power=np.where(r.power >= 0, r.power / level, -1.0).astype(np.float32))
        for r in rays
    ]


def stack_soundings(look: Look, cell_m: float, floor_sigma_m: float) -> Soundings | None:
    """Return the bottom track, averaged over about a cell of track; None where there is none."""
    swath = look.swath
    good = np.flatnonzero(usable_pings(look) & np.isfinite(look.altitude_m) & (look.altitude_m > 0))
    size = max(1, round(cell_m / ping_spacing_m(swath)))
    n = len(good) // size
    if n == 0:
        return None
    chosen = good[: n * size].reshape(n, size)
    chosen = chosen[chosen[:, -1] - chosen[:, 0] < 3 * size]
    sigma = np.nan_to_num(np.asarray(look.altitude_sigma_m, float), nan=0.1)

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(values, float)[chosen].mean(axis=1)

    return Soundings(
        mean(swath.easting_m), mean(swath.northing_m), mean(sonar_height_m(swath)),
        mean(np.unwrap(swath.heading_rad)), mean(look.altitude_m),
        # A track errs over stretches longer than a cell: averaging earns nothing.
        np.hypot(mean(sigma), floor_sigma_m),
    )  # fmt: skip
