"""What goes into the correction of a survey and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass, field

from mapping.keyframes import KeyframeFix, Keyframes
from mapping.overlaps import Window
from mapping.pose_graph import GraphConfig, HeightStep, Link, Solution
from mapping.rounds import Registration
from mapping.textures import MatchConfig
from perception.records import ElevationStrip, FloatArray, Trajectory


@dataclass(frozen=True, slots=True)
class SurveyConfig:
    """How a survey is corrected.

    Attributes
    ----------
    squares : width of the compared squares in each round, as parts of the swath's width. Large squares are
        hard to mistake; small ones bend less with the drift, and there are more of them.
    rounds : most rounds of registering and solving; None one for each of `squares`.
    keyframe_m : way between keyframes; None a twelfth of the swath, a handful of metres.
    widest_search_m : no shift beyond this is looked for.
    settled_m : rounds beyond those of `squares` end when the corrections' rms change is below this; None a
        fifth of a cell.
    """

    graph: GraphConfig = field(default_factory=GraphConfig)
    match: MatchConfig = field(default_factory=MatchConfig)
    squares: tuple[float, ...] = (0.8, 0.5, 0.3, 0.2)
    rounds: int | None = None
    keyframe_m: float | None = None
    widest_search_m: float = 40.0
    settled_m: float | None = None


@dataclass(frozen=True, slots=True)
class Round:
    """One round of the loop.

    Attributes
    ----------
    floor : what told where echoes came from: "soundings" or "map".
    square_m : width of the compared squares.
    compared, accepted, used : comparisons that count here, accepted by themselves, believed by the graph.
    beyond : squares left for later, their shift expected wider than any search.
    evidence : mean log-likelihood ratio of a comparison against no match, refused ones included.
    moved_m : rms by which the track still moved.
    error_before, error_after : the graph's error (half a chi-square).
    passes : how many there were.
    anew : comparisons made in this round; the others stood, matched in the round before or held still since an
        earlier correction (`ComparisonMemory`).
    """

    floor: str
    square_m: float
    compared: int
    accepted: int
    used: int
    beyond: int
    evidence: float
    moved_m: float
    error_before: float
    error_after: float
    passes: int
    anew: int


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """What a user should know of the correction.

    Attributes
    ----------
    rounds : one record per round.
    indeterminate, worsened : the last graph did not determine its unknowns; or did not improve.
    fixes_used, fixes_refused : absolute fixes believed, and contradicted by the rest.
    largest_correction_m : by which a line was moved.
    prior_compared, prior_used : squares compared with a prior map, and those that the graph believed.
    prior_shift_m : (east, north) by which the tie to the prior map moved the track, on average.
    """

    rounds: tuple[Round, ...]
    indeterminate: bool
    worsened: bool
    fixes_used: int
    fixes_refused: int
    largest_correction_m: float
    prior_compared: int = 0
    prior_used: int = 0
    prior_shift_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class CorrectedSurvey:
    """Strips on corrected tracks, the track with covariance, and how it came about.

    `height_sigma_m` (strips,) is the 1-sigma of each strip's height offset; `links`, `ties` and
    `steps` are the registrations, fixes and height steps of the last graph (`pose_graph_files` writes it);
    `squares` are the links' places, one each. `registrations` are all comparisons of the last round.
    """

    strips: tuple[ElevationStrip, ...]
    trajectory: Trajectory
    registrations: tuple[Registration, ...]
    diagnostics: Diagnostics
    height_m: FloatArray
    height_sigma_m: FloatArray
    keyframes: Keyframes
    solution: Solution
    links: tuple[Link, ...] = ()
    ties: tuple[KeyframeFix, ...] = ()
    steps: tuple[HeightStep, ...] = ()
    squares: tuple[Window, ...] = ()
