"""From profiles of the water to measurements, and the knots of the current that stand for it.

The current is a function of depth: knots at whole multiples of a spacing h, numbered from the surface downwards,
linear between them, each a random walk in time, and from knot to knot a first-order Gauss-Markov process,

    u_j = exp(-h / L) u_i + w,  var w = s^2 (1 - exp(-2 h / L)),  i next to j                       (Gelb 1974, 3.8)

A window of K knots about the vehicle is kept, knot j in the place j mod K. As the vehicle descends, the window moves:
a knot that is left behind makes room for a new one, which is drawn from its neighbour. So the dive stays a chain. With
one knot, the current is that at the middle of the cells, and follows from what it was where the vehicle came from.

The cells of a profile, y = Phi (v - u), share the vehicle's velocity v; Phi has the weights of the knots u in each
cell, whose sum is 1. The square-root information of the cells, R with R' R = Phi' W Phi, has two entries in a row, next
to each other and not negative, as Phi' W Phi is tridiagonal. So R y' = Q' y are at most K measurements, each of the
velocity relative to a layer between two knots; they hold all that the cells say of v and u.
"""

import math
from bisect import bisect_right
from collections import Counter
from collections.abc import Collection, Mapping
from copy import copy
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array, matrix_from_rpy
from rovgraph.kernels import assembly
from rovgraph.kernels import measurement_row as at
from rovgraph.log import Measurement, Stream
from rovgraph.model.calibration import LAYERS, LAYOUT, WATER_LAYER
from rovgraph.model.config import Config, mount_matrix
from rovgraph.model.config_sections import Water
from rovgraph.problem.problem import Problem
from rovgraph.sensors.dvl_beam import BeamGeometry, beam_geometry
from rovgraph.sensors.sensor import LARGEST_SD
from rovgraph.sensors.water_layer import ADCP, ALONG, ATTITUDE, CELLS, EARTH, VELOCITIES

USUAL_ANGLE_DEG = 30.0  # of beams that nothing is known of; the widest of usual ones
LEVELLED_S = 0.5  # over which the specific force shows the tilt
FRESH_S = 5.0  # a depth or altitude is believed so long
SLOPE_S = 0.5  # of the depth, at least
REMEMBERED_S = 120.0  # of depth and altitude, online
SETTLED_S = 1.0  # after the start of a dive from which on profiles count
TOGETHER_S = 1e-4  # stamps of the cells of one profile
SAME_M = 1e-6  # depths that differ by rounding
LONE_STEP = 0.1  # of the depth, in knots, from which on the only knot follows
FILLED = 1e-9  # part of a knot's weight below which no cell is near it
OUT_OF_SIGHT = 1e3  # sd by which what stood in a knot's place before is forgotten [m/s]
BESIDE, UNLIKE_SD = 2, 6.0  # cells on each side that a cell is compared with, and how far it may be off
UNLIKE = "rising or sinking unlike the cells beside them"
SIDE_LOBES = "at the bottom or the surface (side lobes)"
_COLUMN = {name: k for k, name in enumerate(ADCP.column_names)}
Left = Counter[tuple[str, str]]


def layer_sensors(
    config: Config, streams: Mapping[str, Stream], expected: Collection[str] = ()
) -> tuple[list[str], str]:
    """The sensor that a log's profiles become, or those that are expected; and why not, if not so."""
    if CELLS not in streams or not config.water.use:
        return [WATER_LAYER] if CELLS in expected and config.water.use else [], ""
    left = "profiles of the water are left out: "
    cells, columns = streams[CELLS].data, _COLUMN
    measured = np.isfinite(cells[:, [columns[name] for name in (*VELOCITIES, *ALONG, *EARTH)]])
    if not measured.any():
        return [], left + "no velocities, expected adcp_vx, adcp_beam_1 or adcp_north"
    if not np.isfinite(cells[:, columns["adcp_range"]]).any():
        return [], left + "cells without ranges; give column range, from the head to the middle of each cell"
    if "depth" not in {*streams, *expected}:
        return [], left + "the log has no depth"
    earth = measured[:, len(VELOCITIES) + len(ALONG) :].any()
    if earth and not np.isfinite(cells[:, [columns[name] for name in ATTITUDE]]).all(axis=1).any():
        return [], left + "north, east and down without the instrument's heading, roll and pitch, give these columns"
    if measured[:, len(VELOCITIES) : -len(EARTH)].any() and beam_geometry(config.dvl) is None:
        return [], left + "it is not known where the beams point; state dvl.beams: {angle_deg, azimuth_deg}"
    if "place" in streams or config.graph.hydrodynamics:
        beside = "thrusters" if config.graph.hydrodynamics else "places seen twice"
        return [], left + f"they are not used beside {beside}; state water.use: false to say so"
    return [WATER_LAYER], ""


def with_knots(config: Config, streams: Mapping[str, Stream], whole: bool = True) -> Config:
    """The configuration with as many knots as the cells of a log reach over, farther apart where these are too few.

    Where it is not the ``whole`` log, cells that reach further may come: then all knots there can be.
    """
    if config.water.knots is not None:
        return config
    reach = _reach(streams)
    spacing = max(config.water.knot_m, reach / (len(LAYERS) - 2))
    knots = min(math.ceil(reach / spacing - 1e-9) + 2, len(LAYERS)) if whole else len(LAYERS)
    return config.with_values(water={"knots": max(knots, 2), "knot_m": spacing})


def nearer_knots(config: Config, streams: Mapping[str, Stream]) -> float | None:
    """How far apart knots would follow the water better, where they are farther apart than the cells require [m]."""
    least = max(Water().knot_m, _reach(streams) / (len(LAYERS) - 2))
    return least if config.water.knot_m > least and config.water.knots != 1 else None


def _reach(streams: Mapping[str, Stream]) -> float:
    """The farthest range of cells [m]."""
    far = streams[CELLS].data[:, _COLUMN["adcp_range"]] if CELLS in streams else np.zeros(0)
    return float(np.nanmax(far, initial=0.0))


class Cells(NamedTuple):
    """n cells of one profile.

    Attributes
    ----------
    down : shape (n,), depth of each below the head [m]
    velocity : shape (n, 3), of the DVL relative to the water, its own axes [m/s]
    sd : shape (n,), of the horizontal components; NaN = not known [m/s]
    """

    down: Array
    velocity: Array
    sd: Array


class WaterLayers:
    """Makes measurements of layers of profiles.

    Parameters
    ----------
    config : effective configuration
    used : whether profiles are used
    """

    def __init__(self, config: Config, used: bool) -> None:
        self.config, self.used = config, used
        self.waiting: list[Measurement] = []  # cells of a profile of which more may come
        self._signals: dict[str, tuple[list[float], list[float]]] = {"depth": ([], []), "dvl_altitude": ([], [])}
        self._geometry = beam_geometry(config.dvl)
        self._R_bs = mount_matrix(config.dvl.mount_rpy_deg)
        angle = config.water.beam_angle_deg or config.dvl.beams.angle_deg or USUAL_ANGLE_DEG
        self._cosine = abs(math.cos(math.radians(angle)))
        self._axis = cells_axis(config)
        self._arm_b = np.array(config.dvl.lever_arm_m) - np.array(config.imu.lever_arm_m)
        self._below_sensor = np.array(config.dvl.lever_arm_m) - np.array(config.depth.lever_arm_m)
        knots = config.water.knots or len(LAYERS)
        names = LAYERS[:knots] if knots > 1 else ("current",)
        self._places = np.array([LAYOUT[name].start for name in names])

    # what the vehicle's depth is, and how far it is to the bottom

    def take_one(self, m: Measurement) -> None:
        """Take a depth or an altitude, online."""
        times, values = self._signals[m.sensor]
        k = bisect_right(times, m.time)
        times.insert(k, m.time)
        values.insert(k, float(m.values[0]))
        gone = bisect_right(times, m.time - REMEMBERED_S)
        del times[:gone], values[:gone]

    def copy(self) -> "WaterLayers":
        """One that goes on by itself from here."""
        twin = copy(self)
        twin.waiting = self.waiting[:]
        twin._signals = {sensor: (time[:], values[:]) for sensor, (time, values) in self._signals.items()}
        return twin

    @property
    def signals(self) -> tuple[str, ...]:
        """Streams that `take_one` needs."""
        return tuple(self._signals) if self.used else ()

    def _depth(self, time: float) -> float:
        """By the samples up to a time alone, so that a dive online gets the same; NaN where there is none [m]."""
        times, values = self._signals["depth"]
        k = bisect_right(times, time) - 1
        if k < 0 or time - times[k] > FRESH_S:
            return math.nan
        j = bisect_right(times, times[k] - SLOPE_S) - 1
        if j < 0 or times[k] - times[j] > FRESH_S:
            return values[k]
        return values[k] + (values[k] - values[j]) * (time - times[k]) / (times[k] - times[j])

    def _altitude(self, time: float) -> float:
        times, values = self._signals["dvl_altitude"]
        k = bisect_right(times, time) - 1
        return values[k] if k >= 0 and time - times[k] <= FRESH_S and values[k] > 0.0 else math.inf

    # from cells to layers

    def of_log(self, streams: Mapping[str, Stream], imu: Array, left_out: Left) -> list[Stream]:
        """Measurements of a whole log, as `of` has them."""
        if not self.used or CELLS not in streams:
            return []
        for sensor in self._signals:
            if sensor in streams:
                self._signals[sensor] = streams[sensor].time.tolist(), streams[sensor].data[:, 0].tolist()
        return [self.of(streams[CELLS], imu, None, left_out)]

    def of(self, cells: Stream, imu: Array, first: float | None, left_out: Left) -> Stream:
        """Measurements of layers: components, their sd, context and number of the layer, shape (k, 7 + LAYER_WIDTH).

        Parameters
        ----------
        cells : of the stream "adcp", in the order of time
        imu : ndarray, shape (m, 7), samples in body axes; of shape (0, 7) the vehicle is taken as level
        first : the uppermost knot of those that are kept, before; None = none is
        left_out : counts cells that are left out
        """
        begins = np.flatnonzero(np.diff(cells.time, prepend=-np.inf) > TOGETHER_S)
        time, rows, lines = [], [np.empty((0, 7 + at.LAYER_WIDTH))], []
        for begin, end in zip(begins.tolist(), [*begins[1:].tolist(), len(cells)], strict=True):
            t = float(cells.time[begin])
            if len(imu) and t < imu[0, 0] + SETTLED_S:
                left_out[CELLS, "before the dive or in its first second"] += end - begin
                continue
            made, first = self._profile(t, cells.data[begin:end], imu, first, left_out)
            rows.append(made)
            time += [t] * len(made)
            lines += [int(cells.row[begin])] * len(made)
        return Stream(WATER_LAYER, (), np.array(time), np.concatenate(rows), np.array(lines, np.int64))

    def _profile(
        self, time: float, data: Array, imu: Array, first: float | None, left_out: Left
    ) -> tuple[Array, float | None]:
        """Measurements of one profile, and the uppermost knot."""
        empty, depth = np.empty((0, 7 + at.LAYER_WIDTH)), self._depth(time)
        if math.isnan(depth):
            left_out[CELLS, f"without a depth within {FRESH_S:g} s"] += len(data)
            return empty, first
        down_b = self._down(data, imu, time)
        bottom = np.nanmin(data[:, _COLUMN["adcp_bottom"]], initial=self._altitude(time))
        limit = depth if self.config.water.looks == "up" else bottom
        data = self._admitted(data, limit * self._cosine, left_out)
        cells = self._cells(data, down_b)
        alike = self._alike(cells, self._R_bs.T @ down_b)
        left_out[CELLS, UNLIKE] += int((~alike).sum())
        cells = Cells(*(a[alike] for a in cells))
        if not len(cells.down):
            return empty, first
        head, spacing, K = depth + float(self._below_sensor @ down_b), self.config.water.knot_m, len(self._places)
        place = (head + cells.down) / spacing
        if K == 1:
            middle = float(place.mean())
            first = first if first is not None and abs(middle - first) < LONE_STEP else middle
            return self._rows(np.zeros(len(place)), cells, first), first
        low, high = math.floor(place.min()), math.floor(place.max()) + 1
        first = low if first is None else min(max(first, high - K + 1), low)
        within = place < first + K - 1
        left_out[CELLS, "beyond the knots of the current"] += int((~within).sum())
        return self._rows(place[within], Cells(*(a[within] for a in cells)), first), first

    def _down(self, data: Array, imu: Array, time: float) -> Array:
        """Direction down in b, shape (3,), by the instrument's own tilt where the table has it, else by the IMU."""
        tilt = data[0, [_COLUMN["adcp_roll"], _COLUMN["adcp_pitch"]]]
        return self._R_bs @ matrix_from_rpy([*tilt, 0.0])[2] if np.isfinite(tilt).all() else _level(imu, time)

    def _admitted(self, data: Array, far: float, left_out: Left) -> Array:
        """Cells that may be used; their far end is nearer than ``far`` [m]."""
        ends = data[:, _COLUMN["adcp_range"]] + 0.5 * np.nan_to_num(data[:, _COLUMN["adcp_cell"]])
        v = data[:, [_COLUMN[name] for name in (*VELOCITIES, *ALONG, *EARTH)]]
        speed = np.nanmax(np.abs(v), axis=1, initial=0.0)
        good = np.ones(len(data), bool)
        for why, bad in (
            ("without a range", ~(ends > 0.0)),
            ("not valid", (data[:, _COLUMN["adcp_valid"]] == 0.0) | ~np.isfinite(v).any(axis=1)),
            (SIDE_LOBES, ends > far),
            ("faster than dvl.max_speed_mps", speed > self.config.dvl.max_speed_mps),
        ):
            if count := int((bad & good).sum()):
                left_out[CELLS, why] += count
            good &= ~bad
        return data[good]

    def _cells(self, data: Array, down_b: Array) -> Cells:
        """Cells by whichever axes they are in."""
        far = data[:, _COLUMN["adcp_range"]]
        down = far * float((self._R_bs @ self._axis) @ down_b)
        v, along = in_dvl_axes(data), data[:, [_COLUMN[name] for name in ALONG]]
        if self._geometry is not None and np.isnan(v).all() and np.isfinite(along).any():
            v = by_mapped_beams(along, far, down, self._geometry, self._R_bs.T @ down_b)
        good = np.isfinite(v).all(axis=1)
        return Cells(down[good], v[good], data[good, _COLUMN["adcp_sd"]])

    def _relative(self, sd: Array) -> Array:
        """Noise of cells over the one that is believed, shape (n,)."""
        believed = self.config.water.cell_sd_mps[0]
        return np.where(np.isfinite(sd), np.minimum(sd, LARGEST_SD), believed) / believed

    def _alike(self, cells: Cells, down_s: Array) -> NDArray[np.bool_]:
        """Cells of whose vertical velocity two on each side do not show that it is far off."""
        n = len(cells.down)
        alike = np.ones(n, bool)
        if n > BESIDE:
            order = np.argsort(cells.down)
            vertical = cells.velocity[order] @ down_s
            padded = np.pad(vertical, BESIDE, constant_values=np.inf)  # behind all others
            nearby = np.sort([padded[k : k + n] for k in range(2 * BESIDE + 1)], axis=0)
            count, each = np.isfinite(nearby).sum(axis=0), np.arange(n)
            median = 0.5 * (nearby[(count - 1) // 2, each] + nearby[count // 2, each])
            sd = self._relative(cells.sd[order]) * self.config.water.cell_sd_mps[2]
            alike[order] = np.abs(vertical - median) <= UNLIKE_SD * sd
        return alike

    def _rows(self, place: Array, cells: Cells, first: float) -> Array:
        """At most one measurement between two knots; ``place`` is the depth of each cell in knots."""
        believed, rho = np.array(self.config.water.cell_sd_mps), self.config.water.cell_correlation
        relative = self._relative(cells.sd)
        K = len(self._places)
        above = np.floor(place).astype(np.int64) - int(first) if K > 1 else np.zeros(len(place), np.int64)
        share, weight = place - np.floor(place), 1.0 / np.square(relative)
        here, below, right = np.zeros(K), np.zeros(K), np.zeros((K + 1, 3))
        np.add.at(here, above, weight * (1.0 - share) ** 2)
        np.add.at(below, above, weight * share * (1.0 - share))
        np.add.at(right, above, (weight * (1.0 - share))[:, None] * cells.velocity)
        if K > 1:
            np.add.at(here, above + 1, weight * share**2)
            np.add.at(right, above + 1, (weight * share)[:, None] * cells.velocity)
        known, before, q, least = [], 0.0, np.zeros(3), FILLED * float(here.max(initial=0.0))
        for k, (own, next_one) in enumerate(zip(here.tolist(), below.tolist(), strict=True)):
            if own - before**2 <= least:
                before, q = 0.0, np.zeros(3)
                continue
            root = math.sqrt(own - before**2)
            q = (right[k] - before * q) / root
            before = next_one / root
            known.append((k, root + before, before, *q))
        out = np.zeros((len(known), 7 + at.LAYER_WIDTH))
        layer, total, of_next, *product = np.array(known).reshape(-1, 6).T
        knot, context = int(first) + layer.astype(np.int64), out[:, 6:]
        widened = believed * math.sqrt(1.0 + 2.0 * rho * (len(place) > 1))
        out[:, :3] = (product / total).T
        out[:, 3:6] = np.hypot(widened / total[:, None], [0.0, 0.0, self.config.water.vertical_sd_mps])
        context[:, at.LAYER_ARM : at.LAYER_ARM + 3] = self._arm_b
        context[:, at.ABOVE_AT], context[:, at.BELOW_AT] = self._places[[knot % K, (knot + (of_next > 0.0)) % K]]
        context[:, at.SHARE], context[:, at.FIRST_KNOT], context[:, at.LAYER_WIDTH] = of_next / total, first, layer
        return out


def in_dvl_axes(data: Array) -> Array:
    """Velocities of n cells, DVL axes; those along Earth's axes by the instrument's attitude; NaN = neither, (n, 3)."""
    v = data[:, [_COLUMN[name] for name in VELOCITIES]].copy()
    earth = data[:, [_COLUMN[name] for name in EARTH]]
    rpy = data[:, [_COLUMN[name] for name in ATTITUDE]]
    turned = np.isnan(v).any(axis=1) & np.isfinite(earth).all(axis=1) & np.isfinite(rpy).all(axis=1)
    if turned.any():
        v[turned] = (earth[turned, None] @ matrix_from_rpy(rpy[turned]))[:, 0]
    return v


def cells_axis(config: Config) -> Array:
    """The direction from the head to its cells, DVL axes, shape (3,)."""
    down = mount_matrix(config.dvl.mount_rpy_deg)[2, 2] >= 0.0
    return np.array([0.0, 0.0, 1.0 if down == (config.water.looks == "down") else -1.0])


def _level(imu: Array, time: float) -> Array:
    """Direction down in b, shape (3,), by the mean specific force of the samples before a time."""
    first, last = np.searchsorted(imu[:, 0], [time - LEVELLED_S, time], side="right") if len(imu) else (0, 0)
    if last <= first:
        return np.array([0.0, 0.0, 1.0])
    force = imu[first:last, 1:4].mean(axis=0)
    return np.asarray(-force / np.linalg.norm(force))


def by_mapped_beams(along: Array, far: Array, down: Array, head: BeamGeometry, down_s: Array) -> Array:
    """Velocities of cells of one profile, DVL axes, from those along beams, each taken at the depth of the cell.

    On a tilted head the cells of one number are at different depths, by beam.

    Parameters
    ----------
    along : ndarray, shape (n, 9), by the instrument's numbers [m/s]
    far, down : ndarray, shape (n,), along the head's axis, and depth below the head [m]
    head : where the beams point
    down_s : ndarray, shape (3,), direction down in the DVL's axes
    """
    mapped = np.full((len(along), len(head.numbers)), np.nan)
    order = np.argsort(down)
    step = np.median(np.abs(np.diff(np.sort(down)))) if len(down) > 1 else 1.0
    for k, number in enumerate(head.numbers):
        direction = head.directions[k]
        there, b = far / abs(direction[2]) * float(direction @ down_s), along[:, number]
        known = order[np.isfinite(b[order])]
        known = known[np.argsort(there[known])]
        if not len(known):
            continue
        near = np.abs(there[known][:, None] - down[None]).min(axis=0) <= step
        near &= (down >= there[known[0]] - SAME_M) & (down <= there[known[-1]] + SAME_M)
        mapped[:, k] = np.where(near, np.interp(down, there[known], b[known]), np.nan)
    out = np.full((len(along), 3), np.nan)
    valid = np.isfinite(mapped)
    for pattern in np.unique(valid, axis=0):
        D, rows = head.directions[pattern], (valid == pattern).all(axis=1)
        if pattern.sum() >= 3 and np.linalg.svd(D, compute_uv=False)[-1] > 0.05:
            out[rows] = mapped[np.ix_(rows, pattern)] @ np.linalg.pinv(D).T
    return out


# the window of knots


class NewKnot(NamedTuple):
    """A knot that takes another's place.

    Attributes
    ----------
    name : the variable
    neighbour : that it follows from; its own name: what it was before; None: nothing
    kept, sd : of the neighbour's deviation from its mean, and what is added [m/s]
    """

    name: str
    neighbour: str | None
    kept: float
    sd: float


def put_windows(keyframes: Array, rows: Array, of: NDArray[np.int64], layer: int, begin: int, context: int) -> None:
    """Write the uppermost knot to each keyframe from one on, as the measurements at it say.

    Measurements beside a keyframe, where no window can change, say nothing if they need one.

    Parameters
    ----------
    keyframes, rows, of : as of `rovgraph.problem.problem.Problem`; rows of ``keyframes`` are written
    layer : number of the sensor, -1 = not used
    begin : the first keyframe
    context : numbers at the end of each row
    """
    keyframes[begin:, assembly.FIRST_KNOT] = keyframes[begin - 1, assembly.FIRST_KNOT] if begin else np.nan
    taken = int(keyframes[begin - 1, assembly.TAKEN]) if begin else 0
    some = taken + np.flatnonzero(of[assembly.WHICH, taken:] == layer)
    first = rows[some, rows.shape[1] - context + at.FIRST_KNOT]
    keyframe = of[assembly.KEYFRAME_OF, some]
    here = keyframe == of[assembly.INTERVAL_OF, some]
    here &= keyframe > 0
    for k, knot in zip(keyframe[here].tolist(), first[here].tolist(), strict=True):
        keyframes[k:, assembly.FIRST_KNOT] = knot
    apart = some[keyframes[keyframe, assembly.FIRST_KNOT] != first]
    rows[apart, at.SD : at.SD + 3] = LARGEST_SD


def window_changes(problem: Problem) -> NDArray[np.int64]:
    """Keyframes, beyond the first, from the one before to which the window moves."""
    first = problem.keyframes[:, assembly.FIRST_KNOT]
    return np.flatnonzero((first[1:] != first[:-1]) & np.isfinite(first[1:])) + 1


def new_knots(problem: Problem, k: int, water: Water) -> list[NewKnot]:
    """Knots that are new at keyframe k, each after its neighbour."""
    first = problem.keyframes[:, assembly.FIRST_KNOT]
    if k == 0 or first[k] == first[k - 1] or math.isnan(first[k]):
        return []
    count, before, now = water.knots or len(LAYERS), float(first[k - 1]), float(first[k])
    if count == 1:
        return [] if math.isnan(before) else [NewKnot("current", "current", *_conditional(water, abs(now - before)))]
    top = int(now)
    if not abs(now - before) < count:  # never where that is nan
        chain = [(top, None), *((j, j - 1) for j in range(top + 1, top + count))]
    elif now > before:
        chain = [(j, j - 1) for j in range(int(before) + count, top + count)]
    else:
        chain = [(j, j + 1) for j in range(int(before) - 1, top - 1, -1)]
    follows, alone = _conditional(water), (0.0, water.current_sd_mps)
    return [
        NewKnot(LAYERS[j % count], None, *alone)
        if i is None
        else NewKnot(LAYERS[j % count], LAYERS[i % count], *follows)
        for j, i in chain
    ]


def _conditional(water: Water, apart: float = 1.0) -> tuple[float, float]:
    """What a knot keeps of another, so many knots ``apart``, and the sd that is added [m/s]."""
    kept = math.exp(-apart * water.knot_m / water.correlation_m)
    return kept, water.current_sd_mps * math.sqrt(1.0 - kept**2)
