"""Height steps between passes, from the soundings where their tracks cross.

Only there do two passes measure one place by the same simple means, the first return below the sonar. What
a strip says farther out is drawn from its soundings or from shadows and errs by the relief: an offset taken
from there was half a metre off where the truth was none.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from mapping.keyframes import Keyframes
from mapping.pose_graph import HeightStep, Link, Solution
from mapping.quality import crossings
from perception.records import ElevationStrip, FloatArray


def height_steps(
    strips: Sequence[ElevationStrip],
    keyframes: Keyframes,
    solution: Solution,
    links: Sequence[Link] = (),
) -> list[HeightStep]:
    """Return the height step of every crossing of two tracks, with an honest sigma.

    A step is the first pass's sounded height less the second's, as the strips came (without the
    solution's offsets): what must be added to the second, less what must be added to the first. Its
    variance holds both soundings' and the slope of the floor times the place's own uncertainty.

    Parameters
    ----------
    strips : on the track of `solution`.
    links : registrations that `solution` rests on: two passes that were matched near their crossing lie far
        closer to each other than to the truth.
    """
    steps = []
    matched = _matched(links, keyframes)
    for i, j, east, north, line_i, line_j in crossings(strips):
        first, second = int(i), int(j)
        place = np.array([east, north])
        a, b = (
            _sounded(strips[s], int(line), place) for s, line in ((first, line_i), (second, line_j))
        )
        if a is None or b is None:
            continue
        ends = [keyframes.nearest(s, line) for s, line in ((first, line_i), (second, line_j))]
        apart = sum(
            float(np.trace(np.nan_to_num(solution.covariance_m2[k], nan=1e4))) for k in ends
        )
        for k, other, between in matched.get((first, second), ()):
            far = abs(k - ends[0]) + abs(other - ends[1])
            apart = min(apart, between * (1.0 + far))
        slope = _slope(a, b, strips[first], strips[second], int(line_i), int(line_j))
        # Half of the trace: an error in any direction.
        variance = a[1] ** 2 + b[1] ** 2 + 0.5 * apart * float(slope @ slope)
        steps.append(HeightStep(first, second, a[0] - b[0], float(np.sqrt(variance))))
    return steps


def _matched(
    links: Sequence[Link], keyframes: Keyframes
) -> dict[tuple[int, int], list[tuple[int, int, float]]]:
    """Return of each pair of strips the keyframes of its links and the trace (m2) of their covariance."""
    found: dict[tuple[int, int], list[tuple[int, int, float]]] = defaultdict(list)
    for link in links:
        pair = int(keyframes.strip[link.first]), int(keyframes.strip[link.second])
        found[pair].append((link.first, link.second, float(np.trace(link.covariance_m2))))
    return found


def _sounded(
    strip: ElevationStrip, line: int, place: FloatArray
) -> tuple[float, float, float] | None:
    """Return height, sigma and along-track slope of the floor below a track at a place near a line.

    A straight line through the soundings within half an altitude: it evens out their noise and carries
    them to the very crossing.
    """
    heading = float(strip.heading_rad[line])
    along = np.array([np.sin(heading), np.cos(heading)])
    position = np.column_stack([strip.easting_m, strip.northing_m]) - place
    beneath = -(strip.depth_m + strip.altitude_m)
    way = position @ along
    reach = max(0.5 * float(np.nan_to_num(strip.altitude_m[line])), 1.0)
    near = (np.hypot(*position.T) < reach) & np.isfinite(beneath)
    if near.sum() < 2 or np.ptp(way[near]) <= 0:
        return None
    slope, height = np.polyfit(way[near], beneath[near], 1)
    left = beneath[near] - (height + slope * way[near])
    # Soundings of one pass err together over metres: their number does not help, their misfit counts.
    sigma = float(np.hypot(np.median(strip.altitude_sigma_m[near]), left.std()))
    return float(height), sigma, float(slope)


def _slope(
    a: tuple[float, float, float],
    b: tuple[float, float, float],
    first: ElevationStrip,
    second: ElevationStrip,
    line_i: int,
    line_j: int,
) -> FloatArray:
    """Return the floor's gradient (east, north) from the slopes along two crossing tracks."""
    headings = [float(first.heading_rad[line_i]), float(second.heading_rad[line_j])]
    along = np.array([[np.sin(h), np.cos(h)] for h in headings])
    if abs(np.linalg.det(along)) < 0.3:
        return along[0] * a[2]
    gradient: FloatArray = np.linalg.solve(along, np.array([a[2], b[2]]))
    return gradient
