"""Sections on the sensors: the DVL and its beams, every sensor's residuals, the compasses, clocks and gaps.

The beams are drawn against time: how many of their pings were valid, and their range. Compasses: residual against
heading with the fitted deviation curve, and two compasses against each other.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
import pandas as pd

from rovgraph.geometry import Array
from rovgraph.model.calibration import BEAM_SENSORS, TABLE
from rovgraph.report.colours import REJECTED, SERIES
from rovgraph.report.motion import axis_limits
from rovgraph.report.pages.dive import bottom_line, over_bottom
from rovgraph.report.pages.page import (
    Item,
    Missing,
    PageTable,
    Panel,
    Section,
    Trace,
    bars,
    broken,
    cloud,
    extremes,
    line,
    packed,
    points,
    spread,
)
from rovgraph.report.pages.source import DiveSource, DiveTime
from rovgraph.report.units import percent, words
from rovgraph.sensors.dvl_beam import Beams, beams_of

BINS = 240  # of the dive; on a narrow screen a bin is hardly wider than a pixel
PINGS = 4  # of a bin, at least, on the average
HEIGHT = 0.8  # of a row, of the place that it has
VALID, INVALID = "#0072B2", "#EDB48F"


def beam_items(source: DiveSource, spans: Sequence[tuple[float, float, str]]) -> list[Item]:
    """Valid pings and range of every beam.

    Parameters
    ----------
    spans : from, to, colour: times that are shaded
    """
    title, beams, clock = "Valid pings of each beam", source.beams, source.clock
    if beams is None:
        return [Missing(title, "the folder has no dvl_beams.csv: the log's files do not tell beams apart")]
    beams = beams.take((beams.time >= clock.start) & (beams.time <= clock.end))
    if not len(beams):
        return [Missing(title, "no ping of the beams lies within the track")]
    of_beams = beams_of(beams.data)
    return [_validity(title, beams.time, of_beams, clock), *_ranges(beams.time, of_beams, clock, spans)]


def valid_share(time: Array, beams: Beams, start: float, end: float) -> tuple[Array, Array]:
    """How many pings of each beam were valid, over stretches of equal length.

    Parameters
    ----------
    time, beams : of n pings [s], all of them between ``start`` and ``end``, and of k beams
    start, end : of all stretches [s]

    Returns
    -------
    edges : ndarray, shape (m + 1,), of the stretches [s]
    share : ndarray, shape (m, k) [%]; NaN where there is no ping
    """
    edges = np.linspace(start, max(end, start + 1e-3), 1 + int(np.clip(len(time) // PINGS, 1, BINS)))
    place = np.clip(np.searchsorted(edges, time, side="right") - 1, 0, len(edges) - 2)
    count = np.bincount(place, minlength=len(edges) - 1)
    sums = np.column_stack([np.bincount(place, own, len(edges) - 1) for own in beams.valid.T])
    share = np.full(sums.shape, np.nan)
    share[count > 0] = 100.0 * sums[count > 0] / count[count > 0, None]
    return edges, share


def _validity(title: str, time: Array, beams: Beams, clock: DiveTime) -> Panel:
    """A row for each beam, filled as high as its pings were valid."""
    names = [f"beam {number}" for number in beams.numbers]
    edges, share = valid_share(time, beams, clock.start, clock.end)
    middle, width = clock(0.5 * (edges[1:] + edges[:-1])), float(edges[1] - edges[0]) / clock.scale
    drawn: list[Trace] = []
    for place, (name, own) in enumerate(zip(names, share.T, strict=True), 1):
        foot, top = place + HEIGHT / 2, place - HEIGHT / 2  # places count downwards
        up, down = -HEIGHT * own / 100.0, HEIGHT * (1.0 - own / 100.0)
        drawn.append(bars(name, middle, up, VALID, width, base=foot, value=packed(own), showlegend=False))
        look = {"base": top, "value": packed(100.0 - own), "showlegend": False, "hoverinfo": "skip", "quiet": True}
        drawn.append(bars(f"{name}, not valid", middle, down, INVALID, width, **look))
    means = ", ".join(f"{name} {100.0 * own.mean():.1f} %" for name, own in zip(names, beams.valid.T, strict=True))
    note = (
        f"Blue: valid, orange: not valid, white: no ping, in every {edges[1] - edges[0]:.2g} s. Valid of all: {means}."
    )
    return Panel(
        title, clock.label, "beam: valid pings [%]", drawn, note=note, names=[str(number) for number in beams.numbers]
    )


def _ranges(time: Array, beams: Beams, clock: DiveTime, spans: Sequence[tuple[float, float, str]]) -> list[Item]:
    """Lines of all beams that have a range."""
    drawn = []
    measured = np.where(np.isfinite(beams.range), beams.range, beams.distance)
    for number, far, colour in zip(beams.numbers, measured.T, SERIES, strict=False):
        if np.isfinite(far).any():
            some = extremes(far)
            drawn.append(line(f"beam {number}", clock(time[some]), far[some], colour))
    note = "As the DVL states it: along the beam or straight down, by its maker."
    return [Panel("Range of each beam", clock.label, "range [m]", drawn, note=note, spans=spans)] if drawn else []


BLUE, RED, DARK = "#0072B2", "#D55E00", "#333333"
LAGS = 60  # of an autocorrelation, in measurements
POINTS = 2500  # of a cloud
SHADE = "#B35900"


def dvl_section(source: DiveSource) -> Section:
    """Lock, beams, figure of merit, silences, velocities, and the bottom."""
    title, clock, pings = "DVL", source.clock, source.pings
    if pings is None:
        why = "the folder has no dvl.csv: no DVL, or an older version"
        alone = [] if source.beams is None else _by_beams(source, [])
        return Section("dvl", title, (), [Missing("Pings", why), *alone], finding="There are no pings to show.")
    time, lock = pings["time"].to_numpy(float), pings["lock"].to_numpy(float)
    items: list[Item] = []
    spans = [(*clock(np.array(s)).tolist(), SHADE) for s in source.silences]
    drawn = [_over_time(source, "bottom lock", time, lock, line_shape="hv")]
    seen = f"{100 * lock.mean():.1f} % of {len(lock)} pings saw the bottom" if len(lock) else "There is no ping"
    note = f"{seen}; one that repeats the ping before it saw nothing. Shaded: silences."
    items.append(Panel("Bottom lock", clock.label, "1 = lock", drawn, note=note, spans=spans, ticks=(0.0, 1.0)))
    items += _by_beams(source, spans)
    items.append(_silences(time[lock == 1]))
    items += _merit(source, pings)
    items += _velocities(source, spans)
    items += _profile(source)
    gap = max((end - begin for begin, end in source.silences), default=0.0)
    finding = f"{seen}" + (f"; the longest silence took {gap:.3g} s." if gap else "; it never fell silent.")
    well = not _sensors_with(source, "alarms", ("dvl", *BEAM_SENSORS)) if len(lock) else None
    return Section("dvl", title, (), items, finding=finding, well=well)


def _by_beams(source: DiveSource, spans: Sequence[tuple[float, float, str]]) -> list[Item]:
    """Every beam by itself: how its pings fitted, how many were valid, its range; and what the beams disagree by."""
    items = [*_beam_table(source), *beam_items(source, spans)]
    error = source.error_velocity
    if error is not None and len(error):
        time, size = error["time"].to_numpy(float), error["error_velocity"].to_numpy(float)
        some = cloud(size)
        drawn = [points("error velocity", source.clock(time[some]), size[some], BLUE, size=3)]
        note = "What four beams or more disagree by, as noisy as one beam: about its noise where all is well. "
        note += f"Median {np.median(size):.2g} m/s."
        limits = (0.0, 1.2 * max(float(np.percentile(size, 99.0)), 1e-3))
        labels = (source.clock.label, "error velocity [m/s]")
        items.append(Panel("Error velocity", *labels, drawn, note=note, spans=spans, limits=limits))
    return items


def _beam_table(source: DiveSource) -> list[Item]:
    """Used and rejected pings of each beam, and its noise."""
    if source.residuals is None:
        return []
    rows = []
    for sensor in BEAM_SENSORS:
        own = source.residuals[source.residuals["sensor"] == sensor]
        used = own[own["weight"] > 0]
        if own.empty:
            continue
        found = _rms(used["innovation"]) if len(used) else np.nan
        stated = _rms(used["sd"]) if len(used) and "sd" in used else np.nan
        rejected = len(own) - len(used)
        share = f"{rejected} ({percent(rejected / len(own))})" if rejected else "0"
        rows.append((sensor.removeprefix("dvl_beam_"), f"{len(used)}", share, f"{found:.2g}", f"{stated:.2g}"))
    head = ("beam", "pings used", "rejected", "noise found [m/s]", "stated [m/s]")
    note = "Noise found: rms of measured less estimated along the beam, of the pings used."
    return [PageTable("Velocities along the beams", head, rows, note=note)] if rows else []


def _rms(values: pd.Series) -> float:
    return float(np.sqrt(np.mean(np.square(values.to_numpy(float)))))


def _profile(source: DiveSource) -> list[Item]:
    """The vehicle over the bottom, with what each range met."""
    track, found = source.main, source.soundings
    if found is None or found.empty:
        return []
    drawn: list[Trace] = []
    beams = [*found.loc[found["used"] == 1, "beam"].unique()]
    for beam, colour in zip(sorted(beams), SERIES, strict=False):
        own = found[(found["beam"] == beam) & (found["used"] == 1)]
        own = own.iloc[spread(len(own), POINTS // max(len(beams), 1))]
        name = f"beam {beam}" if beam >= 0 else "altitude of the DVL"
        drawn.append(points(name, source.clock(own["time"].to_numpy(float)), own["depth"], colour, size=2))
    spikes = found[found["used"] == 0]
    if len(spikes):
        when, some = source.clock(spikes["time"].to_numpy(float)), spread(len(spikes), POINTS)
        drawn.append(points(f"left out ({len(spikes)})", when[some], spikes["depth"].iloc[some], REJECTED, size=4))
    below = over_bottom(source, "bottom_depth")
    if below is not None:
        drawn.append(bottom_line(source, below, "bottom under the vehicle"))
    some = extremes(track["down"])
    drawn.append(line("vehicle", source.clock(track["time"][some]), track["down"][some], DARK))
    note = "The bottom straight under the vehicle by a plane through the ranges of each ping, with one sd to each side."
    labels = (source.clock.label, "depth [m]")
    shown = (found.loc[found["used"] == 1, "depth"].to_numpy(float), track["down"])
    limits = axis_limits([(float(np.nanmin(one)), float(np.nanmax(one))) for one in shown if np.isfinite(one).any()])
    return [Panel("Bottom under the track", *labels, drawn, note=note, down=True, limits=limits)]


def _sensors_with(source: DiveSource, list_of: str, sensors: Sequence[str], kinds: Sequence[str] = ()) -> list[str]:
    """Those of some sensors that the summary's alarms or advice name, of ``kinds`` only where they are given."""
    entries = source.summary.get(list_of) or []
    named = {e.get("sensor") for e in entries if not kinds or e.get("kind") in kinds}
    return [sensor for sensor in sensors if sensor in named]


def _over_time(source: DiveSource, name: str, time: Array, values: Array, **look: str) -> Trace:
    """A line over the page's clock that breaks in gaps."""
    time, values = broken(time, values)
    some = extremes(values)
    return line(name, source.clock(time[some]), values[some], BLUE, **look)


def _silences(locked: Array) -> Item:
    title = "Silences: time between pings that saw the bottom"
    gap = np.diff(locked)
    gap = gap[gap > 0]
    if not len(gap):
        return Missing(title, "fewer than two pings saw the bottom")
    edges = np.geomspace(gap.min() * 0.99, max(gap.max(), gap.min() * 1.1) * 1.01, 31)
    count, _ = np.histogram(gap, edges)
    x, y = np.repeat(edges, 2)[1:-1], np.repeat(count, 2).astype(float)
    drawn = [line("count", x, np.where(y > 0, y, 0.5), BLUE, fill="tozeroy")]
    return Panel(title, "time [s]", "count", drawn, kind="xy", log="xy", wide=False)


def _merit(source: DiveSource, pings: pd.DataFrame) -> list[Item]:
    """Figure of merit against the size of the residual."""
    title, rows = "Figure of merit against residual", source.residuals
    merit = pings.set_index("row")["figure_of_merit"]
    if not merit.notna().any():
        return [Missing(title, "the log has no dvl_sd")]
    if rows is None or not (rows["sensor"] == "dvl").any():
        return [Missing(title, "no ping was compared with the estimate")]
    own = rows[rows["sensor"] == "dvl"]
    size = np.sqrt((own["innovation"] ** 2).groupby(own["row"]).mean())
    when = own.groupby("row")["time"].first()
    both = pd.DataFrame({"merit": merit[~merit.index.duplicated()], "size": size, "time": when}).dropna()
    some = spread(len(both), POINTS)
    both = both.iloc[some]
    drawn = [points("ping", both["merit"], both["size"], BLUE, size=3, t=packed(source.clock(both["time"].to_numpy())))]
    top = float(both["merit"].max()) if len(both) else 1.0
    drawn.append(line("equal", [0, top], [0, top], DARK, dash="dot"))
    labels = ("figure of merit [m/s]", "rms residual of a ping [m/s]")
    return [Panel(title, *labels, drawn, kind="xy", note="Above the line: worse than the DVL says.", wide=False)]


def _velocities(source: DiveSource, spans: list[tuple[float, float, str]]) -> list[Item]:
    rows = source.residuals
    if rows is None or not {"measured", "predicted"} <= set(rows.columns):
        return [Missing("Velocities", "residuals.csv is missing or incomplete")]
    items: list[Item] = []
    of_dvl = rows[rows["sensor"].isin(["dvl", *BEAM_SENSORS])]
    for (sensor, component), own in of_dvl.groupby(["sensor", "component"], sort=False):
        beam = str(sensor).removeprefix("dvl_beam_")
        time, measured = own["time"].to_numpy(float), own["measured"].to_numpy(float)
        some = cloud(measured)
        drawn = [
            points("measured", source.clock(time[some]), measured[some], "#7A7A7A", size=3),
            _over_time(source, source.main.name, time, own["predicted"].to_numpy(float)),
        ]
        along, symbol = (f"the DVL's {component} axis", f"v_{component}") if sensor == "dvl" else (f"beam {beam}", "v")
        items.append(Panel(f"Velocity along {along}", source.clock.label, f"{symbol} [m/s]", drawn, spans=spans))
    return items


def residuals_section(source: DiveSource) -> Section:
    """Normalised residuals against time, their histogram and autocorrelation, and what was rejected."""
    lead = [
        "Measured minus predicted, over the expected sd. About 1 in 370 should lie beyond ±3, the histogram should "
        "follow the normal curve, and the autocorrelation should stay in its band: errors that last break it."
    ]
    items: list[Item] = [_left_out(source)]
    rows = source.residuals
    if rows is None:
        items.append(Missing("Residuals", "the folder has no residuals.csv"))
    elif rows.empty:
        items.append(Missing("Residuals", "no measurement was compared with the estimate"))
    else:
        for (sensor, component), own in rows.groupby(["sensor", "component"], sort=False):
            items += _residual_panels(source, str(sensor), str(component), own)
    finding, well = _residuals_in_a_sentence(source)
    return Section("residuals", "Residuals", lead, items, finding=finding, well=well)


RESIDUAL_KINDS = ("too large", "lasting", "innovations", "rejected", "filter alone", "taken out")  # of alarms


def _residuals_in_a_sentence(source: DiveSource) -> tuple[str, bool | None]:
    """Whether every sensor is as good as stated, by the dive's alarms and advice."""
    if source.residuals is None or source.residuals.empty:
        return "There are no residuals to show.", None
    sensors = [str(s) for s in source.residuals["sensor"].unique()]
    worse = _sensors_with(source, "alarms", sensors, RESIDUAL_KINDS)
    better = [s for s in _sensors_with(source, "advice", sensors, ("too small",)) if s not in worse]
    if not worse and not better:
        return "Every sensor's are as large as stated.", True
    parts = [
        f"{len(some)} of {len(sensors)} sensors {'errs' if len(some) == 1 else 'err'} {what} "
        f"({', '.join(map(words, some))})"
        for some, what in ((worse, "more than stated, or for longer"), (better, "less than stated"))
        if some
    ]
    return "; ".join(parts) + ".", not worse


def _residual_panels(source: DiveSource, sensor: str, component: str, own: pd.DataFrame) -> Iterator[Item]:
    key = f"{sensor} {component}"
    name = words(sensor) if sensor.endswith(component) else f"{words(sensor)}, {component}"
    time, z = source.clock(own["time"].to_numpy(float)), own["normalised"].to_numpy(float)
    used = own["weight"].to_numpy(float) > 0
    drawn = []
    for label, mask, colour in (("used", used, BLUE), ("rejected", ~used, REJECTED)):
        t, values = time[mask], z[mask]
        if len(values):
            some = cloud(values)
            drawn.append(points(f"{label} ({len(values)})", t[some], values[some], colour, size=3))
    reach = 1.1 * max(float(np.nanmax(np.abs(z[used]), initial=0.0)), 5.0)
    beyond = int(np.count_nonzero(np.abs(z) > reach))
    note = f"{beyond} lie beyond what is shown: a double click shows all." if beyond else ""
    labels = (source.clock.label, "residual / sd")
    limits = (-reach, reach)
    yield Panel(f"{name}: residual", *labels, drawn, note=note, levels=(-3.0, 0.0, 3.0), limits=limits, key=key)
    fitted = z[used & np.isfinite(z)]
    if len(fitted) < 2:
        yield Missing(f"{name}: distribution", "fewer than two measurements were used")
        return
    edges = np.linspace(-5.0, 5.0, 51)
    count, _ = np.histogram(np.clip(fitted, -4.999, 4.999), edges)
    centre, width = (edges[:-1] + edges[1:]) / 2, edges[1] - edges[0]
    normal = np.exp(-0.5 * centre**2) / np.sqrt(2 * np.pi)
    drawn = [bars("measured", centre, count / (len(fitted) * width), "#8FBBD9", float(width))]
    drawn.append(line("normal", centre, normal, RED))
    note = f"rms {np.sqrt(np.mean(fitted**2)):.2f}, 1 where the noise is as stated. The outer bars hold what is beyond."
    labels = ("residual / sd", "density")
    yield Panel(f"{name}: distribution", *labels, drawn, kind="xy", note=note, wide=False, key=key)
    yield _autocorrelation(name, key, fitted)


def _autocorrelation(name: str, key: str, z: Array) -> Item:
    rho = autocorrelation(z, LAGS)
    band = 2.0 / np.sqrt(len(z))
    drawn = [bars("autocorrelation", np.arange(1, len(rho) + 1), rho, "#8FBBD9", 0.8)]
    labels = ("lag [measurements]", "autocorrelation")
    levels, note = (-band, band), "Between the lines: 95 % of white noise."
    return Panel(f"{name}: autocorrelation", *labels, drawn, kind="xy", levels=levels, note=note, wide=False, key=key)


def autocorrelation(z: Array, lags: int) -> Array:
    """Of lags 1 to ``lags`` or fewer, of a series less its mean; zero where it does not vary."""
    centred = z - z.mean()
    n, lags = len(z), min(lags, len(z) - 1)
    size = 1 << (2 * n - 1).bit_length()
    power = np.abs(np.fft.rfft(centred, size)) ** 2
    covariance = np.fft.irfft(power, size)[: lags + 1]
    return np.asarray(covariance[1:] / covariance[0] if covariance[0] > 0 else np.zeros(lags))


def _left_out(source: DiveSource) -> Item:
    title = "Measurements that did not count"
    table = source.frame("left_out.csv", "time", "sensor", "reason", "row")
    if table is None:
        return Missing(title, "the folder has no left_out.csv")
    rows = []
    for (sensor, reason), own in table.groupby(["sensor", "reason"], sort=True):
        first, last = source.clock(own["time"].to_numpy(float))[[0, -1]]
        lines = ", ".join(str(r) for r in own["row"].head(5)) + ("…" if len(own) > 5 else "")
        rows.append((str(sensor), str(reason), str(len(own)), f"{first:.1f}", f"{last:.1f}", lines))
    unit = source.clock.unit
    head = ("sensor", "reason", "count", f"first [{unit}]", f"last [{unit}]", "lines of the log")
    return PageTable(title, head, rows, note="" if rows else "Every measurement was used.")


def clocks_section(source: DiveSource) -> Section:
    """Rates, gaps and jitter of every sensor."""
    head = ("sensor", "recorded", "used", "rejected", "rate [Hz]", "from [s]", "to [s]", "longest gap [s]", "at [s]",
            "jitter [s]", "repeats")  # fmt: skip
    keys = ("recorded", "used", "rejected", "rate_hz", "from_s", "to_s", "longest_gap_s", "longest_gap_at_s",
            "jitter_s", "repeats")  # fmt: skip
    rows = []
    sensors = source.summary.get("sensors") or {}
    for sensor, numbers in sensors.items():
        cells = [numbers.get(key) for key in keys]
        rows.append(
            (str(sensor), *("–" if c is None else f"{c:.4g}" if isinstance(c, float) else str(c) for c in cells))
        )
    note = (
        "Times count from the first measurement of the log. Jitter: half the width of the middle 90 % of the periods."
    )
    items: list[Item] = [PageTable("Clocks, rates and gaps", head, rows, note=note), *_periods(source)]
    gaps = {str(s): n["longest_gap_s"] for s, n in sensors.items() if n.get("longest_gap_s") is not None}
    worst = max(gaps, key=gaps.__getitem__, default="")
    finding = f"The longest gap took {gaps[worst]:.3g} s ({words(worst)})." if gaps else "What came when."
    late = [e.get("sensor") for e in source.summary.get("alarms") or [] if e.get("kind") in ("clock", "check")]
    doubt = f" An alarm names {', '.join(words(str(s)) for s in dict.fromkeys(late))}." if late else ""
    return Section("clocks", "Clocks and gaps", (), items, finding=finding + doubt, well=not late if gaps else None)


def _periods(source: DiveSource) -> list[Item]:
    """Time between measurements that were compared with the estimate."""
    rows = source.residuals
    if rows is None or rows.empty:
        return []
    drawn: list[Trace] = []
    for k, (sensor, own) in enumerate(rows.groupby("sensor", sort=False)):
        time = np.unique(own["time"].to_numpy(float))
        if len(time) > 1:
            period = np.diff(time)
            some = extremes(period)
            drawn.append(line(str(sensor), source.clock(time[1:])[some], period[some], SERIES[k % len(SERIES)]))
    if not drawn:
        return []
    note = "One keyframe takes one heading, so a compass shows the rate of the keyframes here."
    return [Panel("Time between measurements used", source.clock.label, "period [s]", drawn, note=note, log="y")]


CURVES = {v.sensors[0]: name for name, v in TABLE.items() if name.endswith("_deviation")}  # sensor -> its curve
MOST = 3000
ALL_ROUND = np.linspace(0.0, 360.0, 181)


def compass_section(source: DiveSource) -> Section:
    """Every compass that was compared with the estimate."""
    rows = source.residuals
    title = "Compasses"
    if rows is None:
        missing = [Missing("Deviation", "the folder has no residuals.csv")]
        return Section("compasses", title, (), missing, finding="There are no residuals to show.")
    headings = rows[(rows["component"] == "heading") & (rows["weight"] > 0)]
    used = {str(s): own for s, own in headings.groupby("sensor", sort=False)}
    items: list[Item] = [_deviation(source, s, own) for s, own in used.items()]
    if not items:
        items = [Missing("Deviation", "no compass that measures a heading was used; a magnetometer is in Residuals")]
    if "measured" in rows:
        items += [_pair(source, a, used[a], b, used[b]) for a, b in combinations(used, 2)]
    finding, well = _compasses_in_a_sentence(source, [*used])
    return Section(
        "compasses", title, ["A wave with one period per turn is deviation."], items, finding=finding, well=well
    )


def _compasses_in_a_sentence(source: DiveSource, used: Sequence[str]) -> tuple[str, bool | None]:
    """How far each one deviates."""
    if not used:
        return "No compass that measures a heading was used.", None
    parts = []
    for sensor in used:
        fit = _fit(source, sensor)
        by = "no deviation was estimated" if fit is None else f"deviates by up to {np.hypot(*fit[1:]):.2g}°"
        parts.append(f"{words(sensor)}: {by}")
    return "; ".join(parts) + ".", not _sensors_with(source, "alarms", used)


def _heading(source: DiveSource, time: Array) -> Array:
    """Heading of the main track at some times, in [0, 360) [deg]."""
    yaw = source.main["yaw"]
    known = np.isfinite(yaw)
    if not known.any():
        return np.full(len(time), np.nan)
    return np.asarray(np.rad2deg(np.interp(time, source.main["time"][known], np.unwrap(yaw[known]))) % 360.0)


def _deviation(source: DiveSource, sensor: str, own: pd.DataFrame) -> Item:
    """Residual against the heading of the compass's own axis, with the fitted curve added back."""
    own = own.iloc[spread(len(own), MOST)]
    time = own["time"].to_numpy(float)
    residual = np.rad2deg(own["innovation"].to_numpy(float))
    look = {"size": 3, "t": packed(source.clock(time))}
    title, key = f"{words(sensor)}: deviation against heading", sensor
    fit = _fit(source, sensor)
    if fit is None or "predicted" not in own:
        drawn = [points("residual", _heading(source, time), residual, "#0072B2", **look)]
        note = "No deviation curve was estimated."
        return Panel(title, "heading [°]", "residual [°]", drawn, kind="xy", note=note, wide=False, key=key)
    offset, sine, cosine = fit
    heading = np.rad2deg(own["predicted"].to_numpy(float)) - offset
    for _ in range(5):  # predicted = heading + offset + deviation(heading)
        heading = np.rad2deg(own["predicted"].to_numpy(float)) - offset - _curve(sine, cosine, heading)
    heading %= 360.0
    drawn = [
        points("compass less offset", heading, residual + _curve(sine, cosine, heading), "#0072B2", **look),
        line("fitted deviation", ALL_ROUND, _curve(sine, cosine, ALL_ROUND), "#D55E00", width=2.5),
        points("residual after the fit", heading, residual, "#8A8A8A", visible="legendonly", **look),
    ]
    note = f"Deviation: {sine:.2f}° sin h + {cosine:.2f}° cos h, h the heading of the compass's own axis."
    labels = ("heading of the compass [°]", "deviation [°]")
    return Panel(title, *labels, drawn, kind="xy", note=note, wide=False, key=key)


def _curve(sine: float, cosine: float, heading: Array) -> Array:
    """Deviation at a heading [deg]."""
    return np.asarray(sine * np.sin(np.deg2rad(heading)) + cosine * np.cos(np.deg2rad(heading)))


def _fit(source: DiveSource, sensor: str) -> tuple[float, float, float] | None:
    """Offset, and coefficients of sine and cosine of the heading [deg], where a curve was estimated."""
    table, name = source.calibration, CURVES.get(sensor)
    if table is None or name is None:
        return None
    value = table.set_index("label")["value"]
    if not {f"{name}_sin", f"{name}_cos"} <= set(value.index):
        return None
    labels = (name.replace("deviation", "offset"), f"{name}_sin", f"{name}_cos")
    offset, sine, cosine = (float(value.get(label, 0.0)) for label in labels)
    return (offset, sine, cosine) if np.isfinite([offset, sine, cosine]).all() and (sine or cosine) else None


def _pair(source: DiveSource, a: str, first: pd.DataFrame, b: str, second: pd.DataFrame) -> Item:
    """The difference of two compasses as recorded, against heading."""
    title = f"{words(a)} minus {words(b)}, as recorded"
    left = first[["time", "measured"]].sort_values("time")
    right = second[["time", "measured"]].sort_values("time")
    both = pd.merge_asof(left, right, on="time", direction="nearest", tolerance=0.5, suffixes=("_a", "_b"))  # type: ignore[arg-type]
    both = both.dropna()
    if both.empty:
        return Missing(title, "they never measured within half a second of each other")
    both = both.iloc[spread(len(both), MOST)]
    angle = (both["measured_a"] - both["measured_b"]).to_numpy(float)
    middle = np.angle(np.mean(np.exp(1j * angle)))
    difference = np.rad2deg(middle + np.angle(np.exp(1j * (angle - middle))))
    time = both["time"].to_numpy(float)
    look = {"size": 3, "t": packed(source.clock(time))}
    drawn = [points("difference", _heading(source, time), difference, "#0072B2", **look)]
    note = f"Mean {np.rad2deg(middle):.1f}°: mountings and offsets together."
    return Panel(title, "heading [°]", "difference [°]", drawn, kind="xy", note=note, wide=False)
