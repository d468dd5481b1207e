"""Noise of sensors from a log at rest: covariance, spectrum, Allan deviation (3.1.4, 3.2.2, appendix A).

What follows for the configuration is the piece of `NoiseReport`: densities and walks of the IMU
from the Allan deviation with lines and waves taken out, standard deviations of what comes slower as the
scatter without them. What the log is too short to show is left out, and said.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rovgraph.calibrate.allan import Allan, allan
from rovgraph.calibrate.piece import Piece, digits
from rovgraph.calibrate.spectrum import Spectrum, quietened, spectrum
from rovgraph.calibrate.stillness import require_still
from rovgraph.config import Config
from rovgraph.errors import InputError, warn
from rovgraph.geometry import Array
from rovgraph.log import Log, Stream

SHORTEST_S = 60.0
LEAST_SAMPLES = 200
GAP = 10.0  # intervals without a sample that cut a log in two

UNITS = {"acc": "m/s2", "gyr": "rad/s", "mag": "field", "dvl": "m/s", "dvl_heading": "rad", "ahrs": "rad"}
CHANNELS = {
    "imu": ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z"),
    "mag": ("mag_x", "mag_y", "mag_z"),
    "dvl": ("dvl_vx", "dvl_vy", "dvl_vz"),
    "dvl_heading": ("dvl_heading",),
    "ahrs": ("ahrs_yaw",),
}


@dataclass(frozen=True)
class Channel:
    """Noise of one column of the log.

    Attributes
    ----------
    name, sensor, unit : unit is that of the values
    rate : [Hz]
    mean, sd : of the samples
    quiet_sd : sd without the lines of its spectrum
    spectrum : Spectrum
    allan : Allan, without the lines
    """

    name: str
    sensor: str
    unit: str
    rate: float
    mean: float
    sd: float
    quiet_sd: float
    spectrum: Spectrum
    allan: Allan


@dataclass(frozen=True)
class Peak:
    """A line that the spectra of a sensor show.

    Attributes
    ----------
    sensor : name of the stream
    frequency : [Hz]
    rad_per_sample : the same against the sensor's rate
    kind : what such a frequency usually is, "waves" or "machine"
    rms : channel -> rms of the signal in it [channel's unit]
    """

    sensor: str
    frequency: float
    rad_per_sample: float
    kind: str
    rms: dict[str, float]


@dataclass(frozen=True)
class NoiseReport:
    """What a log at rest says about its sensors.

    Attributes
    ----------
    source : log
    duration : [s]
    channels : in the order of `CHANNELS`
    covariance : "imu" (acc, gyr and mag: R_MTi) and "dvl" (velocity and heading: R_DVL) -> names of the
        components, and ndarray, shape (k, k) [products of the channels' units]
    peaks : strongest first within a sensor
    piece : keys of a configuration
    remarks : what the log could not say, a sentence each
    """

    source: str
    duration: float
    channels: list[Channel]
    covariance: dict[str, tuple[tuple[str, ...], Array]]
    peaks: list[Peak]
    piece: Piece
    remarks: list[str]

    def channel(self, name: str) -> Channel:
        """The channel of a column."""
        return next(c for c in self.channels if c.name == name)


def calibrate_noise(log: Log, config: Config | None = None) -> NoiseReport:
    """Noise of every sensor of a log at rest.

    Parameters
    ----------
    log : at rest; waves are tolerated
    config : ``environment.dip_deg`` of it is used where the IMU is missing

    Raises
    ------
    InputError : a log that moves, is too short, or has no sensor whose noise is asked for

    Warns
    -----
    DataWarning : a log with gaps, of which the longest part is taken
    """
    config = config or Config()
    streams = {s: _without_gaps(_valid(log[s]), log.source) for s in CHANNELS if s in log}
    streams = {s: stream for s, stream in streams.items() if len(stream) >= LEAST_SAMPLES}
    if not streams:
        raise InputError(
            f"{log.source}: no IMU, magnetometer, DVL or heading with {LEAST_SAMPLES} samples in it; "
            f"give a log at rest of a few minutes, better an hour"
        )
    duration = max(float(s.time[-1] - s.time[0]) for s in streams.values())
    if duration < SHORTEST_S:
        raise InputError(
            f"{log.source}: {duration:.0f} s without a gap, at least {SHORTEST_S:.0f} s are needed; an hour shows walks"
        )
    require_still(replace(log, streams={**log.streams, **streams}))
    channels = [channel for stream in streams.values() for channel in _channels(stream)]
    remarks: list[str] = []
    piece = _piece({c.name: c for c in channels}, config, remarks)
    covariance = {name: matrix for name, matrix in _covariances(streams)}
    return NoiseReport(log.source, duration, channels, covariance, _peaks(channels), piece, remarks)


def _valid(stream: Stream) -> Stream:
    """The measurements of a stream that are complete and, of a DVL, have bottom lock."""
    keep = np.isfinite(np.column_stack([stream[c] for c in CHANNELS[stream.sensor]])).all(axis=1)
    if stream.sensor == "dvl":
        keep &= stream["dvl_valid"] != 0.0
    return _part(stream, np.flatnonzero(keep))


def _part(stream: Stream, keep: Any) -> Stream:
    return stream.take(keep)


def _without_gaps(stream: Stream, source: str) -> Stream:
    """The longest part of a stream without a gap."""
    interval = np.diff(stream.time)
    if not len(interval):
        return stream
    cuts = np.flatnonzero(interval > GAP * np.median(interval)) + 1
    if not cuts.size:
        return stream
    parts = np.split(np.arange(len(stream)), cuts)
    longest = max(parts, key=len)
    at = stream.time[cuts[0] - 1] - stream.time[0]
    warn(
        f"{source}: {stream.sensor}: {cuts.size} gaps, the first after {at:.0f} s; "
        f"the longest part without one is taken, {stream.time[longest[-1]] - stream.time[longest[0]]:.0f} s"
    )
    return _part(stream, longest)


def _values(stream: Stream) -> Array:
    """The channels of a stream, angles unwrapped; shape (n, k)."""
    data = np.column_stack([stream[c] for c in CHANNELS[stream.sensor]])
    return np.unwrap(data, axis=0) if stream.sensor in ("dvl_heading", "ahrs") else data


def _channels(stream: Stream) -> Iterator[Channel]:
    """Every channel of a stream.

    The IMU and the magnetometer are put on an even grid. Pings count as evenly spaced where that
    is needed, since interpolation would smooth them; in the spectrum they are where they are.
    """
    time, data = stream.time, _values(stream)
    step = float((time[-1] - time[0]) / (len(time) - 1))
    even = stream.sensor in ("imu", "mag")
    ticks: Array = step * np.arange(len(time), dtype=float)
    grid = time[0] + ticks if even else time
    for name, column in zip(CHANNELS[stream.sensor], data.T, strict=True):
        values: Array = np.interp(grid, time, column) if even else column
        if np.ptp(values) == 0.0:
            raise InputError(f"column {name} never changes: there is no noise to read in it; is the sensor alive?")
        found = spectrum(grid, values)
        counted = found if even else spectrum(ticks, values)
        quiet = quietened(values, counted)
        unit = UNITS[stream.sensor if stream.sensor in UNITS else name[:3]]
        sds = float(values.std(ddof=1)), float(quiet.std(ddof=1))
        rate = 1.0 / step
        read = allan(quiet, rate)
        if any(line.kind == "waves" for line in counted.lines):
            read = replace(read, instability=None)  # what is left of waves lies where a flat floor would
        yield Channel(name, stream.sensor, unit, rate, float(values.mean()), *sds, found, read)


def _covariances(streams: Mapping[str, Stream]) -> Iterator[tuple[str, tuple[tuple[str, ...], Array]]]:
    """R_MTi and R_DVL of appendix A; the second sensor is taken at the times of the first."""
    for name, first, second in (("imu", "imu", "mag"), ("dvl", "dvl", "dvl_heading")):
        present = [s for s in (first, second) if s in streams]
        if present:
            time = streams[present[0]].time
            columns = [np.interp(time, streams[s].time, x) for s in present for x in _values(streams[s]).T]
            yield name, (tuple(c for s in present for c in CHANNELS[s]), np.atleast_2d(np.cov(np.array(columns))))


def _peaks(channels: list[Channel]) -> list[Peak]:
    """The lines of a sensor's channels, those at the same frequency together."""
    out: list[Peak] = []
    for sensor in dict.fromkeys(c.sensor for c in channels):
        lines = [(c, line) for c in channels if c.sensor == sensor for line in c.spectrum.lines]
        lines.sort(key=lambda pair: -pair[1].rms / pair[0].quiet_sd)
        while lines:
            channel, strongest = lines[0]
            same = [pair for pair in lines if strongest.low <= pair[1].frequency <= strongest.high]
            same = same or lines[:1]
            rms: dict[str, float] = {}
            for c, line in same:
                rms[c.name] = float(np.hypot(rms.get(c.name, 0.0), line.rms))
            angle = 2.0 * np.pi * strongest.frequency / channel.rate
            out.append(Peak(sensor, strongest.frequency, float(angle), strongest.kind, rms))
            lines = [pair for pair in lines if pair not in same]
    return out


def _piece(channels: Mapping[str, Channel], config: Config, remarks: list[str]) -> Piece:
    """Keys of a configuration from the channels there are."""
    piece: dict[str, Any] = {}
    if "acc_x" in channels:
        piece["imu"] = {"noise": _imu_noise(channels, remarks)}
    if "dvl_vx" in channels:
        piece["dvl"] = {"velocity_sd_mps": [digits(channels[c].quiet_sd, 3) for c in CHANNELS["dvl"]]}
    heading = dict(_heading_sds(channels, config))
    if heading:
        piece["heading"] = heading
        remarks.append("heading sds are those at rest: under way deviation and motion add to them, 2 to 3 deg is usual")
    return piece


def _imu_noise(channels: Mapping[str, Channel], remarks: list[str]) -> dict[str, float]:
    """Mean density and walk of three axes; a walk that does not show is left out."""
    out: dict[str, float] = {}
    walks: dict[str, float] = {}
    for sensor, unit in (("acc", "m/s2/rts"), ("gyr", "rad/s/rts")):
        read = [channels[f"{sensor}_{axis}"].allan for axis in "xyz"]
        out[sensor] = digits(_rms([a.density for a in read]), 3)
        seen = [a.walk for a in read if a.walk is not None]
        if seen:
            walks[f"{sensor}_walk"] = digits(_rms(seen), 2)
        else:
            limit = max(a.walk_limit for a in read)
            remarks.append(
                f"imu.noise.{sensor}_walk is left out: the log is too short to show it; it is below {limit:.1g} {unit}"
            )
    return out | walks


def _heading_sds(channels: Mapping[str, Channel], config: Config) -> Iterator[tuple[str, float]]:
    """``heading`` keys; a magnetometer's noise turns the horizontal part of the field."""
    if "mag_x" in channels:
        field = np.array([channels[f"mag_{axis}"].mean for axis in "xyz"])
        length = float(np.linalg.norm(field))
        dip = np.deg2rad(config.environment.dip_deg or 0.0)
        if "acc_x" in channels:
            force = np.array([channels[f"acc_{axis}"].mean for axis in "xyz"])
            dip = np.arcsin(np.clip(-(force @ field) / (np.linalg.norm(force) * length), -1.0, 1.0))
        noise = _rms([channels[f"mag_{axis}"].quiet_sd for axis in "xyz"])
        yield "mag_sd_deg", digits(float(np.rad2deg(noise / (length * max(np.cos(dip), 0.1)))), 3)
    for name, key in (("dvl_heading", "dvl_sd_deg"), ("ahrs_yaw", "ahrs_sd_deg")):
        if name in channels:
            yield key, digits(float(np.rad2deg(channels[name].quiet_sd)), 3)


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
