"""Objects and craters: shadows joined over consecutive pings, each with height, sigma and footprint.

Shadow labels that touch form a candidate; the echo around it is fitted with a bump and with a pit
(`perception.silhouettes`), and the better of the two gives kind, height above the surrounding floor, and
footprint. Where neither explains the shadow (a wreck, a mast), the paper's own relation over the shadow's
pings stands in, with a wider sigma. What the floor's own relief may have cast is told by its probability.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from perception.contours import Roughness
from perception.fitting import BumpFit, fit_patch
from perception.geometry import ground_range
from perception.levels import Levels
from perception.object_patches import cut_patch, first_guesses
from perception.object_table import ObjectRow, ObjectTable, write_objects_csv
from perception.records import FloatArray, IntArray
from perception.shadow_marks import Shadow, Track, darkness, find_shadows, order_evidence
from perception.shadows import crater_depth, crater_sigma, hill_height, hill_sigma
from perception.standing import object_odds, probabilities

__all__ = [
    "ObjectConfig", "ObjectRow", "ObjectTable", "Track", "find_objects", "listed_objects", "write_objects_csv",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class ObjectConfig:
    """Settings of the search for objects.

    Attributes
    ----------
    min_samples, min_pings, min_cells : least shadow: samples in range of its longest ping, pings, and
        samples altogether.
    min_gain : least log likelihood over a flat floor of an object, natural log units.
    min_probability : shadows less likely an object's than this are left to the floor's relief.
    shape_sigma : what the family of shapes leaves open, as a part of the height.
    fits, fits_per_ping : at most ``fits + fits_per_ping * pings`` shadows a side, the largest, are fitted;
        on a floor strewn with shadows the rest are measured by the plain relation, which is quick, and
        those below `plain_cells` samples are left out.
    beam_deg : width of the horizontal beam, two-way between its -3 dB points; few files tell it, and most
        side-scans have some 1 degree one-way.
    """

    min_samples: int = 6
    min_pings: int = 2
    min_cells: int = 20
    min_gain: float = 30.0
    min_probability: float = 0.5
    shape_sigma: float = 0.03
    fits: int = 30
    fits_per_ping: float = 0.025
    plain_cells: int = 60
    beam_deg: float = 0.7


# The footprint is known after the fit alone; before it a shadow of smaller odds is given up, whatever adjoins it.
_HOPELESS, _EVEN_SIGMA = 0.11, 3.0
# Beyond this many standard deviations the order of levels alone settles the kind; below, each counts for this
# much log likelihood.
_SURE_ORDER, _ORDER_WEIGHT = 3.0, 3.0
# A shadow that runs out of the swath proves a least height; how much higher it may be, as a part of it.
_OPEN_SPREAD = 0.7
# Of a Gaussian, the width between half powers over its 1-sigma.
_FULL_WIDTH = 2.355


@dataclass(frozen=True, slots=True)
class _Side:
    """One side of a pass: what every shadow of it is measured with."""

    side: int
    marks: IntArray
    ratio: FloatArray
    levels: Levels
    sample_m: float
    track: Track
    roughness: Roughness | None
    ground: Roughness | None
    config: ObjectConfig


@dataclass(frozen=True, slots=True)
class _Edges:
    """A shadow's longest line: start and end (slant), the sonar's height there and its 1-sigma.

    `floor_sigma_m` is that of the floor at the shadow's end against the floor below the sonar.
    """

    start_m: float
    end_m: float
    drop_m: float
    drop_sigma_m: float
    floor_sigma_m: float

    @property
    def length_m(self) -> float:
        return self.end_m - self.start_m

    def proved_m(self, hill: bool) -> float:
        """Return the height that the plain relation reads from the shadow."""
        relation = hill_height if hill else crater_depth
        return float(relation(self.length_m, self.start_m, self.drop_m))


def find_objects(
    ratio: FloatArray,
    levels: Levels,
    sample_m: float,
    side: int,
    track: Track,
    pass_index: int,
    roughness: Roughness | None = None,
    ground: Roughness | None = None,
    config: ObjectConfig | None = None,
) -> list[ObjectRow]:
    """Find what may be objects and craters of one side of a pass; `listed_objects` says what is listed.

    Parameters
    ----------
    ratio : (n, m) equalised power; NaN no data.
    levels : labels and statistics of the same samples.
    sample_m : range of a sample.
    side : -1 port, 1 starboard.
    roughness : of the floor, against which an object stands out; None takes a flat floor.
    ground : of the floor between objects, which tells what a height's base leaves open; None as `roughness`.

    Returns
    -------
    list of ObjectRow, in order of the pings.
    """
    config = config or ObjectConfig()
    marks, shadows = find_shadows(
        levels.label, ratio, config.min_samples, config.min_pings, config.min_cells
    )
    budget = config.fits + int(config.fits_per_ping * len(ratio))
    least = sorted((shadow.cells for shadow in shadows), reverse=True)[:budget][-1:]
    seen = _Side(
        side, marks, ratio, levels, sample_m, track, roughness, ground or roughness, config
    )
    rows = []
    for shadow in shadows:
        fitted = shadow.cells >= least[0]
        if not fitted and shadow.cells < config.plain_cells:
            continue
        row = _measure(shadow, fitted, seen)
        if row is not None:
            rows.append(_placed(row, side, track, pass_index))
    return rows


def listed_objects(rows: list[ObjectRow], config: ObjectConfig | None = None) -> list[ObjectRow]:
    """Return the candidates of one pass (both sides) that are likelier objects than relief, in order of pings."""
    config = config or ObjectConfig()
    told = probabilities(np.array([row.odds for row in rows]))
    likely = [replace(row, probability=float(p)) for row, p in zip(rows, told, strict=True)]
    return sorted(
        (row for row in likely if row.probability >= config.min_probability),
        key=lambda row: row.ping,
    )


def _measure(shadow: Shadow, fitted: bool, seen: _Side) -> ObjectRow | None:
    """Return height, kind and footprint of one shadow's object, not yet placed on the map."""
    config = seen.config
    edges = _edges(shadow, seen)
    if not edges.start_m > edges.drop_m * 1.0001:
        return None
    order = order_evidence(shadow, seen.ratio, seen.levels.looks * seen.levels.independent)
    dark = darkness(shadow, seen.marks, seen.ratio)
    _, half = shadow.along_extent(seen.track)
    proved = edges.proved_m(hill=order > -_SURE_ORDER)
    if object_odds(proved, 0.7 * half, dark, _EVEN_SIGMA, seen.roughness) < _HOPELESS:
        return None
    fit = None
    # What a shadow without an end proves is a least height: no shape can be read from it.
    if fitted and not shadow.open:
        fit = _fitted(shadow, edges, order, seen)
        if fit is not None and fit.gain < config.min_gain:
            return None
    if fit is not None and _explains(fit, shadow, edges, seen.track):
        return _of_fit(fit, edges, len(shadow.core), (dark, order), seen)
    return _of_shadow(shadow, edges, (dark, order), _fitted_half_m(fit), seen)


def _edges(shadow: Shadow, seen: _Side) -> _Edges:
    peak = shadow.peak_row()
    row = shadow.row0 + peak
    drop = float(seen.track.altitude_m[row])
    start_m, end_m = (int(edge[peak]) * seen.sample_m for edge in (shadow.start, shadow.end))
    floor_sigma = 0.0
    if seen.ground is not None:
        away = np.sqrt(max(end_m**2 - drop**2, 0.0))
        floor_sigma = float(np.sqrt(seen.ground.variogram(np.array(away))))
    drop_sigma = float(np.hypot(seen.track.altitude_sigma_m[row], floor_sigma))
    return _Edges(start_m, end_m, drop, drop_sigma, floor_sigma)


def _fitted(shadow: Shadow, edges: _Edges, order: float, seen: _Side) -> BumpFit | None:
    starts = first_guesses(shadow, edges.start_m, edges.end_m, edges.drop_m, seen.track)
    if abs(order) > _SURE_ORDER:
        starts = starts.take(np.flatnonzero(starts.sign * order > 0))
    patch = cut_patch(
        shadow, seen.marks, seen.ratio, seen.levels, seen.sample_m, seen.track, seen.side,
        float(np.deg2rad(seen.config.beam_deg)) / _FULL_WIDTH,
    )  # fmt: skip
    return fit_patch(patch, starts, favour=_ORDER_WEIGHT * order)


def _explains(fit: BumpFit, shadow: Shadow, edges: _Edges, track: Track) -> bool:
    """Tell whether the fit is an object that the shadow could belong to."""
    x0, y0 = fit.parameters[:2]
    sx, sy = np.exp(fit.parameters[3:5])
    middle, reach = shadow.along_extent(track)
    sigma_log = float(np.sqrt(max(fit.covariance[2, 2], 0)))
    return bool(
        x0 > 0
        and abs(y0 - middle) < 1.5 * reach + sy
        and sy < 4 * reach + 1.0
        and sx < 8 * sy
        and fit.height_m < (0.98 if fit.sign > 0 else 3.0) * edges.drop_m
        and sigma_log < 0.5
        # A summit lies at or above its grazing point; labels reach onto slopes that are merely turned away.
        and fit.height_m > 0.5 * edges.proved_m(fit.sign > 0)
    )


def _of_fit(
    fit: BumpFit, edges: _Edges, pings: int, look: tuple[float, float], seen: _Side
) -> ObjectRow:
    """Return the row of a fitted shape; `look` is the shadow's darkness and its order of levels."""
    x0, y0, _, log_sx, log_sy, log_beta = fit.parameters[:6]
    height, drop = fit.height_m, edges.drop_m
    beta = float(np.exp(log_beta))
    tenth = np.sqrt((2 * np.log(10.0)) ** (1 / beta))
    half_across, half_along = float(np.exp(log_sx) * tenth), float(np.exp(log_sy) * tenth)
    # Heights scale with the sonar's height above the floor; log A has the fit's own sigma.
    relative = np.sqrt(
        fit.covariance[2, 2] + seen.config.shape_sigma**2 + (edges.drop_sigma_m / drop) ** 2
    )
    # How wide the horizontal beam truly is blurs what few pings see.
    relative = np.hypot(relative, 0.06 / max(pings, 1))
    # Nearer than about the altitude the echo folds over itself and is dimmed by slope as much as by shadow:
    # in trials up to a fifth of the height was off there.
    relative = np.hypot(relative, 0.25 * np.clip(1.3 - x0 / drop, 0.0, 0.8))
    half = max(half_across, half_along)
    hill = fit.sign > 0
    ring, end = _relief(half, edges, seen)
    return ObjectRow(
        easting_m=np.nan, northing_m=np.nan, kind="hill" if hill else "crater",
        height_m=height, sigma_m=float(np.sqrt((height * relative) ** 2 + ring**2 + end**2)),
        slant_range_m=edges.start_m, shadow_length_m=edges.length_m, pass_index=0, ping=0,
        across_m=float(x0), along_m=float(y0), half_across_m=half_across, half_along_m=half_along,
        shape=beta, gain=fit.gain, drop_m=drop,
        floor_sigma_m=float(np.hypot(end, height * edges.floor_sigma_m / drop)),
        odds=object_odds(edges.proved_m(hill), half, *look, seen.roughness),
    )  # fmt: skip


def _relief(half_size_m: float, edges: _Edges, seen: _Side) -> tuple[float, float]:
    """Return what the floor's own relief leaves open of a height, around it and at its shadow's end, 1-sigma (m).

    The ring around a footprint, against which a height stands, averages over several differences: half
    the variogram. The floor at the shadow's end lies above or below the object's foot by a difference of its own:
    ``dH = z_end Rs / (Rs + Ls)``.
    """
    if seen.ground is None:
        return 0.0, 0.0
    ground = [float(ground_range(np.array(v), np.array(edges.drop_m))) for v in (edges.start_m, edges.end_m)]  # fmt: skip
    ring, end = seen.ground.variogram(np.array([half_size_m, ground[1] - ground[0]]))
    return float(np.sqrt(0.5 * ring)), float(np.sqrt(2 * end) * edges.start_m / edges.end_m)


def _fitted_half_m(fit: BumpFit | None) -> float:
    """Return the larger half size of a fit that does not explain its shadow: the lie of the land, often."""
    return 0.0 if fit is None else float(np.exp(fit.parameters[3:5]).max())


def _of_shadow(
    shadow: Shadow, edges: _Edges, look: tuple[float, float], land_m: float, seen: _Side
) -> ObjectRow:
    """Measure by the paper's relation: order of levels for the kind, the longest shadow for the height.

    `look` is the shadow's darkness and its order of levels; `land_m` the half size of what the fit took the shadow
    for; relief of that size may have cast it.
    """
    # Beyond the swath's edge no highlight could be seen: a shadow that leaves it counts as a hill's.
    hill = shadow.open or look[1] > 0
    height = edges.proved_m(hill)
    spread = hill_sigma if hill else crater_sigma
    sigma = float(
        spread(edges.length_m, edges.start_m, edges.drop_m, seen.sample_m, edges.drop_sigma_m)
    )
    # The shape is not known here: a smooth summit lies above its grazing point.
    sigma = float(np.hypot(sigma, 0.15 * height))
    if shadow.open:
        room = max(edges.drop_m - height, 0.0) / np.sqrt(3) if hill else np.inf
        sigma = float(np.hypot(sigma, min(_OPEN_SPREAD * height, room)))
    x_start, x_end = (
        float(ground_range(np.array(v), np.array(edges.drop_m)))
        for v in (edges.start_m, edges.end_m)
    )
    middle, half = shadow.along_extent(seen.track)
    half_across = min(half, 0.5 * (x_end - x_start))
    # A footprint that no fit has told may be as long as a good part of its shadow.
    land_m = max(land_m, half, half_across, 0.4 * (x_end - x_start))
    return ObjectRow(
        easting_m=np.nan, northing_m=np.nan, kind="hill" if hill else "crater", height_m=height,
        sigma_m=sigma, slant_range_m=edges.start_m, shadow_length_m=edges.length_m,
        pass_index=0, ping=0, across_m=x_start if hill else 0.5 * (x_start + x_end),
        along_m=middle, half_across_m=half_across, half_along_m=half, lower_bound=shadow.open,
        drop_m=edges.drop_m, floor_sigma_m=edges.floor_sigma_m * edges.length_m / edges.end_m,
        odds=object_odds(height, land_m, *look, seen.roughness),
    )  # fmt: skip


def _placed(row: ObjectRow, side: int, track: Track, pass_index: int) -> ObjectRow:
    """Give a row its place on the map and its ping."""
    line = int(np.clip(np.searchsorted(track.along_m, row.along_m), 0, len(track.along_m) - 1))
    if line > 0 and row.along_m - track.along_m[line - 1] < track.along_m[line] - row.along_m:
        line -= 1
    across = side * row.across_m
    ahead = row.along_m - track.along_m[line]
    heading = float(track.heading_rad[line])
    course = _course(track, line)
    return replace(
        row,
        easting_m=float(track.easting_m[line] + np.cos(heading) * across + np.sin(course) * ahead),
        northing_m=float(
            track.northing_m[line] - np.sin(heading) * across + np.cos(course) * ahead
        ),
        across_m=across,
        ping=int(track.ping[line]),
        pass_index=pass_index,
    )


def _course(track: Track, line: int) -> float:
    """Return the course over ground about a line, from positions some pings apart."""
    low, high = max(0, line - 10), min(len(track.along_m) - 1, line + 10)
    east = track.easting_m[high] - track.easting_m[low]
    north = track.northing_m[high] - track.northing_m[low]
    if np.hypot(east, north) == 0:
        return float(track.heading_rad[line])
    return float(np.arctan2(east, north))
