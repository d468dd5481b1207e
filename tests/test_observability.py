"""What of the calibration a dive shows, and what a manoeuvre would."""

import json
import sys
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from dives import batch, changed, exact, kept, simulated, true_at

from rovgraph.cli import app
from rovgraph.errors import InputError
from rovgraph.inference.error_state import reinitialised
from rovgraph.inference.filter import FilterEngine
from rovgraph.inference.graph.batch import make_graph, make_values
from rovgraph.inference.graph.values import key
from rovgraph.inference.initialise import initialise
from rovgraph.inference.observability import (
    UNOBSERVABLE,
    UNOBSERVABLE_ABOVE,
    data_information,
    relative_covariance,
    without_spurious_information,
)
from rovgraph.lab.choices import goals, read_known
from rovgraph.lab.observability import examined, in_words, observe, solved
from rovgraph.lab.plan import KnownComponents, Manoeuvre, SensorRates, manoeuvres, plan, predicted
from rovgraph.model.calibration import LAYERS, TABLE
from rovgraph.model.config import Config
from rovgraph.model.state import State
from rovgraph.simulate import CALM, SCENARIOS, Style, scenario
from rovgraph.simulate.files import write_log

CALMLY = Style(waves=CALM)
ONE_COMPASS = changed(exact(Config()), calibration={"dvl_yaw": {"estimate": True}}, heading={"sources": ["ahrs"]})
UNBIASED = changed(ONE_COMPASS, calibration={"ahrs_offset": {"estimate": False}})
SLOW = {"imu_rate": 50.0, "dvl_rate": 4.0, "ahrs_rate": 5.0}


def steady(config, seconds=240.0, seed=1, **truth):
    """A dive straight ahead, without its start and its stop."""
    case = simulated(config, seconds + 60.0, seed, "straight", CALMLY, **SLOW, **truth)
    log = case.log
    for sensor in list(log.streams):
        log = kept(log, sensor, (log[sensor].time > 30.0) & (log[sensor].time < 30.0 + seconds))
    return case, log


def part(seen, label):
    return seen.labels.index(label)


@pytest.fixture(scope="module")
def straight():
    """The steady dive, solved, with its truth."""
    case, log = steady(ONE_COMPASS)
    return case, solved(log, ONE_COMPASS)


def dense(linear, order):
    """Covariance by inverting the whole information matrix at once."""
    A, _ = linear.jacobian(order)
    scale = np.linalg.norm(A, axis=0)
    root = np.linalg.inv(np.linalg.qr(A / scale, mode="r")) / scale[:, None]
    return root @ root.T


def as_graph(dive, b):
    """GTSAM's graph of a dive whose calibration is constant, and its values where the chain is linearised."""
    graph, point = make_graph(dive.problem, b.prior, b.config, dive.beliefs, b.instruments), dive.linearised_at
    return graph, make_values(graph, point, point.calibration)


def test_information_agrees_with_a_dense_inversion_at_every_time():
    case = simulated(ONE_COMPASS, 40.0, 2, "square", **SLOW)
    log = case.log
    for sensor in list(log.streams):
        log = kept(log, sensor, (log[sensor].time > 18.0) & (log[sensor].time < 24.0))
    smoother = batch(log, ONE_COMPASS)
    dive = smoother.optimum()
    graph, values = as_graph(dive, smoother.initial)
    ends = [7, 12, graph.count - 1]
    seen = dive.knowledge(ends)
    linear = graph.linearize(values, dive.solution.gates)
    for row, end in enumerate(ends):
        later = {key(v, i) for v in ("pose", "velocity", "bias") for i in range(end + 1, graph.count)}
        so_far, order = gtsam.GaussianFactorGraph(), gtsam.Ordering()
        for k in range(linear.size()):
            if not later & set(linear.at(k).keys()):
                so_far.push_back(linear.at(k))
        for one in [key(v, i) for i in range(end + 1) for v in ("pose", "velocity", "bias")]:
            order.push_back(one)
        for name in graph.unknowns.estimated:
            order.push_back(key(name))
        P = dense(so_far, order)
        states = 15 * (end + 1)
        wanted = np.r_[15 * end + 9 : states, 0:3, states : len(P)]
        expected = P[np.ix_(wanted, wanted)]
        sd = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(seen.covariance[row] / np.outer(sd, sd), expected / np.outer(sd, sd), atol=1e-6)


def test_information_at_the_end_is_that_of_the_smoother(straight):
    _, dive = straight
    last = dive.knowledge([len(dive.problem) - 1])
    expected = np.concatenate([np.sqrt(np.diag(dive.covariances()[n][-1])) for n in dive.unknowns.estimated])
    np.testing.assert_allclose(np.sqrt(np.diag(last.calibration[0])), expected, rtol=1e-8)


def at_truth(case, dive):
    """The dive at the true states and calibration."""
    time, truth = dive.problem.time, case.truth
    there = truth.at(time)
    bias = np.array([np.interp(time, truth.time, column) for column in case.dive.hidden["bias"].T]).T
    hidden = {**dive.unknowns.fixed, **case.dive.hidden["calibration"]}
    point = State(there.R_nb, there.p_n, there.v_n, bias, hidden)
    return replace(dive, solution=replace(dive.solution, point=point), begun=None)


def test_what_noise_pretends_is_taken_off(straight):
    """Ahead at constant speed the information at the truth says that nothing is known of the misalignment."""
    case, dive = straight
    sd = np.concatenate([np.full(TABLE[n].dim, TABLE[n].sd) for n in dive.unknowns.estimated])
    end = [len(dive.problem) - 1]

    def seen(dive):
        return data_information(dive.knowledge(end).calibration, sd)

    truth, claimed = seen(at_truth(case, dive)), seen(dive)
    corrected = without_spurious_information(dive, end, claimed, sd[None])
    true, told, own = (np.sqrt(np.diag(relative_covariance(D)))[0] for D in (truth[0], claimed[0], corrected[0]))
    assert dive.unknowns.estimated[0] == "dvl_yaw"
    assert true > 0.99
    assert told < 0.9  # else there would be nothing to take off
    assert own > 0.95


def test_straight_and_steady_shows_no_misalignment(straight):
    _, dive = straight
    seen = examined(dive, ONE_COMPASS)
    i = part(seen, "dvl_yaw")
    assert seen.verdicts[i] == UNOBSERVABLE
    assert (seen.relative[:, i] > UNOBSERVABLE_ABOVE).all()
    assert "dvl_yaw" in in_words(seen.information, seen.labels, ["rad"] * len(seen.labels), seen.prior_sd)[0]


def test_the_smoother_tells_what_it_could_not_see():
    entries = {c.label: c for c in batch(steady(ONE_COMPASS)[1], ONE_COMPASS).solve().calibration}
    assert entries["dvl_yaw"].verdict == UNOBSERVABLE
    assert entries["dvl_scale"].verdict == ""  # held


def test_what_is_held_keeps_its_doubt_in_the_track():
    """The covariance of a considered variable: that of the track with it known, and its prior carried through."""
    case, log = steady(ONE_COMPASS)
    held = batch(log, ONE_COMPASS).solve()
    assert held.summary["held_at_prior"] == ["dvl_yaw"]
    entry = next(c for c in held.calibration if c.label == "dvl_yaw")
    assert (entry.value, entry.sd) == (entry.prior_mean, pytest.approx(entry.prior_sd))
    fixed = batch(log, changed(ONE_COMPASS, calibration={"dvl_yaw": {"estimate": False}})).solve()
    np.testing.assert_allclose(held.trajectory.p_n, fixed.trajectory.p_n, atol=0.02)
    doubt = np.sqrt(held.trajectory.cov_p[-1, 1, 1] - fixed.trajectory.cov_p[-1, 1, 1])
    gone = np.linalg.norm(true_at(case, held.trajectory.time).p_n[[0, -1]].T @ [-1.0, 1.0])
    assert doubt == pytest.approx(np.deg2rad(5.0) * gone, rel=0.05)  # 5 degrees across the way that was gone


def test_a_filter_goes_on_without_what_noise_feigned(straight):
    """Reinitialised from a dive that does not show the misalignment, it has the prior of it."""
    case, dive = straight
    engine = FilterEngine(initialise(case.log, ONE_COMPASS))
    known, _ = reinitialised(engine, dive.problem, dive.state)
    belief, (column,) = engine.beliefs["dvl_yaw"], np.r_[engine.layout.columns["dvl_yaw"]]
    assert known.state.calibration["dvl_yaw"] == belief.mean
    assert np.sqrt(known.covariance[column, column]) == pytest.approx(belief.sd)
    assert dive.state.calibration["dvl_yaw"] != belief.mean


def test_figure8_with_fixes_and_unbiased_heading_shows_the_misalignment():
    case = simulated(UNBIASED, 150.0, 3, "figure8", fix_interval=4.0, **SLOW)
    seen = observe(case.log, UNBIASED)
    i = part(seen, "dvl_yaw")
    assert seen.verdicts[i] == "observable"
    found = case.dive.hidden["calibration"]["dvl_yaw"][0]
    estimate = next(c for c in batch(case.log, UNBIASED).solve().calibration if c.label == "dvl_yaw")
    assert abs(estimate.value - found) < 4.0 * seen.sd[i]


def test_a_compass_on_the_dvl_shows_only_the_sum():
    """Its heading is the vehicle's, its offset and the DVL's mounting; no acceleration parts the last two."""
    config = changed(
        exact(Config()),
        calibration={
            "dvl_yaw": {"estimate": True},
            "ahrs_offset": {"estimate": False},
            "ahrs_deviation": {"estimate": False},
            "dvl_compass_deviation": {"estimate": False},
        },
        heading={"sources": ["ahrs", "dvl"]},
    )
    _, log = steady(config)
    seen = observe(log, config)
    i, j = part(seen, "dvl_yaw"), part(seen, "dvl_compass_offset")
    assert seen.correlation[i, j] < -0.9
    (words,) = in_words(seen.information, seen.labels, ["rad", "rad"], seen.prior_sd)
    assert words.startswith("only the sum of dvl_") and words.endswith(" is known")


def test_sd_never_grows_with_more_data(straight):
    seen = examined(straight[1], ONE_COMPASS, noisy=False)
    assert (np.diff(seen.relative, axis=0) < 1e-9).all()


def test_components_by_themselves_are_as_sure_as_among_the_others(straight):
    whole = examined(straight[1], ONE_COMPASS, noisy=False)
    labels = whole.labels[::-2]
    some, k = whole.of(labels), [whole.labels.index(label) for label in labels]
    assert some.labels == labels
    np.testing.assert_allclose(some.sd, whole.sd[k], rtol=1e-9)
    np.testing.assert_allclose(some.covariance, whole.covariance[np.ix_(k, k)], rtol=1e-7)
    assert some.correlation.shape == (len(k), len(k) + 9)
    np.testing.assert_array_equal(np.diag(some.correlation), np.diag(whole.correlation)[k])


def test_a_plan_predicts_what_noisy_dives_show():
    config = changed(UNBIASED, calibration={"ahrs_deviation": {"estimate": False}})
    one = Manoeuvre("accelerate-and-stop", 0.4)
    expected = predicted(one, config, 60.0, SensorRates(50.0, 4.0))
    path = scenario(one.name, 60.0, one.speed, CALMLY)
    sd = []
    for seed in range(4):
        case = simulated(config, 60.0, seed, path, imu_rate=50.0, dvl_rate=4.0, ahrs_rate=10.0)
        seen = examined(solved(case.log, config), config)
        sd.append(seen.sd[part(seen, "dvl_yaw")])
    assert np.mean(sd) == pytest.approx(expected.sd[part(expected, "dvl_yaw")], rel=0.2)


def test_what_is_known_before_counts_once():
    sd = np.deg2rad([5.0, 3.0])
    known = KnownComponents(("ahrs_offset", "dvl_yaw"), np.diag((0.5 * sd) ** 2), sd)
    own = known.information(("dvl_yaw", "dvl_scale"), np.array([sd[1], 0.01]))
    np.testing.assert_allclose(own, np.diag([3.0, 0.0]), atol=1e-9)  # half the sd is four times the information


@pytest.mark.parametrize("name", ["accelerate-and-stop", "spiral"])
def test_new_scenarios_begin_at_the_origin_and_keep_their_speed(name):
    motion = SCENARIOS[name](200.0, 0.4, CALMLY).motion(np.linspace(0.0, 200.0, 2001))
    np.testing.assert_allclose(motion.p_n[0, :2], 0.0, atol=1e-6)
    assert 0.35 < np.linalg.norm(motion.v_n, axis=1).max() < 0.45


def test_accelerate_and_stop_keeps_its_heading():
    motion = SCENARIOS["accelerate-and-stop"](100.0, 0.4, CALMLY).motion(np.linspace(0.0, 100.0, 1001))
    np.testing.assert_allclose(motion.R_nb, np.broadcast_to(np.eye(3), (1001, 3, 3)), atol=1e-9)
    assert motion.v_n[:, 0].min() < -0.35


def test_goals_are_read_in_the_units_people_use():
    assert goals(["dvl_yaw=1deg", "dvl_scale=0.002"]) == {"dvl_yaw": np.deg2rad(1.0), "dvl_scale": 0.002}


@pytest.mark.parametrize(
    "text", ["dvl_yaw=1", "dvl_scale=1deg", "dvl_yaww=1deg", "dvl_yaw=-1deg", "dvl_yaw", "dvl_yaw=nandeg"]
)
def test_a_goal_that_cannot_be_is_refused(text):
    with pytest.raises(InputError, match="goal"):
        goals([text])


def test_manoeuvres_that_cannot_be_are_refused():
    assert manoeuvres(["circle@0.3"], 60.0) == [Manoeuvre("circle", 0.3)]
    for name in ("cirle", "circle@fast", "circle@-1"):
        with pytest.raises(InputError):
            manoeuvres([name], 60.0)
    with pytest.raises(InputError, match="duration"):
        manoeuvres(["circle"], 5.0)


# --- the commands


def command(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["rovgraph", *map(str, arguments)])
    try:
        app.main()
    except SystemExit as stop:
        return stop.code or 0
    return 0


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A short log with its configuration."""
    folder = tmp_path_factory.mktemp("dive")
    case = simulated(ONE_COMPASS, 60.0, 5, "square", **SLOW)
    write_log(case.dive.log_frame, folder / "log.csv")
    (folder / "config.yaml").write_text(ONE_COMPASS.to_yaml(), encoding="utf-8")
    return folder


@pytest.mark.slow
def test_observe_and_plan_hand_over(recorded, tmp_path, monkeypatch, capsys):
    config = ("--config", recorded / "config.yaml")
    assert command(monkeypatch, "observe", recorded / "log.csv", *config, "--out", tmp_path / "seen") == 0
    names = {p.name for p in (tmp_path / "seen").iterdir()}
    assert names == {
        "report.html",
        "observability.json",
        "summary.json",
        "config.yaml",
        "learning.png",
        "correlation.png",
    }
    content = json.loads((tmp_path / "seen" / "observability.json").read_text())
    entry = content["components"]["dvl_yaw"]
    assert entry["sd"] < entry["prior_sd"]
    assert np.shape(content["history"]["sd"]) == (len(content["history"]["time_s"]), len(content["components"]))
    known = ("--known", tmp_path / "seen" / "observability.json")
    rates = ("--duration", 40, "--imu-rate", 50, "--dvl-rate", 4)
    arguments = ("--goal", "dvl_yaw=1deg", "--manoeuvres", "accelerate-and-stop@0.5,straight@0.2", *rates)
    assert command(monkeypatch, "plan", *config, *known, *arguments, "--out", tmp_path / "plan") == 0
    planned = json.loads((tmp_path / "plan" / "plan.json").read_text())
    assert planned["sd_before"]["dvl_yaw"] == pytest.approx(entry["sd"], rel=1e-6)
    assert [r["manoeuvre"] for r in planned["ranking"]] == ["accelerate-and-stop", "straight"]
    assert all(r["sd"]["dvl_yaw"] < entry["sd"] for r in planned["ranking"])
    assert {p.name for p in (tmp_path / "plan").iterdir()} == {
        "report.html", "plan.json", "summary.json", "config.yaml", "ranking.png", "path.png",
    }  # fmt: skip
    assert "accelerate-and-stop" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("estimate", "told"),
    [("dvl_yaww", "did you mean dvl_yaw?"), ("current", "no thruster or dvl_water in use")],
)
def test_observe_refuses_what_cannot_be_estimated(recorded, tmp_path, monkeypatch, capsys, estimate, told):
    arguments = ("--config", recorded / "config.yaml", "--estimate", estimate, "--out", tmp_path / "out")
    assert command(monkeypatch, "observe", recorded / "log.csv", *arguments) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("warning:")]
    assert len(lines) == 1 and told in lines[0]
    assert not (tmp_path / "out").exists()


def test_observe_refuses_a_log_that_is_too_short(recorded, monkeypatch, tmp_path, capsys):
    lines = (recorded / "log.csv").read_text().splitlines(keepends=True)
    (tmp_path / "short.csv").write_text("".join(lines[:150]))
    assert command(monkeypatch, "observe", tmp_path / "short.csv", "--out", tmp_path / "out") == 2
    assert "keyframes say nothing" in capsys.readouterr().err


def test_observe_refuses_where_nothing_is_estimated():
    held = {name: {"estimate": False} for name in TABLE if name not in LAYERS}
    config = changed(ONE_COMPASS, calibration=held)
    case = simulated(config, 40.0, 1, "straight", **SLOW)
    with pytest.raises(InputError, match="no calibration variable is estimated"):
        observe(case.log, config)


def test_a_file_that_is_no_report_is_refused(tmp_path):
    for text in ("{}", "no json", '{"components": {"dvl_yaw": {"prior_sd": 0.1}}, "covariance": [[-1]]}'):
        (tmp_path / "known.json").write_text(text)
        with pytest.raises(InputError, match=r"known\.json"):
            read_known(tmp_path / "known.json")
    with pytest.raises(InputError, match="cannot be read"):
        read_known(tmp_path / "nothing.json")


def test_a_goal_for_what_is_held_is_refused():
    with pytest.raises(InputError, match="goal dvl_scale: it is not estimated"):
        plan(
            ONE_COMPASS, [Manoeuvre("straight", 0.4)], 40.0, goals={"dvl_scale": 0.001}, sensors=SensorRates(50.0, 4.0)
        )


def test_open_directions_are_told_apart_and_each_once():
    """The dive sees only the difference of two components, and only the sum of two others."""
    half = np.sqrt(0.5)
    open_ones = np.array([[half, half, 0, 0], [0, 0, 0.72, -np.sqrt(1.0 - 0.72**2)]])
    mixed = np.array([[0.8, 0.6], [-0.6, 0.8]]) @ open_ones  # of nearly one eigenvalue, axes are any mixture
    seen = np.array([[half, -half, 0, 0], [0, 0, np.sqrt(1.0 - 0.72**2), 0.72]])
    information = mixed.T @ np.diag([0.05, 0.06]) @ mixed + 1e4 * seen.T @ seen
    words = in_words(information, ["a", "b", "c", "d"], ["rad"] * 4, np.ones(4))
    told = {frozenset(sentence.split()) for sentence in words}
    sentences = ("only the difference of a and b is known", "only the sum of c and d is known")
    assert told == {frozenset(sentence.split()) for sentence in sentences}
