"""What bars a cell: the one list of reasons, for ends that cannot be used and for walls that part."""

from __future__ import annotations

from typing import Literal

import numpy as np

from planning.currents import STRONGEST
from planning.surface import DRIFT_X, Surface

Bar = Literal["no data", "no sigma", "shallow", "deep", "ceiling", "current", "no-go"]


def bar_of(surface: Surface, row: int, col: int) -> Bar:
    """Return why no route may pass a barred cell; the first reason that holds."""
    bottom, lower = surface.bottom_m[row, col], surface.lower_m[row, col]
    limits = surface.limits
    if not np.isfinite(bottom):
        return "no data"
    if not np.isfinite(lower):
        return "no sigma"
    if lower > surface.top_m:
        return "shallow"
    if bottom + limits.ceiling_m < -limits.depth_max_m:
        return "deep"
    if bottom + limits.ceiling_m < lower:
        return "ceiling"
    if surface.drifts and np.hypot(*surface.stack[row, col, DRIFT_X:]) > STRONGEST:
        return "current"
    return "no-go"
