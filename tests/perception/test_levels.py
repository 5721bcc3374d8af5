"""Levels: labels that hold for one look of speckle, at any size of sample."""

from __future__ import annotations

import numpy as np
import pytest

from perception import levels
from perception.levels import HIGHLIGHT, NO_DATA, NOMINAL, SHADOW, independent_part, segment_levels


def _scene(n: int, m: int) -> np.ndarray:
    """Mean levels of a hill (highlight, then shadow) and a crater (shadow, then highlight)."""
    mean = np.ones((n, m))
    mean[20:40, 60:68], mean[20:40, 70:100] = 6.0, 0.03
    mean[60:80, 150:180], mean[60:80, 180:190] = 0.03, 6.0
    return mean


@pytest.mark.parametrize("looks", [1.0, 2.0, 8.0])
def test_labels_agree_with_what_was_planted(looks: float) -> None:
    rng = np.random.default_rng(0)
    mean = _scene(100, 250)
    levels = segment_levels(mean * rng.gamma(looks, 1 / looks, mean.shape), looks)
    truth = np.where(mean < 0.5, SHADOW, np.where(mean > 2, HIGHLIGHT, NOMINAL))
    # Shadows decide heights: 95 % of their samples even at one look; one nominal sample in 100 may stray.
    assert np.mean(levels.label[truth == SHADOW] == SHADOW) > 0.95
    assert np.mean(levels.label[truth == NOMINAL] == SHADOW) < 0.01
    assert np.mean(levels.label[truth == HIGHLIGHT] == HIGHLIGHT) > (0.7 if looks < 2 else 0.9)
    assert levels.shadow_level == pytest.approx(0.03, rel=0.3)


def test_order_of_levels_tells_hill_from_crater() -> None:
    rng = np.random.default_rng(1)
    mean = _scene(100, 250)
    label = segment_levels(mean * rng.exponential(size=mean.shape), 1.0).label

    def order(rows: slice) -> list[int]:
        share = [np.median(label[rows, k : k + 8], axis=(0, 1)) for k in range(50, 200, 4)]
        seen = [int(s) for s in share if s in (SHADOW, HIGHLIGHT)]
        return [s for i, s in enumerate(seen) if i == 0 or s != seen[i - 1]]

    assert order(slice(22, 38)) == [HIGHLIGHT, SHADOW]
    assert order(slice(62, 78)) == [SHADOW, HIGHLIGHT]


@pytest.mark.parametrize("oversampled", [2, 4])
def test_a_pulse_longer_than_the_sample_does_not_make_shadows_of_speckle(oversampled: int) -> None:
    rng = np.random.default_rng(2)
    field = rng.normal(size=(2, 120, 400 + oversampled))
    kernel = np.ones(oversampled) / np.sqrt(2 * oversampled)
    smooth = np.apply_along_axis(np.convolve, 2, field, kernel, mode="valid")
    power = (smooth**2).sum(axis=0)
    assert independent_part(power) < 0.8
    label = segment_levels(power, 1.0).label
    assert np.mean(label == SHADOW) < 0.02


def test_no_data_stays_no_data_and_empty_input_is_no_error() -> None:
    ratio = np.ones((30, 40), np.float32)
    ratio[:, :10] = np.nan
    label = segment_levels(ratio, 1.0).label
    assert (label[:, :10] == NO_DATA).all() and (label[:, 10:] == NOMINAL).all()
    assert (segment_levels(np.full((5, 6), np.nan), 1.0).label == NO_DATA).all()


def test_mirroring_the_image_mirrors_the_labels() -> None:
    rng = np.random.default_rng(3)
    ratio = (_scene(100, 250) * rng.exponential(size=(100, 250))).astype(np.float32)
    label = segment_levels(ratio, 1.0).label
    np.testing.assert_array_equal(segment_levels(ratio[::-1], 1.0).label, label[::-1])


@pytest.mark.parametrize("pings", [1, 17, 60])
def test_stretches_of_pings_get_the_labels_of_the_whole_image(
    pings: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Paths run on across the stretches' ends, both ways: to the bit, on speckle that leaves them undecided."""
    rng = np.random.default_rng(4)
    ratio = (_scene(100, 250) * rng.exponential(size=(100, 250))).astype(np.float32)
    whole = segment_levels(ratio, 1.0).label
    monkeypatch.setattr(levels, "_STRETCH", pings * 250)
    np.testing.assert_array_equal(segment_levels(ratio, 1.0).label, whole)
