"""A stretch in which one sensor contradicts all others is found by its cost, and nothing else is taken out."""

from dataclasses import replace

import numpy as np
import pytest
from broken import BROKEN, FROM, changed_data
from dives import Simulated, altered, batch, falcon, interrupted, position_errors, rms, simulated, smoothed
from numpy.testing import assert_array_equal

import rovgraph as rg
from rovgraph.geometry import Array
from rovgraph.inference import chain_optimum, faulty_intervals
from rovgraph.inference.chain import Chain, ChainStep
from rovgraph.inference.chain_optimum import ChainOptimum, smooth_chain, window
from rovgraph.inference.dead_reckoning import dead_reckon
from rovgraph.inference.gauss_newton import minimise
from rovgraph.inference.graph.places import smooth_graph
from rovgraph.inference.smoother import BatchSmoother
from rovgraph.log import Log
from rovgraph.model.config import beliefs
from rovgraph.model.state import State
from rovgraph.problem.measurements import cost_at_gate
from rovgraph.simulate import Choices

BIASED_S = 20.0


@pytest.fixture(scope="module")
def case() -> Simulated:
    return simulated(falcon(), 200.0, 1)


def optimum(log: Log, case: Simulated) -> ChainOptimum:
    best = batch(log, case.config).optimum()
    assert isinstance(best, ChainOptimum)
    return best


def dead_reckoned(smoother: BatchSmoother) -> State:
    b = smoother.initial
    return dead_reckon(smoother.problem, b, {name: belief.mean for name, belief in beliefs(b.config).items()})


def on_water(data: Array, time: Array) -> None:
    """The DVL tracks a current along its own axes."""
    data[(time > FROM) & (time < FROM + 40.0), :2] += [0.2, -0.15]


@pytest.mark.slow
def test_a_biased_stretch_of_the_dvl_is_found_and_taken_out(case):
    log = BROKEN["DVL biased by 0.3 m/s for 20 s"].breaks(case.log)
    begin = float(log["imu"].time[0]) + FROM
    (stretch,) = optimum(log, case).solution.stretches
    assert stretch.sensor == "dvl"
    assert abs(stretch.begin - begin) < 3.0
    assert abs(stretch.end - begin - BIASED_S) < 3.0


@pytest.mark.slow
def test_a_tilt_of_the_dvl_does_not_widen_the_stretch_of_its_bias():
    """Seed 5 draws a DVL that is tilted by 3.8 and 3.2 degrees, which the priors allow: all its pings cost more."""
    config = rg.Config().changed(heading={"sources": ["dvl"]})
    frame = rg.simulate("lawnmower", config, 5, Choices(duration=160.0)).dive.log_frame
    frame.loc[frame["time"].between(80.0, 100.0), "dvl_vx"] += 0.3
    log = rg.Log.from_frame(frame, config)
    best = batch(log, config).optimum()
    (stretch,) = best.solution.stretches
    assert stretch.sensor == "dvl"
    assert stretch.begin == pytest.approx(80.0, abs=3.0)
    assert stretch.end == pytest.approx(100.0, abs=3.0)


@pytest.mark.slow
def test_with_a_biased_stretch_tracks_are_as_good_as_without_its_pings():
    """Over six dives: in one, either track is the better one by chance."""
    errors = []
    for seed in range(1, 7):
        case = simulated(falcon(), 200.0, seed)
        log = BROKEN["DVL biased by 0.3 m/s for 20 s"].breaks(case.log)
        silent = interrupted(case.log, float(log["imu"].time[0]) + FROM, BIASED_S, "dvl")
        errors.append([rms(position_errors(smoothed(one, case.config).trajectory, case)) for one in (log, silent)])
    biased, without = np.sqrt(np.mean(np.square(errors), axis=0))
    assert biased <= 1.2 * without


@pytest.mark.slow
def test_solutions_of_a_dive_with_the_same_gates_share_the_search(case, monkeypatch):
    log = BROKEN["DVL biased by 0.3 m/s for 20 s"].breaks(case.log)
    dive, searches, search = batch(log, case.config), [], faulty_intervals._without_stretches
    monkeypatch.setattr(faulty_intervals, "_without_stretches", lambda *given: searches.append(1) or search(*given))
    first = dive.optimum()
    again = dive.optimum()
    assert len(searches) == 1
    assert dive.searches.saved_s > 0.0
    assert again.solution.stretches == first.solution.stretches != ()
    assert_array_equal(again.state.p_n, first.state.p_n)
    gates = {**first.solution.gates, "dvl": np.zeros_like(first.solution.gates["dvl"])}
    other = replace(first.solution, gates=gates)
    assert dive.searches.from_optimum(other, lambda: other) is other  # another optimum has a search of its own


@pytest.mark.slow
def test_water_track_taken_for_bottom_track_is_taken_out(case):
    begin = float(case.log["imu"].time[0]) + FROM
    (stretch,) = optimum(changed_data("dvl", on_water)(case.log), case).solution.stretches
    assert stretch.sensor == "dvl"
    assert stretch.begin == pytest.approx(begin, abs=4.0)
    assert stretch.end == pytest.approx(begin + 40.0, abs=4.0)


@pytest.mark.slow
def test_the_sensor_that_is_wrong_is_taken_out_and_not_the_one_that_contradicts_it():
    case = simulated(falcon(), 200.0, 1, fix_interval=2.0)
    found = optimum(BROKEN["fixes 8 m off for a minute"].breaks(case.log), case).solution.stretches
    assert {stretch.sensor for stretch in found} <= {"fix"}
    log = BROKEN["DVL biased by 0.3 m/s for 20 s"].breaks(case.log)
    assert {stretch.sensor for stretch in optimum(log, case).solution.stretches} <= {"dvl"}


def test_scattered_outliers_are_no_stretch(case):
    data, rng = case.log["dvl"].data.copy(), np.random.default_rng(5)
    wild = rng.random(len(data)) < 0.3
    data[wild, :3] += rng.normal(0.0, 0.5, (wild.sum(), 3))
    best = optimum(altered(case.log, "dvl", data), case)
    assert best.solution.stretches == ()
    clean = rms(position_errors(smoothed(case.log, case.config).trajectory, case))
    spoilt = rms(position_errors(smoothed(altered(case.log, "dvl", data), case.config).trajectory, case))
    assert spoilt < clean + 0.05


@pytest.mark.parametrize("name", ["DVL y sign flipped", "DVL 0.3 s late", "DVL noise three times as stated"])
def test_a_sensor_that_is_wrong_all_the_time_is_not_taken_out(name, case):
    assert optimum(BROKEN[name].breaks(case.log), case).solution.stretches == ()


def test_a_rejected_measurement_costs_what_one_at_its_gate_costs(case):
    """Whether a measurement at its gate is in or out, the cost is the same: that of optima compares."""
    data, wrong = case.log["dvl"].data.copy(), 300
    data[wrong, 0] += 1.0
    best = optimum(altered(case.log, "dvl", data), case)
    count = int(np.sum(~best.solution.gates["dvl"]))
    assert count > 0
    let_in = best.chain.cost(best.state, best.solution.gates)
    extra = count * cost_at_gate(best.blocks["dvl"].instrument)
    assert best.solution.cost == pytest.approx(let_in + extra)


@pytest.mark.slow
def test_optima_with_other_gates_have_costs_that_compare(case):
    """The open gates' optimum of a biased stretch is dearer than the one without it."""
    log = BROKEN["DVL biased by 0.3 m/s for 20 s"].breaks(case.log)
    best = optimum(log, case)
    alone = minimise(best.chain, best.state)
    assert best.solution.cost < alone.cost
    assert best.solution.runner_up > 0.0


def test_a_healthy_dive_is_solved_once(case, monkeypatch):
    counts, eliminate = [0], Chain.eliminate

    def counted(self, *arguments, **options):
        counts[0] += 1
        return eliminate(self, *arguments, **options)

    monkeypatch.setattr(Chain, "eliminate", counted)
    smoother = batch(case.log, case.config)
    states = dead_reckoned(smoother)
    best = smooth_chain(smoother.problem, smoother.initial, states)
    assert counts[0] == best.solution.iterations
    assert (best.solution.stretches, best.solution.runner_up) == ((), np.inf)


@pytest.mark.slow
def test_chain_and_graph_take_out_the_same_stretch():
    case = simulated(falcon(), 120.0, 2, dvl_rate=3.0, imu_rate=50.0)
    smoother = batch(BROKEN["DVL biased by 0.3 m/s for 20 s"].breaks(case.log), case.config)
    states = dead_reckoned(smoother)
    chain = smooth_chain(smoother.problem, smoother.initial, states).solution
    graph = smooth_graph(smoother.problem, smoother.initial, states).solution
    assert len(chain.stretches) == 1
    assert chain.stretches == graph.stretches
    assert chain.cost == pytest.approx(graph.cost, rel=1e-4)


def test_a_window_of_a_dive_knows_what_came_before_it(case):
    """Up to the end of the dive, it has the dive's optimum from anywhere near, and its last covariance."""
    best, rng = optimum(case.log, case), np.random.default_rng(3)
    time, gates = best.problem.time, best.solution.gates
    part = window(best.chain, best.solution, time[-1] - 60.0, np.inf)
    assert part is not None
    whole, own = part.point(best.state), part.gates(gates)
    assert len(whole) < len(time) / 2
    off = ChainStep(0.01 * rng.standard_normal((len(whole), part.problem.layout.d)), np.zeros(part.problem.layout.c))
    found = minimise(part.problem, part.problem.moved(whole, off, 1.0), own).point
    np.testing.assert_allclose(found.p_n, whole.p_n, atol=2e-3)
    np.testing.assert_allclose(found.R_nb, whole.R_nb, atol=2e-4)
    covariances = [
        (root := problem.eliminate(point, gate, kept=1)).newest_covariance(root.border_covariance())
        for problem, point, gate in ((best.chain, best.state, gates), (part.problem, whole, own))
    ]
    np.testing.assert_allclose(covariances[1], covariances[0], rtol=1e-6, atol=1e-12)


def test_there_is_no_window_where_it_would_be_most_of_the_dive(case):
    best = optimum(case.log, case)
    time = best.problem.time
    assert window(best.chain, best.solution, time[0] + 50.0, time[-1]) is None


@pytest.mark.slow
@pytest.mark.parametrize("reach", [40.0, 80.0])
def test_a_stretch_is_found_in_a_part_of_the_dive_as_in_all_of_it(reach, monkeypatch):
    """A part that begins after the dive, and one that begins with it."""
    case = simulated(falcon(), 400.0, 1)
    log = BROKEN["DVL biased by 0.3 m/s for 20 s"].breaks(case.log)
    (whole,) = optimum(log, case).solution.stretches
    made, make = [], chain_optimum.window
    monkeypatch.setattr(chain_optimum, "window", lambda *given: made.append(make(*given)) or made[-1])
    monkeypatch.setattr(faulty_intervals, "REACH_S", reach)
    (part,) = optimum(log, case).solution.stretches
    assert made[0] is not None and (made[0].keyframes.start > 0) == (reach < FROM)
    assert part.sensor == whole.sensor == "dvl"
    assert (part.begin, part.end) == pytest.approx((whole.begin, whole.end), abs=1.0)
