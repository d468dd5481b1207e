"""What docs/thesis.md says in numbers: one table each.

    python benchmarks/thesis.py model         4.1 against 4.2: does a hydrodynamic model help?
    python benchmarks/thesis.py online        what a dive says of the drag coefficients
    python benchmarks/thesis.py frames        4.3 against 4.4: what sets body and earth frame apart?
    python benchmarks/thesis.py misalignment  4.5 against the others that estimate the DVL's angles
    python benchmarks/thesis.py invariant     what GTSAM's invariant filter takes
    python benchmarks/thesis.py field         a magnetic field that changes on the way

A dive is made of its seed alone; ``--seconds`` ends its log early. Nothing is asserted.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from inspect import signature
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from rovgraph.geometry import Array, log_rotation, rotate, transpose
from rovgraph.inference.estimate import Estimate
from rovgraph.inference.trajectory import Trajectory
from rovgraph.lab.estimators import ESTIMATORS
from rovgraph.lab.executors import cores, in_workers
from rovgraph.lab.thesis import FILTERS, Filter, run_filter
from rovgraph.log import Log, Stream
from rovgraph.model.calibration import TABLE
from rovgraph.model.config import Config, beliefs, mount_matrix
from rovgraph.sensors import field_direction
from rovgraph.simulate import CALM, Choices, Dive, Style, Truth, Waves, lake, scenario, simulate, simulated
from rovgraph.simulate.files import known
from rovgraph.simulate.truth import THESIS

Row = dict[str, Any]
ANGLES = ("dvl_roll", "dvl_pitch", "dvl_yaw")
LIVELY = Waves(heave=0.05, roll=0.1, pitch=0.08)


# ------------------------------------------------------------------------------ dives


@dataclass(frozen=True)
class Case:
    """A simulated dive with what an estimator may know.

    Attributes
    ----------
    log, config : what an estimator is given
    truth : Trajectory of the body's origin at the IMU's epochs
    calibration : true values by name
    """

    log: Log
    config: Config
    truth: Trajectory
    calibration: dict[str, Array]


def case_of(dive: Dive, config: Config, seconds: float) -> Case:
    """The dive until ``seconds``."""
    frame = dive.log_frame[dive.log_frame["time"] <= seconds]
    return Case(Log.from_frame(frame, source="dive"), config, dive.truth, dive.hidden["calibration"])


def driven(name: str, seed: int, seconds: float, **choices: Any) -> Case:
    """A dive through the thrusters; run 1 and 2 of the lake take turns."""
    variant = str(seed % 2 + 1) if name == "vattern" else None
    return case_of(*simulated(name, seed, choices=Choices(variant=variant, **choices)), seconds)


def moved(
    path: str, waves: Waves, seed: int, seconds: float, noise: bool = True, arm: bool = True, exact: bool = False
) -> Case:
    """A motion as such with the thesis's noise; the DVL's mounting is exactly as believed.

    Parameters
    ----------
    path : key of `rovgraph.simulate.SCENARIOS`
    waves : Waves
    seed, seconds : of the dive
    noise : False = nothing is drawn
    arm : False = the IMU is at the body's origin
    exact : compasses and field are as believed
    """
    config = lake()
    if not arm:
        config = config.model_copy(update={"imu": config.imu.model_copy(update={"lever_arm_m": (0.0, 0.0, 0.0)})})
    exactly = {name: belief.mean for name, belief in beliefs(config).items() if exact or name in ANGLES}
    truth = Truth(config, calibration=exactly, noise=noise, covariances=THESIS)
    dive = simulate(scenario(path, seconds, None, Style(waves=waves)), truth, np.random.default_rng(seed))
    return case_of(dive, known(dive, config), seconds)


def believing(config: Config, **entries: dict[str, Any]) -> Config:
    """A configuration with some entries of ``calibration`` changed."""
    new = {name: getattr(config.calibration, name).model_copy(update=entry) for name, entry in entries.items()}
    return config.model_copy(update={"calibration": config.calibration.model_copy(update=new)})


# ----------------------------------------------------------------------------- errors


def track_errors(track: Trajectory, truth: Trajectory) -> Row:
    """Horizontal position: rms over the track and at its end [m]; heading, rms [deg]."""
    true = truth.clamped(track.time)
    error = np.linalg.norm((track.p_n - true.p_n)[:, :2], axis=1)
    turn = rotate(true.R_nb, log_rotation(transpose(true.R_nb) @ track.R_nb))[:, 2]
    return {"rms_m": rms(error), "end_m": error[-1], "heading_deg": np.rad2deg(rms(turn))}


def speed_errors(track: Trajectory, truth: Trajectory) -> Array:
    """Length of the error of the velocity in body axes, where the attitude's error is no part of it [mm/s]."""
    true = truth.clamped(track.time)
    error = rotate(transpose(track.R_nb), track.v_n) - rotate(transpose(true.R_nb), true.v_n)
    return np.asarray(1e3 * np.linalg.norm(error, axis=1))


def rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


# ------------------------------------------------------- 1: a model of the vehicle


STILL, CURRENT = (0.0, 0.0), (0.15, 0.1)
GAPS = ((0.28, 0.36), (0.52, 0.64))  # without bottom lock, shares of the dive
WATERS = {
    "all pings": (STILL, ()),
    "all pings, current": (CURRENT, ()),
    "two gaps": (STILL, GAPS),
    "two gaps, current": (CURRENT, GAPS),
}
DRAG_ERRORS = (0.0, 0.2, -0.2, 0.5, -0.5)


def model(seed: int, seconds: float) -> list[Row]:
    """Error of velocity, in the gaps where there are any, and of the end."""
    rows = []
    for water, (current, shares) in WATERS.items():
        gaps = tuple((seconds * a, seconds * b) for a, b in shares)
        case = driven("vattern", seed, seconds, current=current, dropouts=gaps)
        for name, drag, config in with_drag(case):
            for share, noise in ((1.0, "as printed"), (0.01, "a tenth")):
                printed = FILTERS[name].numbers.acceleration
                variant = FILTERS[name].with_numbers(acceleration=tuple(share * q for q in printed))
                track = run_filter(variant, case.log, config).trajectory
                t, error = track.time, speed_errors(track, case.truth)
                asked = np.any([(t >= a) & (t <= b) for a, b in gaps or ((0.0, seconds),)], axis=0)
                rows.append(
                    {"filter": name, "drag": drag, "process noise, sd": noise, "water": water}
                    | {"v": rms(error[asked]), "end": track_errors(track, case.truth)["end_m"]}
                )
    return rows


def with_drag(case: Case) -> list[tuple[str, str, Config]]:
    """Filter, what it believes of the drag, and the configuration that says so."""
    vehicle = case.config.vehicle
    true = {
        name: tuple(np.asarray(getattr(vehicle, name)) * (1.0 + case.calibration[name]))
        for name in ("drag_linear", "drag_quadratic")
    }
    out = [("4.1", "-", case.config), ("4.1-no-accelerometer", "-", case.config)]
    for error in DRAG_ERRORS:
        wrong = {name: tuple(float(c) * (1.0 + error) for c in value) for name, value in true.items()}
        config = case.config.model_copy(update={"vehicle": vehicle.model_copy(update=wrong)})
        out.append(("4.2", f"{error:+.0%}" if error else "true", config))
    return [*out, ("4.2", "the thesis's", case.config)]


# --------------------------------------------------- 2: its coefficients, online


def online(seed: int, seconds: float) -> list[Row]:
    """Drag coefficients from the graph that takes the thrusters as a source."""
    rows = []
    for name in ("vattern", "excited"):
        case = driven(name, seed, seconds)
        graph = case.config.graph.model_copy(update={"hydrodynamics": True})
        config = case.config.model_copy(update={"graph": graph})
        estimate = ESTIMATORS["graph-smoothed-a"](case.log, config)
        for entry in estimate.calibration:
            variable = next((v for v in TABLE.values() if entry.label in v.labels), None)
            if variable is None or "thruster" not in variable.sensors:
                continue
            error = entry.value - case.calibration[variable.name][variable.labels.index(entry.label)]
            rows.append(
                {"dive": name, "coefficient": entry.label, "unit": variable.unit, "prior": variable.sd}
                | {"sd": entry.sd, "error": error, "nees": (error / entry.sd) ** 2}
            )
    return rows


# -------------------------------------------------------------- 3: body or earth


CAREFUL = {"acc_bias": 0.01 * 3e-4**2, "gyr_bias": 0.01 * 1e-5**2}  # the vehicle's bias walks, per sample


def louder(sd: float) -> Array:
    """R_MTI with an accelerometer that is noisier by ``sd`` [m/s^2]."""
    R = FILTERS["4.3a"].numbers.R_mti.copy()
    R[:3, :3] += sd**2 * np.eye(3)
    return R


CHANGES: dict[str, Callable[[Filter], Filter]] = {
    "as printed": lambda f: f,
    "Coriolis exact": lambda f: replace(f, coriolis="exact"),
    "three iterations": lambda f: replace(f, iterations=3),
    "Jacobians at the truth": lambda f: replace(f, linearized_at="truth"),
    "accelerometer sd 0.15": lambda f: f.with_numbers(R_mti=louder(0.15)),
    "bias walks of the vehicle": lambda f: f.with_numbers(**CAREFUL),
}
ON_ARMLESS = ("as printed", "Jacobians at the truth")
MOTIONS = {
    "straight, calm": ("straight", CALM),
    "straight, waves": ("straight", LIVELY),
    "turning, calm": ("square", CALM),
    "turning, waves": ("square", LIVELY),
}


def frames(seed: int, seconds: float) -> list[Row]:
    """How far the tracks of 4.3 and 4.4 are apart, and each from the truth."""
    rows = []
    for motion, (path, waves) in MOTIONS.items():
        case = moved(path, waves, seed, seconds)
        rows += [_apart(case, motion, what, change) for what, change in CHANGES.items()]
        case = moved(path, waves, seed, seconds, arm=False)
        rows += [_apart(case, motion, f"no lever arm, {what}", CHANGES[what]) for what in ON_ARMLESS]
        if seed == 1:  # where nothing is drawn all seeds are alike
            for what, arm in (("nothing drawn", True), ("no lever arm, nothing drawn", False)):
                case = moved(path, waves, seed, seconds, noise=False, arm=arm)
                rows.append(_apart(case, motion, what, CHANGES["as printed"]))
    return rows


def _apart(case: Case, motion: str, what: str, change: Callable[[Filter], Filter]) -> Row:
    row: Row = {"dive": motion, "change": what}
    for letter in "abc":
        tracks = {
            frame: run_filter(change(FILTERS[section + letter]), case.log, case.config, case.truth).trajectory
            for frame, section in (("b", "4.3"), ("n", "4.4"))
        }
        row[f"apart_{letter}"] = rms(np.linalg.norm((tracks["b"].p_n - tracks["n"].p_n)[:, :2], axis=1))
        for frame, track in tracks.items():
            row[f"{frame}_{letter}"] = track_errors(track, case.truth)["rms_m"]
    return row


# --------------------------------------------------------------- 4: misalignment


TIGHT = {name: {"estimate": True, "sd_deg": 0.1} for name in ANGLES[:2]}
OF_4_5: dict[str, Callable[[Filter], Filter]] = {
    **{name: change for name, change in CHANGES.items() if name != "Coriolis exact"},
    "angles walk 0.1 deg/rts": lambda f: f.with_numbers(mount=0.01 * np.deg2rad(0.1) ** 2),
    "psi_DVL held in the heading": lambda f: replace(f, compass_mount="held"),
    "no DVL compass": lambda f: replace(f, compass=False),
    "no magnetometer": lambda f: replace(f, magnetometer=False),
}
OTHERS = ("ekf-misalignment", "graph-filtered-misalignment", "graph-smoothed-misalignment")


SOUGHT: dict[str, Callable[..., Case]] = {
    "vattern": partial(driven, "vattern"),
    "turning, calm": partial(moved, "square", CALM),
    "turning, waves": partial(moved, "square", LIVELY),
}


def misalignment(seed: int, seconds: float) -> list[Row]:
    """Angles of the DVL that 4.5, the error-state filter and the graph find, against the true ones."""
    return [
        {"dive": dive, "estimator": what} | _angles(estimate, case)
        for dive, make in SOUGHT.items()
        for what, case, estimate in _found(make, seed, seconds)
    ]


def _found(make: Callable[..., Case], seed: int, seconds: float) -> Iterator[tuple[str, Case, Estimate]]:
    """What was run, on what, and its estimate."""
    case = make(seed=seed, seconds=seconds)
    for what, change in OF_4_5.items():
        yield f"4.5, {what}", case, run_filter(change(FILTERS["4.5"]), case.log, case.config, case.truth)
    yield "4.5, tilt sd 0.1 deg", case, run_filter("4.5", case.log, believing(case.config, **TIGHT))
    if "arm" in signature(make).parameters:
        for what, changed in (("no lever arm", {"arm": False}), ("exact compasses", {"exact": True})):
            other = make(seed=seed, seconds=seconds, **changed)
            yield f"4.5, {what}", other, run_filter("4.5", other.log, other.config)
        other = make(seed=seed, seconds=seconds, arm=False, exact=True)
        yield "4.5, no lever arm, exact compasses", other, run_filter("4.5", other.log, other.config)
    for name in OTHERS:
        yield name, case, ESTIMATORS[name](case.log, case.config)
    three = believing(case.config, **{name: {"estimate": True} for name in ANGLES[:2]})
    yield f"{OTHERS[-1]}, 3 angles", case, ESTIMATORS[OTHERS[-1]](case.log, three)
    yield "4.3a, none estimated", case, run_filter("4.3a", case.log, case.config)


def _angles(estimate: Estimate, case: Case) -> Row:
    row = track_errors(estimate.trajectory, case.truth)
    for entry in estimate.calibration:
        if entry.label in ANGLES and entry.estimated:
            error = np.rad2deg(np.angle(np.exp(1j * (entry.value - case.calibration[entry.label][0]))))
            sd, short = np.rad2deg(entry.sd), entry.label.removeprefix("dvl_")
            row |= {f"{short}_deg": error, f"{short}_sd": sd, f"{short}_nees": (error / sd) ** 2}
    return row


# ------------------------------------------------------- 6: GTSAM's invariant filter


def invariant(seed: int, seconds: float) -> list[Row]:
    """What GTSAM's filters take and refuse; neither seed nor seconds matter."""
    import gtsam

    state, P, R = gtsam.NavState(), np.eye(9), np.eye(3)

    def updated(columns: int, rows: int = 3) -> str:
        kf = gtsam.InvariantEKFNavState(state, P)
        kf.updateWithVector(np.zeros(rows), np.eye(rows, columns), np.zeros(rows), np.eye(rows))
        return f"covariance {kf.covariance().shape}"

    def imu() -> str:
        kf = gtsam.NavStateImuEKF(state, P, gtsam.PreintegrationParams.MakeSharedD(9.81))
        kf.predict(np.zeros(3), np.array([0.0, 0.0, -9.81]), 0.01)
        kf.updateWithVector(np.zeros(3), np.eye(3, 9), np.zeros(3), R)
        return f"covariance {kf.covariance().shape}"

    def set_covariance() -> str:
        kf = gtsam.InvariantEKFNavState(state, P)
        kf.covariance()[0, 0] = 7.0
        return f"{kf.covariance()[0, 0]}"

    tried: dict[str, Callable[[], str]] = {
        "InvariantEKFNavState, H of 3 x 9": partial(updated, 9),
        "InvariantEKFNavState, H of 1 x 9": partial(updated, 9, 1),
        "InvariantEKFNavState, H of 3 x 24": partial(updated, 24),
        "NavStateImuEKF, a sample and H of 3 x 9": imu,
        "InvariantEKFNavState, P of 15": lambda: str(gtsam.InvariantEKFNavState(state, np.eye(15))),
        "InvariantEKFNavState, P of 24": lambda: str(gtsam.InvariantEKFNavState(state, np.eye(24))),
        "InvariantEKFNavState, writing into its covariance": set_covariance,
        "InvariantEKFGal3, dimension": lambda: str(gtsam.InvariantEKFGal3(gtsam.Gal3(), np.eye(10)).dimension()),
    }
    return [{"tried": what, "result": _came_of(attempt)} for what, attempt in tried.items()]


def _came_of(attempt: Callable[[], str]) -> str:
    try:
        return attempt()
    except (TypeError, RuntimeError, ValueError) as error:
        return f"{type(error).__name__}: {str(error).splitlines()[0][:90]}"


# --------------------------------------------------- 7: a field that changes on the way


DIP_DEG, SCALE, CHANGE_S = 6.0, 0.12, 20.0
BELIEVED: dict[str, Row] = {
    "fixed": {"field_dip": {"estimate": False}, "field_scale": {"estimate": False}},
    "constant": {
        "field_dip": {"estimate": True, "walk_deg": 0.0},
        "field_scale": {"estimate": True, "walk": 0.0},
    },
    "walking": {
        "field_dip": {"estimate": True, "walk_deg": 0.5},
        "field_scale": {"estimate": True, "walk": 0.01},
    },
}


def other_field(case: Case, middle: float) -> Case:
    """The dive with a field that goes over to another within 20 s about ``middle`` [s]."""
    mag, config = case.log["mag"], case.config
    share = np.clip((mag.time - middle) / CHANGE_S + 0.5, 0.0, 1.0)
    dip = np.deg2rad(config.environment.dip_deg or 0.0) + case.calibration["field_dip"][0]
    declination, scale = np.deg2rad(config.environment.declination_deg), 1.0 + case.calibration["field_scale"][0]
    old = scale * field_direction(declination, dip)
    new = (scale + SCALE * share)[:, None] * field_direction(
        np.full(len(share), declination), dip + np.deg2rad(DIP_DEG) * share
    )
    R_sn = mount_matrix(config.imu.mount_rpy_deg).T @ transpose(case.truth.clamped(mag.time).R_nb)
    data = mag.data + (config.environment.field_norm or 1.0) * rotate(R_sn, new - old)
    streams = {**case.log.streams, "mag": Stream("mag", mag.columns, mag.time, data, mag.row)}
    return replace(case, log=Log(case.log.source, streams, case.log.origin))


def field(
    seed: int, seconds: float, case: Case | None = None, letters: str = "ac", among_iron: bool = True
) -> list[Row]:
    """Errors with the field believed fixed, constant and walking, with and without the change.

    Parameters
    ----------
    seed, seconds : of the dive, unless ``case`` is one
    letters : sources of heading
    among_iron : also with iron on the seabed instead of the change
    """
    case = case or driven("vattern", seed, seconds, disturbances=False)
    middle = 0.5 * float(case.log["imu"].time[-1] + case.log["imu"].time[0])
    dives = {"the same": case, "another": other_field(case, middle)}
    if among_iron:
        dives["the same, iron on the seabed"] = driven("vattern", seed, seconds)
    rows = []
    for (which, dive), (what, entries), letter in product(dives.items(), BELIEVED.items(), letters):
        track = ESTIMATORS[f"graph-smoothed-{letter}"](dive.log, believing(dive.config, **entries)).trajectory
        rows.append({"headings": letter, "field": which, "believed": what} | track_errors(track, dive.truth))
    return rows


# ------------------------------------------------------------------------------ tables


@dataclass(frozen=True)
class Study:
    """A table of the document.

    Attributes
    ----------
    run : seed, seconds -> rows
    labels : columns by which rows of all seeds are taken together
    numbers : header -> (column, how it is taken together, format)
    across : a label whose values become columns, or None
    seeds, seconds : of the document
    """

    run: Callable[..., list[Row]]
    labels: tuple[str, ...]
    numbers: dict[str, tuple[str, str, str]]
    across: str | None = None
    seeds: int = 8
    seconds: float = 250.0


TAKEN: dict[str, Callable[[Array], float]] = {
    "mean": lambda x: float(np.mean(x)),
    "median": lambda x: float(np.median(x)),
    "rms": rms,
    "max": lambda x: float(np.max(np.abs(x))),
}
STUDIES = {
    "model": Study(
        model,
        ("filter", "drag", "process noise, sd"),
        {"v, rms [mm/s]": ("v", "rms", ".1f"), "end [m]": ("end", "mean", ".2f")},
        "water",
    ),
    "online": Study(
        online,
        ("dive", "coefficient", "unit"),
        {
            "prior sd": ("prior", "mean", ".2f"),
            "sd": ("sd", "mean", ".3f"),
            "error, rms": ("error", "rms", ".3f"),
            "NEES": ("nees", "mean", ".1f"),
        },
        seconds=500.0,
    ),
    "frames": Study(
        frames,
        ("dive", "change"),
        {f"apart, {k} [mm]": (f"apart_{k}", "rms", "mm") for k in "abc"}
        | {f"4.{s}{k} [m]": (f"{f}_{k}", "rms", ".2f") for s, f in ((3, "b"), (4, "n")) for k in "abc"},
        seconds=120.0,
        seeds=6,
    ),
    "misalignment": Study(
        misalignment,
        ("dive", "estimator"),
        {
            "yaw error, rms [deg]": ("yaw_deg", "rms", ".2f"),
            "sd [deg]": ("yaw_sd", "mean", ".2f"),
            "NEES": ("yaw_nees", "mean", ".1f"),
            "tilt error, max [deg]": ("tilt_deg", "max", ".1f"),
            "its sd [deg]": ("roll_sd", "mean", ".2f"),
            "end error [m]": ("end_m", "mean", ".2f"),
        },
    ),
    "invariant": Study(invariant, ("tried", "result"), {}, seeds=1),
    "field": Study(
        field,
        ("headings", "field", "believed"),
        {
            "heading, rms [deg]": ("heading_deg", "rms", ".2f"),
            "track, rms [m]": ("rms_m", "rms", ".2f"),
            "end, mean [m]": ("end_m", "mean", ".2f"),
        },
    ),
}


def table(study: Study, rows: Sequence[Row]) -> str:
    """Rows of all seeds as a Markdown table."""
    frame = pd.DataFrame(rows)
    if {"roll_deg", "pitch_deg"} <= set(frame):
        frame["tilt_deg"] = frame[["roll_deg", "pitch_deg"]].abs().max(axis=1)
    columns = list(frame[study.across].unique()) if study.across else [None]
    header = [*study.labels, *(f"{c}: {h}" if c else h for c in columns for h in study.numbers)]
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for key, group in frame.groupby(list(study.labels), sort=False, dropna=False):
        parts = [group[group[study.across] == c] if c else group for c in columns]
        cells = [_cell(part, *number) for part in parts for number in study.numbers.values()]
        lines.append("| " + " | ".join([*map(str, key), *cells]) + " |")
    return "\n".join(lines)


def _cell(group: pd.DataFrame, column: str, taken: str, shape: str) -> str:
    values = group[column].dropna().to_numpy(float) if column in group else np.zeros(0)
    if not len(values):
        return "-"
    value = TAKEN[taken](values)
    return f"{1e3 * value:.1f}" if shape == "mm" else format(value, shape)


def main(arguments: Sequence[str] | None = None) -> str:
    """Run a study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", choices=STUDIES)
    parser.add_argument("--seeds", type=int, help="number of dives")
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--seconds", type=float, help="at most, of each dive")
    parser.add_argument("--jobs", type=int, default=cores(), help="processes")
    chosen = parser.parse_args(arguments)
    study = STUDIES[chosen.study]
    seeds = list(range(chosen.first, chosen.first + (chosen.seeds or study.seeds)))
    run = partial(study.run, seconds=chosen.seconds or study.seconds)
    done = (
        [run(seed) for seed in seeds] if chosen.jobs == 1 else in_workers(run, seeds, chosen.jobs, lambda share: None)
    )
    text = table(study, [row for rows in done for row in rows])
    print(text, flush=True)
    return text


if __name__ == "__main__":
    main()
