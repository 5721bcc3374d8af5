"""Fit one shadow's surroundings with the bump-or-pit model: height, shape, place, and their covariance.

The likelihood has many hills of its own: all starts are weighed on a coarse copy of the echo, the best of every
length and outline climb there, and the few that lead go on in full. No family of shapes is true: the height is
the mean over families, each weighed by its evidence, and their spread is part of its sigma.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from perception.records import FloatArray, IntArray
from perception.silhouette_likelihood import HIGHLIGHT_CAP, Heard, climb, score
from perception.silhouettes import N_PARAMETERS, Form, Scene, radius_at


@dataclass(frozen=True, slots=True)
class Patch:
    """The equalised echo around one shadow, averaged to a workable size.

    Attributes
    ----------
    ratio : (n, m) float64 power over nominal; NaN says nothing.
    along_m, drop_m : (n,) place along the track and height of the sonar above the floor.
    start_m, step_m : near edge of the first bin and width of a bin, slant.
    weight : looks times independent part of one cell.
    leak : level inside shadows.
    yaw_rad : (n,) how far the beam looks ahead of square to the track, from the patch's mean.
    beam_rad : spread of the horizontal beam, two-way, 1-sigma.
    """

    ratio: FloatArray
    along_m: FloatArray
    drop_m: FloatArray
    start_m: float
    step_m: float
    weight: float
    leak: float
    yaw_rad: FloatArray
    beam_rad: float = 0.0

    def halved(self) -> Patch:
        """Return a quick copy: bins joined in pairs (a cell of one known bin counts as that bin), one ray a ping."""
        bins = self.ratio.shape[1] // 2
        pairs = self.ratio[:, : 2 * bins].reshape(-1, bins, 2)
        known = np.isfinite(pairs)
        mean = np.where(known, pairs, 0).sum(axis=2) / np.maximum(known.sum(axis=2), 1)
        mean[~known.any(axis=2)] = np.nan
        return replace(
            self,
            ratio=np.ascontiguousarray(mean),
            step_m=2 * self.step_m,
            weight=2 * self.weight,
            beam_rad=0.0,
        )


@dataclass(frozen=True, slots=True)
class Starts:
    """Starting points of a fit, one per row: `sign` and `corner` (s,), `parameters` (s, 10)."""

    sign: FloatArray
    corner: FloatArray
    parameters: FloatArray

    def take(self, rows: IntArray) -> Starts:
        """Return the chosen starts."""
        return Starts(self.sign[rows], self.corner[rows], self.parameters[rows])


@dataclass(frozen=True, slots=True)
class BumpFit:
    """The best bump (`sign` 1) or pit (-1), with the parameters of `perception.silhouettes`.

    `corner` is 2 for an elliptic footprint, 4 for a rectangular one, `power` the family (`silhouettes.Form`);
    `gain` is the log likelihood over that of a flat floor, priors included.
    """

    parameters: FloatArray
    covariance: FloatArray
    sign: float
    corner: float
    gain: float
    power: float = 0.0

    @property
    def form(self) -> Form:
        return Form(self.sign, self.corner, self.power)

    @property
    def height_m(self) -> float:
        """Return the extreme height or depth; positive for either kind."""
        return float(np.exp(self.parameters[2]))


_FACETS_PER_BIN = 1.5
# Rounds of climbing: every start on the coarse patch, the best of those, and the leaders in full.
_FIRST_ROUNDS, _MIDDLE_ROUNDS, _LAST_ROUNDS = 3, 5, 10
_MIDDLE_STARTS, _LAST_STARTS = 2, 2
# A kind this far behind the other after the coarse rounds will not catch up.
_BEHIND = 0.6
# Profiles that end (powers of `Form`), climbed beside the best generalised Gaussian; cones are rare, by so much
# evidence. Where no ray reaches a pit's floor all explain it alike: there a flat one (power 4) is among them.
# Evidence counts a third: no family is true, and what it cannot have is taken for proof.
_ENDED_HILLS, _ENDED_PITS, _RARE, _TEMPER = (1.0, 2.0), (1.0, 2.0, 4.0), 5.0, 3.0
# Halving a patch of fewer bins would leave too little of it.
_LEAST_BINS = 36


def fit_patch(patch: Patch, starts: Starts, favour: float = 0.0) -> BumpFit | None:
    """Return the most likely fit over all starts, or None where none converges.

    `favour` is what other evidence adds to the log likelihood of a hill over a crater.
    """
    patch, value = _with_heading(patch, starts)
    coarse = _coarse(patch)
    chosen = _leaders(starts, value)
    climbed = {
        sign: _climbed(coarse, starts.take(chosen[starts.sign[chosen] == sign]))
        for sign in (1.0, -1.0)
    }
    best = max((fit.gain for fits in climbed.values() for fit in fits), default=0.0)
    found = []
    for fits in climbed.values():
        if fits and fits[0].gain > _BEHIND * best:
            found += [_climb(patch, fit, _LAST_ROUNDS) for fit in fits[:_LAST_STARTS]]
    good = [fit for fit in found if fit is not None]
    if not good:
        return None
    top = max(good, key=lambda fit: fit.gain + 0.5 * fit.sign * favour)
    ended = _ENDED_HILLS if top.sign > 0 else _ENDED_PITS
    others = [_climb(patch, _recast(top, power), _LAST_ROUNDS) for power in ended]
    same = [fit for fit in good if fit.sign == top.sign]
    return _mixed(same + [fit for fit in others if fit is not None])


def _coarse(patch: Patch) -> Patch:
    return patch.halved() if patch.ratio.shape[1] >= _LEAST_BINS else replace(patch, beam_rad=0.0)


def _with_heading(patch: Patch, starts: Starts) -> tuple[Patch, FloatArray]:
    """Return the patch, without the pings' headings where the echo is likelier so, and the starts' log posterior.

    A heading that swings tells which way each ping looked, unless the compass is worse than the steering: the echo
    itself decides.
    """
    variants = [patch]
    if np.any(patch.yaw_rad):
        variants.append(replace(patch, yaw_rad=np.zeros_like(patch.yaw_rad)))
    best = -np.inf
    for variant in variants:
        coarse = _coarse(variant)
        posterior = score(starts.sign, starts.corner, starts.parameters, *_fixed(coarse))
        first = starts.take(np.argmax(posterior, keepdims=True))
        gain = max((fit.gain for fit in _climbed(coarse, first)), default=-np.inf)
        if gain > best or variant is patch:
            best, chosen = gain, (variant, posterior)
    return chosen


def _recast(fit: BumpFit, power: float) -> BumpFit:
    """Return where the climb of a profile that ends starts: as wide as the fit at a tenth of its height."""
    at = fit.parameters.copy()
    at[3:5] += np.log(radius_at(0.1, at[5], fit.power) / radius_at(0.1, 0.0, power))
    at[5] = 0.0
    return replace(fit, parameters=at, power=power)


def _mixed(fits: list[BumpFit]) -> BumpFit:
    """Return the likeliest fit with the mean height of all, each by its evidence, and their spread in its variance.

    The profile is told as the generalised Gaussian of the same widths at half and at a tenth of its height.
    """
    evidence = np.array([fit.gain - (_RARE if fit.power == 1.0 else 0.0) for fit in fits])
    weight = np.exp((evidence - evidence.max()) / _TEMPER)
    weight /= weight.sum()
    log_height = np.array([fit.parameters[2] for fit in fits])
    variance = np.array([fit.covariance[2, 2] for fit in fits])
    best = fits[int(np.argmax(evidence))]
    at, covariance = best.parameters.copy(), best.covariance.copy()
    at[2] = weight @ log_height
    covariance[2, 2] = weight @ (variance + np.square(log_height - at[2]))
    half, tenth = (radius_at(part, at[5], best.power) for part in (0.5, 0.1))
    at[5] = np.log(0.5 * np.log(np.log(2) / np.log(10)) / np.log(half / tenth))
    at[3:5] += np.log(tenth / radius_at(0.1, at[5], 0.0))
    return replace(best, parameters=at, covariance=covariance, power=0.0)


def _leaders(starts: Starts, value: FloatArray) -> IntArray:
    """Return the best start of each kind, outline and length across the track.

    The best of all alone would often be the longest ones, which fit loosely at once and cannot be mended
    by climbing.
    """
    best: dict[tuple[float, float, float], int] = {}
    for row in np.argsort(value):
        key = (float(starts.sign[row]), float(starts.corner[row]), float(starts.parameters[row, 3]))
        best[key] = int(row)
    return np.array(sorted(best.values()), dtype=np.int64)


def _climbed(patch: Patch, starts: Starts) -> list[BumpFit]:
    """Climb from each start, on from the best few, and return those, the best first."""
    first = [
        _climb(patch, BumpFit(at, np.empty(0), float(sign), float(corner), 0.0), _FIRST_ROUNDS)
        for sign, corner, at in zip(starts.sign, starts.corner, starts.parameters, strict=True)
    ]
    ranked = sorted((fit for fit in first if fit is not None), key=lambda fit: -fit.gain)
    further = [_climb(patch, fit, _MIDDLE_ROUNDS) for fit in ranked[:_MIDDLE_STARTS]]
    return sorted((fit for fit in further if fit is not None), key=lambda fit: -fit.gain)


def _climb(patch: Patch, start: BumpFit, rounds: int) -> BumpFit | None:
    """Climb the posterior of a patch from a fit's parameters; None where it leads nowhere."""
    at, value, information = climb(start.parameters, start.form, *_fixed(patch), rounds)
    if not (np.all(np.isfinite(at)) and np.all(np.isfinite(information))):
        return None
    # Unseen directions come out very wide.
    covariance = np.linalg.inv(information + 1e-6 * np.eye(N_PARAMETERS))
    gain = float(value - _flat_likelihood(patch))
    return replace(start, parameters=at, covariance=covariance, gain=gain)


def _facet_m(patch: Patch) -> float:
    """Return the facets' ground length: a part of a bin at the patch's far edge."""
    far_m = patch.start_m + patch.ratio.shape[1] * patch.step_m
    ground_m = np.sqrt(max(far_m**2 - float(patch.drop_m.mean()) ** 2, 1e-2))
    return float(patch.step_m * far_m / ground_m / _FACETS_PER_BIN)


def _fixed(patch: Patch) -> tuple[Scene, Heard]:
    """Return what the kernels need of a patch."""
    scene = Scene(patch.drop_m, patch.along_m, patch.start_m, patch.step_m, patch.leak, _facet_m(patch),
                  patch.yaw_rad, patch.beam_rad)  # fmt: skip
    return scene, Heard(patch.ratio, patch.weight)


def _flat_likelihood(patch: Patch) -> float:
    e = patch.ratio[np.isfinite(patch.ratio)]
    mean = 1.0 + patch.leak
    each = np.where(e < HIGHLIGHT_CAP, e / mean + np.log(mean), HIGHLIGHT_CAP / mean)
    return float(-patch.weight * each.sum())
