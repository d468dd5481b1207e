"""Places seen before: factors, recognition, the filter's memory of them, and what they are worth."""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from dives import (
    Simulated,
    as_log,
    batch,
    changed,
    falcon,
    fed,
    incremental,
    kept,
    position_errors,
    simulated,
    started,
    true_at,
    without,
)
from scipy.stats import chi2

from rovgraph.diagnosis.check import examine
from rovgraph.errors import DataWarning, InputError
from rovgraph.geometry import Array
from rovgraph.inference.error_state import REINITIALISE_AT_S, ErrorStateFilter
from rovgraph.inference.estimate import Estimate
from rovgraph.inference.fixed_lag import FixedLag
from rovgraph.inference.graph.optimum import GraphOptimum, covariances, marginals
from rovgraph.inference.graph.places import matched
from rovgraph.inference.graph.values import calibration_key, key, key_name
from rovgraph.inference.initialise import initialise
from rovgraph.inference.optimum import OTHERS
from rovgraph.kernels.measurement_row import TIME
from rovgraph.live.files import Recorder, read_checkpoint, write_checkpoint
from rovgraph.live.message import Reading
from rovgraph.live.sources.json_lines import JsonRow
from rovgraph.log import Log, read_log
from rovgraph.log.streams import label_number
from rovgraph.model.config import Config
from rovgraph.problem.assembly import assembly_of
from rovgraph.simulate import Choices, Truth, scenario, simulate
from rovgraph.simulate import simulated as by_name
from rovgraph.simulate.files import known, write_log
from rovgraph.simulate.path import Route, Style, path_along

SD = 0.2
SIDE, SPEED, LAPS = 30.0, 0.4, 4  # a square of 20 minutes
PLACES = ((15.0, 0.0), (30.0, 15.0))
NO_LOCK = tuple((150.0 + 300.0 * k, 180.0 + 300.0 * k) for k in range(LAPS - 1))  # without them it hardly drifts
SEEDS = range(1, 11)


def square(seed: int, false: float, sd: float = SD) -> tuple[Simulated, Config]:
    """A dive of four laps that passes each place once a lap, as near as the places are believed to be.

    The DVL loses the bottom for half a minute in every lap but the last.
    """
    rng = np.random.default_rng(seed)
    south, north, west, east = (rng.normal(0.0, sd, (4, LAPS + 1)).T + np.array([0.0, SIDE, 0.0, SIDE])).T
    points = [(0.0, west[0], 5.0)]
    for k in range(LAPS):
        points += [(north[k], west[k], 5.0), (north[k], east[k], 5.0), (south[k], east[k], 5.0)]
        points.append((south[k], west[k + 1] if k + 1 < LAPS else 0.0, 5.0))
    path = path_along(Route.of(points), SPEED, 4 * SIDE * LAPS / SPEED + 40.0, Style())
    config = changed(falcon(), place={"sd_m": sd})
    truth = Truth(
        config,
        start_error=True,
        imu_rate=25.0,
        dvl_rate=1.0,
        depth_rate=0.5,
        dropouts=NO_LOCK,
        places=PLACES,
        false_places=false,
    )
    dive = simulate(path, truth, rng)
    case = Simulated(config, dive, as_log(dive.log_frame))
    heading = np.rad2deg(dive.truth.rpy[0, 2]) + config.start.heading_sd_deg * rng.standard_normal()
    down = float(dive.truth.p_n[0, 2] - dive.hidden["start_offset"][2])
    return case, changed(known(dive, config), start={"heading_deg": float(heading), "down_m": down})


def filtered(log: Log, config: Config, renew: bool = True) -> ErrorStateFilter:
    """The filter that has taken a log."""
    estimator: ErrorStateFilter = fed(
        ErrorStateFilter(initialise(log, config), REINITIALISE_AT_S if renew else ()), log
    )
    return estimator


def end(estimate: Estimate, case: Simulated) -> tuple[float, float]:
    """Horizontal error at the end [m], and its square normalised."""
    t = estimate.trajectory
    error = (t.p_n - true_at(case, t.time).p_n)[-1, :2]
    return float(np.linalg.norm(error)), float(error @ np.linalg.solve(t.cov_p[-1, :2, :2], error))


ESTIMATES = ("smoothed", "filtered")
LOGS = ("without", "with", "with false")


def one_dive(seed: int) -> Array:
    """Error and normalised error squared at the end, shape (2 estimates, 3 logs, 2)."""
    out = np.empty((len(ESTIMATES), len(LOGS), 2))
    for k, false in ((1, 0.0), (2, 0.3)):
        case, config = square(seed, false)
        logs = {k: case.log} | ({0: without(case.log, "place")} if k == 1 else {})
        for which, log in logs.items():
            out[0, which] = end(batch(log, config).solve(), case)
            out[1, which] = end(filtered(log, config).solve(), case)
    return out


def all_dives(seeds: range) -> Array:
    """Of many dives, shape (dives, 2 estimates, 3 logs, 2)."""
    with ProcessPoolExecutor(2) as pool:
        return np.array(list(pool.map(one_dive, seeds)))


# small dives: three laps of a circle, the bottom lost in the second


SMALL = {"imu_rate": 50.0, "dvl_rate": 2.5, "depth_rate": 1.0, "places": ((4.8, 4.5), (-4.8, 4.7))}


def circle(seed: int = 1, seconds: float = 100.0, **truth) -> Simulated:
    config = changed(falcon(), place={"sd_m": 0.1, "every_s": 0.5}, start={"position_sd_m": 0.01})
    case = simulated(config, seconds, seed, scenario("circle", seconds, 1.2), Style(), **SMALL, **truth)
    return replace(case, config=started(case))


@pytest.fixture(scope="module")
def lost() -> Simulated:
    """A dive that loses the bottom for ten seconds."""
    return circle(dropouts=((53.0, 77.0),))


@pytest.fixture(scope="module")
def misled() -> Simulated:
    """The same dive with as many false landmarks as true ones."""
    return circle(dropouts=((53.0, 77.0),), false_places=0.5)


def graph_of(case: Simulated) -> GraphOptimum:
    best = batch(case.log, case.config).optimum()
    assert isinstance(best, GraphOptimum)
    return best


def of_places(estimate: Estimate) -> pd.DataFrame:
    rows = estimate.residuals
    return rows[rows["sensor"] == "place"]


def is_false(case: Simulated) -> dict[float, bool]:
    """Whether the vehicle is elsewhere, at every landmark."""
    stream, out = case.log["place"], {}
    for time, name in zip(stream.time, stream["place_id"], strict=True):
        where = true_at(case, np.array([time])).p_n[0, :2]
        out[round(float(time), 3)] = bool(np.linalg.norm(where - SMALL["places"][int(name) - 1]) > 1.0)
    return out


def test_without_noise_the_dive_is_found_and_every_sighting_fits():
    case = circle(noise=False)
    estimate = batch(case.log, case.config).solve()
    assert position_errors(estimate.trajectory, case).max() < 0.02
    rows = of_places(estimate)
    assert len(rows) == 2 * len(case.log["place"]) > 8
    off = np.column_stack([rows.loc[rows["component"] == c, "predicted"] for c in ("north", "east")])
    where = true_at(case, case.log["place"].time).p_n[:, :2] - off  # each place, as its landmarks have it
    for name in (1.0, 2.0):
        assert np.ptp(where[case.log["place"]["place_id"] == name], axis=0).max() < 0.01
    assert (rows["weight"] > 0.5).all()


def test_places_bring_back_what_was_lost_without_the_bottom(lost):
    with_places, alone = (batch(log, lost.config).solve().trajectory for log in (lost.log, without(lost.log, "place")))
    assert with_places.p_sd[-1, :2].max() < 0.6 * alone.p_sd[-1, :2].max()
    error = (with_places.p_n - true_at(lost, with_places.time).p_n)[:, :2]
    normalised = [e @ np.linalg.solve(P[:2, :2], e) for e, P in zip(error, with_places.cov_p, strict=True)]
    assert np.mean(normalised) < chi2.ppf(0.99, 2)


@pytest.mark.slow
def test_isam2_agrees_with_the_batch_solution(lost):
    one, other = batch(lost.log, lost.config).solve(), incremental(lost.log, lost.config).solve()
    np.testing.assert_allclose(one.trajectory.p_n, other.trajectory.p_n, atol=0.02)
    np.testing.assert_allclose(one.trajectory.p_sd, other.trajectory.p_sd, rtol=0.05)
    assert (of_places(other)["weight"] > 0).all()


def test_the_filters_smoother_agrees_with_the_batch_solution(lost):
    one, other = batch(lost.log, lost.config).solve(), filtered(lost.log, lost.config, renew=False).smoothed()
    apart = np.linalg.norm(one.trajectory.p_n - other.trajectory.p_n, axis=1)
    assert apart.max() < np.linalg.norm(one.trajectory.p_sd, axis=1).max()
    np.testing.assert_allclose(other.trajectory.p_sd[-1], one.trajectory.p_sd[-1], rtol=0.1)


@pytest.mark.parametrize(
    "solver",
    [
        pytest.param(batch, id="batch"),
        pytest.param(filtered, id="filter"),
        pytest.param(incremental, id="isam2", marks=pytest.mark.slow),
    ],
)
def test_false_sightings_are_kept_out_and_change_nothing(misled, solver):
    false = is_false(misled)
    assert 0.3 < np.mean(list(false.values())) < 0.7
    true = kept(misled.log, "place", ~np.array(list(false.values())))
    estimate, undisturbed = (solver(log, misled.config).solve() for log in (misled.log, true))
    weight = of_places(estimate).groupby("time")["weight"].min()
    begun: set[float] = set()
    for time, name in zip(misled.log["place"].time, misled.log["place"]["place_id"], strict=True):
        used = weight.iloc[np.argmin(np.abs(weight.index - time))] > 0
        if solver is filtered:  # which cannot know that the first of a name is false
            assert not (used and false[round(float(time), 3)]) or name not in begun
        else:
            assert used != false[round(float(time), 3)]
        begun.add(name)
    ends = [e.trajectory.p_n[-1] for e in (estimate, undisturbed)]
    np.testing.assert_allclose(*ends, atol=0.01)


def test_a_false_first_sighting_spoils_none_of_those_that_follow(lost):
    frame = lost.dive.log_frame
    first = frame[frame["place_id"].notna()].iloc[[0]]
    false = first.assign(time=first["time"] + 9.0)  # before the first lap is over
    early = pd.concat([frame[~((frame["place_id"] == first["place_id"].iloc[0]) & (frame["time"] < 20.0))], false])
    log = Log.from_frame(early.sort_values("time", kind="stable", ignore_index=True))
    for estimate in (batch(log, lost.config).solve(), filtered(log, lost.config).solve()):
        rows = of_places(estimate)
        assert (rows["weight"] > 0).sum() >= 2 * (len(log["place"]) - 2)
        assert position_errors(estimate.trajectory, lost)[-1] < 4.0 * np.linalg.norm(estimate.trajectory.p_sd[-1])


# recognition


def walked(offsets: Array, sd: Array, names: Array) -> list[int]:
    """Numbers of landmarks on a random walk whose steps have a standard deviation of 1 m."""
    m = len(offsets)
    steps = np.minimum.outer(np.arange(m), np.arange(m)) + 1.0
    covariance = np.kron(steps, np.eye(2)) + np.diag(np.tile(sd**2, m))
    return matched(names, np.arange(m), offsets, covariance, 4.0)


def test_sightings_are_told_apart_by_where_the_vehicle_can_be():
    where = np.array([[40.0, 0.0], [0.0, 0.0], [0.5, 1.0], [0.0, 30.0], [1.0, 0.5], [39.0, 1.0]])
    assert walked(where, np.full(2, 0.1), np.ones(6)) == [0, 1, 1, 3, 1, 0]
    assert walked(where, np.full(2, 0.1), np.arange(6.0)) == [0, 1, 2, 3, 4, 5]


def test_what_was_recognised_narrows_the_next_comparison():
    """Five metres after sixteen steps are little; not after a closure has shown that it did not drift."""
    where = np.zeros((18, 2))
    where[17, 0] = 6.0
    names = np.arange(18.0)
    names[17] = names[0]
    assert walked(where, np.full(2, 0.1), names)[17] == 0
    names[16] = names[1]
    assert walked(where, np.full(2, 0.1), names)[17] == 17


# the filter's memory


def test_a_filter_forgets_what_it_has_not_seen_for_longest(lost):
    problem = batch(lost.log, lost.config).problem
    most = ErrorStateFilter(initialise(lost.log, changed(lost.config, place={"remembered": 1})))
    both = ErrorStateFilter(initialise(lost.log, lost.config))
    most.problem = both.problem = problem
    few, all_of = ([f.step().filtered for _ in range(len(problem))] for f in (most, both))
    size = both.engine.layout.size
    assert {len(k.places) for k in few} == {0, 1} and {len(k.places) for k in all_of} == {0, 1, 2}
    assert all(k.P.shape == (size + 2 * len(k.places),) * 2 for k in all_of)
    assert len(most.smoothed().trajectory) == len(all_of)
    assert all_of[-1].P[3, 3] < few[-1].P[3, 3]


def test_a_renewed_filter_knows_the_places_as_the_graph_does(lost):
    best = graph_of(lost)
    numbers = sorted(set(best.graph.blocks["place"].place.tolist()))
    P = best.newest_covariance(numbers)
    known = covariances(marginals(best.graph, best.solution.point, best.solution.gates))
    for k, number in enumerate(numbers[::-1]):
        own = P[len(P) - 2 * (k + 1) :, len(P) - 2 * (k + 1) :][:2, :2]
        np.testing.assert_allclose(own, known[key("place", number)], rtol=1e-5)
    estimator = filtered(lost.log, lost.config)
    assert {p.number for p in estimator.known.places} == set(numbers)
    for place, true in zip(sorted(estimator.known.places, key=lambda p: p.name), SMALL["places"], strict=True):
        np.testing.assert_allclose(place.position, true, atol=0.5)


def test_late_and_restored_it_remembers_the_same_places(lost, tmp_path):
    initial = initialise(lost.log, lost.config)
    reference = filtered(lost.log, lost.config, renew=False).known
    measurements = list(lost.log.measurements())
    late = sorted(measurements, key=lambda m: m.time + (1.5 if m.sensor == "place" else 0.0))
    engine = FixedLag(initial, 5.0, 0.3)
    for m in late[: len(late) // 2]:
        engine.add(m)
    write_checkpoint(tmp_path / "state", engine.state())
    after = FixedLag(initial, 5.0, 0.3)
    after.restore(read_checkpoint(tmp_path / "state"))
    for m in late[len(late) // 2 :]:
        after.add(m)
    snapshots = []
    after.passed = snapshots.append
    after.finish()
    known = snapshots[-1].known
    assert [p.number for p in known.places] == [p.number for p in reference.places] and len(known.places) == 2
    np.testing.assert_allclose(known.P, reference.P, rtol=1e-5, atol=1e-9)


def test_information_about_the_calibration_is_the_graphs_with_places_in_it(lost):
    best = graph_of(lost)
    end = best.graph.count - 1
    seen = best.knowledge([end // 3, 2 * end // 3, end])
    names, column = best.unknowns.estimated, OTHERS
    known = covariances(marginals(best.graph, best.solution.point, best.solution.gates))
    for name in names:
        P = known[calibration_key(best.unknowns, name, int(best.graph.index[-1]))]
        own = slice(column, column + len(P))
        np.testing.assert_allclose(seen.covariance[-1][own, own], P, rtol=1e-4)
        column += len(P)
    assert seen.covariance.shape[1] == column


def test_a_place_that_stays_in_view_counts_once(lost):
    initial = initialise(lost.log, changed(lost.config, place={"every_s": 5.0}))
    often = lost.log["place"]
    time = np.arange(50.0, 58.0, 0.5)
    data = np.column_stack([np.ones(len(time)), np.full(len(time), 0.3)])
    stream = replace(often, time=time, data=data, row=np.arange(len(time)))
    log = Log("dive.csv", {**lost.log.streams, "place": stream})
    assembly = assembly_of(initial)
    for m in log.measurements():
        assembly.insert(m)
        assembly.extend()
    problem = assembly.problem
    seen = problem.of_sensor("place")
    assert problem.rows[seen, TIME].tolist() == [50.0, 55.0] and problem.number[seen].tolist() == [1, 2]
    assert (problem.sd(seen, 2) == 0.3).all()
    assert assembly.left_out["place", "still in view"] == len(time) - 2
    assert key_name(key("place", 2)) == "place 2"


# logs, and data as they arrive


def table(**columns) -> pd.DataFrame:
    return pd.DataFrame({"time": np.arange(3.0), "depth": 1.0, **columns})


@pytest.mark.parametrize("name", ["log.csv", "log.csv.gz", "log.parquet"])
def test_names_of_places_may_be_numbers_or_texts(tmp_path, name):
    frame = table(place_id=["wreck", None, " 7"], place_sd=[0.5, None, None])
    frame.to_parquet(tmp_path / name) if name.endswith("parquet") else frame.to_csv(tmp_path / name, index=False)
    stream = read_log(tmp_path / name)["place"]
    assert stream["place_id"].tolist() == [label_number("wreck"), 7.0]
    np.testing.assert_array_equal(stream["place_sd"], [0.5, np.nan])
    assert label_number("wreck") != label_number("Wreck")


@pytest.mark.parametrize("sd", [0.0, -1.0])
def test_an_sd_of_0_or_less_is_taken_as_not_known(sd):
    with pytest.warns(DataWarning, match="place_sd: 1 times 0 or less, taken as unknown.* first in line 3"):
        stream = Log.from_frame(table(place_id=[1, 2, 1], place_sd=[0.1, sd, 0.1]))["place"]
    np.testing.assert_array_equal(stream["place_sd"], [0.1, np.nan, 0.1])


def test_an_sd_of_no_place_is_left_out_with_a_warning():
    with pytest.warns(DataWarning, match=r"place: 1 rows partly empty .* first in line 3"):
        log = Log.from_frame(table(place_id=[1, None, 1], place_sd=[0.1, 0.1, np.nan]))
    assert log["place"].time.tolist() == [0.0, 2.0]


def test_the_recording_of_json_lines_has_the_places_again(tmp_path):
    said: list[tuple[str, str]] = []
    row = JsonRow("udp://:1", lambda kind, text, once=False: said.append((kind, text)), Config())
    lines = [b'{"time": 1, "place_id": "wreck", "place_sd": 0.5}', b'{"time": 2, "place_id": 7}']
    lines.append(b'{"time": 2.5, "place_id": 7.5}')
    messages = [row.message(line, 10.0) for line in lines]
    assert row.message(b'{"place_sd": 1}', 10.0) is None and said[-1][0] == "incomplete"
    recorder = Recorder(tmp_path / "recording.csv")
    for message in messages:
        recorder.write(message.stamp, message.arrival, message.readings)
    recorder.write(3.0, 10.0, [Reading("depth", np.array([1.0]))])
    recorder.close()
    stream = read_log(tmp_path / "recording.csv")["place"]
    assert stream["place_id"].tolist() == [label_number("wreck"), 7.0, label_number("7.5")]
    assert stream["place_sd"][0] == 0.5 and np.isnan(stream["place_sd"][1])


def test_check_says_whether_any_place_is_seen_again(lost):
    def texts(log: Log) -> list[tuple[str, str]]:
        return [(f.level, f.text) for f in examine(log, lost.config).findings if f.sensor == "place"]

    [(level, text), _] = texts(lost.log)
    assert level == "ok" and "2 of them seen again" in text
    names = lost.log["place"].data.copy()
    names[:, 0] = np.arange(len(names))
    unlike = replace(lost.log["place"], data=names)
    [(level, text)] = texts(Log("dive.csv", {**lost.log.streams, "place": unlike}))
    assert level == "warning" and "none of them seen again" in text


def test_simulated_sightings_are_where_the_places_are(tmp_path):
    choices = Choices(duration=240.0, places=((5.0, 0.0),), false_places=0.5)
    dive, _ = by_name("square", 3, choices=choices)
    write_log(dive.log_frame, tmp_path / "log.csv")
    stream = read_log(tmp_path / "log.csv")["place"]
    where = dive.path.motion(stream.time).p_n[:, :2]
    away = np.linalg.norm(where - [5.0, 0.0], axis=1)
    assert (away < 1.0).sum() == (away > 2.0).sum() == len(stream) / 2 >= 2
    with pytest.raises(InputError, match="share of false places"):
        Truth(false_places=1.0)


# what they are worth


@pytest.fixture(scope="session")
def squares() -> Array:
    return all_dives(SEEDS)


@pytest.mark.slow
@pytest.mark.parametrize("kind", range(2), ids=ESTIMATES)
def test_places_halve_the_error_at_the_end_of_a_square(squares, kind):
    alone, seen = squares[:, kind, 0, 0], squares[:, kind, 1, 0]
    assert seen.mean() < 0.5 * alone.mean() and np.median(seen) < 0.5 * np.median(alone)


@pytest.mark.slow
@pytest.mark.parametrize("kind", range(2), ids=ESTIMATES)
def test_three_false_sightings_in_ten_do_no_harm(squares, kind):
    seen, misled = squares[:, kind, 1, 0], squares[:, kind, 2, 0]
    assert misled.mean() < 1.1 * seen.mean()


@pytest.mark.slow
@pytest.mark.parametrize("log", range(1, 3), ids=LOGS[1:])
@pytest.mark.parametrize("kind", range(2), ids=ESTIMATES)
def test_with_places_errors_are_as_large_as_the_estimate_says(squares, kind, log):
    low, high = chi2.ppf([0.025, 0.975], 2 * len(squares)) / len(squares)
    assert low < squares[:, kind, log, 1].mean() < high


if __name__ == "__main__":  # python tests/test_places.py FIRST LAST: the same by hand, on other dives
    import sys

    first, last = (int(a) for a in sys.argv[1:3])
    found = all_dives(range(first, last))
    print("band of the mean NEES", np.round(chi2.ppf([0.025, 0.975], 2 * len(found)) / len(found), 2))
    for k, kind in enumerate(ESTIMATES):
        for j, log in enumerate(LOGS):
            error, nees = found[:, k, j].T
            print(
                f"{kind} {log:10}: error at the end, mean {error.mean():.2f}, median {np.median(error):.2f}, "
                f"worst {error.max():.2f} m; mean NEES {nees.mean():.2f}"
            )
