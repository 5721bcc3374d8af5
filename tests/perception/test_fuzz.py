"""Mutated real files never crash, hang or eat memory: they are read, or refused in one line."""

from __future__ import annotations

import resource
import time
from pathlib import Path

import numpy as np
import pytest

from perception.readers import open_survey
from perception.records import BathynavError
from tests.perception.xtf_maker import Plan, xtf_packets

REAL = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "sidescan"
# Mutations of each file: 2,400 in all.
_FILES = {
    "scotsman-iver2.xtf": 1000,
    "starfish_iver2_barbados_20160112.logdoc": 500,
    "lowrance_input.sl2": 500,
    "humminbird_pyhum": 400,
}
# A whole file is read in well under a second; ten leaves room for a busy machine.
_SECONDS = 10.0
_MEGABYTES = 600.0


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage bytes as disks, radios and programs do."""
    out = bytearray(data)
    n = len(out)
    kind = rng.integers(0, 9)
    at = int(rng.integers(0, n))
    span = int(min(rng.integers(1, 5000), n - at))
    if kind == 0:  # single bytes
        for place in rng.integers(0, n, rng.integers(1, 200)):
            out[place] = int(rng.integers(0, 256))
    elif kind == 1:  # the end is missing
        del out[at:]
    elif kind == 2:  # a stretch is missing
        del out[at : at + span]
    elif kind == 3:  # a stretch of noise
        out[at : at + span] = rng.integers(0, 256, span, np.uint8).tobytes()
    elif kind == 4:  # a stretch of one value
        out[at : at + span] = bytes([int(rng.choice([0, 255, 127, 206, 250]))]) * span
    elif kind == 5:  # a stretch twice
        out[at:at] = out[at : at + span]
    elif kind == 6:  # the head
        for place in rng.integers(0, min(n, 1600), 40):
            out[place] = int(rng.integers(0, 256))
    elif kind == 7:  # greatest and least numbers in random words
        for place in rng.integers(0, n - 8, 60):
            word = rng.choice(
                [b"\xff" * 8, b"\0" * 8, b"\xff\xff\xff\x7f" * 2, b"\0\0\xc0\x7f" * 2]
            )
            out[place : place + 4] = word[:4]
    else:  # the same damage in every packet: a writer's bug
        stride = int(rng.choice([25, 43, 576, 1057, 1617, 2080, 4480]))
        offset, value = int(rng.integers(0, stride)), int(rng.integers(0, 256))
        for place in range(offset, n, stride):
            out[place] = value
    return bytes(out)


def read_all(path: Path) -> str:
    """Read as a map would: headers, passes, samples. Say how it ended."""
    try:
        survey = open_survey([path])
    except BathynavError as error:
        assert "\n" not in str(error) and str(path.name) in str(error)
        return "refused"
    for index in range(survey.n_passes):
        swath = survey.swath(index)
        assert np.isfinite(swath.easting_m + swath.northing_m + swath.heading_rad).all()
        assert np.isfinite(swath.time_s + swath.sample_m + swath.sound_speed_m_s).all()
        assert (swath.sample_m > 0).all()
    return "read"


def megabytes() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def survive(path: Path, originals: dict[Path, bytes], count: int, seed: int) -> dict[str, int]:
    """Mutate and read `count` times; give how often each end was met."""
    rng = np.random.default_rng(seed)
    ends = {"read": 0, "refused": 0}
    before = megabytes()
    targets = list(originals)
    for number in range(count):
        target = targets[int(rng.integers(0, len(targets)))]
        target.write_bytes(mutated(originals[target], rng))
        began = time.perf_counter()
        try:
            ends[read_all(path)] += 1
        except Exception as error:
            raise AssertionError(f"mutation {number} of {path.name}, seed {seed}") from error
        seconds = time.perf_counter() - began
        assert seconds < _SECONDS, f"mutation {number} of {path.name} took {seconds:.1f} s"
        target.write_bytes(originals[target])
    grown = megabytes() - before
    assert grown < _MEGABYTES, f"{path.name} grew memory by {grown:.0f} MB"
    return ends


@pytest.mark.slow
@pytest.mark.parametrize("name", list(_FILES))
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_real_files_in_two_thousand_mutations(tmp_path, name):
    source = REAL / name
    if not source.exists():
        pytest.skip(f"{source} is not there")
    sources = [source] if source.is_file() else sorted(source.iterdir())
    originals = {}
    for part in sources:
        # The first 600 kB hold every kind of record and keep a thousand readings to minutes.
        data = part.read_bytes()[: 600_000 if part.suffix.lower() != ".dat" else None]
        (tmp_path / part.name).write_bytes(data)
        originals[tmp_path / part.name] = data
    path = tmp_path / (source.name if source.is_file() else "test.DAT")
    ends = survive(path, originals, _FILES[name], seed=11)
    # Damage that spares the head must not cost the file: most mutations still read.
    if "lowrance" not in name:
        assert ends["read"] > 0.5 * _FILES[name], ends


def test_a_small_made_file_in_sixty_mutations(tmp_path):
    data = b"".join(xtf_packets(Plan(n=40, samples=64)))
    path = tmp_path / "a.xtf"
    path.write_bytes(data)
    ends = survive(path, {path: data}, 60, seed=3)
    assert ends["read"] > 25
