"""A match becomes a constraint on the mean of a pass's corrections over the square, with what that mean misses."""

from __future__ import annotations

import numpy as np
import pytest

from mapping.keyframes import choose_keyframes
from mapping.links import PassFacts, _missed, blended
from mapping.pose_graph import Blend, Link
from mapping.pose_graph_solve import solve
from tests.mapping.worlds import Drift, World, fly


@pytest.mark.parametrize(
    ("at_m", "share", "part"),
    [
        ((0.0, 0.0), 0.5, 1 / 12),
        ((-7.5, 7.5), 0.5, 1 / 48),
        ((-15.0, 15.0), 0.5, 1 / 12),
    ],
)
def test_what_a_blend_misses_of_a_walk_is_the_known_part_of_the_square(
    at_m: tuple[float, float], share: float, part: float
) -> None:
    assert _missed(np.array(at_m), share, 30.0) == pytest.approx(30.0 * part, rel=0.01)


def test_what_a_blend_misses_is_what_drawn_walks_miss() -> None:
    rng = np.random.default_rng(1)
    walks = np.cumsum(rng.normal(0, np.sqrt(0.1), (4000, 600)), axis=1)  # 60 m in steps of 0.1 m
    at, share = np.array([-6.0, 21.0]), 0.3
    square = walks[:, 150:450].mean(axis=1)  # 30 m about the middle
    places = walks[:, (300 + 10 * at).astype(int)]
    apart = square - (1 - share) * places[:, 0] - share * places[:, 1]
    assert np.var(apart) == pytest.approx(_missed(at, share, 30.0), rel=0.1)


def test_a_square_hangs_on_keyframes_about_a_quarter_in_and_their_mean_is_its_middle() -> None:
    world = World(np.full((256, 256), -40.0), np.zeros((256, 256)))
    legs = [(100.0, 20.0, 0.0, 200.0)]
    strip = fly(world, legs, np.random.default_rng(0), Drift(0.0, 0.0, 0.0))[0].strip
    keyframes = choose_keyframes([strip], 10.0)
    for line in (37.0, 150.0, 233.3):
        blend, left = blended(PassFacts.of(strip).step_m, 0, line, 40.0, keyframes)
        assert blend.low < blend.high
        assert blend.of(keyframes.line.astype(float)) == pytest.approx(line, abs=1e-9)
        assert left < 40.0 / 24
    # Squares smaller than the way between keyframes hang on the two beside.
    small, _ = blended(PassFacts.of(strip).step_m, 0, 150.0, 4.0, keyframes)
    assert small.high == small.low + 1
    assert small.of(keyframes.line.astype(float)) == pytest.approx(150.0, abs=1e-9)


def test_the_graph_holds_the_mean_of_two_keyframes_to_a_registration() -> None:
    """One pass and a fixed one: the blend's mean moves by the shift, the two ends only as the walk carries them."""
    world = World(np.full((512, 512), -40.0), np.zeros((512, 512)))
    legs = [(100.0, 20.0, 0.0, 200.0), (140.0, 220.0, 180.0, 200.0)]
    flown = fly(world, legs, np.random.default_rng(0), Drift(0.0, 0.0, 0.0))
    keyframes = choose_keyframes([f.strip for f in flown], 20.0)
    second = int(keyframes.starts[1])
    blend = Blend(second + 2, second + 5, 0.25)
    shift = np.array([0.8, -0.5])
    link = Link(
        2, second + 3, np.zeros(2), np.zeros(2), shift, 1e-6 * np.eye(2),
        first_blend=Blend(2, 2, 0.0), second_blend=blend,
    )  # fmt: skip
    correction = solve(keyframes, [link], robust=False).correction_m
    np.testing.assert_allclose(blend.of(correction) - correction[2], shift, atol=0.03)
