"""Power spectral density of sensors at rest, and the lines in it (3.1.4).

Regular samples by Welch's method, irregular ones (a DVL's pings) by Lomb and Scargle's periodogram,
averaged over half-overlapping tapered segments alike. A line stands out of the running median around it
by more than chance gives.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter  # type: ignore[attr-defined]
from scipy.signal import fftconvolve, find_peaks, lombscargle, welch  # type: ignore[attr-defined]
from scipy.stats import chi2  # type: ignore[attr-defined]

from rovgraph.geometry import Array

SEGMENTS = 16  # at least, over the log
LOWEST = 3  # the frequencies below are touched by taking off a segment's trend
FINEST_HZ = 0.01  # resolution that is enough
PER_DECADE, DECADES = 40, (1.5, 0.4)  # a background is the median over so many decades, wide and narrow
HUMP = 2.0  # times what is below it in frequency: a band of waves, and no chance
FOOT = 1.3  # times the background, where a line ends
FALSE_ALARM = 1e-4  # of a line anywhere in a spectrum of white noise
EVEN = 0.05  # jitter of the intervals up to which samples count as regular
WAVES_HZ = (0.03, 1.0)


@dataclass(frozen=True)
class Line:
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
    lines: list[Line]


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
    cells = np.geomspace(edges[0], edges[-1], int(PER_DECADE * np.log10(edges[-1] / edges[0])) + 2)
    running = np.interp(cells, edges, np.concatenate([[0.0], np.cumsum(density * step)]))
    grid = np.sqrt(cells[1:] * cells[:-1])
    level = np.log(np.maximum(np.diff(running) / np.diff(cells), 1e-300))
    wide, narrow = (_running_median(level, 2 * int(0.5 * decades * PER_DECADE) + 1) for decades in DECADES)
    falling = np.minimum.accumulate(narrow)
    hump = (grid <= 2.0 * WAVES_HZ[1]) & (narrow > falling + np.log(HUMP))
    level = np.where(hump, np.minimum(wide, falling), wide)
    return np.asarray(np.exp(np.interp(np.log(frequency), np.log(grid), level)))


def _running_median(level: Array, width: int) -> Array:
    """Median over ``width`` values; a slope (of a walk) goes on below the first, what is above the last is like it."""
    half = min(width // 2, len(level) - 1)
    padded = np.pad(np.pad(level, (half, 0), mode="reflect", reflect_type="odd"), (0, half), mode="symmetric")
    return np.asarray(median_filter(padded, size=2 * half + 1)[half : len(padded) - half])


def _lines(frequency: Array, density: Array, background: Array, freedom: float) -> list[Line]:
    ratio = density / background
    least = chi2.isf(FALSE_ALARM / len(frequency), freedom) / freedom
    peaks, _ = find_peaks(np.concatenate([[0.0], ratio, [0.0]]), height=max(float(least), 2.0))
    out: list[Line] = []
    for peak in sorted(peaks - 1, key=lambda p: -density[p]):
        if any(line.low <= frequency[peak] <= line.high for line in out):
            continue
        low, high = _foot(ratio, int(peak), -1), _foot(ratio, int(peak), 1)
        band: NDArray[np.int64] = np.arange(low, high + 1)
        power = float(np.sum(np.maximum(density[band] - background[band], 0.0)) * (frequency[1] - frequency[0]))
        centre = float(np.average(frequency[band], weights=density[band]))
        half = 0.5 * (frequency[1] - frequency[0])
        line = Line(centre, float(frequency[low] - half), float(frequency[high] + half), float(np.sqrt(power)))
        out.append(line)
    return sorted(out, key=lambda line: -line.rms)


def _foot(ratio: Array, peak: int, side: int) -> int:
    """Where a line sinks into its background on one side."""
    i = peak
    while 0 <= i + side < len(ratio) and ratio[i + side] > FOOT:
        i += side
    return i
