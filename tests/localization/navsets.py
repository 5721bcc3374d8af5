"""Small planted worlds for the localization tests; nothing here imports `localization`."""

from __future__ import annotations

import numpy as np

from perception.records import FloatArray, Grid

EXTENT_M, CELL_M, DEPTH_M = 1200.0, 5.0, 40.0


def floor_m(
    easting: FloatArray, northing: FloatArray, relief_m: float = 8.0, phase: float = 0.0
) -> FloatArray:
    """An analytic, aperiodic sea floor around -100 m, of about `relief_m` rms."""
    waves = (
        (0.0071, 0.0043, 0.3, 1.0), (-0.0052, 0.0091, 1.9, 0.8), (0.0137, -0.0083, 4.1, 0.5),
        (0.0211, 0.0173, 2.2, 0.3), (-0.0293, 0.0241, 5.0, 0.2), (0.0401, 0.0377, 0.9, 0.12),
    )  # fmt: skip
    total = sum(
        a * np.sin(e * easting + n * northing + p + phase * i)
        for i, (e, n, p, a) in enumerate(waves, start=1)
    )
    return -100.0 + relief_m * np.asarray(total)


def prior(
    rng: np.random.Generator, relief_m: float = 8.0, error_m: float = 0.2, phase: float = 0.0
) -> Grid:
    """The floor sampled at cells' centres with a white error; another `phase` is another floor."""
    n = round(EXTENT_M / CELL_M)
    centre = (np.arange(n) + 0.5) * CELL_M
    easting, northing = np.meshgrid(centre, centre[::-1])
    height = floor_m(easting, northing, relief_m, phase) + error_m * rng.standard_normal((n, n))
    return Grid(height, 0.0, EXTENT_M, CELL_M, "EPSG:32631", np.full((n, n), error_m))


def mission(
    rng: np.random.Generator,
    rows: int = 150,
    relief_m: float = 8.0,
    offset_m: tuple[float, float] = (30.0, -40.0),
    bias_m: float = 0.8,
) -> tuple[dict[str, FloatArray], FloatArray, FloatArray]:
    """Columns of nav.csv over the floor, with true easting and northing."""
    time = 3.0 * np.arange(rows)
    heading = 0.6 + 0.5 * np.sin(time / 120.0)
    step = 4.5
    easting = 350.0 + np.concatenate([[0.0], np.cumsum(step * np.sin(heading[:-1]))])
    northing = 300.0 + np.concatenate([[0.0], np.cumsum(step * np.cos(heading[:-1]))])
    columns: dict[str, FloatArray] = {
        "time_s": time,
        "easting_m": easting - offset_m[0],
        "northing_m": northing - offset_m[1],
        "depth_m": np.full(rows, DEPTH_M + bias_m),
        "heading_deg": np.degrees(heading),
    }
    for b, azimuth in enumerate((45.0, 135.0, 225.0, 315.0), start=1):
        direction = heading + np.radians(azimuth)
        slant = np.full(rows, 60.0)
        for _ in range(60):  # fixed point of range = drop / cos(30 deg)
            east = easting + slant * 0.5 * np.sin(direction)
            north = northing + slant * 0.5 * np.cos(direction)
            slant = 0.5 * slant + 0.5 * (-floor_m(east, north, relief_m) - DEPTH_M) / np.cos(
                np.pi / 6
            )
        columns[f"beam{b}_m"] = slant * (1 + 0.01 * rng.standard_normal(rows))
    return columns, easting, northing
