"""Thrusters and drag as a measurement: what they must find, and what they must not be fooled by."""

from dataclasses import dataclass

import numpy as np
import pytest
from dives import altered, as_log, batch, changed, initial_conditions, kept, rms, same, without

from rovgraph.errors import InputError
from rovgraph.geometry import Array, exp_rotation, rotate
from rovgraph.inference.error_state import REINITIALISE_AT_S, replay
from rovgraph.inference.estimate import Estimate
from rovgraph.inference.initialise import initialise
from rovgraph.inference.smoother import BatchSmoother
from rovgraph.kernels.assembly import UPTO
from rovgraph.kernels.measurement_row import RATE, TIME
from rovgraph.lab.estimators import ESTIMATORS, outcomes, select
from rovgraph.log import Log, Stream
from rovgraph.model.config import Config
from rovgraph.model.state import POSE, State
from rovgraph.problem.admission import OLDEST_SIGNAL_S, PIECE_S
from rovgraph.problem.assembly import assembly_of
from rovgraph.sensors import ModelAiding, WaterVelocity
from rovgraph.sensors.instruments import hydrodynamics, instruments
from rovgraph.simulate import Choices, Dive, simulate
from rovgraph.simulate import simulated as simulated_dive
from rovgraph.simulate.driven import Steps, VelocityControl, World, drive
from rovgraph.simulate.environment import Sea
from rovgraph.simulate.named import lake

COEFFICIENTS = ("drag_linear", "drag_quadratic")
CURRENT = np.array([0.06, -0.04])
TRUE_DRAG = 1.25  # of what is believed
LOST = (77.0, 92.0)  # without bottom lock
BELIEVED_SD = 4e-3  # of the model's acceleration where there are no waves


@dataclass(frozen=True)
class Case:
    """A dive, its log, and what is believed."""

    dive: Dive
    log: Log
    config: Config

    def errors(self, estimate: Estimate) -> Array:
        """Horizontal error of the position, shape (n,) [m]."""
        time = np.minimum(estimate.trajectory.time, self.dive.path.duration)
        return np.linalg.norm((estimate.trajectory.p_n - self.dive.path.motion(time).p_n)[:, :2], axis=1)


def with_thrusters(config: Config, on: bool = True) -> Config:
    return changed(config, graph={"hydrodynamics": on})


@pytest.fixture(scope="module")
def still() -> Case:
    """Pushes on every axis in a current without waves, noise or biases, and a vehicle with more drag than believed."""
    calm = {"water_oscillation": {"estimate": False}}
    config = changed(lake(), vehicle={"acceleration_sd_mps2": BELIEVED_SD}, calibration=calm)
    drag = {name: [TRUE_DRAG * c for c in getattr(config.vehicle, name)] for name in COEFFICIENTS}
    world = World.drawn(changed(config, vehicle=drag), Choices(noise=False, dropouts=(LOST,)), 0)
    forces = np.array([[30, 0, 0, 0], [0, 90, 0, 0], [0, 0, 25, 0], [140, 0, 0, 40], [0, 220, 0, 0], [0, 0, 110, 0]])
    forces = np.vstack([forces, [90, 60, 0, 0]])  # without bottom lock
    station = np.array([0.0, 0.0, 8.0, 0.5])
    pilot = Steps(VelocityControl(world.vehicle), forces, station, rest=8.0, push=4.5, pause=3.0)
    sea = Sea(np.append(CURRENT, 0.0), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))
    path = drive(world.vehicle, sea, pilot, station, pilot.duration)
    dive = simulate(path, world.truth(path, sea, lake=False), np.random.default_rng(0))
    north, east, down = dive.truth.p_n[0]
    start = {"north_m": north, "east_m": east, "down_m": down, "position_sd_m": 0.01}
    return Case(dive, as_log(dive.log_frame), changed(with_thrusters(config), start=start))


@pytest.fixture(scope="module")
def graph(still: Case) -> BatchSmoother:
    return batch(still.log, still.config)


@pytest.fixture(scope="module")
def smoothed(graph: BatchSmoother) -> Estimate:
    return graph.solve()


def coefficients(estimate: Estimate) -> tuple[Array, Array]:
    """Relative changes of the six coefficients, and their sd."""
    rows = [c for c in estimate.calibration if c.label.startswith("drag")]
    return np.array([c.value for c in rows]), np.array([c.sd for c in rows])


def wanted(truth: dict[str, Array]) -> Array:
    return np.concatenate([truth[name] for name in COEFFICIENTS])


# thrusters


def model(rise: float = 0.12) -> ModelAiding:
    return ModelAiding(hydrodynamics(Config()), np.zeros(3), 9.81, rise)


def test_a_thruster_rises_from_ten_to_ninety_percent_in_its_time():
    time = np.linspace(0.0, 1.0, 1001)
    turning = model().turning(np.array([-1.0, 0.5]), np.array([[20.0, -5.0], [60.0, 0.0]]), time)
    np.testing.assert_allclose(turning[time <= 0.5], np.tile([20.0, -5.0], (501, 1)), atol=1e-9)
    part = (turning[:, 0] - 20.0) / 40.0
    assert np.ptp(time[(part > 0.1) & (part < 0.9)]) == pytest.approx(0.12, abs=3e-3)
    assert turning[-1] == pytest.approx([60.0, 0.0])


def test_without_a_rise_a_thruster_obeys_at_once():
    time = np.array([0.4, 0.49, 0.51, 0.9])
    turning = model(0.0).turning(np.array([-1.0, 0.5]), np.array([[20.0], [60.0]]), time)
    np.testing.assert_allclose(turning[:, 0], [20.0, 20.0, 60.0, 60.0])


def test_the_water_seen_from_the_vehicle_has_the_derivatives_of_its_differences():
    rng, h = np.random.default_rng(3), 1e-6
    zero = np.zeros((4, 3))
    calibration = {"current": np.array([0.2, -0.1])}
    state = State(exp_rotation(0.4 * rng.standard_normal((4, 3))), zero, zero, np.zeros((4, 6)), calibration)
    z, H = WaterVelocity().predict(state, zero)
    for variable, size in ((POSE, 6), ("current", 2)):
        for k in range(size):
            step = h * np.eye(size)[k]
            there = WaterVelocity().predict(state.retract(variable, step), zero)[0]
            np.testing.assert_allclose((there - z) / h, H[variable][..., k], atol=1e-6)


# the measurement


def at_truth(case: Case, graph: BatchSmoother) -> Array:
    """Measured less predicted specific force at the true motion, shape (n, 3) [m/s^2]."""
    attached = graph.problem.of_sensor("thruster")
    rows = graph.problem.rows[attached]
    motion = case.dive.path.motion(rows[:, TIME])
    arm = rotate(motion.R_nb, np.cross(motion.w_b, case.config.imu.lever_arm_m))
    truth = dict.fromkeys(COEFFICIENTS, np.full(3, TRUE_DRAG - 1.0))
    truth |= {"current": CURRENT, "water_oscillation": np.zeros(3)}
    state = State(motion.R_nb, motion.p_n, motion.v_n + arm, np.zeros((len(attached), 6)), truth)
    aiding = instruments(case.config, case.config.imu.lever_arm_m)["thruster"].model
    return graph.problem.z(attached, 3) - aiding.predict(state, rows[:, RATE : RATE + 3])[0]


def test_true_motion_explains_the_specific_force_also_while_it_turns_and_reverses(still, graph):
    """Nine pieces of ten to a tenth of what is believed of them, and all in the mean to a hundredth."""
    off = at_truth(still, graph)
    believed = Config().vehicle.acceleration_sd_mps2 * np.sqrt(5.6)
    assert np.abs(still.dive.path.motion(np.arange(0, 90, 0.1)).w_b).max() > 0.2
    assert np.all(np.quantile(np.abs(off), 0.9, axis=0) < 0.1 * believed)
    assert np.all(np.abs(off.mean(axis=0)) < 0.01 * believed)


def test_pieces_are_short_where_keyframes_are_far_apart_and_their_noise_is_that_of_their_length(graph):
    problem, pieces = graph.problem, graph.problem.of_sensor("thruster")
    count = np.bincount(problem.interval[pieces], minlength=len(problem))
    length = np.diff(problem.time) / np.maximum(count[1:], 1)
    assert (length <= PIECE_S + 1e-9).all()
    believed = BELIEVED_SD / np.sqrt(length[problem.interval[pieces] - 1])[:, None]
    np.testing.assert_allclose(problem.sd(pieces, 3), np.broadcast_to(believed, (len(pieces), 3)), rtol=1e-6)
    lost = (problem.time > LOST[0] + 2.0) & (problem.time < LOST[1])
    assert {*count[lost].tolist()} == {4}


# estimates


def test_drag_current_and_track_are_recovered_without_noise(still, graph, smoothed):
    found, _ = coefficients(smoothed)
    np.testing.assert_allclose(found, TRUE_DRAG - 1.0, atol=0.05)
    current = [c.value for c in smoothed.calibration if c.label.startswith("current")]
    np.testing.assert_allclose(current, CURRENT, atol=2e-3)
    assert still.errors(smoothed).max() < 0.05
    filtered = replay(graph.problem, graph.initial, REINITIALISE_AT_S).solve()
    np.testing.assert_allclose(coefficients(filtered)[0], TRUE_DRAG - 1.0, atol=0.1)


def test_graph_and_rts_smoother_agree(graph, smoothed):
    """To half an sd of the track and 10 percent of drag: one pass linearises with drag a quarter off."""
    rts = replay(graph.problem, graph.initial).smoothed()
    far = np.linalg.norm(rts.trajectory.p_n - smoothed.trajectory.p_n, axis=1)
    sd = np.sqrt(np.trace(smoothed.trajectory.cov_p, axis1=1, axis2=2))
    assert np.all(far < 0.5 * sd)
    np.testing.assert_allclose(coefficients(rts)[0], coefficients(smoothed)[0], atol=0.1 * TRUE_DRAG)


# logs that are not as they should be


def test_no_thrusters_or_too_few_are_refused_in_one_line(still):
    with pytest.raises(InputError, match="needs thruster signals, columns thruster_1") as error:
        initialise(without(still.log, "thruster"), still.config)
    assert "\n" not in str(error.value)
    old = still.log["thruster"]
    few = Stream("thruster", old.columns[:4], old.time, old.data[:, :4], old.row)
    log = Log(still.log.source, {**still.log.streams, "thruster": few})
    with pytest.raises(InputError, match=r"4 thruster columns, vehicle\.thrusters has 5"):
        initialise(log, still.config)


def test_signals_that_stop_or_start_late_are_left_out_and_counted(still):
    time = still.log["thruster"].time
    some = batch(kept(still.log, "thruster", (time > 10.0) & (time < 30.0)), still.config)
    used = some.problem.rows[some.problem.of_sensor("thruster"), TIME]
    assert 10.0 < used.min() < 11.0 and 29.0 < used.max() < 30.0 + OLDEST_SIGNAL_S
    reasons = {reason for sensor, reason in some.left_out if sensor == "thruster"}
    assert reasons == {"pieces before the first signal", f"pieces without a signal for {OLDEST_SIGNAL_S:g} s"}


def test_signals_of_a_whole_log_are_taken_as_those_that_come_one_by_one(still):
    whole, one = (assembly_of(initial_conditions(still.log, still.config)) for _ in range(2))
    whole.take(still.log)
    for measurement in still.log.measurements():
        one.insert(measurement)
        one.extend()
    for assembly in (whole, one):
        assembly.extend(finish=True)
        assembly.problem.keyframes[:, UPTO] = 0.0  # counts what never enters
    same(one.problem, whole.problem)
    assert whole.left_out == one.left_out


def test_without_hydrodynamics_signals_change_nothing(still):
    config = with_thrusters(still.config, on=False)
    noisy = altered(still.log, "thruster", 0.0 * still.log["thruster"].data + 50.0)
    start = initial_conditions(still.log, config)
    assert "thruster" not in start.instruments
    same(batch(still.log, config).problem, batch(noisy, config).problem)


# comparison


def test_estimators_with_hydrodynamics_share_nothing_with_those_without():
    chosen = select(["*-hydrodynamics"])
    assert [n.name for n in chosen] == ["ekf-hydrodynamics", "graph-smoothed-hydrodynamics"]
    dive, config = simulated_dive("docking", 1)
    log = as_log(dive.log_frame)
    assert chosen[0].task(log, config).config.graph.hydrodynamics
    assert not ESTIMATORS["ekf-a"].task(log, config).config.graph.hydrodynamics


# statistics: minutes


def calibrations(seeds: range) -> tuple[Array, Array, Array]:
    """Errors, sd and truth of graph and EKF after excited dives, shape (seeds, 2, 6)."""
    errors, sds, truths = [], [], []
    for seed in seeds:
        dive, config = simulated_dive("excited", seed)
        truth = wanted(dive.hidden["calibration"])
        pair = [
            coefficients(o.estimate)
            for o in outcomes(select(["*-hydrodynamics"]), as_log(dive.log_frame), config)
            if o.estimate is not None
        ]
        errors.append([value - truth for value, _ in pair])
        sds.append([sd for _, sd in pair])
        truths.append([truth, truth])
    return np.array(errors), np.array(sds), np.array(truths)


@pytest.mark.slow
def test_drag_after_an_excited_dive_is_within_ten_percent_and_its_interval_holds():
    error, sd, truth = calibrations(range(20))
    assert np.mean(np.abs(error) < 0.1 * (1.0 + truth)) >= 0.95
    assert np.all(np.mean(np.abs(error) < 1.96 * sd, axis=0) >= 0.9)


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "gap"), [("vattern", (120.0, 180.0)), ("excited", (150.0, 210.0))])
def test_a_minute_without_bottom_lock_costs_at_most_half(scenario, gap):
    names = ["ekf-a", "graph-smoothed-a", "ekf-hydrodynamics", "graph-smoothed-hydrodynamics"]
    ends = {name: [] for name in names}
    for seed in range(10):
        dive, config = simulated_dive(scenario, seed, choices=Choices(dropouts=(gap,)))
        case = Case(dive, as_log(dive.log_frame), config)
        for outcome in outcomes([ESTIMATORS[name] for name in names], case.log, config):
            assert outcome.estimate is not None
            at = int(np.searchsorted(outcome.estimate.trajectory.time, gap[1]))
            ends[outcome.named.name].append(case.errors(outcome.estimate)[at - 1])
    for kind in ("ekf", "graph-smoothed"):
        assert rms(np.array(ends[f"{kind}-hydrodynamics"])) < 0.5 * rms(np.array(ends[f"{kind}-a"]))
