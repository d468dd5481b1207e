"""The thesis's filters over whole logs: predict to each epoch, update with what was measured there.

Inertial samples come at their own epochs, pings at theirs: a ping between two samples is reached by a shorter step.
Filters of one kind go in lock step (`timetable`), as one recursion over arrays with a leading axis for the filters: at
25 states a filter by itself spends most of its time on calling NumPy. A filter that is idle at a step moves by zero
time and skips the measurement, which changes neither state nor covariance. So each filter gives the result that it
gives alone, and the others continue where one diverges.

At each step of the timetable all take an inertial sample, or all take a ping. The times of different logs are
unrelated; so the first pings of all are one step, the second ones are one step, and between them each takes the samples
of its own log that lie there. A filter with fewer of them is idle until the others have taken theirs. Pings come at
about the same rate in all logs, so idle steps are few. A ping between two samples comes between them; at equal times
the sample comes first.

The states that are kept become an `Estimate` of the body's origin.
"""

import difflib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.linalg import block_diag

from rovgraph.errors import InputError
from rovgraph.geometry import Array, rotate, transpose, wrap_angle
from rovgraph.inference.estimate import RESIDUAL_COLUMNS, Estimate, History, calibration_estimates, calibration_history
from rovgraph.inference.trajectory import Trajectory
from rovgraph.lab.thesis.core import (
    SECOND,
    Epochs,
    Innovate,
    Linearized,
    Mask,
    iterated_update,
    propagate_covariance,
    rate_matrix,
    unit,
    widened,
)
from rovgraph.lab.thesis.measurements import HEADING, DvlModel, ImuModel, ping_rows
from rovgraph.lab.thesis.processes import moving
from rovgraph.lab.thesis.setup import Setup, TrueMotion, prepare
from rovgraph.lab.thesis.variants import FILTERS, Filter
from rovgraph.log import Log
from rovgraph.model.calibration import MOUNT
from rovgraph.model.config import Config, mount_matrix
from rovgraph.model.thesis import SAMPLE_S

KEEP_EVERY = 10  # of the inertial samples' innovations


@dataclass(frozen=True)
class Timetable:
    """Steps of a batch; arrays of shape (steps, members) but for ``ping``.

    Attributes
    ----------
    ping : ndarray, shape (steps,), of bool: a ping is taken, otherwise a sample
    active : of bool; the others are idle
    time, epoch : of the state after the step [s], and the last IMU epoch at or before it
    number : of the ping, where one is taken
    keeps_state : of bool: at the first epoch, pings and the last epoch, and every
        ``longest`` where pings are missing
    keeps_innovation : of bool: at pings and at every tenth sample
    """

    ping: NDArray[np.bool_]
    active: NDArray[np.bool_]
    time: Array
    epoch: NDArray[np.int64]
    number: NDArray[np.int64]
    keeps_state: NDArray[np.bool_]
    keeps_innovation: NDArray[np.bool_]

    @property
    def ends(self) -> NDArray[np.int64]:
        """Number of steps until each member is through, shape (members,)."""
        return np.asarray(len(self.active) - np.argmax(self.active[::-1], axis=0))

    def of(self, members: list[int]) -> "Timetable":
        """That of some of the members."""
        return Timetable(
            self.ping,
            self.active[:, members],
            self.time[:, members],
            self.epoch[:, members],
            self.number[:, members],
            self.keeps_state[:, members],
            self.keeps_innovation[:, members],
        )


def timetable(samples: Sequence[Array], pings: Sequence[Array], longest: Sequence[float]) -> Timetable:
    """The steps of filters side by side.

    Parameters
    ----------
    samples, pings : for each member, times [s] in their order; pings are within the samples' time
    longest : for each member, between states that are kept [s]
    """
    last = [np.searchsorted(s, p, side="right") - 1 for s, p in zip(samples, pings, strict=True)]  # epoch before a ping
    rounds = max(map(len, pings)) + 1
    counts = np.zeros((len(samples), rounds), dtype=np.int64)  # of samples before each ping, and after the last
    for b, before in enumerate(last):
        counts[b, : len(before) + 1] = np.diff([-1, *before, len(samples[b]) - 1])
    lengths = counts.max(axis=0)
    begins = np.concatenate([[0], np.cumsum(lengths + 1)])  # of each round: samples, then the ping
    shape = (int(begins[-1]) - 1, len(samples))
    ping = np.zeros(shape[0], dtype=bool)
    ping[begins[1:-1] - 1] = True
    time, epoch, number = np.full(shape, -np.inf), np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=np.int64)
    active, keeps_state, keeps_innovation = (np.zeros(shape, dtype=bool) for _ in range(3))
    for b, before in enumerate(last):
        k = np.arange(len(samples[b]))
        its_round = np.searchsorted(before, k)
        at = begins[its_round] + k - np.concatenate([[-1], before])[its_round] - 1
        at_ping = begins[1 : len(before) + 1] - 1
        time[at, b], epoch[at, b], time[at_ping, b], epoch[at_ping, b] = samples[b], k, pings[b], before
        number[at_ping, b] = np.arange(len(before))
        active[at, b] = active[at_ping, b] = True
        keeps_innovation[at[::KEEP_EVERY], b] = keeps_innovation[at_ping, b] = True
        steps = np.flatnonzero(active[:, b])
        keeps_state[steps, b] = _keeps(time[steps, b].tolist(), ping[steps].tolist(), longest[b])
    time, epoch = np.maximum.accumulate(time, axis=0), np.maximum.accumulate(epoch, axis=0)
    return Timetable(ping, active, time, epoch, number, keeps_state, keeps_innovation)


def _keeps(time: list[float], ping: list[bool], longest: float) -> list[bool]:
    """Which of a filter's states are kept: one for each time at most."""
    keeps, last = [], -np.inf
    for k, (t, is_ping) in enumerate(zip(time, ping, strict=True)):
        final = k == len(time) - 1
        followed = not final and time[k + 1] == t
        keep = not followed and (is_ping or t - last > longest or final)
        keeps.append(keep)
        last = t if keep else last
    return keeps


UpdateResult = tuple[Mask, Array, Array, Array]  # a measurement: which components, innovation, whitened, sd

LONGEST_STEP_S = 1.5 * SAMPLE_S  # of forward Euler; a longer interval is divided


@dataclass
class KeptInnovations:
    """Kept innovations of one sensor, a list entry each.

    Attributes
    ----------
    index : of the sample or ping
    components : ndarray, shape (m,), which of it were measured
    residual, normalised, sd : ndarray, shape (m,); z minus h, whitened, and sd
    """

    index: list[int] = field(default_factory=list)
    components: list[NDArray[np.int64]] = field(default_factory=list)
    residual: list[Array] = field(default_factory=list)
    normalised: list[Array] = field(default_factory=list)
    sd: list[Array] = field(default_factory=list)

    def keep(self, index: int, components: NDArray[np.int64], residual: Array, normalised: Array, sd: Array) -> None:
        self.index.append(index)
        self.components.append(components)
        self.residual.append(residual)
        self.normalised.append(normalised)
        self.sd.append(sd)


@dataclass
class Recursion:
    """A filter on its way through a log, and what it leaves behind.

    Attributes
    ----------
    setup : Setup
    true_motion : where to linearise, or None for the estimate
    time, epoch : of the state [s], and the last IMU epoch at or before it
    x, P : ndarray, state and covariance
    kept : (time, epoch, x, P) as `Timetable.keeps_state` has them
    imu, dvl : Innovations
    error : it has diverged; None where it has not
    """

    setup: Setup
    true_motion: TrueMotion | None = None

    def __post_init__(self) -> None:
        s = self.setup
        self.x, self.P = s.x, s.P
        self.epoch, self.time = 0, float(s.log["imu"].time[0])
        self.kept: list[tuple[float, int, Array, Array]] = []
        self.imu, self.dvl = KeptInnovations(), KeptInnovations()
        self.error: InputError | None = None

    def run(self) -> None:
        """The whole log.

        Raises
        ------
        InputError : the filter diverges
        """
        run_together([self])
        if self.error is not None:
            raise self.error


def run_together(members: Sequence[Recursion]) -> None:
    """Filters of one kind (`Filter.kind`) over their whole logs; ``error`` says of each whether it diverged."""
    table = timetable(
        [m.setup.log["imu"].time for m in members],
        [np.array([ping.time for ping in m.setup.pings]) for m in members],
        [m.setup.config.graph.max_gap_s for m in members],
    )
    ends, under_way, step = table.ends.tolist(), list(range(len(members))), 0
    with np.errstate(over="ignore", invalid="ignore"):
        while under_way:
            step = _Batch([members[b] for b in under_way]).run(table.of(under_way), step)
            under_way = [b for b in under_way if ends[b] > step and members[b].error is None]


class _Batch:
    """Members that are under way, their states as one array.

    Parameters
    ----------
    members : list of Recursion, of one kind
    """

    def __init__(self, members: Sequence[Recursion]) -> None:
        setups = [m.setup for m in members]
        first, dim = setups[0], setups[0].imu.dim if setups[0].imu else 0
        self._members, self._iterations = members, first.variant.iterations
        self._quaternion, self._moving = first.places.get("q"), moving(first.places)
        self._process = first.process.together([s.process for s in setups])
        self._dvl = DvlModel.together([s.dvl for s in setups])
        self._imu = None if first.imu is None else first.imu.together([s.imu for s in setups if s.imu is not None])
        self._samples = Epochs.together([Epochs(widened(s.samples, dim)) for s in setups])
        self._pings = Epochs.together([Epochs(ping_rows(s.pings)) for s in setups])
        self._R_imu = np.stack([block_diag(s.R_imu, np.eye(dim - len(s.R_imu))) for s in setups])
        self._R_dvl = np.stack([s.R_dvl for s in setups])
        self._true_motion = [m.true_motion for m in members if m.true_motion is not None]
        self._x, self._P = np.stack([m.x for m in members]), np.stack([m.P for m in members])
        self._time, self._epoch = np.array([m.time for m in members]), np.array([m.epoch for m in members])

    def run(self, table: Timetable, first: int) -> int:
        """Go on with step ``first`` until a member is through or diverges; the step to go on with then."""
        intervals = np.diff(table.time, axis=0, prepend=table.time[:1])
        count = np.ceil(intervals / LONGEST_STEP_S)  # of steps that forward Euler bears
        parts, dt = count.max(axis=1).astype(int).tolist(), intervals / np.maximum(count, 1.0)
        keeps_innovation, keeps_state = (np.any(keeps, axis=1) for keeps in (table.keeps_innovation, table.keeps_state))
        for step in range(first, int(table.ends.min())):
            for part in range(parts[step]):
                self._predict(dt[step] * (part < count[step]))
            self._time, self._epoch = table.time[step], table.epoch[step]
            update: UpdateResult | None = None
            if table.ping[step]:
                update = self._take_ping(table.number[step], table.active[step])
            elif self._imu is not None:
                update = self._take_sample(self._imu, table.active[step])
            if update is not None and keeps_innovation[step]:
                self._keep_innovations(update, table, step)
            if keeps_state[step]:
                self._keep_states(table.keeps_state[step])
            if self._diverged():
                break
        for m, *state in zip(self._members, self._time, self._epoch, self._x, self._P, strict=True):
            m.time, m.epoch, m.x, m.P = float(state[0]), int(state[1]), state[2], state[3]
        return step + 1

    def _predict(self, dt: Array) -> None:
        """A step of forward Euler."""
        Q = self._process.noise(self._x)
        Q = dt.reshape(-1, *[1] * (Q.ndim - 1)) * Q
        x, F = self._process.step(self._x, dt, self._epoch)
        if self._true_motion:
            F = self._process.step(self._truth(self._x), dt, self._epoch)[1]
        self._x, self._P = x, propagate_covariance(self._P, F, Q, self._moving)

    def _take_sample(self, model: ImuModel, active: Mask) -> UpdateResult:
        z = self._samples.at(self._epoch)

        def innovate(x: Array) -> Linearized:
            h, H = model(x, self._epoch)
            return z - h, H

        return self._update(innovate, np.isfinite(z) & active[:, None], self._R_imu)

    def _take_ping(self, number: NDArray[np.int64], active: Mask) -> UpdateResult:
        z = self._pings.at(number)
        measured = np.isfinite(z) & active[:, None]
        heading = bool(measured[:, HEADING].any())

        def innovate(x: Array) -> Linearized:
            h, H = self._dvl(x, self._epoch, heading)
            residual = z - h
            residual[:, HEADING] = wrap_angle(residual[:, HEADING])
            return residual, H

        return self._update(innovate, measured, self._R_dvl)

    def _update(self, innovate: Innovate, measured: Mask, R: Array) -> UpdateResult:
        """Update with the components that were measured and bring quaternions back to unit length."""

        def innovate_at(x: Array) -> Linearized:
            residual, H = innovate(x)
            return residual, (innovate(self._truth(x))[1] if self._true_motion else H)

        residual, self._x, self._P, normalised, sd = iterated_update(
            self._x, self._P, innovate_at, R, measured, self._iterations
        )
        if self._quaternion is not None:
            q = self._x[:, self._quaternion]
            q /= np.where(measured.any(axis=1), np.sqrt(np.einsum("ij,ij->i", q, q)), 1.0)[:, None]
        return measured, residual, normalised, sd

    def _truth(self, x: Array) -> Array:
        """The true motion of each, the rest of the state as in ``x``."""
        return np.stack([m.state(*at) for m, *at in zip(self._true_motion, self._time.tolist(), x, strict=True)])

    def _diverged(self) -> bool:
        """Whether any has; it is told so."""
        if math.isfinite(np.vdot(self._x, self._x)):
            return False
        diverged = np.flatnonzero(~np.isfinite((self._x * self._x).sum(axis=1))).tolist()
        for b in diverged:
            s = self._members[b].setup
            self._members[b].error = InputError(
                f"{s.log.source}: filter {s.variant.name} diverges at {self._time[b]:.2f} s; "
                "check mountings, units and start"
            )
        return len(diverged) > 0

    def _keep_innovations(self, taken: UpdateResult, table: Timetable, step: int) -> None:
        measured, *columns = taken
        for b in np.flatnonzero(table.keeps_innovation[step]).tolist():
            m = self._members[b]
            kept, index = (m.dvl, table.number[step, b]) if table.ping[step] else (m.imu, self._epoch[b])
            components = np.flatnonzero(measured[b])
            kept.keep(int(index), components, *(column[b, components] for column in columns))

    def _keep_states(self, which: Mask) -> None:
        for b in np.flatnonzero(which).tolist():
            state = self._x[b].copy(), self._P[b].copy()
            self._members[b].kept.append((float(self._time[b]), int(self._epoch[b]), *state))


_IMU_COMPONENTS = [("imu", c) for c in ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")]
_MTI_COMPONENTS = [*_IMU_COMPONENTS, *(("mag", c) for c in "xyz")]
_DVL_COMPONENTS = [*(("dvl", c) for c in "xyz"), ("dvl_heading", "heading")]


def estimate_of(done: Recursion) -> Estimate:
    """The estimate of a recursion that has run.

    The components of a measurement were whitened in order, so that the squares of a
    sensor's normalised innovations sum to its normalised innovation squared given the
    sensors before it: those of "imu" and "mag" at one time to that of the MTi, those of
    "dvl" and "dvl_heading" to that of the ping.
    """
    setup = done.setup
    time, epoch, x, P = (np.array(column) for column in zip(*done.kept, strict=True))
    tables = [table for table in (_imu_residuals(done), _dvl_residuals(done)) if len(table)]
    residuals = pd.concat(tables, ignore_index=True) if tables else _imu_residuals(done)
    residuals = residuals.sort_values("time", kind="stable", ignore_index=True)
    history = _histories(done, time, x, P)
    calibration = calibration_estimates(setup.beliefs, [*_sensors(done), "imu"], *_final_calibration(done))
    trajectory = _trajectory(done, time, epoch, x, P)
    return Estimate(setup.variant.name, trajectory, calibration, history, residuals, _summary(done))


def _trajectory(done: Recursion, time: Array, epoch: Array, x: Array, P: Array) -> Trajectory:
    """Poses and velocities in n; the covariance of an attitude that was given is unknown."""
    setup = done.setup
    s, n = setup.places, len(time)
    v, p = x[:, s["v"]], x[:, s["p"]]
    slope_v = np.zeros((n, 3, x.shape[1]))  # of v_n by the state
    if setup.known is not None:
        R_nb, cov_theta = setup.known.R_nb[epoch], np.full((n, 3, 3), np.nan)
    else:
        q = unit(x[:, s["q"]])
        slope = np.einsum("ijab,nb->nija", SECOND, q)
        R_nb = np.eye(3) + 0.5 * np.einsum("nija,na->nij", slope, q)
        turned = 2.0 * R_nb @ transpose(rate_matrix(q))
        cov_theta = turned @ P[:, s["q"], s["q"]] @ transpose(turned)
        if setup.variant.motion == "body":
            slope_v[:, :, s["q"]] = np.einsum("nija,nj->nia", slope, v)
    earth = setup.variant.motion == "earth"
    slope_v[:, :, s["v"]] = np.eye(3) if earth else R_nb
    v_n = v if earth else rotate(R_nb, v)
    cov_v = slope_v @ P @ transpose(slope_v)
    return Trajectory(time, p, R_nb, v_n, P[:, s["p"], s["p"]], cov_theta, cov_v)


def _histories(done: Recursion, time: Array, x: Array, P: Array) -> dict[str, History]:
    """Biases in body axes, hard iron in the MTi's, misalignment."""
    setup, out = done.setup, {}
    R_bs = mount_matrix(setup.config.imu.mount_rpy_deg)
    for name, unit_of in (("acc_bias", "m/s2"), ("gyr_bias", "rad/s")):
        if name in setup.places:
            place = setup.places[name]
            sd = _sd(R_bs @ P[:, place, place] @ R_bs.T)
            out[name] = History(tuple(f"{name}_{c}" for c in "xyz"), unit_of, time, rotate(R_bs, x[:, place]), sd)
    sd = _sd(P)
    if setup.variant.magnetometer:
        place = setup.places["mag_bias"]
        out["hard_iron"] = calibration_history("hard_iron", time, x[:, place], sd[:, place])
    if setup.variant.misalignment:
        for k, name in enumerate(MOUNT, start=setup.places["mount"].start):
            out[name] = calibration_history(name, time, x[:, [k]], sd[:, [k]])
    return out


def _final_calibration(done: Recursion) -> tuple[dict[str, Array], dict[str, Array]]:
    """Values of all calibration variables, and covariances of those that are states."""
    setup = done.setup
    values = {name: belief.mean for name, belief in setup.beliefs.items()}
    covariance: dict[str, Array] = {}
    places = {"hard_iron": setup.places["mag_bias"]} if setup.variant.magnetometer else {}
    if setup.variant.misalignment:
        first = setup.places["mount"].start
        places |= {name: slice(first + k, first + k + 1) for k, name in enumerate(MOUNT)}
    for name, place in places.items():
        values[name], covariance[name] = done.x[place], done.P[place, place]
    return values, covariance


def _sensors(done: Recursion) -> list[str]:
    variant = done.setup.variant
    given = ["ahrs"] if variant.attitude_given and "ahrs" in done.setup.log else []
    return ["dvl", *["mag"] * variant.magnetometer, *["dvl_heading"] * variant.compass, *given]


def _imu_residuals(done: Recursion) -> pd.DataFrame:
    imu, setup = done.setup.log["imu"], done.setup
    scale = np.concatenate([np.ones(6), np.full(3, setup.field_length)])
    return _residuals(done.imu, imu.time, setup.samples, imu.row, _MTI_COMPONENTS, scale)


def _dvl_residuals(done: Recursion) -> pd.DataFrame:
    pings = done.setup.pings
    time, line = np.array([p.time for p in pings]), np.array([p.line for p in pings], dtype=int)
    return _residuals(done.dvl, time, ping_rows(pings), line, _DVL_COMPONENTS, np.ones(HEADING + 1))


def _residuals(
    kept: KeptInnovations, time: Array, z: Array, line: NDArray[np.int64], names: list[tuple[str, str]], scale: Array
) -> pd.DataFrame:
    """A row for each component of what was kept; ``time``, ``z`` and ``line`` are those of all."""
    if not kept.index:
        return pd.DataFrame(columns=pd.Index(RESIDUAL_COLUMNS))
    k = np.repeat(kept.index, [len(c) for c in kept.components])
    component = np.concatenate(kept.components)
    residual, sd = (np.concatenate(column) * scale[component] for column in (kept.residual, kept.sd))
    measured = z[k, component] * scale[component]
    sensors, words = np.array(names, dtype=object).T
    columns = (
        time[k],
        sensors[component],
        words[component],
        measured,
        measured - residual,
        residual,
        sd,
        np.concatenate(kept.normalised),
        1.0,
        line[k],
    )
    return pd.DataFrame(dict(zip(RESIDUAL_COLUMNS, columns, strict=True)))


def _summary(done: Recursion) -> dict[str, Any]:
    """What was run, and the mean of the normalised innovations squared over their dimension."""
    setup = done.setup
    summary: dict[str, Any] = {
        "section": setup.variant.section,
        "about": setup.variant.about,
        "samples": len(setup.samples) if setup.imu is not None else 0,
        "pings": len(setup.pings),
        "assumptions": setup.assumptions,
    }
    for name, kept in (("imu", done.imu), ("dvl", done.dvl)):
        if kept.index:
            summary[f"nis_per_dimension_{name}"] = float(np.mean(np.concatenate(kept.normalised) ** 2))
    return summary


def _sd(covariance: Array) -> Array:
    return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))


Made = TypeVar("Made")


@dataclass(frozen=True)
class FilterJob:
    """A filter on a dive.

    Attributes
    ----------
    variant, log, config : the filter, the dive, and what is believed of vehicle and sensors
    truth : for a filter that is ``linearized_at`` it, dense
    """

    variant: Filter
    log: Log
    config: Config
    truth: Trajectory | None = None


def run_filter(which: str | Filter, log: Log, config: Config, truth: Trajectory | None = None) -> Estimate:
    """Run one of the thesis's filters.

    Heading sources are the filter's own, whatever ``heading.sources`` is; calibration
    stands at its means but for what the filter has as states; nothing is gated.

    Parameters
    ----------
    which : key of `FILTERS`, or a `Filter`
    log, config : the dive, and what is believed of vehicle and sensors
    truth : for a filter that is ``linearized_at`` it, dense

    Returns
    -------
    Estimate : ``kind`` is the filter's name; trajectory of the body's origin at the first
        epoch, the pings and the last epoch; innovations of every ping and every tenth IMU
        sample, whitened

    Raises
    ------
    InputError : no such filter; the log lacks what it needs; it diverges
    """
    variant = _named(which) if isinstance(which, str) else which
    (done,) = run_filters([FilterJob(variant, log, config, truth)])
    if isinstance(done, Exception):
        raise done
    return done


def run_filters(asked: Sequence[FilterJob]) -> list[Estimate | Exception]:
    """Run filters on dives, those of one kind (`Filter.kind`) side by side, at a fraction of the time.

    Returns
    -------
    list : as `run_filter` would have it of each, or what that would raise
    """
    begun = [_attempted(_begun, each) for each in asked]
    kinds: dict[Filter, list[Recursion]] = {}
    for each, recursion in zip(asked, begun, strict=True):
        if isinstance(recursion, Recursion):
            kinds.setdefault(each.variant.kind, []).append(recursion)
    for members in kinds.values():
        run_together(members)
    return [_attempted(_done, each) if isinstance(each, Recursion) else each for each in begun]


def _begun(asked: FilterJob) -> Recursion:
    variant, at = asked.variant, None
    setup = prepare(variant, asked.log, asked.config)
    if variant.linearized_at == "truth":
        if asked.truth is None:
            raise ValueError(f"{variant.name} is linearised at the truth, which was not given")
        at = TrueMotion(setup.places, variant.motion == "body", asked.truth)
    return Recursion(setup, at)


def _done(recursion: Recursion) -> Estimate:
    if recursion.error is not None:
        raise recursion.error
    return estimate_of(recursion)


def _attempted(function: Callable[[Any], Made], argument: Any) -> Made | Exception:
    try:
        return function(argument)
    except Exception as error:  # one that fails does not stop the others
        return error


def _named(name: str) -> Filter:
    if name not in FILTERS:
        near = difflib.get_close_matches(name.lower(), FILTERS, 1)
        hint = f", did you mean {near[0]}?" if near else ""
        raise InputError(f"unknown filter {name!r}{hint} (known: {', '.join(FILTERS)})")
    return FILTERS[name]
