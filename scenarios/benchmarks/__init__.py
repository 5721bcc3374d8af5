"""The benchmark suite: speed and accuracy, each beside a peer or a simpler method in the same run.

A benchmark is a module here with a function ``run(progress) -> Table`` and one line in `BENCHMARKS`;
it is imported only when it is asked for. A peer that is not installed is a row that says so.
"""

from __future__ import annotations

from dataclasses import dataclass, field

# name -> (module below scenarios.benchmarks, what it measures)
BENCHMARKS: dict[str, tuple[str, str]] = {
    "inversion": ("inversion", "joint inversion beside interpolated soundings: error, sigma, time"),
    "inversion-terrains": (
        "inversion_terrains",
        "joint inversion over ten terrains kept apart: error, sigma",
    ),
    "inversion-large": (
        "inversion_large",
        "joint inversion of a thousand cells a side, level and rough: time, memory, error",
    ),
    "experiments": ("experiments", "the experiment runner: overhead, memory, sameness"),
    "sonar-files": ("sonar_files", "reading sonar files: pings a second, memory at 1x and 10x"),
    "strips-memory": (
        "strips_memory",
        "bathynav strips: memory and time on a file of 1x, of 10x, and on one line of 10x",
    ),
    "echoes": ("echoes", "echoes to strips: pings a minute, heights of objects against truth"),
    "mapping": ("mapping", "one map from many passes: registration, pose graph, gridding, peers"),
    "mapping-large": (
        "mapping_large",
        "a hundred passes registered and solved: time, memory, track against the truth",
    ),
    "crossed": ("crossed", "three and three crossed passes that drift, echoes to map and track"),
    "gridding": ("gridding", "ten million soundings into cells, beside bincount, verde and GMT"),
    "tiles": ("tiles", "a map that outgrows memory: memory against size, the slowest step"),
    "simulation": ("simulation", "side-scan simulation: pings a second, beside plain numpy"),
    "navigation-matching": (
        "navigation_matching",
        "Patches placed on a map, heading known or not: compact map beside correlation.",
    ),
    "navigation-montecarlo": ("navigation_montecarlo", "False fixes over terrains, drawn errors."),
    "navigation-observability": (
        "navigation_observability",
        "Where terrain can fix a vehicle: foretold error beside runs on the same ground.",
    ),
    "navigation": (
        "navigation",
        "Position from terrain: error, bound, honesty, time per update, peers.",
    ),
    "planning": ("planning", "Routes: cost against the grid search, parts switched off, peers."),
    "planning-grid": (
        "planning_grid",
        "The grid stage on 4,000 x 4,000 cells, beside fast marching.",
    ),
    "planning-seeds": (
        "planning_seeds",
        "Fifty random routes by the command, checked from the files.",
    ),
    "regions": (
        "regions",
        "H-K regions: signs under noise and seconds, beside fixed scales and peers",
    ),
}


@dataclass(frozen=True, slots=True)
class Row:
    """One measured figure: what was measured, by which method, the value and its unit."""

    case: str
    method: str
    figure: str
    value: float | None
    unit: str
    goal: str = ""
    note: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    """The result of a benchmark; `settings` tells what another run would need to repeat it."""

    name: str
    rows: tuple[Row, ...]
    settings: dict[str, object] = field(default_factory=dict)
