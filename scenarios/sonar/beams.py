"""Beam patterns and absorption: what weights an echo besides the floor."""

from __future__ import annotations

import numpy as np

from perception.records import FloatArray

# An unweighted line array has its one-way -3 dB width at 0.886 lambda / L (Urick 1983, ch. 3).
_WIDTH_OF_LINE_ARRAY = 0.886


def line_array(angle_rad: FloatArray, width_rad: float) -> FloatArray:
    """Return the one-way power pattern of a line array, ``sinc^2(L sin(angle) / lambda)``.

    Parameters
    ----------
    angle_rad : angles off the axis.
    width_rad : one-way -3 dB full width.
    """
    aperture = _WIDTH_OF_LINE_ARRAY / width_rad  # L / lambda
    return np.sinc(aperture * np.sin(angle_rad)) ** 2


def azimuth_nodes(width_rad: float, count: int) -> tuple[FloatArray, FloatArray]:
    """Return angles across the horizontal beam and the two-way pattern's integral over each, rad.

    The nodes lie evenly within 1.05 widths of the axis, where the two-way pattern holds more than
    99 % of its main lobe; each stands for the cell around it.
    """
    edges = np.linspace(-1.05 * width_rad, 1.05 * width_rad, count + 1)
    nodes = 0.5 * (edges[1:] + edges[:-1])
    fine = np.linspace(edges[:-1], edges[1:], 65)
    integrals = np.asarray(np.trapezoid(line_array(fine, width_rad) ** 2, fine, axis=0))
    return nodes, integrals


def vertical_table(width_rad: float, tilt_rad: float, floor_db: float = -35.0) -> FloatArray:
    """Tabulate the two-way vertical power pattern at whole degrees of depression, -180 to 180.

    Zero is the body's horizon on the side that the array looks to, 90 straight down. `floor_db` is
    the level below which side lobes and the hull's scattering fill the pattern's nulls.
    """
    depression = np.deg2rad(np.arange(-180, 181))
    off = (depression - tilt_rad + np.pi) % (2 * np.pi) - np.pi
    pattern = line_array(off, width_rad) ** 2
    # sinc^2 of sin(angle) mirrors behind the array; a baffle stops what comes from there.
    pattern[np.abs(off) > 0.5 * np.pi] = 0.0
    return np.maximum(pattern, 10.0 ** (floor_db / 10.0))


def absorption_db_m(
    frequency_khz: float, *, temperature_c: float, salinity_psu: float, depth_m: float
) -> float:
    """Return the absorption of sea water, dB per metre, at pH 8.

    Ainslie & McColm (1998), J. Acoust. Soc. Am. 103, 1671: boric acid, magnesium sulphate, water.
    """
    f = frequency_khz
    t, s, z = temperature_c, salinity_psu, depth_m / 1000.0
    boron = 0.78 * np.sqrt(s / 35.0) * np.exp(t / 26.0)
    magnesium = 42.0 * np.exp(t / 17.0)
    db_km = (
        0.106 * boron * f**2 / (boron**2 + f**2)
        + 0.52 * (1 + t / 43.0) * (s / 35.0) * magnesium * f**2 / (magnesium**2 + f**2) * np.exp(-z / 6.0)
        + 0.00049 * f**2 * np.exp(-(t / 27.0 + z / 17.0))
    )  # fmt: skip
    return float(db_km / 1000.0)
