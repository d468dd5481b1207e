"""A sensor of your own: ranges to an acoustic beacon whose place is known.

Register it, and simulator, checks, filters and smoother know it. Here half a minute without bottom lock is bridged with
and without the ranges. docs/own-sensor.md explains each part. Writes own_sensor.png.
"""

from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np

import rovgraph as rg
from rovgraph import extend
from rovgraph.extend import BIAS, POSE, VELOCITY, Array, Instrument, Jacobians, State

BEACON_N = np.array([5.0, 12.0, 8.0])  # north, east, down [m]


@dataclass(frozen=True)
class BeaconRange:
    """z = |p_n - beacon|, the transducer in the body's origin."""

    sensor = "beacon"
    dim = 1
    angular = False
    state = (POSE, VELOCITY, BIAS)  # velocity and bias: through the motion from a keyframe to its time
    calibration = ()

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        away = state.p_n - BEACON_N
        distance = np.linalg.norm(away, axis=1, keepdims=True)
        by_position = np.einsum("ni,nij->nj", away / distance, state.R_nb)  # a position is perturbed in body axes
        by_pose = np.concatenate([np.zeros_like(by_position), by_position], axis=1)
        return distance, {POSE: by_pose[:, None]}


def instrument(config: rg.Config, origin_b: Array) -> Instrument:
    own = extend.settings(config, "beacon")
    return extend.instrument(own, BeaconRange(), own.sd, ("range",))


extend.register(
    extend.Sensor(
        name="beacon",
        columns=(extend.Column("beacon", "length"),),
        instrument=instrument,
        observes=extend.Observed("position", (0, 1)),
        may_begin_later=True,
        simulated_hz=1.0,
    )
)
config = rg.parse_config("sensors: {beacon: {sd: 0.1}}")  # after the registration
dive = rg.simulate("square", config, seed=2, choices=rg.Choices(duration=120, dropouts=((60, 90),)))

figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
axes.plot(dive.truth.position[:, 1], dive.truth.position[:, 0], "k", linewidth=0.8, label="truth")
without = rg.Log.from_frame(dive.dive.log_frame.drop(columns="beacon"), dive.config)
for name, log in (("without", without), ("with", dive.log)):
    track = rg.smooth(log, dive.config, estimate="smoothed").smoothed.trajectory
    metrics = rg.evaluate(track, dive.truth)
    print(f"{name} ranges: {metrics.rms_m:.2f} m rms, largest sd {track.p_sd[:, :2].max():.2f} m")
    axes.plot(track.position[:, 1], track.position[:, 0], label=f"{name} ranges: {metrics.rms_m:.2f} m rms")
axes.plot(BEACON_N[1], BEACON_N[0], "r^", label="beacon")
axes.set(xlabel="east [m]", ylabel="north [m]", aspect="equal", title="Half a minute without bottom lock")
axes.legend()
figure.savefig("own_sensor.png", dpi=150)
