"""Replanning under way: the rest of a route on a changed map, from where the vehicle is.

Bounded in time: two guides (what is left of the old route, and a fresh grid path), each polished by a
fixed number of sweeps; no sampling planner.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from perception.files import existing_file
from perception.records import FloatArray, InputError
from planning.ends import end_node
from planning.field import search
from planning.finish import finish
from planning.polish import control_spacing, polish, smooth_guide
from planning.route import Route, route_of
from planning.surface import Surface, cautious

_SWEEPS = 24


@dataclass(frozen=True, slots=True)
class State:
    """Where the vehicle is: position, depth and heading (clockwise from grid north)."""

    easting_m: float
    northing_m: float
    depth_m: float
    heading_rad: float


@dataclass(frozen=True, slots=True)
class OldRoute:
    """The columns of a route file that replanning needs, each (n,)."""

    easting_m: FloatArray
    northing_m: FloatArray
    depth_m: FloatArray
    distance_m: FloatArray

    def state_at(self, travelled_m: float) -> State:
        """Return the vehicle's state after so many metres along the route."""
        s = self.distance_m
        if not 0 <= travelled_m < s[-1]:
            raise InputError(
                f"the vehicle has travelled {travelled_m:g} m of a route of {s[-1]:.1f} m; "
                "give a distance short of its end"
            )
        i = min(int(np.searchsorted(s, travelled_m, side="right")) - 1, len(s) - 2)
        e, n, d = (
            float(np.interp(travelled_m, s, v))
            for v in (self.easting_m, self.northing_m, self.depth_m)
        )
        heading = math.atan2(
            self.easting_m[i + 1] - self.easting_m[i], self.northing_m[i + 1] - self.northing_m[i]
        )
        return State(e, n, d, heading)

    def rest(self, travelled_m: float) -> FloatArray:
        """Return (n, 2) easting and northing of what is left."""
        left = self.distance_m > travelled_m
        return np.column_stack([self.easting_m[left], self.northing_m[left]])


def read_route(path: Path) -> OldRoute:
    """Read a `route.csv`."""
    path = existing_file(path)
    names = ("easting_m", "northing_m", "depth_m", "distance_m")
    with path.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    try:
        columns = [np.array([float(row[name]) for row in rows]) for name in names]
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(
            f"{path}: is no route ({error}); it needs the columns {', '.join(names)}"
        ) from error
    if len(rows) < 2:
        raise InputError(f"{path}: has {len(rows)} waypoints; a route has at least 2")
    return OldRoute(*columns)


def replan(
    surface: Surface, state: State, rest: FloatArray, crs: str = ""
) -> tuple[Route | None, str]:
    """Plan anew from `state` to the end of `rest` on the changed surface.

    Parameters
    ----------
    rest : (n, 2) easting, northing of what is left of the old route; its last row is the goal.

    Returns
    -------
    The route, or None and what breaks: then the vehicle should stop or climb, not go on.
    """
    limits = replace(surface.limits, start_heading_deg=math.degrees(state.heading_rad))
    surface = replace(surface, limits=limits)
    here, goal = (state.easting_m, state.northing_m), (float(rest[-1, 0]), float(rest[-1, 1]))
    a, b = end_node(surface, here, "the vehicle's position"), end_node(surface, goal, "goal")
    ends = [np.array(surface.local(np.array(p[0]), np.array(p[1]))) for p in (here, goal)]
    old = np.column_stack(surface.local(rest[:, 0], rest[:, 1]))
    guides = [np.concatenate([ends[0][None], old[:-1], ends[1][None]])]
    field = search(surface.at_least_height(), a, b, 16)
    if np.isfinite(field.cost[b]):
        nodes = field.path(*b)
        fresh = np.column_stack([nodes[:, 1] * surface.cell_m[0], nodes[:, 0] * surface.cell_m[1]])
        guides.append(np.concatenate([ends[0][None], fresh[1:-1], ends[1][None]]))
    careful = cautious(surface, np.array(ends)) if surface.barred.any() else surface
    candidates = []
    for guide in guides:
        spacing = control_spacing(surface, float(np.hypot(*np.diff(guide, axis=0).T).sum()))
        candidates.append(polish(careful, smooth_guide(guide, spacing), _SWEEPS, rounds=2))
    problem = ""
    for candidate in sorted(candidates, key=lambda c: (c.breach > 0, c.cost)):
        w = finish(surface, candidate.points, start_height_m=-state.depth_m)
        if not w.problem:
            return route_of(surface, w, crs), ""
        problem = problem or w.problem
    return None, problem
