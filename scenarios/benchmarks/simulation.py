"""Side-scan simulation: pings a second of the kernel, beside a plain numpy twin of it."""

from __future__ import annotations

import time

import numpy as np

from perception.records import FloatArray, Grid, Progress
from scenarios.benchmarks import Row, Table
from scenarios.sections import SonarSection, WorldSection
from scenarios.sonar.echoes import SonarModel, facet_echoes, sonar_model
from scenarios.world.build import build_world
from scenarios.world.components import Fractal


def run(progress: Progress) -> Table:
    """Time both on the same rough floor, at the demo's geometry."""
    config = SonarSection()
    world = build_world(
        WorldSection(
            size_east_m=160.0,
            size_north_m=160.0,
            terrain=(Fractal(kind="fractal", rms_m=1.0, longest_m=80.0),),
        ),
        rng=np.random.default_rng(0),
    )
    model = sonar_model(config, depth_m=60.0, cell_m=world.floor.cell_m)
    poses = _poses(world.floor, 400)
    facet_echoes(world.floor, world.albedo, poses[:2], model)  # compile
    start = time.perf_counter()
    fast = facet_echoes(world.floor, world.albedo, poses, model, progress)
    fast_s = time.perf_counter() - start
    few = 4
    start = time.perf_counter()
    plain = np.array(
        [
            [plain_echo(world.floor, world.albedo, p, s, model) for s in (-1.0, 1.0)]
            for p in poses[:few]
        ]
    )
    plain_s = time.perf_counter() - start
    worst = float(np.abs(fast[:few] - plain).max() / plain.max())
    case = f"2 x {config.samples} samples, {config.range_m:g} m, {config.azimuths} azimuths"
    rows = (
        Row(case, "kernel", "speed", len(poses) / fast_s, "pings/s", "", "all threads given"),
        Row(
            case,
            "plain numpy twin",
            "speed",
            few / plain_s,
            "pings/s",
            "",
            "whole arrays but for the walk, step by step",
        ),
        Row(case, "kernel against twin", "worst difference", worst, "of the peak", "< 1e-5"),
    )
    return Table("simulation", rows, {"pings": len(poses), "cell_m": world.floor.cell_m})


def _poses(floor: Grid, count: int) -> FloatArray:
    poses = np.zeros((count, 10))
    poses[:, 0] = 0.5 * (floor.west_m + floor.east_m)
    poses[:, 1] = floor.south_m + 55.0 + np.linspace(0.0, 50.0, count)
    poses[:, 2] = floor.elevation_m.mean() + 15.0
    poses[:, 8] = 1.5
    return poses


def plain_echo(
    floor: Grid, albedo: FloatArray, pose: FloatArray, side: float, model: SonarModel
) -> FloatArray:
    """Return one ping's echo on one side (samples,), written with whole arrays instead of loops.

    It follows the kernel's definition, direction by direction; only where a facet lies depends on
    the facet before it, and that is walked step by step.
    """
    power = np.zeros(model.samples)
    for k in range(len(model.beam.angles)):
        for outward in (1.0, -1.0):
            _plain_walk(floor, albedo, pose, side, outward, k, model, power)
    return power


def _plain_walk(
    floor: Grid,
    albedo: FloatArray,
    pose: FloatArray,
    side: float,
    outward: float,
    k: int,
    model: SonarModel,
    power: FloatArray,
) -> None:
    beam, direction = model.beam, side * outward
    sin_h, cos_h = np.sin(pose[3]), np.cos(pose[3])
    sin_p, cos_p, sin_r, cos_r = (
        np.sin(pose[4]), np.cos(pose[4]), np.sin(pose[5]), np.cos(pose[5]),
    )  # fmt: skip
    ahead = (pose[2] - float(floor.sample(pose[0], pose[1]))) * sin_p / cos_p
    first_drop = pose[2] - float(floor.sample(pose[0] + ahead * sin_h, pose[1] + ahead * cos_h))
    limit = model.samples * beam.sample_m if outward > 0 else first_drop
    v = beam.step_m * np.arange(int(np.ceil(limit / beam.step_m - 1e-9)) + 1)
    u, drop = np.zeros(len(v)), np.zeros(len(v))
    u[0], drop[0] = ahead, first_drop
    clip_e = (floor.west_m + 0.5 * floor.cell_m, floor.east_m - 0.501 * floor.cell_m)
    clip_n = (floor.south_m + 0.501 * floor.cell_m, floor.north_m - 0.5 * floor.cell_m)

    def place(u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        e = pose[0] + u * sin_h + direction * v * cos_h
        n = pose[1] + u * cos_h - direction * v * sin_h
        return np.clip(e, *clip_e), np.clip(n, *clip_n)

    for i in range(1, len(v)):
        guess = np.sqrt(u[i - 1] ** 2 + v[i] ** 2 + drop[i - 1] ** 2)
        u[i] = (guess * np.sin(beam.angles[k]) + drop[i - 1] * sin_p) / cos_p
        drop[i] = pose[2] - float(floor.sample(*place(u[i], v[i])))
    e, n = place(u, v)
    east_slope, north_slope = _patch_slopes(floor, e, n)
    slope = east_slope * sin_h + north_slope * cos_h
    slant = np.sqrt(u**2 + v**2 + drop**2)
    with np.errstate(divide="ignore"):
        rise = np.where(v > 0, -drop / v, -1e30)
    horizon = np.maximum.accumulate(rise)[:-1]
    before, after = rise[:-1], rise[1:]
    with np.errstate(invalid="ignore", divide="ignore"):
        part = np.where(before < horizon, (after - horizon) / (after - before), 1.0)
    seen = np.where(after > horizon, part, 0.0)
    mid_u, mid_v, mid_drop = (0.5 * (x[1:] + x[:-1]) for x in (u, v, drop))
    mid = np.sqrt(mid_u**2 + mid_v**2 + mid_drop**2)
    slope_u, slope_v = 0.5 * (slope[1:] + slope[:-1]), -np.diff(drop) / beam.step_m
    normal = np.sqrt(1 + slope_u**2 + slope_v**2)
    cosine = (mid_u * slope_u + mid_v * slope_v + mid_drop) / (mid * normal)
    cosine = np.where(cosine > 0, cosine, np.nan)
    strength = cosine**beam.exponent
    if beam.lobe > 0:
        steepness = 0.5 * (1 / cosine**2 - 1) / beam.lobe_tan2
        strength += beam.lobe * np.where(steepness < 20.0, np.exp(-steepness), 0.0)
    across, down = direction * mid_v, mid_u * sin_p + mid_drop * cos_p
    depression = np.arctan2(-across * sin_r + down * cos_r, side * (across * cos_r + down * sin_r))
    pattern = np.interp(np.rad2deg(depression), np.arange(-180, 181), beam.vertical)
    weight, shift = np.full(len(mid), beam.weights[k]), np.zeros(len(mid))
    if beam.turns:
        delay = 2 * mid / beam.sound_speed
        angle = beam.angles[k]
        seen_at = angle + delay * (pose[6] * across - pose[7] * mid_drop - pose[8]) / mid
        weight *= np.exp(-4 * np.log(2) * (seen_at**2 - angle**2) / beam.width**2)
        shift = -0.5 * delay * (mid_u * pose[8] - mid_drop * pose[9]) / mid
    rows, cols = floor.fractional_index(e, n)
    nearest = np.floor(rows + 0.5).astype(int), np.floor(cols + 0.5).astype(int)
    strengths = albedo[nearest][1:]
    energy = np.nan_to_num(mid * beam.step_m * normal * weight * strength * pattern) * seen
    far = slant[1:] + shift
    near = slant[1:] + (slant[:-1] - slant[1:]) * seen + shift
    _plain_deposit(power, near, far, energy * strengths, beam.sample_m)


def _patch_slopes(floor: Grid, e: FloatArray, n: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the slopes to east and north of the bilinear patch that each point lies in."""
    row, col = floor.fractional_index(e, n)
    i, j = np.floor(row).astype(int), np.floor(col).astype(int)
    fr, fc = row - i, col - j
    z = floor.elevation_m
    east = (z[i, j + 1] - z[i, j]) * (1 - fr) + (z[i + 1, j + 1] - z[i + 1, j]) * fr
    north = (z[i, j] - z[i + 1, j]) * (1 - fc) + (z[i, j + 1] - z[i + 1, j + 1]) * fc
    return east / floor.cell_m, north / floor.cell_m


def _plain_deposit(
    power: FloatArray, near: FloatArray, far: FloatArray, energy: FloatArray, sample_m: float
) -> None:
    """Spread each energy evenly between its two ranges: differences of a cumulative sum."""
    low, high = np.minimum(near, far)[:, None], np.maximum(near, far)[:, None]
    edges = np.arange(len(power) + 1)[None, :] * sample_m
    width = np.maximum(high - low, 1e-12)
    share = np.clip((edges - low) / width, 0.0, 1.0)
    power += (energy[:, None] * np.diff(share, axis=1)).sum(axis=0)
