"""Sensors: the DVL, every sensor's residuals, the compasses, clocks and gaps."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from rovgraph.geometry import Array
from rovgraph.pages.beams import beam_items
from rovgraph.pages.parts import Item, Missing, Panel, Section, Table, Trace, bars, line, packed, points
from rovgraph.pages.source import DiveSource
from rovgraph.pages.thinning import broken, cloud, extremes, spread
from rovgraph.report.colours import REJECTED, SERIES

BLUE, RED, DARK = "#0072B2", "#D55E00", "#333333"
LAGS = 60  # of an autocorrelation, in measurements
POINTS = 2500  # of a cloud
SHADE = "#B35900"


def dvl_section(source: DiveSource) -> Section:
    """Lock, altitude, beams, figure of merit, silences and velocities."""
    title, clock, pings = "DVL", source.clock, source.pings
    if pings is None:
        return Section("dvl", title, (), [Missing("Pings", "the folder has no dvl.csv: no DVL, or an older version")])
    time, lock = pings["time"].to_numpy(float), pings["lock"].to_numpy(float)
    items: list[Item] = []
    altitude = pings["altitude"].to_numpy(float)
    spans = [(*clock(np.array(s)).tolist(), SHADE) for s in source.silences]
    if np.isfinite(altitude).any():
        drawn = [_over_time(source, "altitude", time, altitude)]
        items.append(Panel("Altitude over the bottom", clock.label, "altitude [m]", drawn, spans=spans))
    else:
        items.append(Missing("Altitude over the bottom", "the log has no dvl_altitude"))
    drawn = [_over_time(source, "bottom lock", time, lock, line_shape="hv")]
    seen = f"{100 * lock.mean():.1f} % of {len(lock)} pings saw the bottom" if len(lock) else "There is no ping"
    note = f"{seen}; one that repeats the ping before it saw nothing. Shaded: silences."
    items.append(Panel("Bottom lock", clock.label, "1 = lock", drawn, note=note, spans=spans))
    items += beam_items(source, spans)
    items.append(_silences(time[lock == 1]))
    items += _merit(source, pings)
    items += _velocities(source, spans)
    return Section("dvl", title, (), items)


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
    for component, own in rows[rows["sensor"] == "dvl"].groupby("component", sort=False):
        time, measured = own["time"].to_numpy(float), own["measured"].to_numpy(float)
        some = cloud(measured)
        drawn = [
            points("measured", source.clock(time[some]), measured[some], "#7A7A7A", size=3),
            _over_time(source, source.main.name, time, own["predicted"].to_numpy(float)),
        ]
        title = f"Velocity along the DVL's {component} axis"
        items.append(Panel(title, source.clock.label, f"v_{component} [m/s]", drawn, spans=spans))
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
            items += _residual_panels(source, f"{sensor} {component}", own)
    return Section("residuals", "Residuals", lead, items)


def _residual_panels(source: DiveSource, name: str, own: pd.DataFrame) -> Iterator[Item]:
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
    yield Panel(f"{name}: residual", *labels, drawn, note=note, levels=(-3.0, 0.0, 3.0), reach=reach)
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
    yield Panel(f"{name}: distribution", *labels, drawn, kind="xy", note=note, wide=False)
    yield _autocorrelation(name, fitted)


def _autocorrelation(name: str, z: Array) -> Item:
    rho = autocorrelation(z, LAGS)
    band = 2.0 / np.sqrt(len(z))
    drawn = [bars("autocorrelation", np.arange(1, len(rho) + 1), rho, "#8FBBD9", 0.8)]
    labels = ("lag [measurements]", "autocorrelation")
    note = "Between the lines: 95 % of white noise."
    return Panel(f"{name}: autocorrelation", *labels, drawn, kind="xy", levels=(-band, band), note=note, wide=False)


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
    return Table(title, head, rows, note="" if rows else "Every measurement was used.")


def clocks_section(source: DiveSource) -> Section:
    """Rates, gaps and jitter of every sensor."""
    head = ("sensor", "recorded", "used", "rejected", "rate [Hz]", "from [s]", "to [s]", "longest gap [s]", "at [s]",
            "jitter [s]", "repeats")  # fmt: skip
    keys = ("recorded", "used", "rejected", "rate_hz", "from_s", "to_s", "longest_gap_s", "longest_gap_at_s",
            "jitter_s", "repeats")  # fmt: skip
    rows = []
    for sensor, numbers in (source.summary.get("sensors") or {}).items():
        cells = [numbers.get(key) for key in keys]
        rows.append(
            (str(sensor), *("–" if c is None else f"{c:.4g}" if isinstance(c, float) else str(c) for c in cells))
        )
    note = (
        "Times count from the first measurement of the log. Jitter: half the width of the middle 90 % of the periods."
    )
    items: list[Item] = [Table("Clocks, rates and gaps", head, rows, note=note), *_periods(source)]
    return Section("clocks", "Clocks and gaps", (), items)


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
