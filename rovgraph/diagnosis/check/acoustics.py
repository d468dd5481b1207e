"""Acoustic positions against the DVL's track and the depth, the ship's heading against its course, unusable replies.

In the plane as complex numbers, range and direction give with the ship's heading the way w from the head, at s, to the
vehicle. With D the DVL's track as in `rovgraph.diagnosis.check.fixes`,

    w = n (p + c D(t - tau) - s) = n p + g D(t - tau) - n s.

``-arg n`` is the error of the head's yaw and of the ship's compass together, ``arg c`` that of the vehicle's heading: g
and n differ by no more than is believed of that; p is free in each stretch. Late stamps put the ship elsewhere, too, so
every lag makes its own s and w. Other axes are other w: a mirrored bearing is conj(w) along the ship's axes, whose turn
tells a wrong sense (0) from transposed x and y (90 deg); ``usbl.frame`` is tried in the same way. Another explanation
is named where it leaves far smaller residuals.
"""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rovgraph.diagnosis.check.findings import Finding, believed_lag, since
from rovgraph.diagnosis.check.fixes import (
    ENOUGH_DISTANCE,
    MIN_FIXES,
    UNEXPLAINED,
    Complexes,
    Tracks,
    heading_believed,
    inflation,
    tracks,
)
from rovgraph.diagnosis.check.inertial import in_gap
from rovgraph.diagnosis.trilateration import DRIFT, trilaterate
from rovgraph.errors import InputError
from rovgraph.geometry import Array, wrap_angle
from rovgraph.kernels import measurement_row as at
from rovgraph.log import STREAMS, Log, Stream
from rovgraph.log.units import UNITS
from rovgraph.model.calibration import ACOUSTICS
from rovgraph.model.config import Config, beliefs
from rovgraph.problem.acoustics import Acoustics, Sightings, sightings, unusable_acoustics
from rovgraph.rules import ACOUSTIC_TRACK, BELIEVED_SDS, SURE, USUAL_SHARE, remedy_of_lag
from rovgraph.sensors.acoustic import in_degrees, is_plumb
from rovgraph.sensors.instruments import heading_sources, instruments
from rovgraph.sensors.sensor import SENSORS

FRAMES = "transducer", "ship", "north"
MOST = 600  # replies that are compared, evenly
PASSES, TURNINGS = 5, 3  # of reweighting, of turning the head's axes as a fit has them
TUKEY = 3.0  # sds at which a reply begins to count less
EARLIEST_S, STEP_S, FINE_S = -1.0, 0.6, 0.15  # lags that are tried
BETTER = 1.5  # times the variance, that another explanation leaves less of,
EVIDENCE = 40.0  # and in chi-square
AXIS = np.deg2rad(15.0)  # around a multiple of 90 deg, within which it is named
TWICE = np.deg2rad(2.0)  # from which on an alignment that is applied twice is named
TELLING = np.deg2rad(5.0)  # sd of the yaw, up to which it is reported
MOSTLY = 0.5  # of the elevations, that stand for none
FASTEST_SHIP_MPS, SHIP_JITTER_M = 15.0, 20.0  # of successive positions of one ship, by a receiver that is not good
TWO_SHIPS = 0.1  # of the steps, from which on two ships are in a log
OPPOSITE = 3.0  # times smaller depth errors with elevations of the other sign
DEPTH_OFF_M = 1.0
GIVEN = 0.25  # of the noise that directions make of a depth: one that is closer to the depth sensor's comes from it
COARSE_M = 0.05  # noise of depths that are passed on with one digit
NEAR_AXIS = 0.1  # sine of the angle off the vertical, below which a bearing says nothing
COURSE_S, UNDER_WAY_MPS = 10.0, 1.0  # over which a course is taken, and the speed from which on it is one
ENOUGH_COURSES = 6
ENOUGH_RANGES = 80  # to a place in a stretch of the track, evenly, to tell their unit
SCALE_OFF = 0.01  # of ranges by another speed of sound
FITTING = 2.0  # robust cost of a range, outliers among them, up to which a unit explains them
UNIT_EVIDENCE = 50.0  # robust cost that another unit must save
CONCENTRATED, TURNS = 0.9, 0.9  # mean of unit vectors of angles that are one, and of courses that are not
OFF_COURSE = np.deg2rad(30.0)  # of a ship's heading, that neither current nor wind makes on several courses


def usable(log: Log, config: Config, frame: str | None = None, late: float | None = None) -> Sightings | None:
    """Positions by the replies that are sound, at most `MOST`; None where there are too few.

    Parameters
    ----------
    frame : other than `usbl.frame`
    late : how late the stamps are [s]; None = as it is believed
    """
    if "usbl" not in log or "usbl" in unusable_acoustics(config, log.sensors) or _wrong_unit(log):
        return None
    if is_plumb(log["usbl"]["usbl_elevation"]).mean() > MOSTLY:
        return None  # `replies` reports it
    if frame is not None and frame != config.usbl.frame:
        config = config.with_values(usbl={"frame": frame})
    replies = _sound(log, config)
    if len(replies) > MOST:
        replies = replies.take(np.unique(np.linspace(0, len(replies) - 1, MOST).astype(int)))
    late = believed_lag(config, "usbl")[0] if late is None else late
    try:
        seen = sightings(_with(log, replies), config, instruments(config), late)
    except InputError:  # `replies` reports it
        return None
    return seen if seen is not None and len(seen.positions) >= MIN_FIXES else None


def _wrong_unit(log: Log) -> bool:
    """Whether directions or the ship's headings are in degrees, which their sensors report themselves."""
    return any(
        sensor in log and in_degrees(log[sensor].data[:, columns]).any()
        for sensor, columns in (("usbl", slice(2, 4)), ("ship_heading", slice(0, 1)))
    )


def _sound(log: Log, config: Config, sensor: str = "usbl") -> Stream:
    """Replies or ranges that can be true."""
    stream = log[sensor]
    bad = [mask for _, mask in SENSORS[sensor].refused(stream.data, config)]
    return stream.take(~np.any(bad, axis=0))


def _with(log: Log, stream: Stream) -> Log:
    return replace(log, streams={**log.streams, stream.sensor: stream})


def replies(log: Log, config: Config) -> Iterator[Finding]:
    """Replies and ranges that cannot be used, by the ship's log, the beacons and the values themselves."""
    unusable = unusable_acoustics(config, log.sensors)
    alone = not (log.sensors - unusable.keys()) & {"dvl", "fix", *ACOUSTICS}
    for sensor in ACOUSTICS:
        if sensor in unusable:
            yield Finding(sensor, "error" if alone else "warning", f"it is left out: {unusable[sensor]}", "missing")
        elif sensor in log and not _wrong_unit(log):
            refused = SENSORS[sensor].refused(log[sensor].data, config)
            unused = Counter({(sensor, why): int(mask.sum()) for why, mask in refused})
            acoustics = Acoustics(config, instruments(config))
            acoustics.take_ship(log.streams)
            try:
                acoustics.exchanges(_sound(log, config, sensor), 0.0, unused)
            except InputError as error:
                yield Finding(sensor, "error", str(error).removeprefix(f"{sensor}: "), "missing")
                continue
            yield from (_unused(log, config, sensor, why, count) for (_, why), count in unused.items() if count)


def _unused(log: Log, config: Config, sensor: str, why: str, count: int) -> Finding:
    """What is left out, and what would mend it."""
    of, what = len(log[sensor]), "replies" if sensor == "usbl" else "ranges"
    text, level = f"{count} of {of} {what} ({count / of:.1%}) are left out: {why}", count > USUAL_SHARE * of
    if why.endswith("of the ship"):
        text += f"; {_extent(log, config, 'ship' if 'position' in why else 'ship_heading')}"
    elif "usbl.beacon" in why:
        text += f"; usbl.beacon is {config.usbl.beacon}, the log has {_names(log[sensor])}"
        level = count == of  # others may answer beside the vehicle's
    elif "beacon" in why:
        named = ", ".join(str(beacon.name) for beacon in config.beacons) or "none"
        text += f"; it names {named}, the log has {_names(log[sensor])}"
    return Finding(sensor, "warning" if level else "ok", text, "missing")


def _names(stream: Stream) -> str:
    """Transponders or beacons in a log, numbers as they are."""
    found = np.unique(stream[f"{stream.sensor}_beacon"])
    found = found[~np.isnan(found)]
    shown = [f"{name:g}" for name in found[found < 2.0**32][:6].tolist()]
    words = int((found >= 2.0**32).sum())  # `label_number` of texts
    return ", ".join(shown + [f"{words} {'others' if shown else 'names'} in words"] * (words > 0)) or "no names"


def _extent(log: Log, config: Config, sensor: str) -> str:
    """From when to when the ship is known, and the longest silence that nothing bridges."""
    if sensor not in log:
        return f"the log has no {sensor}"
    time, longest = log[sensor].time, config.ship.max_gap_s
    text = f"{sensor} begins at {since(log, time[0])} and ends at {since(log, time[-1])}"
    gaps = np.diff(time, append=time[-1])
    k = int(np.argmax(gaps))
    silent = f", is silent for {gaps[k]:.1f} s from {since(log, time[k])} on" if gaps[k] > longest else ""
    return f"{text}{silent}; ship.max_gap_s = {longest:g} s bridges no more"


@dataclass(frozen=True)
class _Fit:
    """Least squares of acoustic positions by the DVL's track.

    Attributes
    ----------
    turn : of the head's directions, and its sd [rad]
    variance : of what is left in both components together, by the median [m2]
    left : ndarray of complex, shape (k,), what is left [m]
    spread : of the DVL's track at these times [m]
    """

    turn: float
    sd: float
    variance: float
    left: Complexes
    spread: float

    def cost(self, variance: float) -> float:
        """Robust chi-square of what is left."""
        return float(TUKEY**2 * np.sum(np.log1p(np.abs(self.left) ** 2 / (TUKEY**2 * variance))))

    @property
    def explained(self) -> bool:
        """Whether what is left is about the noise that differences of neighbours show."""
        noise = _variance(np.abs(self.left[2:] - 2.0 * self.left[1:-1] + self.left[:-2]) ** 2 / 6.0)
        return self.variance < UNEXPLAINED * noise

    def better(self, other: "_Fit") -> bool:
        """Whether it leaves far less than another, beyond chance."""
        ratio = other.variance / self.variance
        return ratio > BETTER and 2.0 * len(self.left) / inflation(self.left) * math.log(ratio) > EVIDENCE


def _variance(square: Array) -> float:
    """Of both components together, of squared residuals, by their median."""
    return max(float(np.median(square)) / math.log(2.0), 1e-6)


@dataclass(frozen=True)
class _Beside:
    """Acoustic positions beside the DVL's track, by several explanations.

    Attributes
    ----------
    log, config : replies and beliefs
    track : of the DVL
    heading_sd : of the vehicle's heading, as believed [rad]
    """

    log: Log
    config: Config
    track: Tracks
    heading_sd: float

    @classmethod
    def of(cls, log: Log, config: Config) -> "_Beside | None":
        """None where something is missing."""
        seen = usable(log, config)
        if seen is None:
            return None
        positions = replace(seen.positions, sensor="fix")
        track = tracks(_with(log, positions), config.with_values(fix={"lever_arm_m": config.usbl.beacon_arm_m}))
        if track is None or track.plane.count < MIN_FIXES:
            return None
        sources = {track.sensor, *heading_sources(config, log.sensors)}
        return cls(log, config, track, heading_believed(config, sources) / BELIEVED_SDS)

    def fit(self, late: float, axes: "_Axes") -> _Fit | None:
        """Fit with stamps that are late, in some axes; None with too few replies."""
        roll, pitch, yaw = self.config.usbl.mount_rpy_deg
        mount = roll, pitch, yaw + math.degrees(axes.yaw)
        config = self.config.with_values(usbl={"mount_rpy_deg": mount})
        log = _with(self.log, _signed(self.log["usbl"], bearing=-1.0)) if axes.mirrored else self.log
        seen = usable(log, config, axes.frame, late)
        if seen is None:
            return None
        plane = self.track.beside(seen.positions)
        if plane.count < MIN_FIXES:
            return None
        away = seen.positions.data[:, :2] - seen.head[:, :2]
        way = away[:, 0] + 1j * away[:, 1]
        w, s, D = (plane.free(each) for each in (way, plane.fixes - way, plane.at(self.track.way, 0.0)))
        A, x = np.column_stack([-s, D]), np.zeros(2, complex)
        prior = np.array([[1.0, -1.0], [-1.0, 1.0]]) * 0.5 / max(self.heading_sd, 1e-3) ** 2 + 1e-6 * np.eye(2)
        for _ in range(PASSES):
            square = np.abs(w - A @ x) ** 2
            variance = _variance(square)
            weighted = A.conj().T / (variance + square / TUKEY**2)
            N = weighted @ A + prior
            x = np.linalg.solve(N, weighted @ w)
        left, n = w - A @ x, complex(x[0])
        sd = math.sqrt(0.5 * float(np.linalg.inv(N)[0, 0].real) * inflation(left)) / max(abs(n), 1e-3)
        spread = float(2.0 * np.sqrt(np.mean(np.abs(D) ** 2)))
        turn = float(np.angle(np.exp(1j * axes.yaw) / n))
        return _Fit(turn, sd, _variance(np.abs(left) ** 2), left, spread)

    def lag(self, axes: "_Axes", turnings: int = TURNINGS) -> "_Lag | None":
        """The lag that leaves least in some axes, turned as the fit has them; None with too few replies."""
        found = self._lag(axes)
        for _ in range(turnings):  # tilts of the ship are those of its turned axes
            if found is None or abs(np.angle(np.exp(1j * (found.fit.turn - axes.yaw)))) < AXIS / 3.0:
                return found
            axes = replace(axes, yaw=found.fit.turn)
            turned = self._lag(axes)
            if turned is None or turned.fit.variance > found.fit.variance:
                return found
            found = turned
        return found

    def _lag(self, axes: "_Axes") -> "_Lag | None":
        reach, earliest = ACOUSTIC_TRACK.reach_s, EARLIEST_S - max(self.config.delay_s.get("usbl", 0.0), 0.0)
        fits = self._fits([0.0, *np.arange(earliest, reach + STEP_S / 2, STEP_S).tolist()], axes)
        if not fits:
            return None
        best = min(fits, key=lambda lag: fits[lag].variance)
        fits |= self._fits((best + FINE_S * np.arange(-2.0, 2.5)).tolist(), axes)
        least, several = min(fit.variance for fit in fits.values()), len(fits[best].left)

        def cost(fit: _Fit) -> float:  # not all lags leave equally many replies inside
            return fit.cost(least) / len(fit.left) * several

        best = min(fits, key=lambda lag: cost(fits[lag]))
        fit, sides = fits[best], self._fits([best - FINE_S, best + FINE_S], axes)
        if not sides:
            return None
        count = max(inflation(fit.left), inflation(fits[0.0].left))  # what wanders slowly looks like a lag
        before, after = (cost(side) for side in sides.values())
        bend = max((before - 2.0 * cost(fit) + after) / FINE_S**2, 1e-12)
        sd = math.sqrt(2.0 * count / bend) if earliest < best < reach else np.inf
        evidence = (cost(fits[0.0]) - cost(fit)) / count
        return _Lag(best + 0.5 * (before - after) / FINE_S / bend, sd, evidence, fit)

    def _fits(self, lags: Sequence[float], axes: "_Axes") -> dict[float, _Fit]:
        """Fits with stamps that are later than believed; none if one of them has too few replies."""
        believed = believed_lag(self.config, "usbl")[0]
        fits = {lag: self.fit(believed + lag, axes) for lag in lags}
        known = {lag: fit for lag, fit in fits.items() if fit is not None}
        return known if len(known) == len(fits) else {}


@dataclass(frozen=True)
class _Axes:
    """Those in which directions are taken: ``usbl.frame``, bearings of the other sense, and turned by a yaw [rad]."""

    frame: str
    mirrored: bool = False
    yaw: float = 0.0


@dataclass(frozen=True)
class _Lag:
    """How late stamps are beyond what is believed [s], its sd, what that explains in chi-square, and the fit there."""

    seconds: float
    sd: float
    evidence: float
    fit: _Fit


def _signed(stream: Stream, bearing: float = 1.0, elevation: float = 1.0) -> Stream:
    """Replies with bearings or elevations of the other sign."""
    return replace(stream, data=stream.data * np.array([1, 1, bearing, elevation, 1, bearing, elevation, 1, 1, 1, 1]))


def positions(log: Log, config: Config) -> Iterator[Finding]:
    """Axes, frame, turn and clock of acoustic positions against the DVL's track."""
    upside_down = _elevations_reversed(log, config)
    beside = _Beside.of(_with(log, _signed(log["usbl"], elevation=-1.0)) if upside_down else log, config)
    as_named = _Axes(config.usbl.frame)
    found = None if beside is None else beside.lag(as_named)
    if beside is None or found is None:
        return
    late = found.fit
    if late.spread > ENOUGH_DISTANCE and not late.explained and (other := _other_axes(beside, late)):
        yield Finding("usbl", "warning", other, "axes")
        return
    if not _moves(late):
        yield Finding("usbl", "ok", "too little movement to compare acoustic positions with the DVL's track")
        return
    lag = _late(beside, found)
    yaw = late.turn if abs(late.turn) > AXIS else 0.0
    fit = late if lag else beside.fit(believed_lag(config, "usbl")[0], replace(as_named, yaw=yaw))
    if fit is not None:
        yield from _turned(config, fit)
    yield from lag


def latency(log: Log, config: Config) -> Iterator[Finding]:
    """The clock of acoustic positions alone, in the axes that are stated, which is quick enough for a live estimate."""
    beside = _Beside.of(log, config)
    found = None if beside is None else beside.lag(_Axes(config.usbl.frame), turnings=0)
    if beside is not None and found is not None and found.fit.explained and _moves(found.fit):
        yield from _late(beside, found)


def _moves(fit: _Fit) -> bool:
    """Whether the vehicle moves enough to be compared."""
    return fit.spread >= max(ENOUGH_DISTANCE, SURE * math.sqrt(fit.variance))


def _late(beside: _Beside, found: _Lag) -> list[Finding]:
    """That stamps are late, where they are."""
    believed, sd = believed_lag(beside.config, "usbl")
    if not ACOUSTIC_TRACK.is_late(found.seconds, found.sd, (0.0, sd)) or found.evidence <= ACOUSTIC_TRACK.evidence:
        return []
    total = believed + found.seconds
    text = (
        f"acoustic positions come {abs(total):.1f} s {'late' if total > 0.0 else 'early'} beside the DVL's track "
        f"and the ship's (sd {found.sd:.2f} s): {remedy_of_lag(beside.config, 'usbl', total, found.sd)}"
    )
    return [Finding("usbl", "warning", text, "lag", lag=(total, found.sd))]


def _other_axes(beside: _Beside, as_is: _Fit) -> str:
    """Other axes that explain the replies far better, by whichever is nearest to those that are stated; "" = none."""
    config, own = beside.config, beside.config.usbl.frame
    every = [_Axes(frame, mirrored) for frame in FRAMES for mirrored in (False, True)]
    tried = [(axes.frame, axes.mirrored, beside.lag(axes)) for axes in every if axes != _Axes(own)]
    good = [(frame, mirrored, lag.fit) for frame, mirrored, lag in tried if lag is not None and lag.fit.better(as_is)]
    if not good:
        return ""
    least = min(fit.variance for *_, fit in good)
    close = [one for one in good if one[2].variance < BETTER * least]
    frame, mirrored, fit = min(close, key=lambda one: (one[1], abs(one[2].turn) > AXIS, one[0] != own, one[2].variance))
    residuals = f"{math.sqrt(fit.variance):.1f} m is left instead of {math.sqrt(as_is.variance):.1f} m"
    if mirrored:
        return _mirrored(beside.log, config, fit, frame, residuals)
    turned = "" if abs(fit.turn) < AXIS else f" and {_yaw(config, fit.turn)}"
    text = (
        f"its directions fit the DVL's track in axes of the frame {frame}: {residuals}; state usbl: {{frame: {frame}}}"
    )
    return text + turned


def _mirrored(log: Log, config: Config, fit: _Fit, frame: str, residuals: str) -> str:
    """What mends bearings of the other sense: turned by 90 degrees, they are transposed coordinates."""
    quarter = round(fit.turn / (0.5 * np.pi)) % 4
    exact = abs(wrap_angle(np.array([fit.turn - quarter * 0.5 * np.pi]))[0]) < AXIS
    by_place = bool(np.isnan(log["usbl"]["usbl_bearing"]).all())
    also = "" if frame == config.usbl.frame else f", and usbl: {{frame: {frame}}}"
    if exact and quarter == 1:
        what = "x and y are transposed"
    elif exact and quarter == 0:
        what = "y points to port" if by_place else "bearings count anticlockwise"
    elif exact and quarter == 2:
        what = "x points astern" if by_place else "bearings count anticlockwise from astern"
    else:
        what = f"its axes are mirrored and turned by {np.rad2deg(fit.turn):+.0f} deg"
    if by_place and exact and quarter in (0, 2):
        remedy = f"state units: {{{_negated(config, ('usbl_y', 'usbl_x')[quarter // 2])}}}"
    elif by_place and exact and quarter == 1:
        named = config.columns
        x, y = named.get("usbl_x", "usbl_x"), named.get("usbl_y", "usbl_y")
        remedy = f"state columns: {{usbl_x: {y}, usbl_y: {x}}}"
    else:
        remedy = f"state units: {{{_negated(config, 'usbl_y' if by_place else 'usbl_bearing')}}}"
        remedy += "" if exact and quarter == 0 else f" and {_yaw(config, 0.5 * np.pi * quarter if exact else fit.turn)}"
    return f"{what}: corrected, {residuals} beside the DVL's track; {remedy}{also}"


def _negated(config: Config, column: str) -> str:
    """Entry of ``units`` that turns the sign of a column."""
    group, plain = ("usbl_direction", "rad") if column in ("usbl_bearing", "usbl_elevation") else ("usbl", "m")
    unit = config.units.get(column, config.units.get(group, plain))
    return f"{column}: {unit.removeprefix('-') if unit.startswith('-') else f'-{unit}'}"


def _yaw(config: Config, turn: float) -> str:
    """Entry of the head's mounting that turns its directions."""
    roll, pitch, yaw = config.usbl.mount_rpy_deg
    new = math.degrees(float(wrap_angle(np.array([math.radians(yaw) + turn]))[0]))
    return f"usbl.mount_rpy_deg: [{roll:g}, {pitch:g}, {round(new)}]"


def _turned(config: Config, fit: _Fit) -> Iterator[Finding]:
    """How far the head's yaw and the ship's compass together are off."""
    degrees, prior = np.rad2deg(fit.turn), beliefs(config)["usbl_yaw"]
    believed = BELIEVED_SDS * prior.sd if prior.estimate else 0.0
    stated = math.radians(config.usbl.mount_rpy_deg[2])
    off = float(prior.mean[0]) - stated  # what is believed beside the nominal mounting
    text = f"acoustic positions fit the DVL's track when its directions are turned by {degrees:+.1f} deg"
    text += f" (sd {np.rad2deg(fit.sd):.1f} deg)"
    twice = abs(fit.turn) > max(TWICE, SURE * fit.sd) and abs(fit.turn + stated) < max(0.5 * TWICE, 3.0 * fit.sd)
    if twice and abs(stated) > TWICE:
        yield Finding(
            "usbl", "warning", f"{text}: usbl.mount_rpy_deg is applied twice; state {_yaw(config, -stated)}", "turned"
        )
    elif abs(fit.turn - off) > believed + SURE * fit.sd:
        text += (
            f": the head's yaw or the ship's heading is off; state {_yaw(config, fit.turn)}, or correct ship_heading"
        )
        yield Finding("usbl", "warning", text, "turned")
    elif fit.sd < TELLING:
        yield Finding("usbl", "ok", text)


def _depth_errors(log: Log, config: Config, frame: str | None = None) -> tuple[Array, Array, Sightings] | None:
    """Depths by range and direction less the depth sensor's, shape (k,), level distances [m], and the positions."""
    if "depth" not in log or len(log["depth"]) < 2 or (seen := usable(log, config, frame)) is None:
        return None
    time, depth = seen.positions.time, log["depth"]
    inside = ~in_gap(time, depth.time, 5.0)
    arm = config.usbl.beacon_arm_m[2] - config.depth.lever_arm_m[2]
    errors = seen.positions.data[:, 2] - np.interp(time, depth.time, depth["depth"]) - arm
    away = np.hypot(*(seen.positions.data[:, :2] - seen.head[:, :2]).T)
    return (errors[inside], away[inside], seen) if inside.sum() >= MIN_FIXES else None


def _unit_of_lengths(log: Log, config: Config, errors: Array, seen: Sightings) -> tuple[str, str] | None:
    """The column or group of lengths, and the unit in which depth errors are far smaller; None = there is none."""
    time, depth = seen.positions.time, log["depth"]
    inside = ~in_gap(time, depth.time, 5.0)
    down = (seen.positions.data[:, 2] - seen.head[:, 2])[inside]
    sensed = np.interp(time[inside], depth.time, depth["depth"])
    by_range = bool(np.isfinite(log["usbl"]["usbl_range"]).any())
    if not by_range and np.isnan(log["usbl"]["usbl_x"]).all():
        return None
    off: dict[tuple[str, str], float] = {}
    for unit, factor in UNITS["length"].items():
        tried = {
            "usbl_range" if by_range else "usbl": errors - (1.0 - factor) * down,
            "depth": errors + (1.0 - factor) * sensed,
        }
        off |= {(name, unit): float(np.median(np.abs(e))) for name, e in tried.items() if name not in config.units}
    best = min(off, key=lambda one: off[one], default=None)
    if best is None or OPPOSITE * max(off[best], DEPTH_OFF_M / OPPOSITE) >= float(np.median(np.abs(errors))):
        return None
    return best


def lengths(log: Log, config: Config) -> Iterator[Finding]:
    """The unit of ranges and travel times, by the DVL's track.

    Ranges from a track show a place, wherever the track begins and however it is turned: that of a beacon, or of the
    dive's start beside the ship. It explains them in one unit alone.
    """
    for sensor in ("usbl", "range"):
        if sensor not in log or sensor in unusable_acoustics(config, log.sensors) or _wrong_unit(log):
            continue
        stream = _sound(log, config, sensor)
        if len(stream) >= MIN_FIXES and not (sensor == "range" and config.range.one_way):  # whose clock is free
            yield from _length_unit(_with(log, stream), config, sensor)


def _length_unit(log: Log, config: Config, sensor: str) -> Iterator[Finding]:
    column, quantity = _length_column(log[sensor])
    stated = config.units.get(column, config.units.get(sensor, "")).removeprefix("-")
    own = UNITS[quantity].get(stated, 1.0)
    among = [*_ranges_along_track(log, config, sensor)]
    cost = {unit: sum(one.cost(factor / own) for one in among) for unit, factor in UNITS[quantity].items()}
    as_read = min((unit for unit, factor in UNITS[quantity].items() if factor == own), default="")
    if not among or not as_read:
        return
    best, count = min(cost, key=lambda unit: cost[unit]), sum(len(one.length) for one in among)
    if best != as_read and cost[best] < FITTING * count and cost[best] + UNIT_EVIDENCE < cost[as_read] / BETTER:
        text = f"its ranges do not fit the DVL's track as they are, and do if {column} is in {best}; "
        yield Finding(sensor, "warning", f"{text}state units: {{{column}: {best}}}", "unit")


def _length_column(stream: Stream) -> tuple[str, str]:
    """The column that lengths come from, and its quantity."""
    prefix = "usbl_" if stream.sensor == "usbl" else ""
    if np.isfinite(stream["usbl_range" if prefix else "range"]).any():
        return f"{prefix}range", "length"
    if np.isfinite(stream[f"{prefix}travel_time"]).any():
        return f"{prefix}travel_time", "duration"
    return stream.sensor, "length"


@dataclass(frozen=True)
class _RangesAlongTrack:
    """Ranges to one place, from points along a track that begins anywhere.

    Attributes
    ----------
    p_n : ndarray, shape (n, 3) [m]
    length, sd, drift : ndarray, shape (n,), of the ranges, and of the track since it began [m]
    """

    p_n: Array
    length: Array
    sd: Array
    drift: Array

    def cost(self, factor: float) -> float:
        """Robust cost of the ranges where they are so many times as long, of the best place."""
        length = factor * self.length
        down, down_sd = float(np.median(self.p_n[:, 2])), float(np.median(length)) + DEPTH_OFF_M
        sd = np.sqrt(self.sd**2 + self.drift**2 + (SCALE_OFF * length) ** 2)
        return trilaterate(self.p_n, length, sd, down, down_sd)[0][1]


def _ranges_along_track(log: Log, config: Config, sensor: str) -> Iterator[_RangesAlongTrack]:
    """Ranges to each beacon, and to the ship, from where the DVL's track has the vehicle."""
    acoustics = Acoustics(config, instruments(config), warns=False)
    acoustics.take_ship(log.streams)
    try:
        stream = acoustics.exchanges(log[sensor], believed_lag(config, sensor)[0], Counter())
    except InputError:  # `replies` reports it
        return
    dim = 3 if sensor == "usbl" else 1
    x = stream.data[:, 2 * dim : 2 * dim + at.WIDTH]
    fix = Stream("fix", STREAMS["fix"], stream.time, np.zeros((len(stream), len(STREAMS["fix"]))), stream.row)
    arm_b = config.range.lever_arm_m if sensor == "range" else config.usbl.beacon_arm_m
    found = tracks(_with(log, fix), config.with_values(fix={"lever_arm_m": arm_b}))
    if found is None:
        return
    way = found.plane.at(found.way, 0.0) - found.plane.fixes
    gone = np.interp(stream.time, found.pings.time, np.append(0.0, np.abs(np.diff(found.way)).cumsum()))
    down = np.interp(stream.time, log["depth"].time, log["depth"]["depth"]) if "depth" in log else 0.0 * gone
    beacon, p_n = x[:, at.BEACON_AT], np.column_stack([way.real, way.imag, down])
    p_n = np.where(beacon[:, None] < 0.0, p_n - x[:, at.HEARD : at.HEARD + 3], p_n)
    usable = found.plane.inside & (x[:, at.WAYS] > 0.0)
    for one, stretch in sorted({*zip(beacon[usable].tolist(), found.plane.stretch[usable].tolist(), strict=True)}):
        of = np.flatnonzero(usable & (beacon == one) & (found.plane.stretch == stretch))
        if len(of) >= MIN_FIXES:
            of = of[np.unique(np.linspace(0, len(of) - 1, ENOUGH_RANGES).astype(int))]
            drift = DRIFT * (gone[of] - gone[of[0]])
            yield _RangesAlongTrack(p_n[of], stream.data[of, 0], stream.data[of, dim], drift)


def _elevations_reversed(log: Log, config: Config) -> bool:
    """Whether depths by range and direction are far nearer to the depth sensor's with elevations of the other sign."""
    if "usbl" not in log:
        return False
    reversed_log = _with(log, _signed(log["usbl"], elevation=-1.0))
    found = [_depth_errors(each, config) for each in (log, reversed_log)]
    as_is, other = (np.inf if one is None else float(np.median(np.abs(one[0]))) for one in found)
    return bool(np.isfinite(as_is) and OPPOSITE * max(other, DEPTH_OFF_M / OPPOSITE) < as_is)


def depths(log: Log, config: Config) -> Iterator[Finding]:
    """Depths by range and elevation against the depth sensor: sign, offset, and whether they are its own."""
    found = _depth_errors(log, config)
    if found is None:
        return
    errors, away, seen = found
    if _elevations_reversed(log, config):
        by_place = bool(np.isnan(log["usbl"]["usbl_elevation"]).all())
        column = "usbl_z" if by_place else "usbl_elevation"
        text = f"depths by range and direction are {np.median(errors):+.1f} m off the depth sensor's: {column} counts "
        yield Finding("usbl", "warning", f"{text}upwards; state units: {{{_negated(config, column)}}}", "sign")
        return
    off = float(np.median(errors))
    if found_unit := _unit_of_lengths(log, config, errors, seen):
        column, unit = found_unit
        text = f"depths by range and direction are {off:+.1f} m off the depth sensor's: {column} is in {unit}; state "
        yield Finding("depth" if column == "depth" else "usbl", "warning", f"{text}units: {{{column}: {unit}}}", "unit")
        return
    noise = 1.4826 * float(np.median(np.abs(errors - off)))
    text = f"depths by range and direction are {off:+.2f} m off the depth sensor's (noise {noise:.2f} m)"
    length = float(np.median(np.linalg.norm(seen.positions.data[:, :3] - seen.head, axis=1)))
    priors = beliefs(config)
    parts = (
        *(priors[name].sd * float(np.median(away)) for name in ("usbl_roll", "usbl_pitch")),
        priors["sound_speed_scale"].sd * length,
        priors["usbl_arm"].sd,
    )
    sd = 1.2533 * noise * math.sqrt(inflation((errors - off).astype(np.complex128)) / len(errors))
    if abs(off) > max(DEPTH_OFF_M, BELIEVED_SDS * math.hypot(*parts)) + SURE * sd:
        x, y, z = config.usbl.lever_arm_m
        text += f": check the head's depth below the waterline, usbl.lever_arm_m: [{x:g}, {y:g}, {z - off:.1f}] would "
        yield Finding("usbl", "warning", f"{text}mend it, and the elevation and the sound speed", "zero")
    elif config.usbl.depth == "measured" and _is_given(log, config, seen):
        text += ", nearer than directions measure: they are that sensor's own; state usbl: {depth: given}"
        yield Finding("usbl", "warning", text, "repeats")
    else:
        yield Finding("usbl", "ok", text)


def _is_given(log: Log, config: Config, seen: Sightings) -> bool:
    """Whether level depths agree with the depth sensor far better than the noise of bearings lets elevations do."""
    found = _depth_errors(log, config, "north" if config.usbl.frame == "north" else "ship")
    if found is None:
        return False
    errors, _, level = found  # with the head's own depth, which the ship's tilt changes, and without
    down = level.positions.data[:, 2] - level.head[:, 2]
    relative = down - np.interp(level.positions.time, log["depth"].time, log["depth"]["depth"])
    noise = 1.4826 * min(float(np.median(np.abs(each - np.median(each)))) for each in (errors, relative))
    w = seen.positions.data[:, :3] - seen.head
    away, length = np.hypot(w[:, 0], w[:, 1]), np.linalg.norm(w, axis=1)
    telling = away > NEAR_AXIS * length
    if telling.sum() < MIN_FIXES:
        return False
    bearing = np.unwrap(np.arctan2(w[telling, 1], w[telling, 0]))
    second = np.abs(np.diff(bearing, 2)) / math.sqrt(6.0) / 0.6745
    across = float(np.median(second * (away / length)[telling][1:-1]))
    expected = across * float(np.median(away))
    return expected > max(config.depth.sd_m, COARSE_M) / GIVEN and noise < GIVEN * expected


def ships(log: Log, config: Config) -> Iterator[Finding]:
    """Positions that go to and fro faster than a ship does: those of two."""
    if "ship" not in log or len(log["ship"]) < MIN_FIXES:
        return
    place = log["ship"].data[:, :2]
    step, over = np.diff(place, axis=0), place[2:] - place[:-2]  # to the next, and to the one after it
    fast = np.linalg.norm(step, axis=1) > FASTEST_SHIP_MPS * np.diff(log["ship"].time) + SHIP_JITTER_M
    back = fast[:-1] & fast[1:] & (np.linalg.norm(over, axis=1) < 0.5 * np.linalg.norm(step[:-1], axis=1))
    if 2 * fast.sum() > TWO_SHIPS * len(fast) and back.any():
        away = float(np.median(np.linalg.norm(step[fast], axis=1)))
        text = (
            f"its positions go to and fro by {away:.0f} m in {fast.sum()} of {len(fast)} steps, as those of two ships "
        )
        yield Finding("ship", "warning", f"{text}or receivers do; keep the rows of one", "contradiction")


def ship(log: Log, config: Config) -> Iterator[Finding]:
    """The ship's heading against its course over ground."""
    if not {"ship", "ship_heading"} <= log.sensors or _wrong_unit(log):
        return
    course, heading = _courses(log["ship"], log["ship_heading"])
    if len(course) < ENOUGH_COURSES:
        return
    along, against = (complex(np.mean(np.exp(1j * (heading - sense * course)))) for sense in (1.0, -1.0))
    several = abs(np.mean(np.exp(1j * course))) < TURNS
    if abs(along) > CONCENTRATED:
        off = float(np.angle(along))
        text = f"it points {np.rad2deg(off):+.0f} deg off the ship's course, from {UNDER_WAY_MPS:g} m/s on"
        if several and abs(off) > OFF_COURSE:
            remedy = f"correct it, or state {_yaw(config, -off)}"
            yield Finding("ship_heading", "warning", f"{text}, on several courses; {remedy}", "turned")
        else:
            yield Finding("ship_heading", "ok", text)
    elif several and abs(against) > CONCENTRATED:
        zero = round(float(np.angle(against)) / (0.5 * np.pi)) % 4
        kind = {0: "nwu", 1: "enu"}.get(zero)
        text = "it turns opposite to the ship's course: it counts anticlockwise"
        text += f"; state angles: {{ship_heading: {kind}}}" if kind else ", from another direction than north or east"
        yield Finding("ship_heading", "warning", text, "sign")


def _courses(ship: Stream, heading: Stream) -> tuple[Array, Array]:
    """Courses over ground between means of some seconds, and the mean headings there, shape (k,) [rad]."""
    edges = np.arange(ship.time[0], ship.time[-1] + COURSE_S, COURSE_S)
    block = np.searchsorted(edges, ship.time, side="right") - 1
    n = np.maximum(np.bincount(block, minlength=len(edges)), 1)
    place = [np.bincount(block, ship.data[:, k], minlength=len(edges)) / n for k in (0, 1)]
    when = np.bincount(block, ship.time, minlength=len(edges)) / n
    told = np.bincount(block, minlength=len(edges)) > 0
    p, t = (place[0] + 1j * place[1])[told], when[told]
    v = np.diff(p) / np.maximum(np.diff(t), 1e-9)
    turn = np.concatenate([[0.0], np.cumsum(np.exp(1j * heading.data[:, 0]))])
    first, last = np.searchsorted(heading.time, t[:-1]), np.searchsorted(heading.time, t[1:])
    mean = turn[last] - turn[first]
    under_way = (np.abs(v) > UNDER_WAY_MPS) & (np.diff(t) < 2.0 * COURSE_S) & (last > first)
    return np.angle(v[under_way]), np.angle(mean[under_way])
