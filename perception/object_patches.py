"""The echo around one shadow, averaged to a workable size, and where the fits to it start."""

from __future__ import annotations

import itertools

import numpy as np
from scipy import ndimage

from perception.fitting import Patch, Starts
from perception.geometry import ground_range
from perception.levels import Levels
from perception.records import FloatArray, IntArray
from perception.shadow_marks import Shadow, Track
from perception.shadows import crater_depth, hill_height

# A patch is averaged down to at most this many lines and bins: the fit's cost is their product.
_PATCH_LINES, _PATCH_BINS = 24, 110
# Many looks would make the fit surer than the family of shapes is true, and the priors mute.
_MOST_WEIGHT = 1.0


def cut_patch(
    shadow: Shadow,
    marks: IntArray,
    ratio: FloatArray,
    levels: Levels,
    sample_m: float,
    track: Track,
    side: int,
    beam_rad: float = 0.0,
) -> Patch:
    """Cut the echo around a shadow: one length to either side in range, half a width along."""
    n, m = ratio.shape
    length = shadow.col1 - shadow.col0
    width = shadow.row1 - shadow.row0
    row0, row1 = max(0, shadow.row0 - width // 2 - 3), min(n, shadow.row1 + width // 2 + 3)
    margin = max(length, 12)
    col0, col1 = max(0, shadow.col0 - margin), min(m, shadow.col1 + margin)
    tall = max(1, -(-(row1 - row0) // _PATCH_LINES))
    wide = max(1, -(-(col1 - col0) // _PATCH_BINS))
    row1 = row0 + max(1, (row1 - row0) // tall) * tall
    col1 = col0 + max(1, (col1 - col0) // wide) * wide
    cut = ratio[row0:row1, col0:col1].astype(float)
    others = (marks[row0:row1, col0:col1] > 0) & (marks[row0:row1, col0:col1] != shadow.number)
    sizes_matter = ndimage.binary_opening(others, np.ones((2, 2)))
    cut[ndimage.binary_dilation(sizes_matter, np.ones((3, 5)))] = np.nan
    blocks = cut.reshape((row1 - row0) // tall, tall, (col1 - col0) // wide, wide)
    known = np.isfinite(blocks)
    count = known.sum(axis=(1, 3))
    mean = np.where(known, blocks, 0).sum(axis=(1, 3)) / np.maximum(count, 1)
    # A cell of which half is missing would weigh as a whole one: leave it out.
    mean = np.where(2 * count >= tall * wide, mean, np.nan)
    independent = min(1.0, levels.independent * wide) if wide > 1 else levels.independent
    weight = levels.looks * independent * tall * (wide if levels.independent == 1 else 1.0)
    lines = np.s_[row0:row1]
    drop = track.altitude_m[lines].reshape(-1, tall).mean(axis=1)
    # Close to nadir the nominal level says nothing: the floor's bins there are as long as an object.
    slant = (col0 + (np.arange(mean.shape[1]) + 0.5) * wide) * sample_m
    mean[slant < 1.03 * drop[:, None]] = np.nan
    # Headings count clockwise: to starboard a turn to the right looks astern. How far the course itself lies off
    # them (a crab angle, a compass's error) shears the picture by little and is left out.
    heading = np.unwrap(track.heading_rad[lines]).reshape(-1, tall).mean(axis=1)
    yaw = -side * (heading - heading.mean())
    return Patch(
        ratio=np.ascontiguousarray(mean),
        # To a micrometre: the last digit of a place must not decide where a climb ends.
        along_m=np.round(track.along_m[lines].reshape(-1, tall).mean(axis=1), 6),
        drop_m=np.round(drop, 6),
        start_m=col0 * sample_m,
        step_m=wide * sample_m,
        weight=float(np.clip(weight, 0.2, _MOST_WEIGHT)),
        leak=levels.shadow_level,
        yaw_rad=np.round(yaw, 9),
        beam_rad=beam_rad,
    )


def first_guesses(
    shadow: Shadow, start_m: float, end_m: float, drop: float, track: Track
) -> Starts:
    """Return starting points of the fit: bumps and pits, short and long, smooth and steep."""
    y0, half = shadow.along_extent(track)
    x_start = float(ground_range(np.array(start_m), np.array(drop)))
    high = float(hill_height(end_m - start_m, start_m, drop))
    deep = float(crater_depth(end_m - start_m, start_m, drop))
    outlines = ((1.0, 2.0), (2.0, 2.0), (5.0, 2.0), (2.0, 4.0), (5.0, 4.0))
    choices = np.array([
        (size, beta, lag, corner)
        for size, lag, (beta, corner) in itertools.product((0.4, 0.7, 1.1, 1.7), (0.1, 0.6), outlines)
    ])  # fmt: skip
    size_x, beta, lag, corner = choices.T
    sx, sy = size_x * half, np.where(beta == 1.0, 0.8, 0.95) * half
    # The grazing point lies `lag` sizes behind the summit; lower by the shape's fall to there.
    hill = x_start - lag * sx, high * np.exp(0.5 * lag ** (2 * beta))
    # A pit's near rim lies a size and more before its centre.
    rim = x_start + np.where(beta == 1.0, 1.6, 1.1) * sx * (0.7 + 0.6 * lag)
    pit = rim, np.full(len(lag), 1.25 * deep)
    parameters = [
        np.stack([x0, np.full(len(sx), y0), *np.log([extreme, sx, sy, beta]),
                  np.full(len(sx), np.log(1.8)), *np.zeros((3, len(sx)))], axis=1)
        for x0, extreme in (hill, pit)
    ]  # fmt: skip
    sign = np.repeat([1.0, -1.0], len(choices))
    return Starts(sign, np.tile(corner, 2), np.concatenate(parameters))
