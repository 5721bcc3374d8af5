"""`flags.tif`: the quality flags of the strips' cells on the map, beside it.

A cell of the map bears a flag where most of the data that fell into it do, of all passes together: ground that one
pass saw in shadow and two others saw well is not in shadow. Layover is settled pass by pass: a cell is ambiguous only
where no pass saw it clearly (`mapping.looks`), and a pass in whose shadow it lies heard nothing of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from mapping.cog import Kind
from mapping.gridding import Spacing, Window, spacing_of
from mapping.placed import PlacedStrip, boxes, hull, placed, runs_on
from mapping.rasters import write_bands
from perception.quality import CellFlag
from perception.records import BoolArray, ElevationStrip, FloatArray, Grid, IntArray

# No data, in the file and in arrays of flags.
NO_FLAGS = 255
FLAGS_KIND = Kind("uint8", NO_FLAGS, "nearest")
_BITS = np.array([flag.value for flag in CellFlag], np.uint8)
# first line, last line + 1 -> flags (lines, m) uint8, and where there is a height.
FlagRows = Callable[[int, int], tuple[npt.NDArray[np.uint8], BoolArray]]


def flag_tags() -> dict[str, str]:
    """Return what the bits mean, as tags of the file."""
    return {f"FLAG_{flag.value}": str(flag.name).lower() for flag in CellFlag}


def map_flags(strips: Sequence[ElevationStrip], grid: Grid) -> npt.NDArray[np.uint8]:
    """Return (rows, cols) flags of a map's cells, rows from the north; `NO_FLAGS` where it has no height."""
    row, col = round(grid.south_m / grid.cell_m), round(grid.west_m / grid.cell_m)
    window = Window(row, col, *grid.shape)
    votes = no_votes(window)
    folded, clear = (np.zeros((window.rows, window.cols), bool) for _ in range(2))
    for strip in strips:
        if strip.flags is None:
            continue
        one = placed(strip)
        blocks = boxes(one, grid.cell_m)
        part = hull([box for _, _, box in blocks]).common(window) if blocks else None
        if part is None:
            continue
        own = vote(one, rows_of(strip), blocks, grid.cell_m, part)
        inner = part.within(window)
        votes[inner] = added(votes[inner], own)
        folded[inner] |= mostly(own, CellFlag.AMBIGUOUS)
        clear[inner] |= mostly_clear(own)
    flags = decided(votes, folded & ~clear)[::-1]
    # What the joint method infers beside all data has a height and nothing against it but its sigma.
    flags = np.where(flags == NO_FLAGS, 0, flags)
    return np.where(np.isfinite(grid.elevation_m), flags, NO_FLAGS).astype(np.uint8)


def rows_of(strip: ElevationStrip) -> FlagRows:
    """Return what gives the flags of lines of a strip in memory."""
    flags = np.zeros(strip.echo.shape, np.uint8) if strip.flags is None else strip.flags

    def rows(first: int, last: int) -> tuple[npt.NDArray[np.uint8], BoolArray]:
        return np.asarray(flags[first:last], np.uint8), np.isfinite(strip.elevation_m[first:last])

    return rows


def no_votes(window: Window) -> npt.NDArray[np.uint16]:
    """Return (rows, cols, 1 + flags) counts of data, and of those with each flag, before any is counted."""
    return np.zeros((window.rows, window.cols, 1 + len(_BITS)), np.uint16)


def vote(
    strip: PlacedStrip,
    rows: FlagRows,
    blocks: Sequence[tuple[int, int, Window]],
    cell_m: float,
    window: Window,
) -> npt.NDArray[np.uint16]:
    """Return a strip's flags counted in the cells of a window; its samples are filled in as its heights are."""
    votes = no_votes(window)
    spacing = spacing_of(strip.easting_m, strip.northing_m, strip.across_m, cell_m)
    row0, col0 = strip.anchor(cell_m)
    for first, last in runs_on(blocks, window, len(strip.easting_m)):
        flags, seen = rows(first, last)
        lines = slice(first, last)
        _count(
            flags, seen, (strip.easting_m[lines] - col0 * cell_m) / cell_m,
            (strip.northing_m[lines] - row0 * cell_m) / cell_m, strip.heading_rad[lines],
            strip.across_m / cell_m, _parts(spacing), spacing.gap_m / cell_m,
            window.row - row0, window.col - col0, _BITS, votes,
        )  # fmt: skip
    return votes


def _parts(spacing: Spacing) -> tuple[int, int]:
    return spacing.along_parts, spacing.across_parts


def added(votes: npt.NDArray[np.uint16], more: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """Return the sum of two counts, held at the type's greatest."""
    return np.minimum(votes.astype(np.uint32) + more, 65535).astype(np.uint16)


def mostly(votes: npt.NDArray[np.uint16], *flags: CellFlag) -> BoolArray:
    """Return in which cells (rows, cols) most data bear a flag, or one of several that exclude each other."""
    bearing = np.zeros(votes.shape[:-1], np.int64)
    for flag in flags:
        bearing += votes[..., 1 + int(np.flatnonzero(flag.value == _BITS)[0])]
    return np.asarray(2 * bearing > votes[..., 0])


def mostly_clear(votes: npt.NDArray[np.uint16]) -> BoolArray:
    """Return in which cells (rows, cols) a pass heard one surface: there are data, most neither folded nor in shadow.

    A strip has heights in its shadows too, but they are inferred: no echo speaks for them.
    """
    return (votes[..., 0] > 0) & ~mostly(votes, CellFlag.AMBIGUOUS, CellFlag.SHADOW)


def decided(votes: npt.NDArray[np.uint16], open_: BoolArray) -> npt.NDArray[np.uint8]:
    """Return (rows, cols) the flags that most data of a cell bear; `NO_FLAGS` where there are none.

    `open_` : where a pass's look is ambiguous and no other's is clear: there, not by votes, a cell is ambiguous.
    """
    total = votes[..., 0].astype(np.int64)
    flags = np.zeros(total.shape, np.uint8)
    for k, bit in enumerate(_BITS, start=1):
        flags |= np.where(2 * votes[..., k].astype(np.int64) > total, bit, np.uint8(0))
    flags &= np.uint8(255 - CellFlag.AMBIGUOUS.value)
    flags |= np.where(open_, np.uint8(CellFlag.AMBIGUOUS.value), np.uint8(0))
    return np.where(total > 0, flags, np.uint8(NO_FLAGS)).astype(np.uint8)


def flagged_cells(flags: npt.NDArray[np.uint8]) -> dict[str, int]:
    """Return how many cells bear each flag."""
    known = flags[flags != NO_FLAGS]
    return {str(flag.name).lower(): int(((known & flag.value) > 0).sum()) for flag in CellFlag}


def flag_figures(cells: Mapping[str, int], total: int) -> dict[str, Any]:
    """Return the share of the map that each flag covers, as `metrics.json` names it."""
    return {f"flag_{name}_share": number / max(total, 1) for name, number in cells.items()}


def write_flags(path: Path, flags: npt.NDArray[np.uint8], frame: Grid) -> None:
    """Write `flags.tif`: one band of bits, 255 no data, their meaning in the file's tags."""
    write_bands(path, {"flags": flags}, frame, "uint8", NO_FLAGS, flag_tags())


@numba.njit(cache=True, nogil=True)
def _count(
    flags: npt.NDArray[np.uint8], seen: BoolArray, east: FloatArray, north: FloatArray,
    heading: FloatArray, across: FloatArray, parts: tuple[int, int], gap: float, first_row: int,
    first_col: int, bits: IntArray, votes: npt.NDArray[np.uint16],
) -> None:  # fmt: skip
    """Count flags of lines in the cells of a window, each point between samples as the nearest; places in cells."""
    n, m = flags.shape
    rows, cols, _ = votes.shape
    for i in range(n):
        after = min(i + 1, n - 1)
        along_parts = parts[0]
        if after == i or np.hypot(east[after] - east[i], north[after] - north[i]) > gap:
            along_parts = 1
        turn = np.arctan2(np.sin(heading[after] - heading[i]), np.cos(heading[after] - heading[i]))
        for a in range(along_parts):
            f = a / along_parts
            line = i if f < 0.5 else after
            c, s = np.cos(heading[i] + f * turn), np.sin(heading[i] + f * turn)
            e0 = east[i] + f * (east[after] - east[i]) - first_col
            n0 = north[i] + f * (north[after] - north[i]) - first_row
            for j in range(m):
                across_parts = parts[1] if j + 1 < m else 1
                for b in range(across_parts):
                    g = b / across_parts
                    k = j if g < 0.5 else j + 1
                    x = across[j] if b == 0 else across[j] + g * (across[j + 1] - across[j])
                    row, col = int(np.floor(n0 - s * x)), int(np.floor(e0 + c * x))
                    if not (seen[line, k] and 0 <= row < rows and 0 <= col < cols):
                        continue
                    if votes[row, col, 0] == 65535:
                        continue
                    votes[row, col, 0] += 1
                    for bit in range(len(bits)):
                        if flags[line, k] & bits[bit]:
                            votes[row, col, bit + 1] += 1
