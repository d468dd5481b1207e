"""The thesis's filters over whole logs, and an `Estimate` of the states that they keep."""

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array, rotate, transpose
from rovgraph.inference.estimate import RESIDUAL_COLUMNS, Estimate, History, calibration_estimates, calibration_history
from rovgraph.inference.trajectory import Trajectory
from rovgraph.lab.thesis.core import SECOND, rate_matrix, unit
from rovgraph.lab.thesis.measurements import HEADING, ping_rows
from rovgraph.lab.thesis.recursion import KeptInnovations, Recursion, run_together
from rovgraph.lab.thesis.setup import TrueMotion, prepare
from rovgraph.lab.thesis.variants import FILTERS, Filter
from rovgraph.log import Log
from rovgraph.model.calibration import MOUNT
from rovgraph.model.config import Config, mount_matrix

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
