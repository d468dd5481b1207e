"""The DVL's misalignment from rovgraph and from navlib, on the same dives.

    pip install 'rovgraph[benchmarks]'
    python benchmarks/misalignment.py check                   what navlib finds where nothing is noisy
    python benchmarks/misalignment.py simulated --minutes 5   rms errors of all methods, a Markdown table
    python benchmarks/misalignment.py arm --seeds 40          what the DVL's lever arm does to our sd
    python benchmarks/misalignment.py recorded FOLDER         a recorded dive: log.csv.gz, reference.csv.gz, FOLDER.yaml
    python benchmarks/misalignment.py fixes LOG REFERENCE OUT a log with the reference's positions as its fixes

navlib's methods are `cal_dvl_acc_so3`, without fixes (Troni and Whitcomb), and `cal_dvl_jck_so3`, with
fixes (Kinsey and Whitcomb). Both return the rotation from the DVL's axes to the vehicle's, our R_bs.
How they are fed stands with `Signals`. Nothing is asserted.
"""

import argparse
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.signal import butter, sosfiltfilt

from rovgraph.dive import smooth
from rovgraph.geometry import Array, log_rotation, matrix_from_rpy, rotate, rpy_from_matrix, transpose
from rovgraph.inference.estimate import Estimate
from rovgraph.inference.trajectory import Trajectory
from rovgraph.lab.evaluate import read_reference
from rovgraph.lab.misalignment.plan import Grade, believed
from rovgraph.log import Log, Stream, read_log
from rovgraph.model.config import Config, load_config, mount_matrix
from rovgraph.simulate import Dive, Truth, scenario, simulate
from rovgraph.simulate.files import known
from rovgraph.simulate.named import falcon

Row = dict[str, Any]
ANGLES = ("dvl_roll", "dvl_pitch", "dvl_yaw")
WIDE = {"dvl_roll": 25.0, "dvl_pitch": 25.0, "dvl_yaw": 180.0}  # sd of our priors [deg]: they must not do the work
SPEED, FIX_SD_M, FIX_INTERVAL_S = 0.4, 1.0, 5.0
TILT_SD_DEG, LARGEST_DEG = 2.0, 45.0
GOLDEN = 0.618034
RATE = 20.0  # of signals for navlib [Hz]
SLOW = 2.0  # rate of signals in cutoffs, for its optimiser, which takes minutes at the other rate
CUTOFF = 0.1  # of the ping rate, navlib's own choice


# ---------------------------------------------------------------------- navlib


@dataclass(frozen=True)
class Signals:
    """A dive as navlib takes it: vehicle axes forward, starboard, down, the IMU's place as origin.

    - navlib's own removal of gravity is for axes that point up: with z down it adds gravity where it
      should take it off. So it is given the acceleration without gravity.
    - It interpolates headings as numbers: they are unwrapped.
    - It differentiates backwards, half an interval late: signals are interpolated to `RATE` first.
    - It filters each signal to a tenth of the signal's own rate: all are filtered to a tenth of the ping
      rate instead, so that the same motion is left in each.
    - With fixes it multiplies the angular rate by the position, and a gyro's bias by tens of metres: it is
      given the rate of the attitude itself.
    - It knows one lever arm: depth is moved to the DVL's place, or to the antenna's, by the attitude.

    Attributes
    ----------
    imu_time, dvl_time, depth_time, fix_time : [s]
    force_b, rate_b : without their biases, at ``imu_time``
    R_nb : at ``imu_time``
    velocity_s : in the DVL's axes
    depth : of the depth sensor
    fix_n : north and east, shape (n, 2)
    attitude, config : the same attitude at any time; places of the sensors, gravity
    """

    imu_time: Array
    force_b: Array
    rate_b: Array
    R_nb: Array
    dvl_time: Array
    velocity_s: Array
    depth_time: Array
    depth: Array
    fix_time: Array
    fix_n: Array
    attitude: Trajectory
    config: Config

    def without_fixes(self) -> Array:
        """R_bs by `cal_dvl_acc_so3`."""
        from navlib.cal import cal_dvl_acc_so3

        dvl, imu = (np.asarray(s.lever_arm_m) for s in (self.config.dvl, self.config.imu))
        time = self._grid(self.imu_time, self.dvl_time, self.depth_time)
        gravity_b = rotate(transpose(self.R_nb), [0.0, 0.0, self.config.environment.gravity_mps2])
        signals = (
            self._at(time, self.dvl_time, self.velocity_s),
            self._at(time, self.imu_time, self.force_b + gravity_b),
            self._at(time, self.imu_time, self._rpy),
            self._at(time, self.imu_time, self.rate_b),
            self._at(time, self.depth_time, self._depth_of(self.config.dvl.lever_arm_m)[:, None])[:, 0],
        )
        np.random.seed(0)  # noqa: NPY002 of the optimiser, which begins anywhere
        options = {"low_pass_filter": False, "remove_gravity": False, "lever_arm": dvl - imu}
        return np.asarray(cal_dvl_acc_so3(time, time, time, *signals, **options))

    def with_fixes(self) -> Array:
        """R_bs by `cal_dvl_jck_so3`.

        Its method svd has the optimum of its method min in closed form, and at once; but where a reflection
        fits better than any rotation it returns that, or what becomes of it as a rotation.
        """
        R_bs = self._jck("svd", RATE, force_so3=False)
        return R_bs if np.linalg.det(R_bs) > 0.0 else self._jck("min", SLOW * self._cutoff)

    def _jck(self, method: str, rate: float, **more: bool) -> Array:
        from navlib.cal import cal_dvl_jck_so3

        dvl, antenna = (np.asarray(s.lever_arm_m) for s in (self.config.dvl, self.config.fix))
        time = self._grid(self.imu_time, self.dvl_time, self.depth_time, self.fix_time, rate=rate)
        down = np.interp(time, self.depth_time, self._depth_of(self.config.fix.lever_arm_m))
        position = np.column_stack([_interpolated(time, self.fix_time, self.fix_n), down])
        rpy = self._at(time, self.imu_time, self._rpy)
        signals = (
            self._at(time, self.dvl_time, self.velocity_s),
            rpy,
            _rate(matrix_from_rpy(rpy), rate),
            position - position.mean(axis=0),
        )
        np.random.seed(0)  # noqa: NPY002 of the optimiser, which begins anywhere
        options = {"low_pass_filter": False, "lever_arm": dvl - antenna, "method": method, "zero_mean_equation": True}
        return np.asarray(cal_dvl_jck_so3(time, time, time, *signals, **options, **more))

    @property
    def _cutoff(self) -> float:
        """Of the filter [Hz]."""
        return CUTOFF / float(np.median(np.diff(self.dvl_time)))

    @property
    def _rpy(self) -> Array:
        return np.unwrap(rpy_from_matrix(self.R_nb), axis=0)

    def _grid(self, *times: Array, rate: float = RATE) -> Array:
        """Epochs that all signals have."""
        return np.arange(max(t[0] for t in times), min(t[-1] for t in times), 1.0 / rate)

    def _at(self, time: Array, own: Array, values: Array) -> Array:
        """A signal without what is faster than the cutoff, at other times."""
        rate = 1.0 / float(np.median(np.diff(own)))
        if rate <= 2.0 * RATE:  # finer and even, for the filter
            fine = np.arange(own[0], own[-1], 0.5 / RATE)
            own, values, rate = fine, _interpolated(fine, own, values), 2.0 * RATE
        return _interpolated(time, own, _low_pass(values, self._cutoff, rate))

    def _depth_of(self, lever_arm_m: Sequence[float]) -> Array:
        arm = np.subtract(lever_arm_m, self.config.depth.lever_arm_m)
        return self.depth + rotate(self.attitude.clamped(self.depth_time).R_nb, arm)[:, 2]


def _rate(R_nb: Array, rate: float) -> Array:
    """Angular rate of attitudes that come at a rate, body axes."""
    at = np.arange(len(R_nb))
    before, after = np.maximum(at - 1, 0), np.minimum(at + 1, len(at) - 1)
    return log_rotation(transpose(R_nb[before]) @ R_nb[after]) * (rate / (after - before))[:, None]


def _low_pass(values: Array, cutoff: float, rate: float) -> Array:
    """Without phase, as navlib filters; in sections, which a low cutoff needs to be stable."""
    return np.asarray(sosfiltfilt(butter(5, cutoff, fs=rate, output="sos"), values, axis=0))


def _interpolated(time: Array, own: Array, values: Array) -> Array:
    return np.column_stack([np.interp(time, own, column) for column in values.T])


def signals(log: Log, config: Config, attitude: Trajectory, bias: Array) -> Signals:
    """What navlib is given.

    Parameters
    ----------
    log, config : the dive; lever arms and limits of the sensors
    attitude : of which only R_nb is used
    bias : of accelerometer and gyro in body axes, shape (6,) or (n, 6)
    """
    imu, dvl, depth, fix = (log.streams.get(name) for name in ("imu", "dvl", "depth", "fix"))
    assert imu is not None and dvl is not None and depth is not None
    R_bs = mount_matrix(config.imu.mount_rpy_deg)
    force, rate = rotate(R_bs, imu.data[:, :3]), rotate(R_bs, imu.data[:, 3:6])
    good = (dvl["dvl_valid"] != 0) & (np.linalg.norm(dvl.data[:, :3], axis=1) <= config.dvl.max_speed_mps)
    return Signals(
        imu.time,
        force - bias[..., :3],
        rate - bias[..., 3:],
        attitude.at(imu.time).R_nb,
        dvl.time[good],
        dvl.data[good, :3],
        depth.time,
        depth["depth"],
        np.zeros(0) if fix is None else fix.time,
        np.zeros((0, 2)) if fix is None else fix.data[:, :2],
        attitude,
        config,
    )


def from_ahrs(log: Log, config: Config) -> Signals:
    """With the attitude that the inertial unit gives, and without what the gyro turns further than that."""
    ahrs, imu = log["ahrs"], log["imu"]
    rpy = np.column_stack([ahrs[f"ahrs_{name}"] for name in ("roll", "pitch", "yaw")])
    R_nm = mount_matrix((0.0, 0.0, config.environment.declination_deg))  # its north is magnetic
    R_nb = R_nm @ matrix_from_rpy(rpy) @ mount_matrix(config.imu.mount_rpy_deg).T
    turned = log_rotation(transpose(R_nb[:-1]) @ R_nb[1:]).sum(axis=0) / (ahrs.time[-1] - ahrs.time[0])
    bias = rotate(mount_matrix(config.imu.mount_rpy_deg), imu.data[:, 3:6].mean(axis=0)) - turned
    nothing = np.zeros((len(ahrs), 3))
    attitude = Trajectory.certain(ahrs.time, nothing, R_nb, nothing)
    return signals(log, config, attitude, np.append(np.zeros(3), bias))


def from_estimate(log: Log, config: Config, estimate: Estimate) -> Signals:
    """With attitude and biases as we estimate them."""
    biases = [
        _interpolated(log["imu"].time, estimate.history[name].time, estimate.history[name].value)
        for name in ("acc_bias", "gyr_bias")
    ]
    return signals(log, config, estimate.trajectory, np.hstack(biases))


# ------------------------------------------------------------------------ ours


def estimated(log: Log, config: Config, angles: Sequence[str] = ANGLES) -> Estimate:
    """Our smoother's estimate, with wide priors of the DVL's angles about the mounting."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a log in which not every row is good
        wide = believing(config, **{name: {"estimate": True, "sd_deg": WIDE[name]} for name in angles})
        return smooth(log, wide, "smoothed").estimates[0]


def believing(config: Config, **entries: Row) -> Config:
    """A configuration with some entries of ``calibration`` changed."""
    data = config.model_dump()
    for name, entry in entries.items():
        data["calibration"][name] |= entry
    return Config.model_validate(data)


def mounting(estimate: Estimate) -> Array:
    """R_bs of the DVL."""
    value = {entry.label: entry.value for entry in estimate.calibration}
    return matrix_from_rpy([value[name] for name in ANGLES])


def error_deg(R_bs: Array, true_R_bs: Array) -> Row:
    """Error of a mounting, as turns about the body's axes.

    Roll is taken first: a vehicle that moves ahead does not show it, and it must not pass for yaw.
    """
    angles = np.rad2deg(rpy_from_matrix(R_bs @ true_R_bs.T))
    return dict(zip(("roll", "pitch", "yaw"), map(float, angles), strict=True))


def without(log: Log, sensor: str) -> Log:
    return replace(log, streams={name: stream for name, stream in log.streams.items() if name != sensor})


# ------------------------------------------------------------------- simulated


def make_dive(
    manoeuvre: str,
    minutes: float,
    grade: Grade,
    angles_deg: Sequence[float],
    seed: int,
    noise: bool = True,
    together: bool = False,
) -> tuple[Dive, Config, Array]:
    """A dive in the waves of a lake with AHRS and fixes, what may be known of it, and the true R_bs.

    Parameters
    ----------
    angles_deg : roll, pitch, yaw of the DVL beyond its mounting
    together : the DVL is where the inertial unit is
    """
    vehicle = falcon()
    if together:
        dvl = vehicle.dvl.model_copy(update={"lever_arm_m": vehicle.imu.lever_arm_m})
        vehicle = vehicle.model_copy(update={"dvl": dvl})
    config = believed(vehicle, grade, "ahrs", "offset", 5.0, FIX_SD_M, (0.0, WIDE["dvl_yaw"]))
    angles = np.deg2rad(np.add(config.dvl.mount_rpy_deg, angles_deg))
    calibration = {name: np.array([angle]) for name, angle in zip(ANGLES, angles, strict=True)}
    truth = Truth(config, calibration=calibration, noise=noise, ahrs_rate=10.0, fix_interval=FIX_INTERVAL_S)
    dive = simulate(scenario(manoeuvre, 60.0 * minutes, SPEED), truth, np.random.default_rng(seed))
    return dive, known(dive, config), matrix_from_rpy(angles)


def one_dive(manoeuvre: str, minutes: float, grade: Grade, seed: int) -> Iterator[Row]:
    """Errors of all methods; the misalignments of any number of dives lie evenly between 0 and `LARGEST_DEG`."""
    dive, config, true = make_dive(manoeuvre, minutes, grade, _angles_deg(seed), seed)
    log = Log.from_frame(dive.log_frame)
    for fixes in (False, True):
        given = log if fixes else without(log, "fix")
        estimate = estimated(given, config)
        sd = {f"{x.label[4:]}_sd": float(np.rad2deg(x.sd)) for x in estimate.calibration if x.label in ANGLES}
        row = {"manoeuvre": manoeuvre, "minutes": minutes, "imu": grade, "fixes": fixes, "seed": seed}
        yield row | {"method": "rovgraph"} | error_deg(mounting(estimate), true) | sd
        fed = {
            "navlib, AHRS": from_ahrs(given, config),
            "navlib, our attitude": from_estimate(given, config, estimate),
            "navlib, true attitude": signals(given, config, dive.truth, dive.hidden["bias"]),
        }
        for method, signal in fed.items():
            R_bs = signal.with_fixes() if fixes else signal.without_fixes()
            yield row | {"method": method} | error_deg(R_bs, true)


def _angles_deg(seed: int) -> tuple[float, float, float]:
    """Misalignment of a dive: roll, pitch, yaw."""
    roll, pitch = TILT_SD_DEG * np.random.default_rng([seed, 2]).standard_normal(2)
    return roll, pitch, LARGEST_DEG * (seed * GOLDEN % 1.0)


def arm(seeds: int) -> str:
    """Our yaw on figures of eight of five minutes with an MTi and no fixes: its error, sd and mean NEES."""
    lines = ["| DVL | dives | error, rms | sd | mean NEES |", "|---|---|---|---|---|"]
    for together in (False, True):
        found = []
        for seed in range(1, seeds + 1):
            dive, config, true = make_dive("figure8", 5.0, "mti", _angles_deg(seed), seed, together=together)
            estimate = estimated(without(Log.from_frame(dive.log_frame), "fix"), config)
            (sd,) = (float(np.rad2deg(x.sd)) for x in estimate.calibration if x.label == "dvl_yaw")
            found.append((error_deg(mounting(estimate), true)["yaw"], sd))
        error, sds = np.array(found).T
        rms, sd = np.sqrt(np.mean(error**2)), np.sqrt(np.mean(sds**2))
        where = "at the inertial unit" if together else "where the Falcon has it"
        lines.append(f"| {where} | {seeds} | {rms:.2f} | {sd:.2f} | {np.mean((error / sds) ** 2):.2f} |")
    return "\n".join(lines)


def simulated(seeds: int, minutes: float, manoeuvres: Sequence[str], grades: Sequence[Grade], out: Path | None) -> str:
    """All dives, and the table of their rms errors; ``out`` keeps a row per dive and method as they come."""
    rows: list[Row] = []
    for seed, manoeuvre, grade in product(range(1, seeds + 1), manoeuvres, grades):
        rows += one_dive(manoeuvre, minutes, grade, seed)
        if out is not None:
            pd.DataFrame(rows).to_csv(out, index=False)
    return table(pd.DataFrame(rows))


def table(rows: pd.DataFrame) -> str:
    """Rms error of yaw, and of roll and pitch, of every method, a line per kind of dive."""
    methods = list(rows["method"].unique())
    header = ["dive", "imu", "fixes", "dives", *methods, "our sd"]
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for (minutes, fixes, manoeuvre, imu), group in rows.groupby(["minutes", "fixes", "manoeuvre", "imu"], sort=True):
        cells = []
        for method in methods:
            own = group[group["method"] == method]
            rms = {angle: float(np.sqrt(np.mean(np.square(own[angle])))) for angle in ("yaw", "roll", "pitch")}
            cells.append(f"**{rms['yaw']:.2f}** ({rms['roll']:.1f}, {rms['pitch']:.1f})")
        first = [f"{manoeuvre}, {minutes:g} min", imu, "yes" if fixes else "no", str(group["seed"].nunique())]
        sd = float(np.sqrt(np.mean(np.square(group["yaw_sd"].dropna()))))
        lines.append("| " + " | ".join([*map(str, first), *cells, f"{sd:.2f}"]) + " |")
    return "\n".join(lines)


def check() -> str:
    """What navlib finds where nothing is noisy: errors in degrees of a mounting turned by (3, -2, 30) degrees."""
    lines = ["| method | dive | roll | pitch | yaw |", "|---|---|---|---|---|"]
    for manoeuvre in ("figure8", "lawnmower"):
        dive, config, true = make_dive(manoeuvre, 3.0, "mti", (3.0, -2.0, 30.0), 1, noise=False)
        signal = signals(Log.from_frame(dive.log_frame), config, dive.truth, np.zeros(6))
        for method, R_bs in (("acc", signal.without_fixes()), ("jck", signal.with_fixes())):
            error = error_deg(R_bs, true)
            numbers = " | ".join(f"{error[angle]:.2f}" for angle in ("roll", "pitch", "yaw"))
            lines.append(f"| cal_dvl_{method}_so3 | {manoeuvre} | {numbers} |")
    return "\n".join(lines)


# -------------------------------------------------------------------- recorded


def with_positions(log: Log, reference: Trajectory) -> Log:
    """A log with the reference's positions as its fixes; both have the same origin."""
    data = np.column_stack([reference.p_n[:, :2], np.full(len(reference), np.nan)])
    fix = Stream("fix", ("fix_north", "fix_east", "fix_sd"), reference.time, data, np.arange(len(reference)) + 2)
    return replace(log, streams={**log.streams, "fix": fix})


def between(log: Log, begin: float, end: float) -> Log:
    """Part of a log."""
    streams = {}
    for name, stream in log.streams.items():
        streams[name] = stream.take((stream.time >= begin) & (stream.time <= end))
    return replace(log, streams=streams)


# What is believed beside the wide prior of the yaw
BELIEFS: dict[str, dict[str, Row]] = {
    "as configured": {},
    "offset of the AHRS held at 0": {"ahrs_offset": {"estimate": False}},
    "and no deviation curves": {
        name: {"estimate": False} for name in ("ahrs_offset", "ahrs_deviation", "dvl_compass_deviation")
    },
    "as configured, time offset and scale of the DVL estimated": {
        "dvl_time_offset": {"estimate": True, "sd": 0.3},
        "dvl_scale": {"estimate": True},
    },
    "as configured, roll and pitch of the DVL estimated": {
        name: {"estimate": True, "sd_deg": WIDE[name]} for name in ANGLES[:2]
    },
}


def recorded(folder: Path) -> str:
    """Yaw of the mounting of a recorded dive by all methods, for the whole of it and its halves."""
    config = load_config(folder / f"{folder.name}.yaml")
    log = read_log(folder / "log.csv.gz", config)
    log = with_positions(log, read_reference(folder / "reference.csv.gz"))
    begin, end = log["imu"].time[0], log["imu"].time[-1]
    middle = 0.5 * (begin + end)
    parts = {"all": (begin, end), "first half": (begin, middle), "second half": (middle, end)}
    cells: dict[tuple[str, str], list[str]] = {}
    for fixes, (begin, end) in product((True, False), parts.values()):
        part = between(log, begin, end)
        given, with_or = (part, "yes") if fixes else (without(part, "fix"), "no")
        for what, entries in BELIEFS.items():
            estimate = estimated(given, believing(config, **entries), ("dvl_yaw",))
            cells.setdefault((f"rovgraph, {what}", with_or), []).append(_estimated_yaw(estimate))
            if not entries:
                ours = estimate
        for what, signal in (("AHRS", from_ahrs(given, config)), ("our attitude", from_estimate(given, config, ours))):
            R_bs = signal.with_fixes() if fixes else signal.without_fixes()
            cells.setdefault((f"navlib, {what}", with_or), []).append(f"{_yaw_deg(R_bs, signal):.1f}")
    lines = ["| method | fixes | " + " | ".join(parts) + " |", "|---|---|" + "---|" * len(parts)]
    lines += ["| " + " | ".join([*key, *values]) + " |" for key, values in cells.items()]
    return "\n".join(lines)


def _yaw_deg(R_bs: Array, signals: Signals) -> float:
    """Yaw of a mounting beyond its nominal roll and pitch, of the way that the vehicle went most.

    A turn about that way is not shown by fixes, and must not pass for yaw.
    """
    roll, pitch, _ = signals.config.dvl.mount_rpy_deg
    way_s = signals.velocity_s.mean(axis=0)
    (x, y, _), (nominal_x, nominal_y, _) = R_bs @ way_s, mount_matrix((roll, pitch, 0.0)) @ way_s
    return float(np.rad2deg(np.arctan2(nominal_x * y - nominal_y * x, nominal_x * x + nominal_y * y)))


def _estimated_yaw(estimate: Estimate) -> str:
    (yaw,) = (entry for entry in estimate.calibration if entry.label == "dvl_yaw")
    return f"{np.rad2deg(yaw.value):.1f} ± {np.rad2deg(yaw.sd):.1f}"


def merge(log: Path, reference: Path, out: Path) -> str:
    """Write a log with the reference's positions in place of its own fixes."""
    own = ["fix_lat", "fix_lon", "fix_north", "fix_east", "fix_sd"]
    frame = pd.read_csv(log, low_memory=False).drop(columns=own, errors="ignore")
    track = read_reference(reference)
    fixes = pd.DataFrame({"time": track.time, "fix_north": track.p_n[:, 0], "fix_east": track.p_n[:, 1]})
    merged = pd.concat([frame, fixes], ignore_index=True).sort_values("time", kind="stable")
    merged.dropna(how="all", subset=[c for c in merged if c != "time"]).to_csv(out, index=False)
    return f"{out}: {len(fixes)} fixes"


def main(arguments: Sequence[str] | None = None) -> str:
    """Run one of the above and print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("check")
    simulation = commands.add_parser("simulated")
    simulation.add_argument("--seeds", type=int, default=20, help="dives of each kind")
    simulation.add_argument("--minutes", type=float, default=5.0)
    simulation.add_argument("--manoeuvres", nargs="+", default=["figure8", "lawnmower"])
    simulation.add_argument("--grades", nargs="+", default=["mti", "fog"])
    simulation.add_argument("--out", type=Path, help="a CSV file with a row per dive and method")
    commands.add_parser("arm").add_argument("--seeds", type=int, default=40, help="dives of each kind")
    commands.add_parser("recorded").add_argument("folder", type=Path)
    fixes = commands.add_parser("fixes")
    for name in ("log", "reference", "out"):
        fixes.add_argument(name, type=Path)
    chosen = parser.parse_args(arguments)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="navlib")  # of its optional parts
        if chosen.command == "check":
            text = check()
        elif chosen.command == "simulated":
            text = simulated(chosen.seeds, chosen.minutes, chosen.manoeuvres, chosen.grades, chosen.out)
        elif chosen.command == "arm":
            text = arm(chosen.seeds)
        elif chosen.command == "recorded":
            if not (chosen.folder / "log.csv.gz").exists():
                text = f"{chosen.folder}: no log.csv.gz there; the recorded dive is left out"
            else:
                text = recorded(chosen.folder.resolve())
        else:
            text = merge(chosen.log, chosen.reference, chosen.out)
    print(text, flush=True)
    return text


if __name__ == "__main__":
    main()
