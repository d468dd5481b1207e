"""Velocity, attitude and depth against time."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rovgraph.config import Config, beliefs, mount_matrix
from rovgraph.estimators.estimate import Estimate
from rovgraph.geometry import Array, matrix_from_rpy, rotate, wrap_angle
from rovgraph.log import Log
from rovgraph.report.style import Clock, broken, legend_below, line_of, name_of, new_figure, thin
from rovgraph.trajectory import Trajectory

SOURCES: dict[str, tuple[str, dict[str, Any]]] = {
    "ahrs": ("AHRS heading", {"marker": ".", "color": "#999999"}),
    "dvl_heading": ("DVL compass", {"marker": "x", "color": "#009E73", "mew": 0.5}),
    "mag": ("magnetometer", {"marker": "+", "color": "#E69F00", "mew": 0.5}),
}
BOTTOM: dict[str, Any] = {"color": "#8C6D46", "linewidth": 0.9, "zorder": 1}
MOST_SAMPLES = 1500  # of a heading source
DENSE = 2000  # epochs from which lines are drawn thinner
USUAL = (1.0, 99.0)  # percentiles of value ± 2 sd that an axis shows; a poorly known start would flatten the dive


def draw_velocity(estimates: Sequence[Estimate]) -> Figure:
    """Velocity north, east, down and speed over ground, with ±2 sd."""
    figure = new_figure(7.2)
    panels: list[Axes] = list(figure.subplots(4, 1, sharex=True))
    clock = Clock.of(estimates[0])
    spans: list[list[tuple[float, float]]] = [[] for _ in panels]
    for estimate in estimates:
        track = estimate.trajectory
        speed, speed_sd = _speed(track)
        values, sds = np.column_stack([track.v_n, speed]), np.column_stack([track.v_sd, speed_sd])
        some = thin(len(track))
        for axes, span, value, sd in zip(panels, spans, values[some].T, sds[some].T, strict=True):
            _line_and_band(axes, clock(track.time[some]), value, sd, estimate.kind)
            span.append(_span(value, sd))
    for axes, name, span in zip(panels, ("north", "east", "down", "speed"), spans, strict=True):
        axes.set_ylabel(f"{name} [m/s]")
        _scale(axes, span)
    panels[3].set_ylim(bottom=0.0)
    panels[0].set_title("velocity over ground, bands ±2 sd", loc="left")
    clock.name_axis(panels[3])
    figure.align_ylabels()
    legend_below(figure, panels)
    return figure


def draw_depth(estimates: Sequence[Estimate], log: Log) -> Figure:
    """Depth with ±2 sd, the bottom below it and the altitude over it where the DVL measured one."""
    main, clock = estimates[0], Clock.of(estimates[0])
    bottom = "dvl_altitude" in log
    figure = new_figure(4.8 if bottom else 3.6)
    panels: list[Axes] = list(figure.subplots(1 + bottom, 1, sharex=True, squeeze=False)[:, 0])
    spans = []
    for estimate in estimates:
        track, some = estimate.trajectory, thin(len(estimate.trajectory))
        depth, sd = track.p_n[some, 2], track.p_sd[some, 2]
        _line_and_band(panels[0], clock(track.time[some]), depth, sd, estimate.kind)
        spans.append(_span(depth, sd))
    panels[0].set_ylabel("depth [m]")
    panels[0].set_title("depth, bands ±2 sd" + ("; bottom and altitude by the DVL" if bottom else ""), loc="left")
    if bottom:
        stream = log["dvl_altitude"].take(thin(len(log["dvl_altitude"])))
        altitude, time = stream["dvl_altitude"], clock(stream.time)
        below = main.trajectory.at(stream.time).p_n[:, 2] + altitude
        panels[0].plot(time, below, label="bottom", **BOTTOM)
        spans.append(_span(below, np.zeros_like(below)))
        panels[1].plot(time, altitude, **BOTTOM)
        panels[1].set_ylabel("altitude [m]")
        panels[1].set_ylim(bottom=0.0)
    _scale(panels[0], spans)
    panels[0].invert_yaxis()
    clock.name_axis(panels[-1])
    figure.align_ylabels()
    legend_below(figure, panels)
    return figure


def draw_attitude(estimates: Sequence[Estimate], log: Log, config: Config) -> Figure:
    """Roll, pitch and heading with ±2 sd, and what the compasses said."""
    main, clock = estimates[0], Clock.of(estimates[0])
    samples = heading_samples(main.trajectory, log, config)
    heights = (1.0, 1.0, 1.6, 1.1) if samples else (1.0, 1.0, 1.6)
    figure = new_figure(1.0 + 1.6 * sum(heights))
    panels: list[Axes] = list(figure.subplots(len(heights), 1, sharex=True, height_ratios=heights))
    low = _lower_end(main.trajectory)
    for estimate in estimates:
        _draw_attitude(panels, estimate, clock, low)
    tracks = [estimate.trajectory for estimate in estimates]
    for i in (0, 1):
        _scale(panels[i], [_span(np.rad2deg(t.rpy[:, i]), np.rad2deg(t.rpy_sd[:, i])) for t in tracks])
    for sensor, (time, heading) in samples.items():
        label, look = SOURCES[sensor]
        panels[2].plot(clock(time), _within(heading, low), ls="none", ms=2.5, label=label, zorder=1, alpha=0.6, **look)
        difference = np.rad2deg(wrap_angle(heading - main.trajectory.at(time).rpy[:, 2]))
        panels[3].plot(clock(time), difference, ls="none", ms=2.5, alpha=0.6, **look)
    names = ("roll", "pitch", "heading", f"compass − {name_of(main.kind)}")
    for axes, name in zip(panels, names, strict=False):
        axes.set_ylabel(f"{name} [deg]")
    _limit_heading(panels[2], low)
    title = "attitude, bands ±2 sd" + ("; compasses before their calibration" if samples else "")
    panels[0].set_title(title, loc="left")
    clock.name_axis(panels[-1])
    figure.align_ylabels()
    legend_below(figure, panels, 5, 2.0)
    return figure


def _draw_attitude(panels: Sequence[Axes], estimate: Estimate, clock: Clock, low: float) -> None:
    track, some = estimate.trajectory, thin(len(estimate.trajectory))
    time, rpy, sd = clock(track.time[some]), track.rpy[some], np.rad2deg(track.rpy_sd[some])
    for i in (0, 1):
        _line_and_band(panels[i], time, np.rad2deg(rpy[:, i]), sd[:, i], estimate.kind)
    time, heading, spread = broken(time, _within(rpy[:, 2], low), sd[:, 2])
    _line_and_band(panels[2], time, heading, spread, estimate.kind)


def heading_samples(track: Trajectory, log: Log, config: Config) -> dict[str, tuple[Array, Array]]:
    """True heading of the body as each compass has it, before any deviation is taken off.

    Instruments are taken as level: their mounting turns the heading by the azimuth of
    their x axis. The magnetometer is levelled with the estimate's roll and pitch.

    Returns
    -------
    sensor -> (time [s], heading [rad]), each ndarray, shape (m,)
    """
    prior = beliefs(config)
    R_dvl = matrix_from_rpy([float(prior[f"dvl_{angle}"].mean[0]) for angle in ("roll", "pitch", "yaw")])
    R_imu = mount_matrix(config.imu.mount_rpy_deg)
    declination = np.deg2rad(config.environment.declination_deg)
    out = {}
    for sensor, column, R_bs in (("ahrs", "ahrs_yaw", R_imu), ("dvl_heading", "dvl_heading", R_dvl)):
        if sensor in log:
            some = thin(len(log[sensor]), MOST_SAMPLES)
            azimuth = np.arctan2(R_bs[1, 0], R_bs[0, 0])
            out[sensor] = (log[sensor].time[some], log[sensor][column][some] + declination - azimuth)
    if "mag" in log:
        some = thin(len(log["mag"]), MOST_SAMPLES)
        time = log["mag"].time[some]
        out["mag"] = (time, _levelled(track.at(time), rotate(R_imu, log["mag"].data[some])) + declination)
    return out


def _levelled(track: Trajectory, field_b: Array) -> Array:
    """Magnetic heading from a field in body axes at the attitudes of a track [rad]."""
    rpy = track.rpy
    level = rotate(matrix_from_rpy(np.column_stack([rpy[:, :2], np.zeros(len(rpy))])), field_b)
    return np.arctan2(-level[:, 1], level[:, 0])


def _speed(track: Trajectory) -> tuple[Array, Array]:
    """Horizontal speed and its sd [m/s]."""
    v = track.v_n[:, :2]
    speed = np.linalg.norm(v, axis=1)
    along = v / np.maximum(speed, 1e-6)[:, None]
    variance = np.einsum("ni,nij,nj->n", along, track.cov_v[:, :2, :2], along)
    return speed, np.sqrt(np.clip(variance, 0.0, None))


def _line_and_band(axes: Axes, time: Array, value: Array, sd: Array, kind: str) -> None:
    look = line_of(kind)
    if len(time) > DENSE:
        look = {**look, "linewidth": 0.65 * look["linewidth"]}
    axes.plot(time, value, label=name_of(kind), **look)
    if np.isfinite(sd).any():
        band = {"color": look["color"], "alpha": 0.18, "linewidth": 0, "zorder": look["zorder"] - 2}
        axes.fill_between(time, value - 2 * sd, value + 2 * sd, **band)


def _span(value: Array, sd: Array) -> tuple[float, float]:
    """What an axis has to show of a line and its ±2 sd."""
    spread = np.where(np.isfinite(sd), 2.0 * sd, 0.0)
    known = np.isfinite(value)
    if not known.any():
        return np.inf, -np.inf
    ends = np.percentile((value - spread)[known], USUAL[0]), np.percentile((value + spread)[known], USUAL[1])
    return float(min(*ends, value[known].min())), float(max(*ends, value[known].max()))


def _scale(axes: Axes, spans: Sequence[tuple[float, float]]) -> None:
    """Have an axis show all of some spans, and little more."""
    low, high = min(span[0] for span in spans), max(span[1] for span in spans)
    if high >= low:
        margin = max(0.05 * (high - low), 1e-3)
        axes.set_ylim(low - margin, high + margin)


def _lower_end(track: Trajectory) -> float:
    """Lower end of the heading axis [deg], 0 or -180, whichever breaks the line less often."""
    jumps = {low: np.sum(np.abs(np.diff(_within(track.rpy[:, 2], low))) > 180.0) for low in (0.0, -180.0)}
    return min(jumps, key=lambda low: jumps[low])


def _within(heading: Array, low: float) -> Array:
    """Heading [rad] in degrees from ``low`` to ``low + 360``."""
    degrees: Array = (np.rad2deg(heading) - low) % 360.0 + low
    return degrees


def _limit_heading(axes: Axes, low: float) -> None:
    """No axis beyond one turn; over most of a turn, all of it with ticks at the quarters."""
    bottom, top = np.clip(axes.get_ylim(), low, low + 360.0)
    if top - bottom > 220.0:
        bottom, top = low, low + 360.0
        axes.set_yticks(np.arange(low, low + 361.0, 90.0))
    axes.set_ylim(bottom, top)
