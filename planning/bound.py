"""A certified lower bound on the cost of any route."""

from __future__ import annotations

import numpy as np

from planning.surface import WEIGHT, Surface


def lower_bound(surface: Surface, start: tuple[float, float], goal: tuple[float, float]) -> float:
    """Return the least weight times the straight distance: nothing can be cheaper."""
    straight = float(np.hypot(goal[0] - start[0], goal[1] - start[1]))
    return straight * float(surface.stack[..., WEIGHT].min())
