"""Position fixes against the DVL's track, turned by a heading, and against the configured start.

In the plane as complex numbers: a fix is ``p + c D(t - tau)`` with ``D`` the sum of ``exp(i psi) v dt``. ``arg c`` is
the error of heading and mounting, ``|c|`` the scale, ``tau`` how late the fixes are, and ``p`` is free in each stretch
of some minutes, since D drifts. Fixes of swapped north and east fit the conjugate of D; a DVL whose y axis is mirrored
fits better with the conjugate velocity. A cause is named where it explains the fixes better than chance.

`start` compares the configured start with the first fixes. The vehicle cannot be further from its start than the
distance that the DVL has measured since. Fixes of another origin, or turned by a wrong heading of the ship, begin
somewhere else.

`current` finds a current that changes under a water track: against the bottom track or fixes, one level against two.
The water's velocity over ground is that of the vehicle over ground less that through the water, c = v - v_w, turned
into n by a compass. In means over blocks of some seconds waves hardly show.
"""

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rovgraph.diagnosis.check.compasses import body_heading
from rovgraph.diagnosis.check.findings import Finding, believed_lag, since, valid_pings
from rovgraph.diagnosis.check.inertial import in_gap
from rovgraph.errors import InputError
from rovgraph.geometry import Array, rotate
from rovgraph.log import Log, Stream
from rovgraph.log.streams import LAT_LON, integral
from rovgraph.model.config import Config, beliefs, mount_matrix
from rovgraph.model.gauss_markov import walked
from rovgraph.model.grids import convergence_and_scale, utm_zone
from rovgraph.rules import BELIEVED_SDS, CLIPPED, START_REMEDY, SURE, TRACK, remedy_of_lag
from rovgraph.sensors.compass import reference
from rovgraph.sensors.dvl import other_way_up
from rovgraph.sensors.instruments import DEFAULT_DIP, OFFSETS, heading_sources

MIN_FIXES = 15
STRETCH = 300.0  # over which the DVL's track drifts less than fixes scatter [s]
LONGEST_GAP = 5.0  # between pings, in which the track is lost [s]
ENOUGH_DISTANCE = 10.0  # spread of the fixes [m]
MISALIGNED = np.deg2rad(15.0)
FARTHER = 5.0  # times the spread of fixes, that a DVL's track spreads over if they are no measurement of it
RADIANS = 40.0, 80.0  # times too small, that radians are if they are taken for degrees
LAG_STEP = 0.25  # [s]
STRETCHED = 0.1  # logarithm of a scale that no turn leaves
MIRRORED = 3.0  # times less error, that a mirrored axis leaves
LIKE = 0.9  # agreement, below which fixes and track go different ways where noise is not the reason
UNEXPLAINED, CLOSELY = (
    1.6,
    0.995,
)  # of the fixes' variance, left by what is no cause; agreement that is one all the same
Complexes = NDArray[np.complex128]


@dataclass(frozen=True)
class _Line:
    """Least squares of fixes by a track.

    Attributes
    ----------
    c : turn and scale
    sd : of c, relative
    agreement : part of the fixes' movement that it explains, 0 to 1, as a correlation
    error : sum of squared residuals, in units of their variance where all is right
    """

    c: complex
    sd: float
    agreement: float
    error: float


@dataclass(frozen=True)
class Tracks:
    """The DVL's track beside the fixes.

    Attributes
    ----------
    sensor : compass that turns it
    heading : its times and headings [rad]
    arm : of what is positioned, from the DVL, forward and starboard [m]
    pings : with bottom lock
    way, mirrored : ndarray, shape (n,), its track, and that of a DVL whose y axis points the other way [m]
    """

    sensor: str
    heading: tuple[Array, Array]
    arm: complex
    pings: Stream
    plane: "Plane"
    way: Complexes
    mirrored: Complexes

    def beside(self, positions: Stream) -> "Plane":
        """The same track beside other positions."""
        arms = self.arm * np.exp(1j * np.interp(positions.time, *self.heading))
        return Plane(positions, self.pings.time, arms)


def tracks(log: Log, config: Config, compass: str | None = None) -> Tracks | None:
    """The DVL's track by the heading that determines it best, or by one compass; None where something is missing."""
    if not {"dvl", "fix"} <= log.sensors:
        return None
    others = {name: s for name, s in log.streams.items() if compass in (None, name) or name not in OFFSETS}
    found = body_heading(replace(log, streams=others), config)
    pings = valid_pings(log["dvl"])
    if found is None or len(pings) < MIN_FIXES or len(log["fix"]) < MIN_FIXES:
        return None
    sensor, *heading = found
    psi = heading[0], heading[1]
    v_b = rotate(mount_matrix(config.dvl.mount_rpy_deg), pings.data[:, :3])
    turn = np.exp(1j * np.interp(pings.time, *psi))
    arm = complex(*config.fix.lever_arm_m[:2]) - complex(*config.dvl.lever_arm_m[:2])  # from the DVL
    plane = Plane(log["fix"], pings.time, arm * np.exp(1j * np.interp(log["fix"].time, *psi)))
    way, mirrored = (plane.way(turn * (v_b[:, 0] + sign * 1j * v_b[:, 1])) for sign in (1.0, -1.0))
    return Tracks(sensor, psi, arm, pings, plane, way, mirrored)


def turned_by(log: Log, config: Config, compass: str) -> float | None:
    """How far the DVL's track by a compass has to be turned to fit the fixes [rad]; None where they do not show it."""
    found = tracks(log, config, compass)
    if found is None or found.plane.spread < max(ENOUGH_DISTANCE, SURE * config.fix.sd_m):
        return None
    line = found.plane.fit(found.way, 0.0)
    return None if line.agreement < TRACK.follows else float(np.angle(line.c))


def _too_short(found: Tracks, geodetic: bool) -> Finding:
    """Fixes that move too little to be compared, although the DVL moves far."""
    line, moved = found.plane.fit(found.way, 0.0), found.plane.spread_of(found.way)
    if moved < max(ENOUGH_DISTANCE, FARTHER * found.plane.spread):
        return Finding("fix", "ok", "too few fixes, or too little movement, to compare the DVL with them")
    text = f"the fixes spread over {found.plane.spread:.2g} m while the DVL's track spreads over {moved:.3g} m"
    if geodetic and line.agreement > TRACK.follows and RADIANS[0] < 1.0 / max(abs(line.c), 1e-9) < RADIANS[1]:
        return Finding(
            "fix", "warning", f"{text}: latitude and longitude are in radians; state units: {{fix: rad}}", "unit"
        )
    return Finding("fix", "warning", f"{text}: check the unit of the fixes, and whether they are measured", "scale")


def track(log: Log, config: Config) -> Iterator[Finding]:
    """Handedness, rotation, scale and clock of the DVL's velocities against the fixes."""
    found = tracks(log, config)
    if found is None:
        return
    sensor, pings, plane, way, mirrored = found.sensor, found.pings, found.plane, found.way, found.mirrored
    if plane.spread < max(ENOUGH_DISTANCE, SURE * config.fix.sd_m):
        if len(plane.fixes) >= MIN_FIXES and plane.count >= MIN_FIXES:
            yield _too_short(found, log.origin is not None)
        else:
            yield Finding("fix", "ok", "too few fixes, or too little movement, to compare the DVL with them")
        return
    lag, lag_sd, lag_evidence = plane.lag(way)
    late = TRACK.is_late(lag, lag_sd, believed_lag(config, "fix")) and lag_evidence > TRACK.evidence
    as_is, unlike, swapped = (plane.fit(one, 0.0) for one in (way, mirrored, way.conj()))
    late &= plane.fit(way, lag).error < min(unlike.error, swapped.error)
    if late:
        as_is, unlike, swapped = (plane.fit(one, lag) for one in (way, mirrored, way.conj()))
    if _better(swapped, as_is) and swapped.error <= 1.05 * unlike.error:
        angle = round(np.rad2deg(np.angle(swapped.c)))
        yield Finding(
            "fix",
            "warning",
            "north and east are swapped or mirrored; corrected, the fixes fit the DVL's track turned by "
            f"{angle:+d} deg (agreement {swapped.agreement:.2f} instead of {as_is.agreement:.2f}): {_exchange(log)}",
            "swapped",
        )
    elif _better(unlike, as_is, MIRRORED) and unlike.agreement > TRACK.follows and plane.explained(unlike):
        yield Finding("dvl", "warning", _mirrored_text(config, as_is.agreement, unlike.agreement), "axes")
    elif as_is.agreement < TRACK.follows:
        if as_is.error > TRACK.evidence + 2.0 * plane.count:
            text = f"velocities do not fit the fixes (agreement {as_is.agreement:.2f}); check mounting and heading"
            yield Finding("dvl", "warning", text, "contradiction")
    else:
        turned = _turned(config, {sensor, *heading_sources(config, log.sensors)}, as_is, unlike)
        said, sure = _of_grid(log, config, sensor, as_is)
        turned = replace(turned, level="warning" if sure else turned.level, text=turned.text + said)
        stretched = turned.level != "ok" and abs(np.log(abs(as_is.c))) > STRETCHED
        apart = not plane.explained(as_is) and (stretched or as_is.agreement < LIKE)
        yield _contradicted(as_is) if apart else turned
        if late:
            sense = "late" if lag > 0.0 else "early"
            text = f"fixes come {abs(lag):.1f} s {sense} relative to the DVL's track (sd {lag_sd:.1f} s)"
            moved = float(np.median(np.linalg.norm(pings.data[:, :3], axis=1))) * abs(lag)
            remedy = f"{remedy_of_lag(config, 'fix', lag, lag_sd)}, if it is {moved:.1f} m off"
            yield Finding("fix", "warning", f"{text}: {remedy}", "lag")


def _exchange(log: Log) -> str:
    """What to do about swapped columns of fixes."""
    pair = ("fix_north", "fix_east") if log.origin is None else LAT_LON
    named = {} if log.config is None else log.config.columns
    one, other = (named.get(name, name) for name in pair)
    return f"state columns: {{{pair[0]}: {other}, {pair[1]}: {one}}}"


def _better(one: _Line, other: _Line, times: float = 1.5) -> bool:
    """Whether it explains the fixes beyond chance, and beyond what a drift of the track may do."""
    return one.error + TRACK.evidence < other.error and one.error * times < other.error


def heading_believed(config: Config, compasses: Collection[str]) -> float:
    """How far heading and mounting may be off by what is believed of them [rad]."""
    priors = {name: belief for name, belief in beliefs(config).items() if belief.estimate}
    sds = [priors[name].sd for name in ("dvl_yaw", *(OFFSETS[sensor] for sensor in compasses)) if name in priors]
    if "mag" in compasses and "hard_iron" in priors:
        dip = DEFAULT_DIP if config.environment.dip_deg is None else np.deg2rad(config.environment.dip_deg)
        sds.append(priors["hard_iron"].sd / max(np.cos(dip), 0.1))
    return BELIEVED_SDS * math.hypot(*sds)


def _of_grid(log: Log, config: Config, sensor: str, line: _Line) -> tuple[str, bool]:
    """What says that a heading is relative to a grid, or was made true twice, by the turn of its track; "" = nothing.

    With it, whether compass and mounting are known so well that nothing else turns the track.
    """
    if log.origin is None or sensor not in NORTHS:
        return "", False
    grid = config.environment.grid or utm_zone(*log.origin)
    try:
        found = float(convergence_and_scale(grid, *np.array(log.origin))[0])
    except InputError:  # no PROJ, or no such place
        return "", False
    turn, north = math.degrees(float(np.angle(line.c))), reference(config, sensor)
    expected, sd = -found if north == "grid" else found, math.degrees(line.sd)
    if abs(found) < OF_GRID_SDS * sd or abs(turn - expected) > max(0.25 * abs(found), OF_GRID_DEG):
        return "", False
    key = f"heading.{NORTHS[sensor]}_reference"
    said = f"; the convergence of {grid} is {found:+.2f} deg there"
    if north == "grid":
        said += f", and was probably taken twice: if {sensor} is true already, state {key}: true"
    else:
        said += f": if {sensor} is relative to grid north, state {key}: grid, and environment.grid: {grid}"
    priors = (beliefs(config)[name] for name in {OFFSETS[sensor], "dvl_yaw"})
    others = math.hypot(*(math.degrees(prior.sd) for prior in priors if prior.estimate or prior.considered))
    return said, abs(found) > OF_GRID_SDS * others


NORTHS = {"ahrs": "ahrs", "dvl_heading": "dvl", "vehicle_heading": "vehicle"}
OF_GRID_SDS, OF_GRID_DEG = 4.0, 0.2  # of a turn that is a convergence: beyond its sd, and from it


def _contradicted(as_is: _Line) -> Finding:
    """What neither a turn nor a scale explains."""
    turn = round(np.rad2deg(np.angle(as_is.c))) + 0
    text = (
        f"its track and the fixes do not show the same motion: turned by {turn:+d} deg and scaled by "
        f"{abs(as_is.c):.2f} it still misses them; the bottom moves, or the fixes wander"
    )
    return Finding("dvl", "warning", text, "contradiction")


def _turned(config: Config, sources: Collection[str], as_is: _Line, unlike: _Line) -> Finding:
    angle, scale = float(np.angle(as_is.c)), float(abs(as_is.c))
    wrong = abs(angle) > max(MISALIGNED, heading_believed(config, sources)) + SURE * as_is.sd or (
        not 0.8 < scale < 1.25 and abs(np.log(scale)) > SURE * as_is.sd + 0.2
    )
    tail = "; heading or mounting is off: check declination, compass offset and dvl.mount_rpy_deg" if wrong else ""
    if wrong and unlike.agreement > as_is.agreement - 0.05:
        tail += f". It may also be mirrored: {other_way_up(config)}"
    text = (
        f"its track fits the fixes when turned by {round(np.rad2deg(angle)) + 0:+d} deg and scaled by {scale:.2f}{tail}"
    )
    return Finding("dvl", "warning" if wrong else "ok", text, "turned")


class Plane:
    """Fixes as complex numbers, less their arm from the DVL, and the stretches in which the DVL's track is known."""

    def __init__(self, fix: Stream, pings: Array, arms: Complexes):
        lost = np.cumsum(np.diff(pings) > LONGEST_GAP)
        self.pings, self.time = pings, fix.time
        stretch = np.concatenate([[0], lost])[np.searchsorted(pings, fix.time).clip(0, len(pings) - 1)]
        stretch = stretch * 1_000_000 + ((fix.time - fix.time[0]) // STRETCH).astype(np.int64)
        self.stretch = np.unique(stretch, return_inverse=True)[1]
        self.fixes: Complexes = fix.data[:, 0] + 1j * fix.data[:, 1] - arms
        self.inside = ~in_gap(fix.time, pings, LONGEST_GAP)
        self.inside &= _near_median(self.fixes)

    @property
    def count(self) -> int:
        return int(self.inside.sum())

    def explained(self, line: _Line) -> bool:
        """Whether what a fit leaves of the fixes is about their noise, or next to nothing."""
        return line.error < UNEXPLAINED * self.count or line.agreement > CLOSELY

    @property
    def spread(self) -> float:
        """Of the fixes within their stretches [m]."""
        return 0.0 if self.count < MIN_FIXES else float(2.0 * np.sqrt(np.mean(np.abs(self.free(self.fixes)) ** 2)))

    def spread_of(self, way: Complexes) -> float:
        """The same of a track at the times of the fixes [m]."""
        return float(2.0 * np.sqrt(np.mean(np.abs(self.free(self.at(way, 0.0))) ** 2)))

    def way(self, velocity: Complexes) -> Complexes:
        """Integral of a velocity at the pings."""
        steps = 0.5 * (velocity[1:] + velocity[:-1]) * np.minimum(np.diff(self.pings), LONGEST_GAP)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def at(self, way: Complexes, lag: float) -> Complexes:
        when = self.time - lag
        return np.interp(when, self.pings, way.real) + 1j * np.interp(when, self.pings, way.imag)

    def free(self, values: Complexes) -> Complexes:
        """Without the mean of each stretch; shape (count,)."""
        values, stretch = values[self.inside], self.stretch[self.inside]
        n = np.maximum(np.bincount(stretch), 1)
        means = (np.bincount(stretch, values.real) + 1j * np.bincount(stretch, values.imag)) / n
        return np.asarray(values - means[stretch])

    def fit(self, way: Complexes, lag: float) -> _Line:
        """Turn and scale of a track that the fixes follow after a lag."""
        d, D = self.free(self.fixes), self.free(self.at(way, lag))
        square = max(float(np.vdot(D, D).real), 1e-12)
        c = complex(np.vdot(D, d)) / square
        left = d - c * D
        size = np.abs(left) ** 2
        left = np.where(size > CLIPPED**2 * np.median(size), 0.0, left)
        total = max(float(np.vdot(d, d).real), 1e-12)
        agreement = float(abs(np.vdot(D, d))) / np.sqrt(square * total)
        error = float(np.vdot(left, left).real)
        return _Line(c, np.sqrt(error / len(d) * inflation(left) / square), agreement, error / self.noise**2)

    @property
    def noise(self) -> float:
        """Of a fix in both components together, by differences from its neighbours' mean [m]."""
        second = np.abs(self.fixes[2:] - 2.0 * self.fixes[1:-1] + self.fixes[:-2])
        return float(max(np.median(second) / np.sqrt(6.0) / 0.8326, 1e-3))  # the median of a Rayleigh variable

    def lag(self, way: Complexes) -> tuple[float, float, float]:
        """How late the fixes are [s], its sd, and how much it explains in chi-square."""
        reach = min(TRACK.reach_s, 0.25 * (self.time[-1] - self.time[0]))
        lags = np.arange(-reach, reach + 0.5 * LAG_STEP, LAG_STEP)
        d = self.free(self.fixes)
        error = np.empty(len(lags))
        for k, lag in enumerate(lags):
            D = self.free(self.at(way, float(lag)))
            error[k] = float(np.vdot(d, d).real) - abs(np.vdot(D, d)) ** 2 / max(float(np.vdot(D, D).real), 1e-12)
        k = int(np.argmin(error))
        if not 0 < k < len(lags) - 1:
            return 0.0, np.inf, 0.0
        bend = (error[k - 1] - 2.0 * error[k] + error[k + 1]) / LAG_STEP**2
        D = self.free(self.at(way, float(lags[k])))
        left = d - complex(np.vdot(D, d)) / max(float(np.vdot(D, D).real), 1e-12) * D
        variance = max(error[k] / len(d), 1e-9) * inflation(left)
        seconds = lags[k] + 0.5 * (error[k - 1] - error[k + 1]) / LAG_STEP / max(bend, 1e-12)
        unshifted = error[len(lags) // 2]
        return float(seconds), float(np.sqrt(variance / max(bend, 1e-12))), float((unshifted - error[k]) / variance)


def _near_median(fixes: Complexes) -> NDArray[np.bool_]:
    """Fixes near the median of the five around them."""
    padded = np.lib.stride_tricks.sliding_window_view(np.pad(fixes, 2, mode="edge"), 5)
    off = np.abs(fixes - np.median(padded.real, axis=1) - 1j * np.median(padded.imag, axis=1))
    return np.asarray(off <= CLIPPED * max(float(np.median(off)), 1e-3))


def inflation(left: Complexes) -> float:
    """How many residuals of a first-order process make one independent one."""
    keep = float(np.real(np.vdot(left[:-1], left[1:]))) / max(float(np.vdot(left, left).real), 1e-12)
    keep = min(max(keep, 0.0), 0.95)
    return (1.0 + keep) / (1.0 - keep)


def _mirrored_text(config: Config, like: float, unlike: float) -> str:
    return (
        f"velocities fit the fixes better with y mirrored (agreement {unlike:.2f} instead of {like:.2f}): "
        f"{other_way_up(config)}"
    )


FIRST = 5  # fixes, of which the median counts
ENOUGH = 3  # fixes
SOON = 30.0  # after the log's begin [s]


def start(log: Log, config: Config) -> Iterator[Finding]:
    """Distance of the first fixes from ``start.north_m`` and ``start.east_m``, less the way since."""
    stated = config.start
    if not (stated.located and {"dvl", "fix"} <= log.sensors):
        return
    begin = min(float(stream.time[0]) for stream in log.streams.values())
    fix = log["fix"]
    first = fix.take(np.arange(min(FIRST, int(np.searchsorted(fix.time, begin + SOON)))))
    pings = valid_pings(log["dvl"])
    if len(first) < ENOUGH or not len(pings) or pings.time[0] > begin + SOON:
        return
    away = np.hypot(first.data[:, 0] - (stated.north_m or 0.0), first.data[:, 1] - (stated.east_m or 0.0))
    way = _way(np.linalg.norm(pings.data[:, :2], axis=1), pings.time, begin, first.time)
    own_sd = np.fmax(first["fix_sd"], first["fix_east_sd"])
    fix_sd = float(np.median(np.where(np.isnan(own_sd), config.fix.sd_m, own_sd)))
    arm = float(np.hypot(*config.fix.lever_arm_m[:2]))
    beyond = float(np.median(away - way)) - arm
    if beyond > SURE * np.hypot(stated.position_sd_m, fix_sd):
        yield Finding(
            "fix",
            "warning",
            f"the first fixes lie {np.median(away):.1f} m from start.north_m and start.east_m, of which the vehicle "
            f"moved at most {np.median(way):.1f} m: {START_REMEDY}",
            "start",
        )


def _way(speed: Array, time: Array, begin: float, at: Array) -> Array:
    """Length of the way since ``begin`` [m], before the first ping at its speed."""
    when = np.unique(np.concatenate([[begin], time, at]))
    v = np.interp(when, time, speed)
    return np.asarray(np.interp(at, when, integral(when, v)))


BLOCK_S = 20.0
FIX_BLOCK_S = 30.0  # of fixes, whose differences are noisier
LONGEST_GAP_OF_TRACKS = 2.0  # between pings [s]
ENOUGH_OF_CURRENT = 3  # blocks of either level
LEAST_MPS = 0.1  # between two levels, which errors of scale and heading stay below
HALF = 0.5  # of the square about one level, that two may leave
ENOUGH_FIXES = 5  # in a block
Heading = tuple[Array, Array]  # times [s], of the body [rad]
NONE = np.empty(0), np.empty(0, dtype=np.complex128)


def current(log: Log, config: Config) -> Iterator[Finding]:
    """Two levels of the water's velocity, where they explain far more than one and than its prior allows."""
    if "dvl_water" not in log or len(log["dvl_water"]) < 2 or not {"dvl", "fix"} & log.sensors:
        return
    found = body_heading(log, config)
    if found is None:
        return
    time, c = _over_bottom(log, config, found[1:])
    if len(c) < 2 * ENOUGH_OF_CURRENT:
        time, c = _over_fixes(log, config, found[1:])
    if len(c) < 2 * ENOUGH_OF_CURRENT:
        return
    left = np.arange(ENOUGH_OF_CURRENT, len(c) - ENOUGH_OF_CURRENT + 1)
    sums = np.cumsum(c)
    before, after = sums[left - 1] / left, (sums[-1] - sums[left - 1]) / (len(c) - left)
    weight = left * (len(c) - left) / len(c)
    k = int(np.argmax(weight * np.abs(after - before) ** 2))
    step, split = float(abs(after[k] - before[k])), int(left[k])
    noise = float(np.median(np.abs(np.diff(c)) ** 2)) / (2.0 * np.log(2.0))  # of a block, both components
    one = float(np.sum(np.abs(c - c.mean()) ** 2))
    two = one - float(weight[k]) * step**2
    prior = beliefs(config)["current"]
    apart = float(time[split:].mean() - time[:split].mean())
    allowed = BELIEVED_SDS * float(walked(prior.walk, prior.time_constant, apart)[1]) if prior.estimate else 0.0
    if step < max(LEAST_MPS, allowed, SURE * np.sqrt(noise / weight[k])) or two > HALF * one:
        yield Finding("dvl_water", "ok", f"the current stays within {np.sqrt(one / len(c)):.2g} m/s of its mean (rms)")
        return
    levels = [f"({v.real:.2f}, {v.imag:.2f})" for v in (before[k], after[k])]
    first, second = (since(log, t) for t in time[split - 1 : split + 1])
    yield Finding(
        "dvl_water",
        "warning",
        f"the current changes from {levels[0]} to {levels[1]} m/s north, east between {first} and {second}, "
        f"more than calibration.current allows: let it change faster, "
        f"calibration: {{current: {{walk: {step / np.sqrt(BLOCK_S):.2g}}}}}",
        "current",
    )


def _over_bottom(log: Log, config: Config, heading: Heading) -> tuple[Array, Complexes]:
    """Middle of each block of water track with bottom track, and the mean current in it [m/s]."""
    water = log["dvl_water"]
    pings = valid_pings(log["dvl"]) if "dvl" in log else None
    if pings is None or len(pings) < 2:
        return NONE
    over_ground = np.column_stack([np.interp(water.time, pings.time, column) for column in pings.data[:, :3].T])
    both = ~in_gap(water.time, pings.time, LONGEST_GAP_OF_TRACKS)
    time, c = water.time[both], _in_n(water.time, over_ground - water.data, config, heading)[both]
    if not len(time):
        return NONE
    n, t, v, _, _ = _sums(((time - time[0]) // BLOCK_S).astype(np.int64), time, c)
    return t / n, v / n


def _over_fixes(log: Log, config: Config, heading: Heading) -> tuple[Array, Complexes]:
    """Middle of each block of fixes with water track, and the slope there of what both differ by [m/s]."""
    water = log["dvl_water"]
    if "fix" not in log:
        return NONE
    v = _in_n(water.time, water.data, config, heading)
    periods = np.diff(water.time)
    way = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * periods)])
    fix = log["fix"].take(~in_gap(log["fix"].time, water.time, LONGEST_GAP_OF_TRACKS))
    if not len(fix):
        return NONE
    arm = complex(*config.fix.lever_arm_m[:2]) * np.exp(1j * np.interp(fix.time, *heading))
    apart = fix.data[:, 0] + 1j * fix.data[:, 1] - arm
    apart -= np.interp(fix.time, water.time, way.real) + 1j * np.interp(fix.time, water.time, way.imag)
    lost = np.append(0, np.cumsum(periods > LONGEST_GAP_OF_TRACKS))[np.searchsorted(water.time, fix.time) - 1]
    block = np.unique(lost * 1_000_000 + (fix.time - fix.time[0]) // FIX_BLOCK_S, return_inverse=True)[1]
    n, t, d, tt, td = _sums(block, fix.time - fix.time[0], apart)
    spread = tt - t**2 / n
    enough = (n >= ENOUGH_FIXES) & (spread > n * (0.2 * FIX_BLOCK_S) ** 2)
    return (t / n + fix.time[0])[enough], ((td - t * d / n) / np.where(enough, spread, 1.0))[enough]


def _in_n(time: Array, v_s: Array, config: Config, heading: Heading) -> Complexes:
    """North and east of velocities along the DVL's axes (n, 3), shape (n,) [m/s]."""
    v_b = rotate(mount_matrix(config.dvl.mount_rpy_deg), v_s)
    return np.asarray((v_b[:, 0] + 1j * v_b[:, 1]) * np.exp(1j * np.interp(time, *heading)))


def _sums(block: NDArray[np.int64], t: Array, v: Complexes) -> tuple[Array, Array, Complexes, Array, Complexes]:
    """Of every block: how many, and the sums of t, v, t^2 and t v."""

    def total(values: Complexes) -> Complexes:
        return np.bincount(block, values.real) + 1j * np.bincount(block, values.imag)

    n = np.bincount(block).astype(float)
    some = n > 0
    t_, tt = (np.asarray(np.bincount(block, values)[some], float) for values in (t, t * t))
    return n[some], t_, total(v)[some], tt, total(t * v)[some]
