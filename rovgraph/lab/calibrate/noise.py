"""Noise of sensors from a log at rest: covariance, spectrum, Allan deviation (3.1.4, 3.2.2, appendix A).

`NoiseReport` holds the piece of configuration: densities and walks of the IMU from the Allan deviation with lines and
waves removed, standard deviations of slower sensors as the scatter without them. Values that the log is too short for
are left out and listed.

**Allan deviation**

    sigma^2(tau) = N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3

N is the noise density (angle or velocity random walk), B the bias instability, K the random walk of the
bias (IEEE Std 952, annex C). The three are fitted at once, none below zero, each point weighted by
how well a log of that length determines it. `allantools` computes the deviation.

**Power spectral density** and the lines in it (3.1.4). Regular samples by Welch's method, irregular ones (a DVL's
pings) by Lomb and Scargle's periodogram, averaged over half-overlapping tapered segments alike. A line exceeds the
running median around it by more than chance gives.

**Standing still.** Waves do not count as motion: signals are averaged under a Hann window of `WINDOW_S`, which reduces
an oscillation of waves (0.34 Hz in the thesis's lake, 3.1.4) to a thousandth and leaves turning, tilting, driving.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import median_filter  # type: ignore[attr-defined]
from scipy.optimize import nnls  # type: ignore[attr-defined]
from scipy.signal import (  # type: ignore[attr-defined]
    fftconvolve,
    find_peaks,
    lombscargle,
    welch,
)
from scipy.stats import chi2  # type: ignore[attr-defined]

from rovgraph.errors import InputError, warn
from rovgraph.geometry import Array
from rovgraph.lab.calibrate.piece import Piece, digits
from rovgraph.log import Log, Stream
from rovgraph.model.config import Config

TIMES_PER_DECADE = 8  # averaging times
LONGEST = 0.2  # averaging time, of the log
FLAT = 2.0 * np.log(2.0) / np.pi  # square of the height of the flat floor over B^2
VISIBLE = {1: 40.0, 2: 10.0}  # fall of the misfit that shows B, K; chance alone reaches it once in a hundred logs


@dataclass(frozen=True)
class Allan:
    """Allan deviation of a channel and its readings.

    Attributes
    ----------
    tau : ndarray, shape (m,), averaging times [s]
    deviation, sd : ndarray, shape (m,) [unit]
    density : N [unit/rtHz]
    density_sd : its standard deviation by the length of the log
    instability : B [unit], None where no flat floor shows
    walk : K [unit/rts], None where the log is too short to show it
    walk_limit : K is not above it (95 %) [unit/rts]
    """

    tau: Array
    deviation: Array
    sd: Array
    density: float
    density_sd: float
    instability: float | None
    walk: float | None
    walk_limit: float

    def model(self, tau: Array) -> Array:
        """The fitted deviation, shape (m,)."""
        B, K = self.instability or 0.0, self.walk or 0.0
        return np.asarray(np.sqrt(self.density**2 / tau + FLAT * B**2 + K**2 * tau / 3.0))


def allan(values: Array, rate: float) -> Allan:
    """Overlapping Allan deviation of a regular channel.

    Parameters
    ----------
    values : ndarray, shape (n,)
    rate : [Hz]

    Raises
    ------
    InputError : allantools is not installed
    """
    try:
        from allantools import oadev
    except ImportError:
        raise InputError(
            "calibrate noise needs allantools; install it with: pip install 'rovgraph[calibrate]'"
        ) from None
    n = len(values)
    most = max(int(LONGEST * n), 2)
    steps = np.unique(np.geomspace(1, most, int(TIMES_PER_DECADE * np.log10(most)) + 2).round().astype(int))
    tau, deviation, *_ = oadev(values, rate=rate, data_type="freq", taus=steps / rate)
    # degrees of freedom of overlapping estimates of white noise, IEEE Std 1139
    m = np.round(tau * rate)
    freedom = np.maximum((1.5 * (n - 1) / m - 2.0 * (n - 2) / n) * 4.0 * m**2 / (4.0 * m**2 + 5.0), 1.0)
    return _read(tau, deviation, freedom, n)


def _read(tau: Array, deviation: Array, freedom: Array, n: int) -> Allan:
    variance = deviation**2
    terms = np.column_stack([1.0 / tau, np.full(len(tau), FLAT), tau / 3.0])
    squares, cost = _fit(terms, variance, freedom)
    seen: list[float | None] = []
    for i in (1, 2):
        kept = [k for k in range(3) if k != i]
        explained = _fit(terms[:, kept], variance, freedom)[1] - cost
        seen.append(float(np.sqrt(squares[i])) if explained > VISIBLE[i] else None)
    limit = np.sqrt(3.0 * variance[-1] * freedom[-1] / chi2.ppf(0.05, freedom[-1]) / tau[-1])
    return Allan(
        tau=tau,
        deviation=deviation,
        sd=deviation / np.sqrt(2.0 * freedom),
        density=float(np.sqrt(squares[0])),
        density_sd=float(np.sqrt(squares[0]) / np.sqrt(2.0 * n / 1.5)),
        instability=seen[0],
        walk=seen[1],
        walk_limit=float(limit),
    )


def _fit(terms: Array, variance: Array, freedom: Array) -> tuple[Array, float]:
    """Terms that are not negative, and twice the negative log-likelihood, each variance as a scaled chi-square.

    Weights are by the model's variance, not the measured: low points would weigh most.
    """
    expected = variance
    for _ in range(6):
        weight = np.sqrt(freedom / 2.0) / expected
        scale = np.linalg.norm(terms * weight[:, None], axis=0)
        squares = nnls(terms * weight[:, None] / scale, variance * weight)[0] / scale
        expected = np.maximum(terms @ squares, 1e-300)
    ratio = variance / expected
    return squares, float(np.sum(freedom * (ratio - np.log(ratio) - 1.0)))


SEGMENTS = 16  # at least, over the log
LOWEST = 3  # the frequencies below are touched by taking off a segment's trend
FINEST_HZ = 0.01  # resolution that is enough
CELLS_PER_DECADE, DECADES = 40, (1.5, 0.4)  # a background is the median over so many decades, wide and narrow
HUMP = 2.0  # times what is below it in frequency: a band of waves, and no chance
FOOT = 1.3  # times the background, where a line ends
FALSE_ALARM = 1e-4  # of a line anywhere in a spectrum of white noise
EVEN = 0.05  # jitter of the intervals up to which samples count as regular
WAVES_HZ = (0.03, 1.0)


@dataclass(frozen=True)
class SpectralLine:
    """A line or narrow band in the spectrum of a channel.

    Attributes
    ----------
    frequency : [Hz]
    low, high : where it sinks into the background [Hz]
    rms : of the signal in it [channel's unit]
    """

    frequency: float
    low: float
    high: float
    rms: float

    @property
    def kind(self) -> str:
        """What such a frequency usually is."""
        return "waves" if WAVES_HZ[0] <= self.frequency <= WAVES_HZ[1] else "machine"


@dataclass(frozen=True)
class Spectrum:
    """One-sided power spectral density.

    Attributes
    ----------
    frequency : ndarray, shape (m,) [Hz]
    density : ndarray, shape (m,) [unit^2/Hz]
    background : ndarray, shape (m,), the running median without lines [unit^2/Hz]
    lines : strongest first
    """

    frequency: Array
    density: Array
    background: Array
    lines: list[SpectralLine]


def spectrum(time: Array, values: Array) -> Spectrum:
    """Spectrum of a channel.

    Parameters
    ----------
    time : ndarray, shape (n,) [s], increasing
    values : ndarray, shape (n,)
    """
    interval = np.diff(time)
    step = float((time[-1] - time[0]) / (len(time) - 1))
    count = 2 * int(0.5 * min(len(time) // (SEGMENTS // 2), 1.0 / (FINEST_HZ * step)))
    if np.percentile(np.abs(interval - step), 95) < EVEN * step:
        frequency, density = welch(values, 1.0 / step, "hann", count, detrend="linear")
        frequency, density = frequency[LOWEST:-1], density[LOWEST:-1]
    else:
        frequency, density = _segmented_lomb_scargle(time, values, count, step)
    averaged = max(2.0 * len(time) / count - 1.0, 1.0)
    freedom = 2.0 * averaged / 1.1  # neighbouring segments overlap: a little less than all
    background = _background(frequency, density)
    return Spectrum(frequency, density, background, _lines(frequency, density, background, freedom))


def quietened(values: Array, found: Spectrum) -> Array:
    """A regular channel with its lines filtered down to what is around them.

    Parameters
    ----------
    values : ndarray, shape (n,)
    found : its spectrum

    Returns
    -------
    ndarray, shape (n,) or, where there are lines, shorter by the length of the filter
    """
    if not found.lines:
        return values
    gain = np.ones(len(found.frequency))
    for line in found.lines:
        band = (found.frequency >= line.low) & (found.frequency <= line.high)
        gain[band] = np.sqrt(np.minimum(found.background[band] / found.density[band], 1.0))
    response = np.fft.fftshift(np.fft.irfft(np.concatenate([np.ones(LOWEST), gain, [1.0]])))
    response *= np.hanning(len(response) + 1)[:-1]
    mean = values.mean()
    return np.asarray(fftconvolve(values - mean, response / response.sum(), mode="valid") + mean)


def _segmented_lomb_scargle(time: Array, values: Array, count: int, step: float) -> tuple[Array, Array]:
    """Welch's method with Lomb and Scargle's periodogram in the place of Fourier's."""
    frequency = np.arange(LOWEST, count // 2) / (count * step)
    window, total, segments = np.hanning(count), np.zeros(len(frequency)), 0
    for begin in range(0, len(time) - count + 1, count // 2):
        part = slice(begin, begin + count)
        t, y = time[part], values[part]
        y = y - np.polyval(np.polyfit(t - t[0], y, 1), t - t[0])
        power = lombscargle(t - t[0], window * y, 2.0 * np.pi * frequency)  # about |transform|^2 / n
        total += 2.0 * step * power * count / (window**2).sum()
        segments += 1
    return frequency, total / segments


def _background(frequency: Array, density: Array) -> Array:
    """Running median over logarithmic frequencies: blind to lines, follows slopes.

    Waves may fill a decade, more than a median is blind to. Where they may be, a background does
    not rise with frequency: no sensor's noise does there.
    """
    step = frequency[1] - frequency[0]
    edges = np.concatenate([frequency - 0.5 * step, frequency[-1:] + 0.5 * step])
    cells = np.geomspace(edges[0], edges[-1], int(CELLS_PER_DECADE * np.log10(edges[-1] / edges[0])) + 2)
    running = np.interp(cells, edges, np.concatenate([[0.0], np.cumsum(density * step)]))
    grid = np.sqrt(cells[1:] * cells[:-1])
    level = np.log(np.maximum(np.diff(running) / np.diff(cells), 1e-300))
    wide, narrow = (_running_median(level, 2 * int(0.5 * decades * CELLS_PER_DECADE) + 1) for decades in DECADES)
    falling = np.minimum.accumulate(narrow)
    hump = (grid <= 2.0 * WAVES_HZ[1]) & (narrow > falling + np.log(HUMP))
    level = np.where(hump, np.minimum(wide, falling), wide)
    return np.asarray(np.exp(np.interp(np.log(frequency), np.log(grid), level)))


def _running_median(level: Array, width: int) -> Array:
    """Median over ``width`` values; a slope (of a walk) continues below the first; above the last it is constant."""
    half = min(width // 2, len(level) - 1)
    padded = np.pad(np.pad(level, (half, 0), mode="reflect", reflect_type="odd"), (0, half), mode="symmetric")
    return np.asarray(median_filter(padded, size=2 * half + 1)[half : len(padded) - half])


def _lines(frequency: Array, density: Array, background: Array, freedom: float) -> list[SpectralLine]:
    ratio = density / background
    least = chi2.isf(FALSE_ALARM / len(frequency), freedom) / freedom
    peaks, _ = find_peaks(np.concatenate([[0.0], ratio, [0.0]]), height=max(float(least), 2.0))
    out: list[SpectralLine] = []
    for peak in sorted(peaks - 1, key=lambda p: -density[p]):
        if any(line.low <= frequency[peak] <= line.high for line in out):
            continue
        low, high = _foot(ratio, int(peak), -1), _foot(ratio, int(peak), 1)
        band: NDArray[np.int64] = np.arange(low, high + 1)
        power = float(np.sum(np.maximum(density[band] - background[band], 0.0)) * (frequency[1] - frequency[0]))
        centre = float(np.average(frequency[band], weights=density[band]))
        half = 0.5 * (frequency[1] - frequency[0])
        line = SpectralLine(centre, float(frequency[low] - half), float(frequency[high] + half), float(np.sqrt(power)))
        out.append(line)
    return sorted(out, key=lambda line: -line.rms)


def _foot(ratio: Array, peak: int, side: int) -> int:
    """Where a line sinks into its background on one side."""
    i = peak
    while 0 <= i + side < len(ratio) and ratio[i + side] > FOOT:
        i += side
    return i


WINDOW_S = 20.0
GRID_S = 0.1


@dataclass(frozen=True)
class _Watch:
    """What may change of a stream, and what it means when it does."""

    sensor: str
    columns: tuple[str, ...]
    most: float
    unit: str
    says: str
    angle: bool = False  # a heading, which wanders at rest too: asked only where there is no gyro


_DEG = float(np.deg2rad(1.0))
# biases drift: the limits are well above that
_WATCHES = (
    _Watch("imu", ("gyr_x", "gyr_y", "gyr_z"), 0.3 * _DEG, "rad/s", "the gyro turns"),
    _Watch("imu", ("acc_x", "acc_y", "acc_z"), 0.2, "m/s2", "the accelerometer tilts or is pushed"),
    _Watch("dvl", ("dvl_vx", "dvl_vy", "dvl_vz"), 0.05, "m/s", "the DVL drives"),
    _Watch("dvl_heading", ("dvl_heading",), 5.0 * _DEG, "rad", "the DVL's compass turns", angle=True),
    _Watch("ahrs", ("ahrs_yaw",), 5.0 * _DEG, "rad", "the IMU's own heading turns", angle=True),
    _Watch("depth", ("depth",), 0.5, "m", "the depth changes"),
)


def require_still(log: Log) -> None:
    """Refuse a log that moves.

    Raises
    ------
    InputError : names the sensor that shows it, when and how much
    """
    for watch in _WATCHES:
        if watch.sensor in log and not (watch.angle and "imu" in log):
            stream = log[watch.sensor]
            data = np.column_stack([stream[c] for c in watch.columns])
            whole = np.isfinite(data).all(axis=1)
            if whole.sum() > 1:
                _require(watch, stream.time[whole], data[whole], log.source)


def _require(watch: _Watch, time: Array, data: Array, source: str) -> None:
    data = np.unwrap(data, axis=0) if watch.angle else data
    steps = np.arange(time[0], time[-1], GRID_S)
    integral = cumulative_trapezoid(data, time, axis=0, initial=0.0)
    means = [np.diff(np.interp(steps, time, column)) / GRID_S for column in integral.T]
    smooth = np.column_stack([_smooth(mean) for mean in means])
    off = np.linalg.norm(smooth - np.median(smooth, axis=0), axis=1)
    worst = int(np.argmax(off))
    if off[worst] > watch.most:
        middle = 0.5 * min(WINDOW_S, float(steps[-1] - steps[0]))
        first, at = (float(steps[i] - time[0]) + middle for i in (int(np.argmax(off > watch.most)), worst))
        size, most, unit = off[worst], watch.most, watch.unit
        if unit.startswith("rad"):
            size, most, unit = size / _DEG, most / _DEG, "deg" + unit[3:]
        raise InputError(
            f"{source}: moves: {watch.says}, from about {first:.0f} s after its first sample on, "
            f"by up to {size:.2g} {unit} at {at:.0f} s, expected at most {most:.2g} {unit}; "
            "give a log at rest, or that part of it"
        )


def _smooth(values: Array) -> Array:
    """Means under the window, at every place where it fits in."""
    window = np.hanning(int(min(WINDOW_S / GRID_S, len(values))) + 2)[1:-1]
    return np.asarray(fftconvolve(values, window / window.sum(), mode="valid"))


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
class ColumnNoise:
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
    """Noise of sensors from a log at rest.

    Attributes
    ----------
    source : log
    duration : [s]
    channels : in the order of `CHANNELS`
    covariance : "imu" (acc, gyr and mag: R_MTi) and "dvl" (velocity and heading: R_DVL) -> names of the
        components, and ndarray, shape (k, k) [products of the channels' units]
    peaks : strongest first within a sensor
    piece : keys of a configuration
    remarks : what the log could not determine, a sentence each
    """

    source: str
    duration: float
    channels: list[ColumnNoise]
    covariance: dict[str, tuple[tuple[str, ...], Array]]
    peaks: list[Peak]
    piece: Piece
    remarks: list[str]

    def channel(self, name: str) -> ColumnNoise:
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


def _channels(stream: Stream) -> Iterator[ColumnNoise]:
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
        yield ColumnNoise(name, stream.sensor, unit, rate, float(values.mean()), *sds, found, read)


def _covariances(streams: Mapping[str, Stream]) -> Iterator[tuple[str, tuple[tuple[str, ...], Array]]]:
    """R_MTi and R_DVL of appendix A; the second sensor is taken at the times of the first."""
    for name, first, second in (("imu", "imu", "mag"), ("dvl", "dvl", "dvl_heading")):
        present = [s for s in (first, second) if s in streams]
        if present:
            time = streams[present[0]].time
            columns = [np.interp(time, streams[s].time, x) for s in present for x in _values(streams[s]).T]
            yield name, (tuple(c for s in present for c in CHANNELS[s]), np.atleast_2d(np.cov(np.array(columns))))


def _peaks(channels: list[ColumnNoise]) -> list[Peak]:
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


def _piece(channels: Mapping[str, ColumnNoise], config: Config, remarks: list[str]) -> Piece:
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


def _imu_noise(channels: Mapping[str, ColumnNoise], remarks: list[str]) -> dict[str, float]:
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


def _heading_sds(channels: Mapping[str, ColumnNoise], config: Config) -> Iterator[tuple[str, float]]:
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
