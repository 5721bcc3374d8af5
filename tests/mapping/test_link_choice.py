"""What is compared, believed and given to the graph: spread evenly, by the odds, no ground twice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapping.link_choice import apart, believed, enough, without
from mapping.overlaps import Window
from mapping.pose_graph import Link
from mapping.registration import Match
from tests.mapping.worlds import crossed_legs, fly, make_world


def window(east: float, side_m: float = 30.0, second: int = 1) -> Window:
    return Window(0, second, east, 0.0, side_m, 0.0, 0.0, 1.0)


def matched(spare: float, evidence: float = 0.0) -> Match:
    return Match(
        np.zeros(2), np.eye(2), evidence, 0.0, {}, spare, spare >= 0, "" if spare >= 0 else "weak"
    )


def link(sigma_m: float) -> Link:
    return Link(0, 1, np.zeros(2), np.zeros(2), np.zeros(2), sigma_m**2 * np.eye(2))


def test_a_large_survey_compares_an_even_choice_of_its_squares() -> None:
    windows = [window(30.0 * i) for i in range(10_000)]
    assert enough(windows[:1500], 100) == windows[:1500]
    chosen = enough(windows, 4000)
    assert len(chosen) == 4000
    gaps = np.diff([w.easting_m for w in chosen]) / 30.0
    assert gaps.min() >= 1 and gaps.max() <= 4 and gaps.mean() > 2.49


def test_of_neighbours_the_one_is_compared_where_the_passes_had_most_in_common() -> None:
    windows = [window(30.0 * i) for i in range(4000)]
    before = [(window(30.0 * i + 5.0), matched(0.0, 20.0 if i % 2 else 1.0)) for i in range(4000)]
    assert [w.easting_m % 60.0 for w in enough(windows, 100, before)] == [30.0] * 2000
    # Nothing is known of another pair of passes: an even choice.
    other = [window(30.0 * i, second=2) for i in range(4000)]
    assert len(enough(other, 100, before)) == 2000


def test_weak_matches_count_where_most_squares_match_and_nowhere_else() -> None:
    rich = [matched(1.0)] * 6 + [matched(-2.0)] * 4
    assert [m.accepted for m in believed(rich)] == [True] * 10
    assert [m.accepted for m in believed([matched(1.0)] * 6 + [matched(-4.0)])] == [True] * 6 + [
        False
    ]
    poor = [matched(1.0)] + [matched(-0.1)] * 99
    assert sum(m.accepted for m in believed(poor)) == 1
    assert not any(m.accepted for m in believed([matched(-0.1)] * 5))
    assert believed([]) == []


def test_a_match_of_no_clear_shape_is_never_let_off() -> None:
    found = believed([matched(1.0)] * 9 + [matched(-np.inf)])
    assert [m.accepted for m in found] == [True] * 9 + [False]


def test_of_squares_over_one_ground_the_best_known_is_kept_and_neighbours_all() -> None:
    wide, narrow, beside = window(0.0, 60.0), window(10.0, 20.0), window(40.0, 20.0)
    pool = [(wide, link(0.5)), (narrow, link(0.4)), (beside, link(0.9))]
    assert [w for w, _ in apart(pool)] == [narrow, beside]
    other = (window(0.0, 60.0, second=2), link(2.0))
    assert [w for w, _ in apart([*pool, other])] == [narrow, beside, other[0]]


def test_a_square_is_not_compared_again_where_its_passes_were_matched_at_the_same_lines() -> None:
    """The tracks may have moved by more than a square in between; the lines tell."""
    rng = np.random.default_rng(0)
    world = make_world(rng, size=64)
    strips = [f.strip for f in fly(world, crossed_legs(), rng, None, step_m=2.0)]
    seen = Window(0, 1, 500.0, 0.0, 30.0, 40.0, 60.0, 1.0)
    moved = replace(seen, easting_m=620.0, first_line=43.0, second_line=57.0)
    elsewhere = replace(seen, first_line=70.0, second_line=30.0)
    other = replace(seen, second=2)
    assert without([moved, elsewhere, other], [seen], strips) == [elsewhere, other]
    assert without([moved], [], strips) == [moved]
