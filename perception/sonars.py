"""The sonars that bathynav knows, as data sheets: what each kind sees, how finely and how fast.

Kinds of the founding paper carry its figures (middle of a stated span); instruments carry their makers'.
Needs nothing but the standard library, so that simulators and estimators may share it.
"""

from __future__ import annotations

from dataclasses import dataclass

_PAPER = "Cuschieri & Hebert"


@dataclass(frozen=True, slots=True)
class Sonar:
    """One sonar's data sheet.

    Attributes
    ----------
    kind : `side-scan`; `mechanical` (one beam turned step by step), `ctfm` (one beam turned
        continuously), `phased` (whole sector within one pulse), `multibeam` (several beams at once),
        `whiskers` (few fixed beams, for obstacles).
    horizontal_deg, vertical_deg : widths of the beam (-3 dB, one way). tilt_deg : the beam's axis below
        the horizon.
    range_m : greatest slant range of use. resolution_m : in slant range.
    step_deg : from beam to beam, 0 where the vehicle's motion steps. sector_deg : scanned in all.
    image_s : seconds for a whole sector, 0 where an image is as long as the track.
    images : whether contours can be drawn from it (None of the coarse kinds).
    """

    name: str
    kind: str
    frequency_hz: float
    horizontal_deg: float
    vertical_deg: float
    tilt_deg: float
    range_m: float
    resolution_m: float
    step_deg: float
    sector_deg: float
    image_s: float
    images: bool
    source: str


SONARS = (
    Sonar("side-scan", "side-scan", 500e3, 1.5, 80.0, 30.0, 100.0, 0.05, 0.0, 0.0, 0.0, True,
          f"{_PAPER}: 1-2 deg, about 80 deg; frequency, tilt and range are our choice"),
    # 90 deg at 400 m in steps of 1 deg, each 2 R / c: 48 s.
    Sonar("mechanical", "mechanical", 300e3, 2.0, 80.0, 30.0, 400.0, 0.075, 1.0, 90.0, 48.0, True,
          f"{_PAPER}: 1-2 deg, 5-10 cm, 48 s for 90 deg at 400 m; frequency and tilt are our choice"),
    # Ten times coarser than the pulsed kind; 30 deg/s over 180 deg.
    Sonar("ctfm", "ctfm", 300e3, 1.5, 80.0, 30.0, 400.0, 0.75, 1.0, 180.0, 6.0, True,
          f"{_PAPER}: 1-2 deg, ten times coarser in range, 30 deg/s; frequency and tilt are our choice"),
    # An image per 2 R / c: 0.53 s at 400 m.
    Sonar("phased", "phased", 300e3, 1.5, 80.0, 30.0, 400.0, 0.1, 1.0, 90.0, 0.53, True,
          f"{_PAPER}: whole sector per range cell, an image per 2R/c; other figures are our choice"),
    Sonar("multibeam", "multibeam", 300e3, 10.0, 80.0, 30.0, 200.0, 0.1, 10.0, 90.0, 1.5, False,
          f"{_PAPER}: 5-15 deg, 1-2 s an image; other figures are our choice"),
    Sonar("whiskers", "whiskers", 300e3, 10.0, 10.0, 0.0, 100.0, 0.1, 22.5, 90.0, 1.0, False,
          f"{_PAPER}: 3 layers of 5 beams ahead; other figures are our choice"),
    Sonar("starfish-453", "side-scan", 450e3, 2.0, 60.0, 30.0, 100.0, 0.025, 0.0, 0.0, 0.0, True,
          "starfishsonar.com: fan 2 deg wide, most energy in 60 deg, 30 deg down; range and cell are our choice"),
    Sonar("imagenex-881l-675", "mechanical", 675e3, 1.8, 20.0, 0.0, 200.0, 0.01, 1.0, 360.0, 96.0,
          True, "Imagenex 881L sheet: 675 kHz 1.8 x 20 deg, 10 mm, 200 m; image of 360 steps at 2R/c"),
    Sonar("imagenex-881l-310", "mechanical", 310e3, 4.0, 40.0, 0.0, 200.0, 0.01, 1.0, 360.0, 96.0,
          True, "Imagenex 881L sheet: 310 kHz 4 x 40 deg, 10 mm, 200 m; image of 360 steps at 2R/c"),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Sensor:
    """A navigation sensor that `locate` understands, with its default 1-sigma."""

    name: str
    column: str
    sigma: str
    note: str


SENSORS = (
    Sensor("beam", "beam1_m ... beamN_m", "1 % of range", "slant range to the bottom; four beams lie "
           "30 deg off nadir at 45, 135, 225, 315 deg from the bow"),
    Sensor("altimeter", "altitude_m", "1 % of range", "one beam straight down"),
    Sensor("odometry", "easting_m, northing_m", "start 50 m an axis, scale 0.5 %",
           "differences of the dead-reckoned position"),
    Sensor("compass", "heading_deg", "0.5 deg", "from true north; orients the beams"),
    Sensor("depth", "depth_m", "bias 1 m", "down from the surface"),
)  # fmt: skip
