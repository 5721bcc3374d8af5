"""A strip's texture gathered on the grid of one square, channel by channel."""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

from mapping.textures import OF_PORT, OF_STARBOARD, SEEN, Texture
from perception.records import FloatArray

# Channels of the grid, in the order of its first axis.
RELIEF, PORT, STARBOARD, OBJECTS = range(4)


def gather(
    texture: Texture, corner: tuple[float, float], cell_m: float, size: int
) -> tuple[FloatArray, FloatArray, float]:
    """Return the texture on the square's grid (4, size, size), its weights, and its mean heading.

    Row 0 lies south; `corner` is the square's south-west one. Weights count data, those of relief by their own; zero no
    data. Ground seen is not counted for the objects of a strip that shows none.
    """
    strip = texture.strip
    half = 0.5 * size * cell_m
    east, north = strip.easting_m - corner[0] - half, strip.northing_m - corner[1] - half
    along = np.abs(east * np.sin(strip.heading_rad) + north * np.cos(strip.heading_rad))
    near = along < 1.5 * half
    if not near.any():
        nothing = np.zeros((4, size, size), np.float32)
        return nothing, nothing.copy(), 0.0
    rows = slice(int(np.argmax(near)), len(near) - int(np.argmax(near[::-1])))
    heading = strip.heading_rad[rows]
    lines = np.column_stack(
        [
            (strip.easting_m[rows] - corner[0]) / cell_m - 0.5,
            (strip.northing_m[rows] - corner[1]) / cell_m - 0.5,
            np.cos(heading) / cell_m,
            -np.sin(heading) / cell_m,
        ]
    )
    objects = texture.objects
    values, weights = _scatter(
        texture.relief[rows], texture.relief_weight[rows], texture.level[rows], texture.echo[rows],
        lines, texture.across_m[rows], size, texture.relief_share > 0, len(objects) > 0,
    )  # fmt: skip
    if len(objects):
        here = objects[(objects[:, 0] >= rows.start) & (objects[:, 0] < rows.stop)]
        _add_objects(values[OBJECTS], here, lines, texture.across_m, rows.start)
    _divide(values, weights)
    turned = strip.heading_rad[near]
    return values, weights, float(np.arctan2(np.sin(turned).mean(), np.cos(turned).mean()))


@numba.njit(cache=True, nogil=True)
def _scatter(
    relief: FloatArray,
    relief_weight: FloatArray,
    level: FloatArray,
    echo: npt.NDArray[np.uint8],
    lines: FloatArray,
    across: FloatArray,
    size: int,
    with_relief: bool,
    with_objects: bool,
) -> tuple[FloatArray, FloatArray]:
    """Return sums of weight times value and of weights, (4, size, size) each; no sums of objects.

    Each datum is shared among the four cells around it: given whole to one cell, a regular lattice of data
    on a regular grid beats, and every match is off by up to half a datum's spacing. `lines` are each line's place in
    cells, column and row, and what they gain a metre to starboard.
    """
    total = np.zeros((4, size, size), np.float32)
    weight = np.zeros((4, size, size), np.float32)
    n, m = level.shape
    most = float(size - 1)
    for i in range(n):
        column, row, per_column, per_row = lines[i]
        # Across the track the line is inside the square between `low` and `high`.
        low, high = -np.inf, np.inf
        for at, per in ((column, per_column), (row, per_row)):
            if per != 0.0:
                one, other = -at / per, (most - at) / per
                low, high = max(low, min(one, other)), min(high, max(one, other))
            elif not 0.0 <= at < most:
                high = -np.inf
        if low > high:
            continue
        for j in range(m):
            a = across[i, j]
            if not low <= a <= high:
                continue
            x, y = column + per_column * a, row + per_row * a
            if not (0.0 <= x < most and 0.0 <= y < most):
                continue
            c, r = int(x), int(y)
            fx, fy = np.float32(x - c), np.float32(y - r)
            gx, gy = np.float32(1.0) - fx, np.float32(1.0) - fy
            w00, w01, w10, w11 = gy * gx, gy * fx, fy * gx, fy * fx
            if with_relief:
                w = relief_weight[i, j]
                if w > 0:
                    _share(
                        total[RELIEF],
                        weight[RELIEF],
                        r,
                        c,
                        w * w00,
                        w * w01,
                        w * w10,
                        w * w11,
                        relief[i, j],
                    )
            kind = echo[i, j]
            if kind & OF_PORT:
                _share(total[PORT], weight[PORT], r, c, w00, w01, w10, w11, level[i, j])
            elif kind & OF_STARBOARD:
                _share(total[STARBOARD], weight[STARBOARD], r, c, w00, w01, w10, w11, level[i, j])
            if with_objects and kind & SEEN:
                weight[OBJECTS, r, c] += w00
                weight[OBJECTS, r, c + 1] += w01
                weight[OBJECTS, r + 1, c] += w10
                weight[OBJECTS, r + 1, c + 1] += w11
    return total, weight


@numba.njit(cache=True, nogil=True, inline="always")
def _share(
    total: FloatArray, weight: FloatArray, r: int, c: int, w00: float, w01: float, w10: float,
    w11: float, value: float,
) -> None:  # fmt: skip
    """Add a datum to the four cells around it."""
    weight[r, c] += w00
    weight[r, c + 1] += w01
    weight[r + 1, c] += w10
    weight[r + 1, c + 1] += w11
    total[r, c] += w00 * value
    total[r, c + 1] += w01 * value
    total[r + 1, c] += w10 * value
    total[r + 1, c + 1] += w11 * value


def _add_objects(
    total: FloatArray, objects: FloatArray, lines: FloatArray, across: FloatArray, first: int
) -> None:
    """Share each object among the four cells around it."""
    line, column = objects[:, 0].astype(int), objects[:, 1].astype(int)
    at = lines[line - first]
    aside = across[line, column]
    x, y = at[:, 0] + at[:, 2] * aside, at[:, 1] + at[:, 3] * aside
    most = len(total) - 1
    inside = (x >= 0) & (x < most) & (y >= 0) & (y < most)
    x, y, value = x[inside], y[inside], objects[inside, 2]
    c, r = x.astype(int), y.astype(int)
    for dy in (0, 1):
        for dx in (0, 1):
            part = np.abs(1 - dx - (x - c)) * np.abs(1 - dy - (y - r))
            np.add.at(total, (r + dy, c + dx), (part * value).astype(np.float32))


@numba.njit(cache=True, nogil=True)
def _divide(values: FloatArray, weights: FloatArray) -> None:
    """Turn sums into means, in place."""
    for k in range(values.shape[0]):
        for r in range(values.shape[1]):
            for c in range(values.shape[2]):
                if weights[k, r, c] > 0:
                    values[k, r, c] /= weights[k, r, c]
