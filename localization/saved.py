"""All that a navigator remembers, as arrays and plain values: saved, it can go on another day."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from localization.measurements import Measurement
from localization.navigator import Navigator
from localization.particles import Cloud
from localization.proof import Proof
from perception.records import FloatArray

# Attributes of a navigator that are plain values: with its arrays, all its memory.
_PLAIN_STATE = ("tracking", "losses", "since_update_m", "heard_s")


def state_of(navigator: Navigator) -> tuple[dict[str, FloatArray], dict[str, Any]]:
    """Return all that the next update depends on, as arrays and plain values."""
    words: dict[str, Any] = {name: getattr(navigator, name) for name in _PLAIN_STATE}
    arrays: dict[str, FloatArray] = {
        f"cloud_{k}": v for k, v in asdict(navigator.search.cloud).items()
    }
    for i, f in enumerate(navigator.bank.filters):
        arrays[f"filter_{i}_x"], arrays[f"filter_{i}_p"] = f.filter.x, f.filter.P
    for i, (mean, covariance) in enumerate(
        [navigator.reckoning.state, *navigator.reckoning.trusted]
    ):
        arrays[f"trusted_{i}_mean"], arrays[f"trusted_{i}_covariance"] = mean, covariance
    arrays["bank_weight"], arrays["velocity"] = navigator.bank.log_weight, navigator.velocity
    bank = navigator.bank
    arrays["places"], arrays["heading"] = bank.places_m, bank.heading_m
    words["bank"] = [bank.assumed.index(f.assumed) for f in bank.filters]
    words["bank_way_m"], words["bank_updates"] = bank.way_m, bank.updates
    arrays["rival"], arrays["seen"] = navigator.rival.known, np.array(sorted(navigator.seen_times))
    arrays["health"] = np.array(navigator.health.normalised).reshape(
        -1, len(navigator.sensors.beams)
    )
    words["rng"] = navigator.search.rng.bit_generator.state
    words["misses"] = navigator.rival.misses
    words["trusted"] = len(navigator.reckoning.trusted)
    words["proof"] = asdict(navigator.proof)
    if navigator.last is not None:
        last = {k: v for k, v in asdict(navigator.last).items() if k != "slant_range_m"}
        words["last"], arrays["last_ranges"] = last, navigator.last.slant_range_m
    return arrays, words


def bring_to(
    navigator: Navigator, arrays: Mapping[str, FloatArray], words: Mapping[str, Any]
) -> None:
    """Take the state that `state_of` gave; map, sensors and configuration must be the same."""
    names = asdict(navigator.search.cloud)
    navigator.search.take(Cloud(**{k: arrays[f"cloud_{k}"].copy() for k in names}))
    navigator.search.rng.bit_generator.state = words["rng"]
    for name in _PLAIN_STATE:
        setattr(navigator, name, words[name])
    trusted = [
        (arrays[f"trusted_{i}_mean"], arrays[f"trusted_{i}_covariance"])
        for i in range(words["trusted"] + 1)
    ]
    navigator.reckoning.state, navigator.reckoning.trusted = trusted[0], trusted[1:]
    navigator.proof = Proof(**words["proof"])
    bank = navigator.bank
    bank.places_m = np.asarray(arrays["places"]).copy()
    bank.heading_m = np.asarray(arrays["heading"]).copy()
    if words["bank"]:
        bank.start(*navigator.reckoning.state)
        bank.keep(words["bank"])
        for i, f in enumerate(bank.filters):
            f.take(arrays[f"filter_{i}_x"], arrays[f"filter_{i}_p"])
        bank.log_weight = np.asarray(arrays["bank_weight"]).copy()
    bank.way_m, bank.updates = words["bank_way_m"], words["bank_updates"]
    navigator.velocity = np.asarray(arrays["velocity"])
    navigator.rival.known, navigator.rival.misses = arrays["rival"], words["misses"]
    navigator.seen_times = set(arrays["seen"].tolist())
    navigator.health.reset()
    navigator.health.normalised.extend(arrays["health"])
    if "last" in words:
        navigator.last = Measurement(slant_range_m=arrays["last_ranges"], **words["last"])
