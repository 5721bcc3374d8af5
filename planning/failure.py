"""Why there is no route: which limit blocks, where, and what would open a way.

The least-breaking path is found first: the one that pays least for what it must break. Where it breaks
is the place that blocks, and how much it breaks is the relaxation that would open it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from perception.records import BoolArray, FloatArray, IntArray
from planning.bars import bar_of
from planning.curve import waypoints
from planning.field import search
from planning.polish import RADIUS_RESERVE, Candidate, polish, respace, rules_of
from planning.profile import cone_envelope, make_work, path_cost
from planning.surface import BAR, BOTTOM, LOWER, WEIGHT, Surface

# Price of a metre through barred ground: a detour of a hundred times a wall's thickness is taken first.
_WALL_PRICE = 100.0
# What the proof may add to a planned height (m) when a relaxation is named.
_HAIR_M = 0.3
# What planning keeps in reserve between two limits that meet (m).
_ROOM_M = 0.1
# A breach (m^2) that touches a barred corner between samples, and is none.
_TINY = 1e-3
# So far above the ceiling that it limits nothing (m).
_NO_CEILING_M = 1e4


@dataclass(frozen=True, slots=True)
class Blockage:
    """The place that blocks and the way out.

    Attributes
    ----------
    reason : one line for the user.
    limit : name of the limit that blocks, or "barred".
    place : (easting, northing) of what blocks.
    path : (n, 2) easting, northing of the least-breaking path.
    height_m : (n,) height along it, `bottom_m` the bottom below it.
    opens : limit to the value that would open that path, each on its own.
    """

    reason: str
    limit: str
    place: tuple[float, float]
    path: FloatArray
    height_m: FloatArray
    bottom_m: FloatArray
    opens: dict[str, float] = field(default_factory=dict)


def explain_barrier(surface: Surface, source: tuple[int, int], target: tuple[int, int]) -> Blockage:
    """Explain why barred ground parts two nodes: find the thinnest way through it."""
    stack = surface.stack.copy()
    stack[..., WEIGHT] += np.where(surface.barred, _WALL_PRICE, 0.0).astype(np.float32)
    open_all = replace(surface, stack=stack, barred=np.zeros_like(surface.barred))
    nodes = search(open_all, source, target, 16).path(*target)
    blocked = surface.barred[nodes[:, 0], nodes[:, 1]]
    if not blocked.any():
        # The grid slips between two barred corners; the pair beside the step is what bars it.
        blocked = stack[nodes[:, 0], nodes[:, 1], BAR] > 0
        blocked |= _beside(surface, nodes)
    first = int(np.argmax(blocked))
    last = first
    while last + 1 < len(nodes) and blocked[last + 1]:
        last += 1
    x, y = nodes[:, 1] * surface.cell_m[0], nodes[:, 0] * surface.cell_m[1]
    easting, northing = surface.world(x, y)
    place = (float(easting[(first + last) // 2]), float(northing[(first + last) // 2]))
    thick = float(np.hypot(*(nodes[last] - nodes[first]) * np.array(surface.cell_m[::-1])))
    reason = (
        f"barred ground parts start and goal; the thinnest way through is {thick + min(surface.cell_m):.0f} m "
        f"at {place[0]:.1f},{place[1]:.1f}, {_what_bars(surface, nodes[first : last + 1])}"
    )
    return Blockage(
        reason, "barred", place, np.column_stack([easting, northing]),
        stack[nodes[:, 0], nodes[:, 1], LOWER].astype(float),
        stack[nodes[:, 0], nodes[:, 1], BOTTOM].astype(float),
    )  # fmt: skip


def _beside(surface: Surface, nodes: IntArray) -> BoolArray:
    rows, cols = surface.shape
    out = np.zeros(len(nodes), bool)
    for i, (r, c) in enumerate(nodes):
        out[i] = surface.barred[
            max(0, r - 1) : min(rows, r + 2), max(0, c - 1) : min(cols, c + 2)
        ].any()
    return out


def _what_bars(surface: Surface, wall: IntArray) -> str:
    """Say what bars the middle node of a wall, and what would open all (n, 2) nodes of it."""
    limits = surface.limits
    row, col = (int(v) for v in wall[len(wall) // 2])
    bottoms, lowers = (
        surface.bottom_m[wall[:, 0], wall[:, 1]],
        surface.lower_m[wall[:, 0], wall[:, 1]],
    )
    bottom, lower = surface.bottom_m[row, col], surface.lower_m[row, col]
    bar = bar_of(surface, row, col)
    if bar == "shallow":
        room = surface.top_m - bottom
        if room <= 0:
            return f"where the ground stands {-room:.1f} m above the water: nothing opens it"
        floor = limits.floor_m - (float(np.nanmax(lowers)) - surface.top_m) - _ROOM_M
        way = "nothing opens it" if floor < 0 else f"a floor_m of {_below(floor):g} opens it"
        return (
            f"where only {room:.1f} m of water stand over the ground and floor and k sigma need "
            f"{lower - bottom:.1f} m: {way}"
        )
    if bar == "deep":
        need = -float(np.nanmin(bottoms)) - limits.ceiling_m + _ROOM_M
        return f"deeper than depth_max_m: a depth_max_m of {_above(need):g} opens it"
    if bar == "ceiling":
        need = float(np.nanmax(lowers - bottoms)) + _ROOM_M
        return (
            f"where floor and k sigma need {need:.1f} m of altitude: a ceiling_m of {_above(need):g} "
            "or a higher --risk opens it"
        )
    return {
        "no data": "where the map has no data: survey or fill it",
        "no sigma": "where the map has no sigma: give --map-sigma",
        "current": "where the current is as strong as the vehicle: a higher speed_m_s opens it",
        "no-go": "in a no-go area or on an object of unknown height: leave it out or move an end",
    }[bar]


def _above(value: float) -> float:
    """Round up to a tenth: a limit named as the way out must be one."""
    return math.ceil(value * 10.0 - 1e-9) / 10.0


def _below(value: float) -> float:
    return math.floor(value * 10.0 + 1e-9) / 10.0


def explain_limits(
    surface: Surface, tries: list[Candidate], guide: FloatArray, problem: str
) -> Blockage:
    """Explain which of the vehicle's limits blocks, from the least-breaking candidates.

    Each limit is given up in turn: the one without which the path breaks nothing is the one that
    blocks. Then the least value that would do is found on that path.
    """
    best = min(tries, key=lambda c: c.breach)
    without_turn = replace(surface, limits=replace(surface.limits, turn_radius_m=0.0))
    narrow = respace(guide, 2.0 * min(surface.cell_m))
    straightened = min(
        (
            polish(without_turn, points, sweeps=30, rounds=1, fineness=2.0)
            for points in (best.points, narrow)
        ),
        key=lambda c: c.breach,
    )
    lifted = _least_lifted(surface, tries)
    if surface.limits.turn_radius_m > 0 and straightened.breach < _TINY:
        turning = _turn_blocks(surface, straightened)
        # A vehicle that turns on the spot can zigzag up any wall's face: where a ceiling would do as well,
        # a radius far below the vehicle's is no way out.
        if lifted is None or turning.opens["turn_radius_m"] >= 0.3 * surface.limits.turn_radius_m:
            return turning
    return _climb_blocks(surface, best if lifted is None else lifted, problem)


def _least_lifted(surface: Surface, tries: list[Candidate]) -> Candidate | None:
    """Return the plain path, every other limit kept, that needs the least ceiling; None without."""
    limits = surface.limits
    open_top = replace(surface, limits=replace(limits, ceiling_m=limits.ceiling_m + _NO_CEILING_M))
    lifted = []
    # Skimming a wall's face needs less ceiling than crossing it, but a fresh plan need not find that path:
    # what is named is what the plain way over needs.
    for candidate in tries[:2]:
        free = polish(open_top, candidate.points, sweeps=25, rounds=2, source=candidate.source)
        if free.breach <= _TINY:
            _, _, _, upper, z = _profile_along(surface, free.points)
            lifted.append((float((z - upper).max()), free))
    return min(lifted, key=lambda pair: pair[0])[1] if lifted else None


def _profile_along(
    surface: Surface, points: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return (xy, distance, lower, upper, height) along the rounded polygon, a cell apart."""
    step = min(surface.cell_m)
    xy = waypoints(points, surface.limits.turn_radius_m * RADIUS_RESERVE, 0.5 * step)
    work, hull = make_work(len(xy))
    path_cost(
        surface.stack, surface.cell_m[0], surface.cell_m[1],
        np.ascontiguousarray(xy[:, 0]), np.ascontiguousarray(xy[:, 1]), len(xy),
        rules_of(surface), work, hull,
    )  # fmt: skip
    return xy, work[:, 0].copy(), work[:, 1].copy(), work[:, 2].copy(), work[:, 3].copy()


def _climb_blocks(surface: Surface, candidate: Candidate, problem: str) -> Blockage:
    limits = surface.limits
    xy, s, lower, upper, z = _profile_along(surface, candidate.points)
    rules = rules_of(surface)
    cone_envelope(s, lower, len(s), rules[1], rules[2], z)
    easting, northing = surface.world(xy[:, 0], xy[:, 1])
    excess = z - upper
    worst = int(np.argmax(excess))
    # The cone on the worst place stands on the ground that forces it up.
    reach = np.where(s >= s[worst], rules[1] * (s - s[worst]), rules[2] * (s[worst] - s))
    forcing = int(np.argmax(lower - reach))
    place = (float(easting[forcing]), float(northing[forcing]))
    need = limits.ceiling_m + float(excess[worst])
    way = (
        f"climb to {lower[forcing]:.1f} m"
        if forcing >= worst
        else f"dive from {lower[forcing]:.1f} m"
    )
    pitch = _pitch_that_opens(s, lower, upper, surface)
    name = "pitch_up_deg" if forcing >= worst else "pitch_down_deg"
    now = limits.pitch_up_deg if forcing >= worst else limits.pitch_down_deg
    opens: dict[str, float] = {}
    if excess[worst] <= 0:
        reason = f"no path found that keeps every limit ({problem}); a smaller turn_radius_m may open one"
    else:
        steep = math.degrees(math.atan(_steepest(s, lower, forcing)))
        opens["ceiling_m"] = math.ceil((need + _HAIR_M) * 10) / 10
        if math.isfinite(pitch):
            opens[name] = math.ceil(pitch)
        reason = (
            f"ceiling and pitch block at {place[0]:.1f},{place[1]:.1f}: the {way} there (ground up to "
            f"{steep:.0f} deg) at {now:g} deg of pitch lifts the vehicle to {need:.1f} m above the bottom "
            f"at {easting[worst]:.1f},{northing[worst]:.1f}; "
            + " or ".join(f"a {key} of {value:g}" for key, value in opens.items())
            + " opens it"
        )
    return Blockage(
        reason, "ceiling_m", place, np.column_stack([easting, northing]), z,
        upper - limits.ceiling_m, opens,
    )  # fmt: skip


def _steepest(s: FloatArray, lower: FloatArray, at: int) -> float:
    near = slice(max(0, at - 10), min(len(s), at + 11))
    slope = np.diff(lower[near]) / np.maximum(np.diff(s[near]), 1e-9)
    return float(np.abs(slope).max(initial=0.0))


def _pitch_that_opens(
    s: FloatArray, lower: FloatArray, upper: FloatArray, surface: Surface
) -> float:
    """Return the least pitch, up and down alike, at which the path keeps its ceiling; infinite if none."""
    z = np.empty(len(s))

    def fits(pitch_deg: float) -> bool:
        slope = math.tan(math.radians(pitch_deg))
        cone_envelope(s, lower, len(s), slope, slope, z)
        return bool((z <= upper).all())

    low, high = max(surface.limits.pitch_up_deg, surface.limits.pitch_down_deg), 89.0
    if not fits(high):
        return math.inf
    while high - low > 0.25:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if fits(middle) else (middle, high)
    return high


def _turn_blocks(surface: Surface, candidate: Candidate) -> Blockage:
    """Find the greatest radius that opens a way, and the bend that needs it."""
    limits = surface.limits
    low, high, opened = 0.0, limits.turn_radius_m, candidate
    for _ in range(4):
        middle = 0.5 * (low + high)
        eased = replace(surface, limits=replace(limits, turn_radius_m=middle))
        tried = polish(eased, opened.points, sweeps=30, rounds=1, fineness=2.0)
        if tried.breach < _TINY:
            low, opened = middle, tried
        else:
            high = middle
    eased = replace(surface, limits=replace(limits, turn_radius_m=low))
    xy, _, _, upper, z = _profile_along(eased, opened.points)
    easting, northing = surface.world(xy[:, 0], xy[:, 1])
    bend = _sharpest(opened.points)
    place_e, place_n = surface.world(opened.points[bend, 0], opened.points[bend, 1])
    place = (float(place_e), float(place_n))
    reason = (
        f"turn_radius_m of {limits.turn_radius_m:g} blocks at the bend at {place[0]:.1f},{place[1]:.1f}; "
        f"a turn_radius_m of {math.floor(low * 10) / 10:g} opens it"
    )
    return Blockage(
        reason, "turn_radius_m", place, np.column_stack([easting, northing]), z,
        upper - limits.ceiling_m, {"turn_radius_m": math.floor(low * 10) / 10},
    )  # fmt: skip


def _sharpest(points: FloatArray) -> int:
    if len(points) < 3:
        return 0
    legs = np.diff(points, axis=0)
    turn = np.abs(
        np.arctan2(
            legs[:-1, 0] * legs[1:, 1] - legs[:-1, 1] * legs[1:, 0],
            (legs[:-1] * legs[1:]).sum(axis=1),
        )
    )
    return int(np.argmax(turn)) + 1
