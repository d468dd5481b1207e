"""How sharp smoothed dives are: under way with a fibre-optic gyro, with nonsense that has to be ignored, by a prior.

    python benchmarks/sharpness.py under-way --seeds 20
    python benchmarks/sharpness.py absent --seeds 20
    python benchmarks/sharpness.py scale --seeds 12
    python benchmarks/sharpness.py compass --seeds 6

Dives are those of `fault_campaign`. Figures are in benchmarks/README.md, those of `scale` and `compass` in
docs/uncertainty.md.
"""

import argparse
import warnings
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any
from unittest import mock

import numpy as np
import pandas as pd
from fault_campaign.campaign import make_dive, merge
from fault_campaign.cases import CASES, Case, silent
from fault_campaign.instruments import Streams, log_table
from fault_campaign.judge import SETTLED_S, Dive
from fault_campaign.motion import Motion
from fault_campaign.vehicle import Vehicle

from rovgraph.config import Config
from rovgraph.dive import smooth
from rovgraph.estimators import results
from rovgraph.geometry import rpy_from_matrix
from rovgraph.log import Log

UNDER_WAY = "FOG under way, DVL 1 Hz"
WRONG_S = {"dvl frozen": (80.0, 140.0), "dvl false lock": (90.0, 110.0)}  # when the pings of a case are wrong
OFF = "dvl sound speed 3 %"
HEALTHY = ("survey", "long survey", "transit", "tactical", "FOG", "hover")
PRIORS: dict[str, dict[str, Any]] = {
    "exact": {"estimate": False},
    **{str(sd): {"estimate": "considered", "sd": sd} for sd in (0.01, 0.02, 0.03)},
    "0.03, always estimated": {"estimate": True, "sd": 0.03},
}

OFF_DEG, DEVIATION_DEG, NOISE_DEG, TILT_DEG = 20.0, 1.5, 1.0, 0.5  # of a boat's compass, and of its roll and pitch
COMPASSES = {"5° and 3°": (5.0, 3.0), "10° and 5°, linear": None, "10° and 5°": None}  # sds that are stated


@dataclass(frozen=True)
class Errors:
    """Of the horizontal position: NEES per degree of freedom, stated variance, squared error [m^2], the end's [m]."""

    nees: float
    variance: float
    square: float
    end: float


def errors(dive: Dive, estimate: str = "smoothed", prior: dict[str, Any] | None = None) -> Errors:
    """A dive's, with another prior of the DVL's scale where one is given."""
    data = merge(dive.configuration, {"calibration": {"dvl_scale": prior}} if prior else {})
    log = Log.from_frame(log_table(dive.streams))
    track = smooth(log, Config.model_validate(data), estimate).estimates[0].trajectory
    later = track.time > SETTLED_S
    error, P = (track.p_n - dive.motion.local(track.time))[later, :2], track.cov_p[later, :2, :2]
    squares = np.einsum("ni,ni->n", error, np.linalg.solve(P, error[..., None])[..., 0])
    variance = float(np.trace(P, axis1=1, axis2=2).mean())
    return Errors(float(squares.mean()) / 2.0, variance, float((error**2).sum(1).mean()), float(np.hypot(*error[-1])))


def distance(dive: Dive) -> float:
    """[m]"""
    place = dive.motion.local(np.arange(0.0, dive.motion.duration, 0.1))
    return float(np.linalg.norm(np.diff(place, axis=0), axis=1).sum())


def without_wrong_pings(case: Case) -> Case:
    """The same dive in which the pings that are wrong are absent."""
    return replace(case, on_log=silent("dvl", *WRONG_S[case.name]))


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
    print("| prior sd of `dvl_scale` | 3 % off: NEES, sd, rms | " + " | ".join(f"{n}: sd, rms" for n in HEALTHY) + " |")
    print("|---" * (2 + len(HEALTHY)) + "|")
    for name, prior in PRIORS.items():
        cells = []
        for case in (OFF, *HEALTHY):
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
    parser.add_argument("what", choices=["under-way", "absent", "scale", "compass"])
    parser.add_argument("--seeds", type=int, default=20)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    {"under-way": under_way, "absent": absent, "scale": scale, "compass": compass}[given.what](given.seeds)


if __name__ == "__main__":
    main()
