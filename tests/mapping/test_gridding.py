"""Gridding: a plain twin agrees, windows agree with the whole to the bit, missing data fill nothing."""

from __future__ import annotations

import numpy as np
import pytest

from mapping.gridding import COUNT, HEIGHT, POINTS, WEIGHT, Spacing, Window, bin_lines
from perception.records import FloatArray


def some_lines(rng: np.random.Generator, n: int = 30, m: int = 21) -> dict[str, FloatArray]:
    heading = 0.4 + 0.02 * np.arange(n)
    height = rng.normal(-30.0, 1.0, (n, m)).astype(np.float32)
    height[rng.random((n, m)) < 0.1] = np.nan
    sigma = rng.uniform(0.1, 0.4, (n, m)).astype(np.float32)
    sigma[n // 2, 7] = 0.0
    return {
        "height_m": height, "sigma_m": sigma,
        "easting_m": 5000.0 + np.cumsum(0.9 * np.sin(heading)),
        "northing_m": 7000.0 + np.cumsum(0.9 * np.cos(heading)),
        "heading_rad": heading, "across_m": np.linspace(-8.0, 8.0, m),
        "position_m2": rng.uniform(0.0, 0.2, n),
    }  # fmt: skip


def plain(
    lines: dict[str, FloatArray], spacing: Spacing, cell: float, window: Window
) -> FloatArray:
    """Do the same point by point, as the definition has it."""
    sums = np.zeros((window.rows, window.cols, 5))
    z, var, n = (
        lines["height_m"].astype(float),
        lines["sigma_m"].astype(float) ** 2,
        len(lines["easting_m"]),
    )
    z = np.where(var > 0, z, np.nan)
    for i in range(n):
        k = min(i + 1, n - 1)
        for a in range(spacing.along_parts if k > i else 1):
            f = a / spacing.along_parts

            def mixed(values: FloatArray, f: float = f, i: int = i, k: int = k) -> FloatArray:
                return values[i] if f == 0 else (1 - f) * values[i] + f * values[k]

            heading, east, north = (
                mixed(lines[x]) for x in ("heading_rad", "easting_m", "northing_m")
            )
            line_z, line_var = mixed(z), mixed(var)
            for j in range(len(lines["across_m"])):
                for b in range(spacing.across_parts):
                    g = b / spacing.across_parts
                    if g > 0 and j + 1 == len(lines["across_m"]):
                        continue

                    def across(values: FloatArray, g: float = g, j: int = j) -> float:
                        return values[j] if g == 0 else (1 - g) * values[j] + g * values[j + 1]

                    height, x = across(line_z), across(lines["across_m"])
                    row = int(np.floor((north - np.sin(heading) * x) / cell)) - window.row
                    col = int(np.floor((east + np.cos(heading) * x) / cell)) - window.col
                    if np.isfinite(height) and 0 <= row < window.rows and 0 <= col < window.cols:
                        w = 1.0 / across(line_var)
                        true_datum = float(f == 0 and g == 0)
                        sums[row, col] += [
                            w,
                            w * height,
                            1.0,
                            w * lines["position_m2"][i],
                            true_datum,
                        ]
    return sums


@pytest.mark.parametrize("spacing", [Spacing(1, 1, 9.0), Spacing(3, 2, 9.0)])
def test_the_kernel_does_what_the_definition_says(spacing: Spacing) -> None:
    lines = some_lines(np.random.default_rng(0))
    window = Window(6990, 4992, 50, 40)
    sums = bin_lines(**lines, spacing=spacing, cell_m=1.0, window=window, anchor=(7000, 5000))
    expected = plain(lines, spacing, 1.0, window)
    assert expected[..., COUNT].sum() > 400
    np.testing.assert_allclose(sums, expected, rtol=1e-9, atol=1e-9)


def test_any_window_gives_its_cells_the_same_bits() -> None:
    lines = some_lines(np.random.default_rng(1))
    whole = Window(6990, 4992, 50, 40)
    common = {"spacing": Spacing(3, 4, 9.0), "cell_m": 1.0, "anchor": (7000, 5000)}
    everything = bin_lines(**lines, window=whole, **common)  # type: ignore[arg-type]
    for part in (Window(6995, 5000, 7, 5), Window(7003, 4992, 30, 11), Window(6990, 5004, 50, 1)):
        sums = bin_lines(**lines, window=part, **common)  # type: ignore[arg-type]
        np.testing.assert_array_equal(sums, everything[part.within(whole)])


def test_a_gap_between_lines_is_not_bridged() -> None:
    lines = some_lines(np.random.default_rng(2), n=2)
    lines["northing_m"][1] += 20.0
    window = Window(6980, 4980, 70, 50)
    common = {"cell_m": 1.0, "window": window, "anchor": (7000, 5000)}
    apart = bin_lines(**lines, spacing=Spacing(30, 1, 5.0), **common)  # type: ignore[arg-type]
    bridged = bin_lines(**lines, spacing=Spacing(30, 1, 50.0), **common)  # type: ignore[arg-type]
    assert apart[..., POINTS].sum() == apart[..., COUNT].sum()
    assert (bridged[..., WEIGHT] > 0).sum() > 3 * (apart[..., WEIGHT] > 0).sum()


def test_sums_are_added_to_what_is_there() -> None:
    lines = some_lines(np.random.default_rng(3))
    common = {
        "spacing": Spacing(1, 1, 9.0), "cell_m": 1.0, "window": Window(6990, 4992, 50, 40),
        "anchor": (7000, 5000),
    }  # fmt: skip
    once = bin_lines(**lines, **common)  # type: ignore[arg-type]
    twice = bin_lines(**lines, **common, sums=once.copy())  # type: ignore[arg-type]
    np.testing.assert_allclose(twice[..., HEIGHT], 2 * once[..., HEIGHT])
