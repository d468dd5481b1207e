"""The chain of keyframes and GTSAM's graph are the same problem: the same optimum, and the same certainty."""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from dives import altered, batch, below_a_ship, by_beams, changed, falcon, interrupted, simulated, started

from rovgraph.geometry import Array, log_rotation, transpose
from rovgraph.inference import chain_optimum, gauss_newton
from rovgraph.inference.chain import ChainStep
from rovgraph.inference.chain_optimum import ChainOptimum, smooth_chain
from rovgraph.inference.dead_reckoning import dead_reckon
from rovgraph.inference.graph.batch import make_values
from rovgraph.inference.graph.optimum import GraphOptimum
from rovgraph.inference.graph.places import smooth_graph
from rovgraph.inference.optimum import Optimum
from rovgraph.log import STREAMS, Log, Stream
from rovgraph.log.companions import usable_cells
from rovgraph.model.calibration import BEAM_SENSORS, LAYERS, TABLE
from rovgraph.model.config import Config, beliefs
from rovgraph.model.state import BIAS, POSE, VELOCITY
from rovgraph.problem.layers import window_changes
from rovgraph.sensors import SENSORS
from rovgraph.simulate import Style, Waves, lake
from rovgraph.simulate import simulated as driven
from rovgraph.simulate.files import write_log

EXACT = 1e-10  # decrease of the cost that is left when both stop here
# these measure nothing of the vehicle, or where there is no IMU, or have a dive or tests of their own
UNUSED = "dvl_altitude", "vehicle_tilt", "ship", "ship_heading", "ship_tilt", "usbl", "range", "dvl_beams", "dvl_sound"
UNUSED += "pressure", "adcp", "water_layer"
SHORT = {"dvl_rate": 3.0, "imu_rate": 50.0}
WILD = Style(waves=Waves(heave=0.2, roll=0.4, pitch=0.35))


def estimated(*names: str, **others) -> dict:
    return {"calibration": {name: {"estimate": True} for name in names} | others}


Case = tuple[Log, Config]


def both_compasses() -> Case:
    case = simulated(falcon(**estimated("dvl_yaw")), 60.0, seed=6, **SHORT)
    return case.log, case.config


def walking() -> Case:
    config = falcon(**estimated("dvl_yaw", mag_offset={"estimate": True, "walk_deg": 0.1}))
    case = simulated(config, 60.0, seed=2, **SHORT)
    return case.log, case.config


def lasting() -> Case:
    errors = {name: {"estimate": True} for name in ("dvl_compass_error", "fix_error")}
    config = falcon(calibration=errors | {"dvl_error": {"estimate": True, "mean": 0.01, "time_constant_s": 5.0}})
    case = simulated(config, 45.0, seed=2, fix_interval=2.0, dvl_rate=1.5, imu_rate=50.0)
    return case.log, case.config


def scales() -> Case:
    config = falcon(calibration={n: {"estimate": True, "sd": 0.01} for n in ("acc_scale", "gyr_scale")})
    case = simulated(config, 50.0, seed=2, style=WILD, **SHORT)
    return case.log, case.config


def time_offset() -> Case:
    others = {name: {"estimate": False} for name in TABLE if name not in LAYERS}
    config = falcon(calibration=others | {"dvl_time_offset": {"estimate": True, "sd": 0.1}})
    case = simulated(config, 45.0, seed=2, calibration={"dvl_time_offset": np.array([0.1])}, **SHORT)
    return case.log, started(case)


def outage() -> Case:
    case = simulated(falcon(), 60.0, seed=4, **SHORT)
    return interrupted(case.log, 40.0, 1.6, "imu"), changed(case.config, imu={"max_gap_s": 5.0})


def outliers() -> Case:
    case = simulated(falcon(**estimated("dvl_yaw")), 60.0, seed=7, **SHORT)
    data = case.log["dvl"].data.copy()
    data[20::17, 0] += 1.0
    return altered(case.log, "dvl", data), case.config


def padded(values: Array, columns: int) -> Array:
    return np.pad(values, ((0, 0), (0, columns - values.shape[1])), constant_values=np.nan)


def every_sensor() -> Case:
    """All that may be in use beside an IMU, but places, for 20 s."""
    made, config = driven("excited", 1, lake())
    log, rng = Log.from_frame(made.log_frame[made.log_frame["time"] <= 20.0]), np.random.default_rng(3)
    ahrs, dvl, truth = log["ahrs"], log["dvl"], made.truth
    time = truth.time[(truth.time > 1.0) & (truth.time < 19.0)][:: len(truth.time) // 90]
    p_n = truth.p_n[truth.time.searchsorted(time)]
    noise = np.array([0.5, 0.7, 0.3])  # of fixes: sds of north and east, covariance
    L = np.linalg.cholesky([[noise[0] ** 2, noise[2]], [noise[2], noise[1] ** 2]])
    fixes = np.column_stack([p_n[:, :2] + rng.standard_normal((len(time), 2)) @ L.T, np.tile(noise, (len(time), 1))])
    own = {
        "fix": (time, fixes),
        "vehicle_heading": (ahrs.time, ahrs.data[:, :1] + 0.03 * rng.standard_normal((len(ahrs.time), 1))),
        "dvl_water": (dvl.time, dvl.data[:, :3] + 0.03 * rng.standard_normal((len(dvl.time), 3))),
    }
    more = {s: Stream(s, STREAMS[s], t, padded(z, len(STREAMS[s])), np.arange(len(t))) for s, (t, z) in own.items()}
    config = changed(config, graph={"hydrodynamics": True}, heading={"sources": ["mag", "dvl", "ahrs", "vehicle"]})
    return Log(log.source, {**log.streams, **more}), config


def acoustic() -> Case:
    log, config = below_a_ship()
    exact = {name: {"estimate": False} for name, variable in TABLE.items() if variable.considered}
    return log, config.changed(calibration=exact)


def beams() -> Case:
    exact = {name: {"estimate": False} for name, variable in TABLE.items() if variable.considered}
    config = falcon(
        **estimated(**exact | {n: {"estimate": True} for n in ("dvl_yaw", "dvl_scale", "dvl_beam_2_angle")})
    )
    case = simulated(config, 45.0, seed=6, **SHORT)
    return by_beams(case.log, case.config)


def layers(knots: int) -> Case:
    """A descent without bottom lock, through several windows of the current's knots."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
    import water
    from fault_campaign.instruments import log_table

    setting = water.Setting(water.Profiler(3, 4.0, 4.0), surface_s=8.0, depth=45.0)
    dive, table = water.make_dive(setting, 1)
    exact = {name: {"estimate": False} for name, variable in TABLE.items() if variable.considered}
    config = changed(Config.model_validate(dive.configuration), water={"knots": knots}, calibration=exact)
    cells = usable_cells({name: table[name].to_numpy() for name in table}, config, "adcp")
    return Log.from_frame(log_table(dive.streams), config).with_profiles(cells), config


SCENARIOS: dict[str, Callable[[], Case]] = {
    "both compasses and misalignment": both_compasses,
    "calibration that walks": walking,
    "errors that last": lasting,
    "scales of the IMU": scales,
    "time offset of the DVL": time_offset,
    "IMU outage": outage,
    "outliers": outliers,
    "every sensor but places": every_sensor,
    "acoustic positioning": acoustic,
    "beams of the DVL": beams,
    "layers of the water": partial(layers, 3),
    "one layer of the water": partial(layers, 1),
}


@pytest.fixture(scope="module", params=SCENARIOS, ids=lambda name: name.replace(" ", "_"))
def solved(request) -> tuple[ChainOptimum, GraphOptimum]:
    """A dive, solved by both until neither moves any more."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gauss_newton, "FINE", EXACT)
        patch.setattr(gauss_newton, "FINAL_TOLERANCE", EXACT)
        dive = batch(*SCENARIOS[request.param]())
        b = dive.initial
        states = dead_reckon(dive.problem, b, {name: belief.mean for name, belief in beliefs(b.config).items()})
        both = smooth_chain(dive.problem, b, states), smooth_graph(dive.problem, b, states)
    assert IS_SO[request.param](both[0]), "the scenario is not what it is called"
    return both


IS_SO: dict[str, Callable[[ChainOptimum], bool]] = {
    "every sensor but places": lambda best: {*best.blocks} == {*SENSORS} - {"imu", "place", *UNUSED, *BEAM_SENSORS},
    "acoustic positioning": lambda best: {"usbl", "range"} <= set(best.blocks),
    "beams of the DVL": lambda best: (
        {f"dvl_beam_{k}" for k in range(4)} <= set(best.blocks) and "dvl" not in best.blocks
    ),
    "both compasses and misalignment": lambda best: {"mag", "dvl_heading"} <= set(best.blocks),
    "calibration that walks": lambda best: best.chain.layout.d > 15,
    "errors that last": lambda best: len(best.chain.unknowns.time_constants) == 3,
    "scales of the IMU": lambda best: {"acc_scale", "gyr_scale"} <= set(best.unknowns.estimated),
    "time offset of the DVL": lambda best: "dvl_time_offset" in best.unknowns.estimated,
    "IMU outage": lambda best: best.problem.coasted.any(),
    "layers of the water": lambda best: LAYERS[2] in best.unknowns.estimated and len(window_changes(best.problem)) > 2,
    "one layer of the water": lambda best: "current" in best.unknowns.walks and len(window_changes(best.problem)) > 5,
    "outliers": lambda best: 5 < int((~best.solution.gates["dvl"]).sum()) < 20,
}


def sds(best: Optimum) -> dict[str, Array]:
    return {name: np.sqrt(np.diagonal(P, axis1=1, axis2=2)) for name, P in best.covariances().items()}


def test_both_come_to_the_same_cost(solved):
    chain, graph = solved
    assert isinstance(chain, ChainOptimum) and isinstance(graph, GraphOptimum)
    assert chain.solution.converged and graph.solution.converged
    assert chain.solution.cost == pytest.approx(graph.solution.cost, rel=1e-6)
    for sensor, gate in graph.solution.gates.items():
        np.testing.assert_array_equal(chain.solution.gates[sensor], gate)


def test_an_elimination_of_which_the_diagonal_is_kept_is_as_likely(solved):
    chain, state, gates = solved[0].chain, solved[0].state, solved[0].solution.gates
    whole, diagonal = chain.eliminate(state, gates), chain.eliminate(state, gates, diagonal=True)
    assert (whole.log_determinant(), whole.least()) == (diagonal.log_determinant(), diagonal.least())


def test_both_come_to_the_same_states(solved):
    chain, graph = solved
    a, b, known = chain.state, graph.state, sds(graph)
    np.testing.assert_allclose(a.p_n, b.p_n, atol=1e-6)
    np.testing.assert_allclose(a.v_n, b.v_n, atol=1e-6)
    assert np.abs(log_rotation(transpose(a.R_nb) @ b.R_nb)).max() < 1e-6
    for name in chain.unknowns.estimated:
        assert (np.abs(a.calibration[name] - b.calibration[name]) < 1e-3 * known[name]).all(), name
    assert (np.abs(a.bias - b.bias) < 1e-3 * known[BIAS]).all()


def test_the_last_step_leaves_next_to_nothing_and_covariances_are_those_of_where_it_led():
    dive = batch(*both_compasses())
    best = dive.optimum()
    anew = ChainOptimum(best.chain, best.solution)
    assert best.begun is not None and anew.eliminated().explained() < 1e-3
    assert best.chain.cost(best.state, best.solution.gates) < best.chain.cost(best.begun, best.solution.gates)
    for variable in (POSE, VELOCITY, BIAS):
        np.testing.assert_allclose(sds(anew)[variable], sds(best)[variable], rtol=1e-3)


def test_covariances_of_a_long_dive_are_made_again_and_those_of_a_short_one(monkeypatch):
    dive = batch(*both_compasses())
    short = dive.optimum()
    monkeypatch.setattr(chain_optimum, "SHORT", 10)
    long = dive.optimum()
    expected = sds(short)[POSE]
    for _ in range(2):
        np.testing.assert_allclose(sds(long)[POSE], expected, rtol=1e-12)
        assert long.at_hand is None, "of a long dive it is large"
    again = ChainOptimum(long.chain, long.solution, long.begun)
    assert again.linear == pytest.approx(short.linear, rel=1e-12) and again.at_hand is None
    np.testing.assert_allclose(again.newest_covariance(), short.newest_covariance(), rtol=1e-9, atol=1e-15)
    assert again.at_hand is None


def test_what_is_estimated_or_considered_afterwards_is_as_if_it_had_been_from_the_beginning():
    considered = {"dvl_pitch": {"estimate": "considered", "sd_deg": 1.0}}
    case = simulated(falcon(calibration=considered), 60.0, seed=4, **SHORT)
    b = batch(case.log, case.config)
    states = dead_reckon(b.problem, b.initial, {n: belief.mean for n, belief in beliefs(b.initial.config).items()})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gauss_newton, "FINE", EXACT)
        patch.setattr(gauss_newton, "FINAL_TOLERANCE", EXACT)
        held = smooth_chain(b.problem, b.initial, states)
        assert held.unknowns.considered == ("dvl_pitch",)
        found = held.estimating(["dvl_pitch"])
        exact = replace(held.chain, unknowns=found.unknowns)
        alone = gauss_newton.minimise(exact, exact.start(states, None))
        np.testing.assert_allclose(found.state.p_n, alone.point.p_n, atol=1e-5)
        assert found.solution.cost == pytest.approx(alone.cost, rel=1e-9)
        assert abs(found.state.calibration["dvl_pitch"][0]) > 1e-4
        again = found.considering(["dvl_pitch"])
    np.testing.assert_allclose(again.state.p_n, held.state.p_n, atol=1e-5)
    np.testing.assert_allclose(again.state.calibration["dvl_pitch"], 0.0, atol=1e-15)
    np.testing.assert_allclose(sds(again)[POSE], sds(held)[POSE], rtol=1e-6)


def test_both_know_them_equally_well(solved):
    chain, graph = solved
    mine, other = sds(chain), sds(graph)
    for variable in (POSE, VELOCITY, BIAS, *chain.unknowns.estimated):
        np.testing.assert_allclose(mine[variable], other[variable], rtol=1e-4, err_msg=variable)
    a, b = chain.newest_covariance(), graph.newest_covariance()
    sd = np.sqrt(np.diag(b))
    np.testing.assert_allclose(a / np.outer(sd, sd), b / np.outer(sd, sd), atol=1e-4)


def test_both_weigh_the_measurements_alike(solved):
    chain, graph = solved
    assert set(chain.weights) == set(graph.weights)
    for sensor, weight in graph.weights.items():
        np.testing.assert_allclose(chain.weights[sensor], weight, atol=1e-4)


def test_both_say_the_same_of_the_calibration_as_the_dive_goes_on(solved):
    chain, graph = solved
    end = len(chain.problem) - 1
    keyframes = [end // 3, 2 * end // 3, end]
    a, b = chain.knowledge(keyframes), graph.knowledge(keyframes)
    assert a.keyframe.tolist() == b.keyframe.tolist() == keyframes
    for mine, other in zip(a.covariance, b.covariance, strict=True):
        sd = np.sqrt(np.diag(other))
        np.testing.assert_allclose(mine / np.outer(sd, sd), other / np.outer(sd, sd), atol=1e-4)


@pytest.mark.slow
def test_noise_of_the_states_adds_as_much_information_to_both(solved):
    """The draws differ: so the mean of some is compared, to what a draw of them may differ by."""
    chain, graph = solved
    end = [len(chain.problem) - 1]
    sd = np.sqrt(np.diag(graph.knowledge(end).calibration[0]))

    def gained(best: Optimum) -> Array:
        known = [P for seed in range(1, 5) for P in best.noisier(end, seed)]
        return np.array([np.sqrt(np.diag(k.calibration[0])) / sd for k in known])

    a, b = gained(chain), gained(graph)
    allowed = 5.0 * np.sqrt((a.var(axis=0) + b.var(axis=0)) / len(a)) + 1e-3
    assert (np.abs(a.mean(axis=0) - b.mean(axis=0)) < allowed).all()


@pytest.mark.slow
def test_both_move_alike_when_a_constant_is_considered(solved):
    chain, _ = solved
    constant = [name for name, walk in chain.unknowns.walks.items() if not walk]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gauss_newton, "FINE", EXACT)
        patch.setattr(gauss_newton, "FINAL_TOLERANCE", EXACT)
        a, b = (best.considering(constant[:1]) for best in solved)
        again = [one.estimating(constant[:1]) for one in (a, b)]
    assert a.solution.cost == pytest.approx(b.solution.cost, rel=1e-6)
    np.testing.assert_allclose(a.state.p_n, b.state.p_n, atol=1e-5)
    mine, other = sds(a), sds(b)
    for variable in (POSE, VELOCITY, BIAS, *a.unknowns.estimated, *constant[:1]):
        np.testing.assert_allclose(mine[variable], other[variable], rtol=1e-3, err_msg=variable)
    (P, Q), sd = (one.newest_covariance() for one in (a, b)), np.sqrt(np.diag(b.newest_covariance()))
    np.testing.assert_allclose(P / np.outer(sd, sd), Q / np.outer(sd, sd), atol=2e-3)
    (name,) = constant[:1]
    np.testing.assert_allclose(a.relative_sd()[name], b.relative_sd()[name], rtol=1e-3)
    for one, before in zip(again, solved, strict=True):
        np.testing.assert_allclose(one.state.p_n, before.state.p_n, atol=1e-4)
        assert set(one.unknowns.estimated) == set(before.unknowns.estimated)


# a machine without GTSAM

WITHOUT_GTSAM = """
import sys
sys.modules["gtsam"] = None
from rovgraph.cli import app
sys.argv = ["rovgraph", *sys.argv[1:]]
app.main()
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """A short dive, with places and without, and its configuration."""
    folder = tmp_path_factory.mktemp("dive")
    case = simulated(falcon(), 33.0, seed=3, path="circle", places=((0.0, 1.0),), **SHORT)
    frame = case.dive.log_frame
    assert frame["place_id"].notna().any()
    write_log(frame, folder / "places.csv")
    write_log(frame.drop(columns=[c for c in frame if c.startswith("place")]), folder / "log.csv")
    (folder / "config.yaml").write_text(case.config.to_yaml(), encoding="utf-8")
    return folder


def smoothed_without_gtsam(folder: Path, log: str) -> subprocess.CompletedProcess:
    arguments = ["smooth", folder / log, "--config", folder / "config.yaml", "--out", folder / f"out-{log}"]
    command = [sys.executable, "-c", WITHOUT_GTSAM, *arguments, "--no-figures"]
    return subprocess.run([str(a) for a in command], capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_a_dive_without_places_is_smoothed_where_gtsam_is_missing(recorded):
    done = smoothed_without_gtsam(recorded, "log.csv")
    assert done.returncode == 0, done.stderr[-1000:]
    written = {path.name for path in (recorded / "out-log.csv").iterdir()}
    assert {"trajectory_smoothed.csv", "trajectory_filtered.csv"} <= written


@pytest.mark.slow
def test_a_dive_with_places_says_in_one_line_that_gtsam_is_missing(recorded):
    done = smoothed_without_gtsam(recorded, "places.csv")
    assert done.returncode == 2
    said = [line for line in done.stderr.splitlines() if not line.startswith("warning:")]
    assert len(said) == 1 and "gtsam" in said[0] and "pip install" in said[0]
    assert not (recorded / "out-places.csv").exists()


def test_a_step_promises_what_the_slope_of_the_cost_says(solved):
    chain, graph = solved
    rng, n, layout = np.random.default_rng(1), len(chain.problem), chain.chain.layout
    x, y = 1e-3 * rng.standard_normal((n, layout.d)), 1e-3 * rng.standard_normal(layout.c)
    there = chain.chain.moved(chain.state, ChainStep(x, y), 1.0)
    for problem, point in ((chain.chain, there), (graph.graph, make_values(graph.graph, there))):
        gates = chain.solution.gates
        step, small = problem.step(point, gates), 1e-5
        ends = [problem.cost(problem.moved(point, step, sign * small), gates) for sign in (1.0, -1.0)]
        assert 2.0 * problem.promised(step) == pytest.approx((ends[1] - ends[0]) / (2.0 * small), rel=1e-4)


def test_what_is_known_last_needs_the_last_conditionals_only(solved):
    chain, _ = solved
    whole, last = (chain.chain.eliminate(chain.state, chain.solution.gates, (1,), kept) for kept in (None, 1))
    assert len(last.conditionals) == 1
    np.testing.assert_array_equal(last.conditionals[0], whole.conditionals[-1])
    np.testing.assert_array_equal(last.border, whole.border)
    np.testing.assert_array_equal(last.filtered, whole.filtered)
