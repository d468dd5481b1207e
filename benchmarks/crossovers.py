"""Crossovers of surveys whose truth is known: wrong matches, what they gain, and their NEES.

    python benchmarks/crossovers.py --surveys 20        errors of a track and soundings, drawn
    python benchmarks/crossovers.py --dives 3           dives of an independent simulator, through the command line
    python benchmarks/crossovers.py --predicted 4       what crosslines would leave, predicted and then driven
    python benchmarks/crossovers.py --dives 6 --small --online    the same, live: where the vehicle is after crosslines
    python benchmarks/crossovers.py --figure docs/images/crossovers.png

A survey has 12 lines of 500 m, 25 m apart, and four crosslines, 10 m above a bottom whose relief is 1 m over 20 m.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from fault_campaign.beams import Beams, Bottom, stated
from fault_campaign.campaign import merge
from fault_campaign.instruments import sample
from fault_campaign.judge import Dive, nees, run_dive, settled_rows, tracks, write_dive
from fault_campaign.motion import Motion, Profile
from fault_campaign.vehicle import Compass, configuration, make_vehicle
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, map_coordinates
from scipy.stats import chi2

import rovgraph as rg
from rovgraph.geometry import Array
from rovgraph.inference.chart import DepthChart
from rovgraph.inference.crossovers import field_at, match
from rovgraph.inference.drift import BEAMS_M, Drift
from rovgraph.inference.relief import Line, lines_of
from rovgraph.lab.crosslines import COUNTS, CrosslinePlan, plan_crosslines, plan_crosslines_after
from rovgraph.lab.plan import SensorRates
from rovgraph.lab.survey import Survey as Lines

KNOT_S = 20.0
WRONG_M = (
    3.0  # of a crossing: what is left of its shift, if it is beyond 99.9 % of what the track's covariance says, too
)


def path(lines: int = 12, length: float = 500.0, apart: float = 25.0, crosslines: int = 4) -> Array:
    """Places a metre, or a second, apart: lines to and fro, then crosslines; shape (n, 2)."""
    width, corners = (lines - 1) * apart, []
    for k in range(lines):
        ends = [(0.0, k * apart), (length, k * apart)]
        corners += ends if k % 2 == 0 else ends[::-1]
    over = 25.0
    for k in range(crosslines):
        north = length * (k + 0.5) / crosslines
        ends = [(north, width + over), (north, -over)]
        corners += ends if k % 2 == 0 else ends[::-1]
    points = [np.array(corners[0], float)]
    radius = 10.0
    for a, b, c in zip(corners, corners[1:], corners[2:], strict=False):
        a, b, c = (np.array(x, float) for x in (a, b, c))
        u, v = (b - a) / np.linalg.norm(b - a), (c - b) / np.linalg.norm(c - b)
        begin, end = b - u * radius, b + v * radius
        s = np.linspace(0.0, 1.0, 9)[:, None]
        points += list((1 - s) ** 2 * begin + 2 * s * (1 - s) * b + s**2 * end)
    points.append(np.array(corners[-1], float))
    p = np.array(points)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    at = np.arange(0.0, arc[-1], 1.0)
    return np.stack([np.interp(at, arc, axis) for axis in p.T], axis=-1)


@dataclass
class Terrain:
    """Depths on a grid of cells of half a metre about the survey."""

    depth: Array
    origin: tuple[float, float] = (-100.0, -100.0)
    cell: float = 0.5

    def __call__(self, place: Array) -> Array:
        where = ((place - self.origin) / self.cell).reshape(-1, 2).T
        return np.asarray(map_coordinates(self.depth, where, order=1, mode="nearest")).reshape(place.shape[:-1])


def spectrum(rng: np.random.Generator, shape: tuple[int, int], sd: float, density: Callable[[Array], Array]) -> Array:
    """A Gaussian field by its spectral density over the wave number [rad/m]."""
    k = [2.0 * np.pi * np.fft.fftfreq(n, 0.5) for n in shape]
    S = density(np.hypot(k[0][:, None], k[1][None]))
    values = np.fft.ifft2(np.fft.fft2(rng.standard_normal(shape)) * np.sqrt(S)).real
    return np.asarray(sd * values / values.std())


SHAPE = (1400, 1000)


def matern(rng: np.random.Generator, sd: float = 0.35, length: float = 4.5) -> Terrain:
    return Terrain(20.0 + spectrum(rng, SHAPE, sd, lambda k: (3.0 / length**2 + k**2) ** -2.5))


def flat(rng: np.random.Generator) -> Terrain:
    return Terrain(np.full(SHAPE, 20.0))


def waves(rng: np.random.Generator) -> Terrain:
    """Sand waves of one wavelength, of 0.35 m sd."""
    length, bearing = rng.uniform(12.0, 20.0), rng.uniform(0.0, np.pi)
    x = (np.arange(SHAPE[0])[:, None] * np.cos(bearing) + np.arange(SHAPE[1])[None] * np.sin(bearing)) * 0.5
    return Terrain(20.0 + 0.5 * np.sin(2.0 * np.pi * x / length + rng.uniform(0.0, 6.28)))


def smooth_relief(rng: np.random.Generator) -> Terrain:
    """Much smoother than the covariance that is fitted."""
    return Terrain(20.0 + spectrum(rng, SHAPE, 0.35, lambda k: np.exp(-((k * 5.0) ** 2))))


def rough_relief(rng: np.random.Generator) -> Terrain:
    """Much rougher: an exponential covariance."""
    return Terrain(20.0 + spectrum(rng, SHAPE, 0.35, lambda k: (1.0 / 10.0**2 + k**2) ** -1.5))


def other_relief(rng: np.random.Generator) -> Terrain:
    """Relief that no Matern describes: ridges on one half, boulders on the other, a smooth swell."""
    swell = spectrum(rng, SHAPE, 0.4, lambda k: np.exp(-((k * 20.0) ** 2)))
    ridged = np.abs(spectrum(rng, SHAPE, 0.5, lambda k: np.exp(-((k * 4.0) ** 2))))
    boulders = np.maximum(spectrum(rng, SHAPE, 1.0, lambda k: np.exp(-((k * 1.0) ** 2))) - 2.0, 0.0)
    half = np.linspace(0.0, 1.0, SHAPE[0])[:, None]
    return Terrain(20.0 + swell + half * ridged - (1.0 - half) * boulders)


@dataclass
class Drifting:
    """What a track's error is made of: sds of constants, and of a heading that wanders.

    Attributes
    ----------
    heading, deviation : constants [deg]; scale
    wander, wander_s : [deg, s]
    velocity : white, of the speed over ground [m/s/rtHz]
    start : of the first place of a dive [m]
    common : correlation of the constants of two dives
    """

    heading: float = 0.0
    deviation: float = 0.0
    scale: float = 0.0
    wander: float = 0.5
    wander_s: float = 900.0
    velocity: float = 0.005
    start: float = 0.1
    common: float = 0.5

    def covariance(self, t: Array, p: Array, dive: Array) -> Array:
        """Of north and east at m knots, shape (2 m, 2 m), by their times, places, shape (m, 2), and dives."""
        d, m = np.diff(p, axis=0) * (np.diff(dive) == 0)[:, None], len(p) - 1
        same, own = dive[:, None] == dive, dive[1:, None] == dive[1:]
        turned, psi = np.stack([-d[:, 1], d[:, 0]], axis=-1), np.arctan2(d[:, 1], d[:, 0])
        constants = [
            np.deg2rad(self.heading) * turned,
            np.deg2rad(self.deviation) * turned * np.sin(psi)[:, None],
            np.deg2rad(self.deviation) * turned * np.cos(psi)[:, None],
            self.scale * d,
        ]
        K = np.deg2rad(self.wander) ** 2 * np.exp(-np.abs(t[:-1, None] - t[:-1]) / self.wander_s)
        steps = np.einsum("ia,ij,jb->iajb", turned, K, turned).reshape(2 * m, 2 * m)
        alike = np.kron(np.where(own, 1.0, self.common), np.ones((2, 2)))
        for c in constants:
            steps += alike * np.outer(c.ravel(), c.ravel())
        steps += self.velocity**2 * KNOT_S * np.eye(2 * m)
        total = np.kron(np.tril(np.ones((m + 1, m)), -1) * same[:, 1:], np.eye(2))
        return total @ steps @ total.T + self.start**2 * np.kron(same, np.eye(2)) + 1e-6 * np.eye(2 * m + 2)


MTI = Drifting(heading=0.5, deviation=0.5, scale=0.003)
KNOWN = Drifting(heading=0.1, deviation=0.1, scale=0.0006)
WANDER = Drifting()
SLOW = Drifting(wander=1.0, wander_s=3600.0)
CONSTANTS = Drifting(heading=0.3, scale=0.004, wander=0.0)
FOG = Drifting(wander=0.1, wander_s=3600.0)
LOST = Drifting(start=50.0)


@dataclass
class Case:
    """A row of the table.

    Attributes
    ----------
    drift, terrain : of the track, and of the bottom
    noise : of a sounding [m]
    tide : amplitude [m], with a period of 10 000 s
    steep : sd of what the zero of depth does in each of 5 minutes, over the way [m/m]
    late : of the depth of a vehicle that follows the bottom [s]
    fish : share of the time, or a school as dense as a bottom
    altimeter : one beam
    size : lines, their length, how far they are apart, crosslines
    chart : what is wrong with it, or "right"
    again : crosslines of a second dive, so long after
    """

    drift: Drifting = field(default_factory=lambda: WANDER)
    terrain: Callable[[np.random.Generator], Terrain] = matern
    noise: float = 0.14
    tide: float = 0.0
    steep: float = 0.0
    late: float = 0.0
    fish: float = 0.0
    dense: bool = False
    altimeter: bool = False
    size: tuple[int, float, float, int] = (12, 500.0, 25.0, 4)
    chart: str | None = None
    again: int = 0
    after_s: float = 15_000.0

    @cached_property
    def way(self) -> tuple[Array, Array, NDArray[np.intp]]:
        """Time and place, every second, shapes (n,), (n, 2), and which of them are knots."""
        dives = [path(*self.size)]
        if self.again:
            length, width = self.size[1], (self.size[0] - 1) * self.size[2]
            across = path(self.again, width + 50.0, length / self.again, 0)[:, ::-1]
            dives.append(across + np.array([0.5 * length / self.again, -25.0]))
        t, knots, first = [], [], 0
        for dive in range(len(dives)):
            own = np.arange(first, first := first + len(dives[dive]))
            t.append(own + dive * self.after_s)
            knots.append(np.append(own[: -1 : int(KNOT_S)], own[-1]))
        return np.concatenate(t), np.concatenate(dives), np.concatenate(knots)

    @cached_property
    def covariance(self) -> tuple[Array, Array]:
        """Of the track at its knots, and its root."""
        t, p, knots = self.way
        dive = np.cumsum(np.diff(t[knots], prepend=0.0) > 0.5 * self.after_s)
        P = self.drift.covariance(t[knots], p[knots], dive)
        return P, np.linalg.cholesky(P)


def charted(rng: np.random.Generator, terrain: Terrain, change: str) -> DepthChart:
    """A chart of the bottom in cells of a metre, with errors of 0.5 m and an offset of 2 m; with something wrong."""
    depth = terrain.depth[::2, ::2] + 2.0 + rng.normal(0.0, 0.5, terrain.depth[::2, ::2].shape)
    if change == "upside down":
        depth = depth[::-1]
    elif change == "holes":
        depth[spectrum(rng, depth.shape, 1.0, lambda k: np.exp(-((k * 8.0) ** 2))) > 0.5] = np.nan
    elif change == "elsewhere":
        depth = np.roll(depth, (300, 200), (0, 1))
    return DepthChart(depth / 0.3048 if change == "feet" else depth, np.array(terrain.origin), 2.0 * terrain.cell, 0.5)


LINE = 2, 250.0, 25.0, 0
SMALL = 8, 250.0, 25.0, 3  # lines, their length, how far they are apart, crosslines

CASES = {
    "MTi with compass": Case(MTI),
    "constants five times better": Case(KNOWN),
    "heading 0.5 deg, 15 min": Case(WANDER),
    "heading 1 deg, 1 h": Case(SLOW),
    "constants only": Case(CONSTANTS),
    "FOG": Case(FOG),
    "altimeter": Case(WANDER, altimeter=True),
    "flat bottom": Case(MTI, flat, size=SMALL),
    "sand waves": Case(MTI, waves, size=SMALL),
    "other relief": Case(MTI, other_relief, size=SMALL),
    "fish school": Case(MTI, fish=0.15, size=SMALL),
    "dense fish school": Case(MTI, fish=0.15, dense=True, size=SMALL),
    "tide": Case(MTI, tide=1.5, size=SMALL),
    "steep tide": Case(MTI, steep=0.04, size=SMALL),
    "late depth": Case(MTI, late=1.0, size=SMALL),
    "smooth relief": Case(MTI, smooth_relief, size=SMALL),
    "rough relief": Case(MTI, rough_relief, size=SMALL),
    "two dives": Case(replace(MTI, start=4.0), tide=1.5, size=(8, 250.0, 25.0, 0), again=4),
    "chart": Case(LOST, size=LINE, chart="right"),
    "chart with holes": Case(LOST, size=LINE, chart="holes"),
    "chart elsewhere": Case(LOST, size=LINE, chart="elsewhere"),
    "chart upside down": Case(LOST, size=LINE, chart="upside down"),
    "chart in feet": Case(LOST, size=LINE, chart="feet"),
}


@dataclass
class Survey:
    """Errors of a track and its soundings, drawn.

    Attributes
    ----------
    time, true, error : shapes (n,), (n, 2), (n, 2), every second [s, m]; the track is at true - error
    knots, at_knots : of the drift, shapes (m,), (2 m,)
    lines, drift, chart : what `match` gets
    """

    time: Array
    true: Array
    error: Array
    knots: Array
    at_knots: Array
    lines: list[Line]
    drift: Drift
    chart: DepthChart | None


def draw(case: Case, seed: int) -> Survey:
    rng = np.random.default_rng([43, seed])
    t, p, at = case.way
    knots, (P, root) = t[at], case.covariance
    e = root @ rng.standard_normal(len(P))
    error = np.stack([np.interp(t, knots, axis) for axis in e.reshape(-1, 2).T], axis=-1)
    terrain = case.terrain(rng)
    way = np.gradient(p, t, axis=0)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    side = np.stack([-way[:, 1], way[:, 0]], axis=-1)
    reach = 0.0 if case.altimeter else 10.0 * np.tan(np.deg2rad(22.5)) / np.sqrt(2.0)
    signs = [(0.0, 0.0)] if case.altimeter else [(1, 1), (1, -1), (-1, 1), (-1, -1)]
    arm = np.stack([reach * (a * way + b * side) for a, b in signs], axis=1)
    depth = terrain(p[:, None] + arm) + rng.normal(0.0, case.noise, arm.shape[:2])
    zero = case.tide * np.sin(2.0 * np.pi * t / 10000.0)
    if case.steep:
        slopes = np.random.default_rng([48, seed]).normal(0.0, case.steep, len(t) // 300 + 1)
        zero += np.cumsum(np.repeat(slopes, 300)[: len(t)])
    if case.late:
        follows = gaussian_filter1d(terrain(p), 10.0)
        zero += np.interp(t - case.late, t, follows) - follows
    depth += zero[:, None]
    if case.fish:
        inside = np.interp(t, np.arange(0, len(t) + 20, 20), rng.uniform(size=len(t) // 20 + 2)) < case.fish
        depth -= inside[:, None] * (2.0 if case.dense else rng.uniform(0.0, 4.0, depth.shape))
    beams = np.repeat(np.random.default_rng([47, seed]).normal(0.0, BEAMS_M, (len(t) // 60 + 1, 2)), 60, axis=0)
    place = (p - error + beams[: len(t)])[:, None] + arm
    heading = np.arctan2(way[:, 1], way[:, 0])
    lines = lines_of(t, heading, p - error, np.repeat(t, len(signs)), place.reshape(-1, 2), depth.ravel())
    drift, chart = Drift(knots, np.zeros(len(P)), P), None
    if case.chart is not None:
        drift, chart = drift.beside(np.zeros(2), 1e-3), charted(rng, terrain, case.chart)
    return Survey(t, p, error, knots, e, lines, drift, chart)


def shape_rms(error: Array, place: Array) -> float:
    """What remains of n errors when the whole track is shifted, turned and scaled as it fits best [m]."""
    e, z = (x[:, 0] + 1j * x[:, 1] for x in (error, place))
    M = np.column_stack([np.ones_like(z), z])
    return float(np.sqrt(np.mean(np.abs(e - M @ np.linalg.lstsq(M, e, rcond=None)[0]) ** 2)))


@dataclass
class Outcome:
    """Of one survey: rms error before and after, and after but for shift, rotation and scale of the whole [m]; NEES,
    crossings that were used, that there are, and that were matched wrongly."""

    before: float
    after: float
    shape: float
    nees: float
    used: int
    crossings: int
    wrong: int
    seconds: float
    text: str


def survey(case: Case, seed: int) -> Outcome:
    drawn = draw(case, seed)
    begin = time.perf_counter()
    found = match(drawn.lines, drawn.drift, drawn.chart)
    seconds = time.perf_counter() - begin
    after, e = drawn.drift.given(found.closures) if found.closures else drawn.drift, drawn.at_knots
    left = e - after.mean[: len(e)]
    nees, wrong = np.nan, 0
    if found.closures:
        each = [(left[own], after.P[own, own]) for own in (slice(2 * k, 2 * k + 2) for k in range(1, len(drawn.knots)))]
        nees = float(np.mean([x @ np.linalg.solve(C, x) / 2 for x, C in each]))
        H, off_chart = (
            after.between([c.times for c in found.closures]),
            np.append(left, np.zeros(len(after.mean) - len(e))),
        )
        for k in range(0, len(H), 2):
            x, C = H[k : k + 2] @ off_chart, H[k : k + 2] @ after.P @ H[k : k + 2].T
            wrong += int(np.linalg.norm(x) > WRONG_M and x @ np.linalg.solve(C, x) > chi2.isf(1e-3, 2))
    rms = [float(np.sqrt(np.mean(x**2) * 2)) for x in (e, left)]
    shape = shape_rms(left.reshape(-1, 2), drawn.true[np.searchsorted(drawn.time, drawn.knots)])
    used, crossings = len(found.closures), len(found.crossings)
    return Outcome(*rms, shape, nees, used, crossings, wrong, seconds, f"{found.text} {found.relief}")


def draw_figure(path: str, case: Case, seed: int) -> None:
    """A survey with and without crossovers, and the field of one of its crossings."""
    import matplotlib.pyplot as plt

    drawn = draw(case, seed)
    found = match(drawn.lines, drawn.drift)
    after = drawn.drift.given(found.closures)
    figure, (left, right) = plt.subplots(1, 2, figsize=(10.0, 5.0), layout="constrained")
    tracks = {
        "true": (drawn.true, "0.7"),
        "without crossovers": (drawn.true - drawn.error, "tab:red"),
        "with crossovers": (drawn.true - drawn.error + after.at(drawn.time), "tab:blue"),
    }
    for name, (place, colour) in tracks.items():
        left.plot(place[:, 1], place[:, 0], color=colour, label=name, linewidth=2.5 if name == "true" else 0.9)
    left.set(xlabel="east [m]", ylabel="north [m]", aspect="equal")
    left.legend(loc="upper right", fontsize=8)
    crossing = found.crossings[-5]
    true = drawn.error[[np.abs(drawn.time - time).argmin() for time in crossing.times]]
    axis = np.arange(-30.0, 30.5, 0.5)
    shifts = true[0] - true[1] + np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    L = field_at(drawn.lines, crossing, true[0] - true[1], 40.0, found.relief, None).at(shifts.reshape(-1, 2))
    image = right.pcolormesh(axis, axis, L.reshape(len(axis), -1).clip(min=-10.0), cmap="viridis")
    right.plot(0.0, 0.0, "r+", markersize=12)
    right.set(xlabel="shift from the true one, east [m]", ylabel="north [m]", aspect="equal")
    figure.colorbar(image, ax=right, label="log likelihood of one crossing [nats]", shrink=0.8)
    figure.savefig(path, dpi=110)


@dataclass
class Relief(Bottom):
    """The bottom of a terrain, for the beams of a simulated dive."""

    terrain: Terrain | None = None

    def at(self, north: Array, east: Array) -> tuple[Array, Array]:
        assert self.terrain is not None
        place, h = np.stack([north, east], axis=-1), 0.25
        slope = [(self.terrain(place + d) - self.terrain(place - d)) / (2 * h) for d in ((h, 0.0), (0.0, h))]
        normal = np.stack([-slope[0], -slope[1], np.ones_like(north)], axis=-1)
        return self.terrain(place), normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def survey_motion(lines: int, length: float, apart: float, crosslines: int, home: float = 0.0) -> Motion:
    """The same survey at 1 m/s, its first line to the north; turns of 90 degrees within 10 s; then ``home`` metres."""
    turn, over = 10.0, 25.0
    beside = apart - 0.62 * turn  # of a straight between two turns
    legs: list[tuple[float, float]] = []  # length of a straight and the turn after it
    for k in range(lines):
        side = 1.0 if k % 2 == 0 else -1.0
        legs += [(length, side), (beside, side)] if k < lines - 1 else [(length, -1.0), (over, -1.0)]
    for k in range(crosslines):
        side = -1.0 if k % 2 == 0 else 1.0
        legs += [(length * (0.5 if k == 0 else 1.0) / crosslines, side), (apart * (lines - 1) + 2.0 * over, -side)]
    t, heading = 20.0, []
    for straight, side in legs:
        t += straight
        heading.append((t, turn, side * np.pi / 2.0))
        t += turn
    t += home
    surge = Profile(0.0, ((8.0, 4.0, 1.0),), ((0.005, 5.1, 0.3),))
    still, level = Profile(0.0, (), ((0.003, 6.7, 1.1),)), Profile(0.0, (), ((2e-4, 5.9, 0.7),))
    return Motion(t, Profile(0.0, tuple(heading)), (surge, still, still), level, level, depth=10.0)


def dive(
    terrain: Callable[[np.random.Generator], Terrain],
    seed: int,
    size: tuple[int, float, float, int],
    gyro_scale: float,
    home: float = 0.0,
) -> Dive:
    """A dive with an MTi with compass: offset and deviation of 0.5 degrees, scale of the DVL 0.3 %.

    The gyro's scale decides how far it shows the deviation: an sd of 0.5 % is stated, ``gyro_scale`` is drawn.
    """
    rng = np.random.default_rng([44, seed])
    motion = survey_motion(*size, home)
    vehicle = make_vehicle("mti", ("ahrs", "depth"))
    beams = Beams(bottom=Relief(20.0, terrain=terrain(rng)))
    vehicle.imu.gyr_matrix = np.diag(1.0 + rng.normal(0.0, gyro_scale, 3))
    vehicle.dvl = replace(
        vehicle.dvl, mount_rpy_deg=(0.0, 0.0, -45.0), yaw_sd=0.3, scale_sd=0.003, sd=beams.head.velocity_sd
    )
    vehicle.dvl.rate, vehicle.imu.rate = 2.0, 50.0
    vehicle.ahrs = Compass(offset_sd=0.5, curve_sd=0.5)
    config = merge(configuration(vehicle), stated(beams.head))
    more = {"dvl_scale": {"estimate": "considered", "sd": 0.003}}
    config = merge(config, {"calibration": more, "environment": {"earth_rotation": True}})  # as long legs need it
    streams, hidden = sample(motion, vehicle, rng, beams)
    return Dive(streams, config, motion, hidden)


HOME_M, END_S = 90.0, 30.0  # after the crosslines of a live dive, and of its end that counts


def print_dives(row: str, seeds: range, small: bool, gyro_scale: float, online: bool) -> None:
    """Both ways, smoothed: rms, that of the shape, sd, NEES, seconds, and what was said; live at the end likewise."""

    def inspect(folder: Path, dive: Dive) -> dict[str, float]:
        track = dict(tracks(folder))
        rows = settled_rows(track["smoothed"], dive)
        true = dive.motion.local(rows["time"].to_numpy())[:, :2]
        found = {"shape": shape_rms(true - rows[["north", "east"]].to_numpy(), true)}
        for kind in track if online else ():
            end = settled_rows(track[kind], dive).iloc[-int(END_S) :]
            quantities, rms, sd = nees(end, dive.motion)
            found |= {f"{kind} rms": rms, f"{kind} sd": sd, f"{kind} nees": quantities["position"]}
        return found

    for seed in seeds:
        size = SMALL if small else Case().size
        made = dive(CASES[row].terrain, seed, size, gyro_scale, HOME_M if online else 0.0)
        for crossovers in (False, True):
            begin, config = time.perf_counter(), merge(made.configuration, {"graph": {"crossovers": crossovers}})
            got = run_dive(replace(made, configuration=config), online, inspect)
            seconds, said = time.perf_counter() - begin, [line for line in got.said if "crossovers:" in line]
            ways = {"smooth": [got.rms["smoothed"], got.found["shape"], got.sd["smoothed"]]}
            ways["smooth"].append(got.nees["smoothed"]["position"])
            for kind, command in (("smoothed", "smooth"), ("online", "online")) if online else ():
                ways[f"{command}, end"] = [got.found[f"{kind} {name}"] for name in ("rms", "sd", "nees")]
            for way, numbers in ways.items():
                cells = " | ".join(f"{number:.2f}" for number in numbers)
                live, verdict = way.startswith("online"), got.verdicts[way.partition(",")[0]]
                text = "; ".join([line for line in said if line.startswith("online") == live][-1:])
                how = "with" if crossovers else "without"
                print(f"| {row} {seed} | {how} | {way} | {cells} | {seconds:.0f} | {verdict} | {text} |", flush=True)


def print_predicted(row: str, seeds: range, gyro_scale: float) -> None:
    """The sd of a small survey's lines with 0, 1, 2 and 4 crosslines: by its size, by its log, and as driven."""
    lines, length, apart, _ = SMALL
    end = survey_motion(lines, length, apart, 0).duration

    def read(crosslines: int, seed: int) -> tuple[rg.Log, rg.Config]:
        made = dive(CASES[row].terrain, seed, (lines, length, apart, crosslines), gyro_scale)
        made = replace(made, configuration=merge(made.configuration, {"graph": {"crossovers": True}}))
        with TemporaryDirectory() as folder:
            write_dive(made, Path(folder))
            config = rg.load_config(Path(folder) / "vehicle.yaml")
            return rg.read_log(Path(folder) / "log.csv", config), config

    for seed in seeds:
        log, config = read(0, seed)
        after = plan_crosslines_after(log, config)
        centres = np.array([p.mean(axis=0) for p in after.survey.legs[after.survey.parallel]])
        wide = float(np.median(np.linalg.norm(np.diff(centres, axis=0), axis=1)))
        size = f"{lines}x{np.ptp(after.survey.box[:, 0]):.0f}x{wide:.1f}@1"
        before = plan_crosslines(Lines.planned(size, config), config, SensorRates(50.0, 2.0), after.relief)
        driven = []
        for count in (0, *COUNTS):
            track = rg.smooth(*read(count, seed)).smoothed.trajectory
            P = track.cov_p[track.time < end]
            driven.append(float(np.sqrt(np.mean(P[:, 0, 0] + P[:, 1, 1]))))
        said = (", ".join(f"{sd:.2f}" for sd in sds) for sds in (_sds(before), _sds(after), driven))
        print(f"| {seed} | {' | '.join(said)} |", flush=True)


def _sds(plan: CrosslinePlan) -> list[float]:
    return [c.sd for c in plan.ranked]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", nargs="*", default=list(CASES))
    parser.add_argument("--surveys", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--dives", type=int, default=0, help="through the command line, of the first row alone")
    parser.add_argument("--predicted", type=int, default=0, help="small surveys with and without crosslines")
    parser.add_argument("--small", action="store_true", help="dives of 8 lines of 250 m, with three crosslines")
    parser.add_argument("--online", action="store_true", help="dives through the online mode, too")
    parser.add_argument("--gyro-scale", type=float, default=0.005, help="sd of the gyro's scale errors in dives")
    parser.add_argument("--figure", help="draw a survey to this file")
    given = parser.parse_args()
    if given.figure:
        draw_figure(given.figure, CASES[given.rows[0]], given.first)
        return
    if given.predicted:
        print_predicted(given.rows[0], range(given.first, given.first + given.predicted), given.gyro_scale)
        return
    if given.dives:
        seeds = range(given.first, given.first + given.dives)
        print_dives(given.rows[0], seeds, given.small, given.gyro_scale, given.online)
        return
    for name in given.rows:
        out = []
        for k in range(given.surveys):
            out.append(survey(CASES[name], given.first + k))
            if given.verbose:
                print("   ", out[-1], flush=True)
        rms = (np.sqrt(np.mean([getattr(o, n) ** 2 for o in out])) for n in ("before", "after", "shape"))
        before, after, shape = rms
        some = [o for o in out if o.used]
        print(
            f"| {name} | {before:.1f} | {after:.1f} | {after / before:.2f} | {shape:.1f} | {len(some)} of {len(out)} | "
            f"{sum(o.used for o in out)} | {sum(o.wrong for o in out)} | {sum(o.wrong > 0 for o in out)} | "
            f"{np.mean([o.nees for o in some]) if some else np.nan:.2f} | "
            f"{np.mean([o.seconds for o in out]):.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
