"""The peers of the timing row: the same particle filter written with `particles` and Stone Soup.

Both get the terrain through one vectorised bilinear lookup of ours, as a user of theirs would write
it: what is timed is the filter's own work per update.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from localization.measurements import beam_vectors, soundings_of
from localization.navfile import NavTable
from localization.terrain import TerrainMap
from perception.records import FloatArray

_PARTICLES = 2000
_SIGMA_M = 0.6
_UPDATES = 60


def _steps(nav: NavTable) -> list[tuple[FloatArray, FloatArray, FloatArray, FloatArray]]:
    """Step, sounding offsets east and north from the first position, and elevations, per update."""
    vectors = beam_vectors(nav.sensors.beams)
    fractions = np.full(len(vectors), 0.01)
    steps = []
    before = nav.row(0)
    for i in range(1, min(len(nav), _UPDATES + 1)):
        m = nav.row(i)
        s = soundings_of(m, vectors, fractions, 0.02)
        step = np.array([m.easting_m - before.easting_m, m.northing_m - before.northing_m])
        steps.append((step, s.east_m, s.north_m, s.elevation_m))
        before = m
    return steps


def particles_update_ms(nav: NavTable, terrain: TerrainMap) -> float:
    """Median time of one update with `particles` (bootstrap filter, systematic resampling)."""
    import particles
    from particles import distributions as dists
    from particles import state_space_models as ssm

    steps = _steps(nav)
    start = np.array([nav.easting_m[0], nav.northing_m[0]])

    class Sounded(dists.ProbDist):
        def __init__(self, place: FloatArray, t: int) -> None:
            self.place, self.t = place, t

        def logpdf(self, x: FloatArray) -> FloatArray:
            _, east, north, _ = steps[self.t]
            height = terrain.heights(self.place[:, :1] + east, self.place[:, 1:2] + north)
            miss = x - height - self.place[:, 2:]
            return -0.5 * np.nansum((miss / _SIGMA_M) ** 2, axis=1)

    class Terrain(ssm.StateSpaceModel):
        def PX0(self) -> Any:
            return dists.IndepProd(
                dists.Normal(loc=start[0], scale=50.0), dists.Normal(loc=start[1], scale=50.0),
                dists.Normal(scale=1.0),
            )  # fmt: skip

        def PX(self, t: int, xp: FloatArray) -> Any:
            step = steps[t][0]
            return dists.IndepProd(
                dists.Normal(loc=xp[:, 0] + step[0], scale=0.1),
                dists.Normal(loc=xp[:, 1] + step[1], scale=0.1),
                dists.Normal(loc=xp[:, 2], scale=0.001),
            )

        def PY(self, t: int, xp: FloatArray, x: FloatArray) -> Any:
            return Sounded(x, t)

    model = ssm.Bootstrap(ssm=Terrain(), data=[s[3] for s in steps])
    smc = particles.SMC(fk=model, N=_PARTICLES, resampling="systematic")
    taken = []
    for _ in range(len(steps)):
        began = time.perf_counter()
        next(smc)
        taken.append(time.perf_counter() - began)
    return 1e3 * float(np.median(taken[5:]))


def stonesoup_update_ms(nav: NavTable, terrain: TerrainMap) -> float:
    """Median time of one update with Stone Soup's particle predictor, updater and resampler."""
    from datetime import datetime, timedelta

    from stonesoup.base import Property
    from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, RandomWalk
    from stonesoup.predictor.particle import ParticlePredictor
    from stonesoup.resampler.particle import SystematicResampler
    from stonesoup.types.array import StateVector, StateVectors
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import ParticleState
    from stonesoup.updater.particle import ParticleUpdater

    class Sounded(NonLinearGaussianMeasurement):
        place: Any = Property(default=None)
        offsets: Any = Property(default=None)

        @property
        def ndim_meas(self) -> int:
            return 4

        def function(self, state: Any, noise: Any = False, **_: Any) -> Any:
            x = np.asarray(state.state_vector, float)
            east, north = self.offsets
            height = terrain.heights(
                self.place[0] + x[0] + east[:, None], self.place[1] + x[1] + north[:, None]
            )
            return StateVectors(np.nan_to_num(height) + x[2])

    steps = _steps(nav)
    rng = np.random.default_rng(0)
    motion = CombinedLinearGaussianTransitionModel(
        [RandomWalk(0.003), RandomWalk(0.003), RandomWalk(1e-6)]
    )
    predictor, updater = ParticlePredictor(motion), ParticleUpdater(SystematicResampler())
    start = datetime(2026, 1, 1)
    state: Any = ParticleState(
        StateVectors(np.diag([50.0, 50.0, 1.0]) @ rng.standard_normal((3, _PARTICLES))),
        weight=np.full(_PARTICLES, 1.0 / _PARTICLES), timestamp=start,
    )  # fmt: skip
    place = np.array([nav.easting_m[0], nav.northing_m[0]])
    taken = []
    for k, (step, east, north, z) in enumerate(steps, start=1):
        place = place + step
        model = Sounded(
            ndim_state=3, mapping=(0, 1, 2), noise_covar=_SIGMA_M**2 * np.eye(4), place=place,
            offsets=(east, north),
        )  # fmt: skip
        when = start + timedelta(seconds=3 * k)
        detection = Detection(StateVector(z), timestamp=when, measurement_model=model)
        began = time.perf_counter()
        prediction = predictor.predict(state, timestamp=when)
        state = updater.update(SingleHypothesis(prediction, detection))
        taken.append(time.perf_counter() - began)
    return 1e3 * float(np.median(taken[5:]))
