"""How sharp smoothed dives are: beside another revision, under way with a fibre-optic gyro, with nonsense, by a prior.

    python benchmarks/sharpness.py healthy --seeds 3            beside a checkout of 07f9a06, which is made, and removed
    python benchmarks/sharpness.py healthy --base REVISION      beside another revision, or the checkout in a folder
    python benchmarks/sharpness.py under-way --seeds 20
    python benchmarks/sharpness.py noise --seeds 20
    python benchmarks/sharpness.py absent --seeds 20
    python benchmarks/sharpness.py scale --seeds 12
    python benchmarks/sharpness.py compass --seeds 6

Dives are those of `fault_campaign`. Figures are in benchmarks/README.md, those of `scale` and `compass` in
docs/uncertainty.md.
"""

import argparse
import json
import warnings
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

import numpy as np
import pandas as pd
from checkouts import ROOT, Checkout, checkout_of
from fault_campaign.campaign import make_dive, merge
from fault_campaign.cases import CASES, HEALTHY, Case, silent
from fault_campaign.instruments import Streams, log_table, sample
from fault_campaign.judge import SETTLED_S, Dive, nees, settled_rows, write_dive
from fault_campaign.motion import Motion
from fault_campaign.scenarios import make_motion
from fault_campaign.vehicle import Vehicle, configuration, make_vehicle
from scipy.stats import chi2

from rovgraph.dive import smooth
from rovgraph.geometry import rpy_from_matrix
from rovgraph.inference import estimate as results
from rovgraph.inference.trajectory import Trajectory
from rovgraph.log import Log
from rovgraph.model.config import Config

UNDER_WAY = "FOG under way, DVL 1 Hz"
WRONG_S = {"dvl frozen": (80.0, 140.0), "dvl false lock": (90.0, 110.0)}  # when the pings of a case are wrong
OFF = "dvl sound speed 3 %"
WITHOUT_FIXES = ("survey", "long survey", "transit", "tactical", "FOG", "hover")
BASE = "07f9a06"
MEDIAN, WORST = 1.1, 1.3  # times the sd of the base, at most
BUSY = 1.1  # times the processor time of the base, at most
STATED = (1.0, 3.0, 0.5)  # times the noise of a ping that `dvl.velocity_sd_mps` states
DRAWN = {"scale": 0.02, "tilt_deg": 2.0, "arm_m": 0.05}  # sds of what rovgraph considers by default
PRIORS: dict[str, dict[str, Any]] = {
    "exact": {"estimate": False},
    **{str(sd): {"estimate": "considered", "sd": sd} for sd in (0.01, 0.02, 0.03)},
    "0.03, always estimated": {"estimate": True, "sd": 0.03},
}

OFF_DEG, DEVIATION_DEG, NOISE_DEG, TILT_DEG = 20.0, 1.5, 1.0, 0.5  # of a boat's compass, and of its roll and pitch
COMPASSES = {"5° and 3°": (5.0, 3.0), "10° and 5°, linear": None, "10° and 5°": None}  # sds that are stated


@dataclass(frozen=True)
class Errors:
    """Of the horizontal position: NEES per degree of freedom, stated variance, squared error [m^2], the end's [m].

    And the heading's NEES.
    """

    nees: float
    heading: float
    variance: float
    square: float
    end: float


def errors(dive: Dive, estimate: str = "smoothed", prior: dict[str, Any] | None = None) -> Errors:
    """A dive's, with another prior of the DVL's scale where one is given."""
    data = merge(dive.configuration, {"calibration": {"dvl_scale": prior}} if prior else {})
    log = Log.from_frame(log_table(dive.streams))
    return errors_of(smooth(log, Config.model_validate(data), estimate).estimates[0].trajectory, dive)


def errors_of(track: Trajectory, dive: Dive) -> Errors:
    """A trajectory's."""
    later = track.time > SETTLED_S
    error, P = (track.p_n - dive.motion.local(track.time))[later, :2], track.cov_p[later, :2, :2]
    squares = np.einsum("ni,ni->n", error, np.linalg.solve(P, error[..., None])[..., 0])
    variance = float(np.trace(P, axis1=1, axis2=2).mean())
    turned = np.angle(np.exp(1j * (track.rpy[later, 2] - dive.motion.heading(track.time[later]))))
    heading = float((turned**2 / track.rpy_sd[later, 2] ** 2).mean())
    square, end = float((error**2).sum(1).mean()), float(np.hypot(*error[-1]))
    return Errors(float(squares.mean()) / 2.0, heading, variance, square, end)


def distance(dive: Dive) -> float:
    """[m]"""
    place = dive.motion.local(np.arange(0.0, dive.motion.duration, 0.1))
    return float(np.linalg.norm(np.diff(place, axis=0), axis=1).sum())


def without_wrong_pings(case: Case) -> Case:
    """The same dive in which the pings that are wrong are absent."""
    return replace(case, on_log=silent("dvl", *WRONG_S[case.name]))


@dataclass(frozen=True)
class Smoothed:
    """A dive by the command of some checkout: stated variance and squared error [m^2], NEES, verdict, time [s]."""

    variance: float
    square: float
    nees: float
    verdict: str
    processor: float


def smoothed(checkout: Checkout, dive: Dive, folder: Path) -> Smoothed:
    """The dive in ``folder``, by `rovgraph smooth` without figures."""
    log, config, out = (folder / part for part in ("log.csv", "vehicle.yaml", "out"))
    cost = checkout.rovgraph("smooth", log, "--config", config, "--out", out, "--force", "--no-figures")
    track = pd.read_csv(out / "trajectory_smoothed.csv")
    values, rms, sd = nees(settled_rows(track, dive), dive.motion)
    verdict = json.loads((out / "summary.json").read_text(encoding="utf-8"))["verdict"]
    return Smoothed(sd**2, rms**2, values["position"], verdict, cost.processor)


def healthy(seeds: int, base: str) -> None:
    """Sds, errors and processor time of the campaign's healthy dives, beside those of another checkout."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        root = Path(base).resolve() if Path(base).is_dir() else stack.enter_context(checkout_of(base))
        checkouts = [Checkout(root, ""), Checkout(ROOT, "")]
        for checkout in checkouts:
            checkout.compile()
        print(f"| case | sd at {base} [m] | sd now | ratio | rms | rms now | NEES now | doubted | processor time |")
        print("|---" * 9 + "|")
        ratios, total = {}, np.zeros(2)
        for case in (case for case in HEALTHY if not case.second_file):
            rows = []
            for seed in range(seeds):
                dive = make_dive(case, seed)
                write_dive(dive, folder)
                rows.append([smoothed(checkout, dive, folder) for checkout in checkouts])
            then, now = zip(*rows, strict=True)
            sds, rms = ([_root_mean(part, of) for of in (then, now)] for part in ("variance", "square"))
            times = np.array([sum(row.processor for row in of) for of in (then, now)])
            ratios[case.name], total = sds[1] / sds[0], total + times
            doubted = " → ".join(f"{sum(row.verdict != 'trusted' for row in of)}" for of in (then, now))
            cells = [case.name, f"{sds[0]:.3g}", f"{sds[1]:.3g}", f"{ratios[case.name]:.2f}", f"{rms[0]:.3g}"]
            cells += [f"{rms[1]:.3g}", f"{np.mean([row.nees for row in now]):.2f}", doubted]
            print("| " + " | ".join([*cells, f"{times[1] / times[0]:.2f}"]) + " |", flush=True)
    worst = max(ratios, key=lambda name: ratios[name])
    middle = float(np.median([*ratios.values()]))
    print(
        f"\nsd {middle:.2f} times in the median (at most {MEDIAN}), {ratios[worst]:.2f} times in the worst, {worst} "
        f"(at most {WORST}); processor time {total[1] / total[0]:.2f} times (at most {BUSY})."
    )


def _root_mean(part: str, rows: Sequence[Smoothed]) -> float:
    return float(np.sqrt(np.mean([getattr(row, part) for row in rows])))


def drawn_dive(seed: int, stated: float) -> Dive:
    """`UNDER_WAY` with a DVL whose scale, mounting and place are drawn, and ``stated`` times its noise stated."""
    rng, case = np.random.default_rng([4, seed]), CASES[UNDER_WAY]
    motion, vehicle = make_motion(case.scenario, rng), make_vehicle(case.grade, case.aids)
    vehicle.dvl.rate = 1.0
    config = merge(configuration(vehicle), {"dvl": {"velocity_sd_mps": [stated * sd for sd in vehicle.dvl.sd]}})
    config["start"] |= dict(zip(("north_m", "east_m"), rng.normal(0.0, 0.1, 2).tolist(), strict=True))
    roll, pitch, yaw = vehicle.dvl.mount_rpy_deg  # the yaw is drawn in any case
    vehicle.dvl.mount_rpy_deg = (*(np.array([roll, pitch]) + rng.normal(0.0, DRAWN["tilt_deg"], 2)), yaw)
    vehicle.dvl.arm = np.asarray(vehicle.dvl.arm) + rng.normal(0.0, DRAWN["arm_m"], 3)
    vehicle.dvl.scale = rng.normal(0.0, DRAWN["scale"])
    streams, hidden = sample(motion, vehicle, rng)
    return Dive(streams, config, motion, hidden)


def noise(seeds: int) -> None:
    """NEES of dives under way with a drawn DVL whose noise is stated right, too large and too small."""
    print("| noise stated | estimate | NEES position, at most | NEES heading, at most | sd [m] | rms [m] |")
    print("|---" * 6 + "|")
    for stated in STATED:
        found: dict[str, list[Errors]] = {"smoothed": [], "filtered": []}
        for seed in range(seeds):
            dive = drawn_dive(seed, stated)
            estimates = smooth(
                Log.from_frame(log_table(dive.streams)), Config.model_validate(dive.configuration), "both"
            ).estimates
            for estimate in estimates:
                if estimate.kind in found:
                    found[estimate.kind].append(errors_of(estimate.trajectory, dive))
        for kind, rows in found.items():
            both = ([getattr(r, part) for r in rows] for part in ("nees", "heading"))
            cells = [f"{np.mean(values):.2f}, {max(values):.1f}" for values in both]
            cells += [f"{np.sqrt(np.mean([getattr(r, part) for r in rows])):.2f}" for part in ("variance", "square")]
            print("| " + " | ".join([f"{stated:g} times", kind, *cells]) + " |", flush=True)
    low, high = chi2.ppf([0.005, 0.995], 2 * seeds) / (2 * seeds)
    print(f"\nIn 99 of 100 campaigns the mean NEES of an honest position is within {low:.2f} and {high:.2f}.")


def under_way(seeds: int) -> None:
    """End errors, as a part of the distance, and NEES."""
    dives = [make_dive(CASES[UNDER_WAY], seed) for seed in range(seeds)]
    for estimate in ("smoothed", "filtered"):
        found = [errors(dive, estimate) for dive in dives]
        ends = [one.end / distance(dive) for one, dive in zip(found, dives, strict=True)]
        nees = np.mean([one.nees for one in found])
        print(f"{estimate}: end error {np.median(ends):.3%} of the distance, at most {max(ends):.3%}; NEES {nees:.2f}")


def absent(seeds: int) -> None:
    """Errors with wrong pings, beside those where they are absent."""
    for name in WRONG_S:
        case, rms = CASES[name], []
        for one in (case, without_wrong_pings(case)):
            squares = [errors(make_dive(one, seed)).square for seed in range(seeds)]
            rms.append(float(np.sqrt(np.mean(squares))))
        print(f"{name}: {rms[0]:.2f} m rms, with those pings absent {rms[1]:.2f} m: {rms[0] / rms[1]:.2f} times")


def scale(seeds: int) -> None:
    """Tracks by the prior of the scale; of healthy dives a quarter as many."""
    print(
        "| prior sd of `dvl_scale` | 3 % off: NEES, sd, rms | "
        + " | ".join(f"{n}: sd, rms" for n in WITHOUT_FIXES)
        + " |"
    )
    print("|---" * (2 + len(WITHOUT_FIXES)) + "|")
    for name, prior in PRIORS.items():
        cells = []
        for case in (OFF, *WITHOUT_FIXES):
            count = seeds if case == OFF else max(seeds // 4, 1)
            rows = [errors(make_dive(CASES[case], seed), prior=prior) for seed in range(count)]
            sd, rms = (np.sqrt(np.mean([getattr(r, part) for r in rows])) for part in ("variance", "square"))
            nees = f"{np.mean([r.nees for r in rows]):.1f}, " if case == OFF else ""
            cells.append(f"{nees}{sd:.2f}, {rms:.2f}")
        print("| " + " | ".join([name, *cells]) + " |", flush=True)


def compass(seeds: int) -> None:
    """A boat whose only compass is off, without fixes, by the prior of its compass."""
    cases = [boat(scenario, imu) for scenario in ("river", "river with turns") for imu in (False, True)]
    print("| prior | " + " | ".join(f"{case.name}: NEES, sd, rms" for case in cases) + " |")
    print("|---" * (1 + len(cases)) + "|")
    for name, stated in COMPASSES.items():
        linear = mock.patch.object(results, "rests_on_doubtful_compass", return_value=False)
        cells = []
        with linear if "linear" in name else nullcontext():
            for case in cases:
                rows = [errors(_with_priors(make_dive(case, seed), stated)) for seed in range(seeds)]
                sd, rms = (np.sqrt(np.mean([getattr(r, part) for r in rows])) for part in ("variance", "square"))
                cells.append(f"{np.mean([r.nees for r in rows]):.1f}, {sd:.1f}, {rms:.1f}")
        print("| " + " | ".join([name, *cells]) + " |", flush=True)


def boat(scenario: str, imu: bool) -> Case:
    """A boat of which only the sensors' noise is stated, not its compass."""
    source, noise = ("ahrs", "ahrs_sd_deg") if imu else ("vehicle", "vehicle_sd_deg")
    unstated = {f"ahrs_{what}": {"sd_deg": None} for what in ("offset", "deviation")}
    config = {
        "heading": {"sources": [source], noise: NOISE_DEG},
        "tilt": {"sd_deg": TILT_DEG},
        "calibration": {**unstated, "dvl_yaw": {"estimate": "considered", "sd_deg": 1.0}},
    }
    name = f"{scenario}, {'IMU' if imu else 'no IMU'}"
    on_log = None if imu else _without_imu
    return Case(name, "compass off", scenario=scenario, on_vehicle=_off, on_log=on_log, config=config, dvl_rate=2.0)


def _off(vehicle: Vehicle) -> None:
    compass, vehicle.dvl.yaw_sd = vehicle.ahrs, 1.0
    compass.offset, compass.offset_sd, compass.curve_sd, compass.sd = OFF_DEG, 0.0, DEVIATION_DEG, NOISE_DEG


def _without_imu(streams: Streams, motion: Motion, rng: np.random.Generator) -> None:
    """The vehicle's own attitude in place of the unit and its heading."""
    del streams["imu"]
    ahrs = streams.pop("ahrs").iloc[::5]
    tilt = rpy_from_matrix(motion.C_nb(ahrs["time"].to_numpy()))[:, :2]
    tilt += np.deg2rad(rng.normal(0.0, TILT_DEG, tilt.shape))
    streams["vehicle"] = pd.DataFrame(
        {"time": ahrs["time"], "heading": ahrs["ahrs_yaw"], "roll": tilt[:, 0], "pitch": tilt[:, 1]}
    )


def _with_priors(dive: Dive, stated: tuple[float, float] | None) -> Dive:
    """The dive with sds of the compass's offset and deviation in its configuration."""
    if stated is None:
        return dive
    sds = zip(("offset", "deviation"), stated, strict=True)
    own = {f"{prefix}_{what}": {"sd_deg": sd} for what, sd in sds for prefix in ("ahrs", "vehicle_compass")}
    return replace(dive, configuration=merge(dive.configuration, {"calibration": own}))


def main() -> None:
    """Run one of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["healthy", "under-way", "noise", "absent", "scale", "compass"])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--base", default=BASE, help="revision, or folder of a checkout, to compare healthy dives with")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    if given.what == "healthy":
        healthy(given.seeds, given.base)
    else:
        runs = {"under-way": under_way, "noise": noise, "absent": absent, "scale": scale, "compass": compass}
        runs[given.what](given.seeds)


if __name__ == "__main__":
    main()
