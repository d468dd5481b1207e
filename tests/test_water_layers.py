"""Profiles of the water: what becomes of their cells, and that chain, filter and live dives know the current alike."""

import json
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rovgraph import Choices, read_log, simulate, smooth
from rovgraph.diagnosis.check.water import profiles
from rovgraph.errors import InputError
from rovgraph.geometry import Array, matrix_from_rpy
from rovgraph.inference.error_state import replay
from rovgraph.inference.initialise import initialise
from rovgraph.inference.smoother import assemble
from rovgraph.kernels import measurement_row as at
from rovgraph.kernels.assembly import FIRST_KNOT, KEYFRAME
from rovgraph.live.outputs.json_lines import json_line
from rovgraph.live.sources.json_lines import JsonRow
from rovgraph.log import Log, Stream
from rovgraph.log.companions import usable_cells
from rovgraph.model.calibration import LAYOUT, TABLE, WATER_LAYER
from rovgraph.model.config import Config, mount_matrix, parse_config
from rovgraph.model.state import State
from rovgraph.problem.assembly import assembly_of
from rovgraph.problem.layers import UNLIKE, WaterLayers, by_mapped_beams, layer_sensors, new_knots, window_changes
from rovgraph.readers.records import Refused
from rovgraph.sensors.dvl import DvlVelocity
from rovgraph.sensors.dvl_beam import beam_geometry
from rovgraph.sensors.water_layer import ADCP, CELLS, WaterLayer

NAMES = ADCP.column_names
JANUS = {"angle_deg": 20.0, "azimuth_deg": [270.0, 90.0, 0.0, 180.0]}


def cells(time: Array | float, **columns: Array) -> Stream:
    """Cells with some of their columns, named without prefix."""
    n = max(np.size(values) for values in columns.values())
    data = np.full((n, len(NAMES)), np.nan)
    for name, values in columns.items():
        data[:, NAMES.index(f"adcp_{name}")] = values
    return Stream(CELLS, NAMES, np.broadcast_to(time, n).astype(float), data, np.arange(n) + 2)


def layers(config: str, depth: float = 20.0, altitude: float | None = None) -> WaterLayers:
    made = WaterLayers(parse_config(config), True)
    made._signals["depth"] = [9.9], [depth]
    if altitude is not None:
        made._signals["dvl_altitude"] = [9.9], [altitude]
    return made


LEVEL = np.empty((0, 7))


def context(rows: Stream) -> Array:
    return rows.data[:, 6 : 6 + at.LAYER_WIDTH]


def test_rows_of_a_profile_hold_all_that_its_cells_say():
    """Least squares by the rows and by the cells themselves give the same velocities and covariance."""
    rng = np.random.default_rng(1)
    far, v = np.arange(3.0, 43.0, 4.0), rng.normal(0.0, [0.3, 0.3, 0.02], (10, 3))
    sd = rng.uniform(0.03, 0.1, 10)
    made = layers("water: {knots: 8, cell_correlation: 0}")
    rows = made.of(cells(10.0, range=far, vx=v[:, 0], vy=v[:, 1], vz=v[:, 2], sd=sd), LEVEL, None, Counter())
    place = (20.0 + far) / 10.0
    Phi = np.maximum(1.0 - np.abs(place[:, None] - np.arange(2, 7)), 0.0)
    W = 1.0 / sd**2
    share, places = context(rows)[:, at.SHARE], context(rows)[:, [at.ABOVE_AT, at.BELOW_AT]]
    knot = {p: j for j, p in enumerate(made._places[np.arange(2, 7) % 8].tolist())}
    A = np.zeros((len(rows), 5))
    for k, (above, below) in enumerate(places.tolist()):
        A[k, knot[above]] += 1.0 - share[k]
        A[k, knot[below]] += share[k]
    by_rows = 1.0 / rows.data[:, 3] ** 2
    np.testing.assert_allclose(A.T * by_rows @ A, Phi.T * W @ Phi, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(A.T * by_rows @ rows.data[:, :3], Phi.T * W @ v, rtol=1e-9, atol=1e-9)
    assert len(rows) == 5 and (share >= 0.0).all() and (share <= 1.0).all()


def test_neighbouring_cells_widen_each_others_noise():
    velocity = {"vx": np.zeros(4), "vy": np.zeros(4), "vz": np.zeros(4)}
    found = [
        layers(f"water: {{knots: 1, cell_correlation: {rho}}}").of(
            cells(10.0, range=np.arange(2.0, 6.0), **velocity), LEVEL, None, Counter()
        )
        for rho in (0.0, 0.15)
    ]
    assert found[0].data[0, 3] == pytest.approx(0.025)
    assert found[1].data[0, 3] == pytest.approx(0.025 * np.sqrt(1.3))


@pytest.mark.parametrize(
    ("bottom", "kept"), [(np.nan, 10), (30.0 / np.cos(np.pi / 6) + 0.01, 10), (30.0 / np.cos(np.pi / 6) - 0.01, 9)]
)
def test_cells_beyond_the_side_lobes_are_left_out(bottom, kept):
    far, zero = np.arange(2.0, 30.0, 3.0), np.zeros(10)
    made = layers("water: {knots: 8}")
    left = Counter()
    made.of(cells(10.0, range=far, cell=2.0, bottom=bottom, vx=zero, vy=zero, vz=zero), LEVEL, None, left)
    assert 10 - sum(left.values()) == kept


def test_a_bottom_that_the_table_does_not_mark_is_known_by_the_altitude():
    far, zero, left = np.arange(2.0, 30.0, 3.0), np.zeros(10), Counter()
    layers("water: {knots: 8}", altitude=15.0).of(cells(10.0, range=far, vx=zero, vy=zero, vz=zero), LEVEL, None, left)
    assert sum(left.values()) == np.count_nonzero(far > 15.0 * np.cos(np.pi / 6))


def test_cells_that_rise_or_sink_unlike_those_beside_them_are_left_out():
    """As the last ones of a real profile do, where echoes are faint; on a tilted head too."""
    rpy = np.array([0.1, -0.4, 0.0])
    v_n = np.tile([0.3, -0.2, 0.5], (9, 1))
    v_n[:, 0] += 0.05 * np.arange(9)
    v_n[[3, 8], 2] += 0.2
    v = v_n @ matrix_from_rpy(rpy)
    by, left = {f"v{axis}": v[:, k] for k, axis in enumerate("xyz")}, Counter()
    layers("water: {knots: 8}").of(
        cells(10.0, range=np.arange(2.0, 20.0, 2.0), roll=rpy[0], pitch=rpy[1], **by), LEVEL, None, left
    )
    assert +left == {(CELLS, UNLIKE): 2}


def test_beams_of_a_tilted_head_are_taken_at_the_depth_of_the_cell():
    head = beam_geometry(parse_config("dvl: {beams: " + str(JANUS).replace("'", "") + "}").dvl)
    R_ns = matrix_from_rpy([0.2, -0.1, 0.7])
    far, along = np.arange(4.0, 44.0, 2.0), np.full((20, 9), np.nan)
    v_n = np.array([0.3, -0.2, 0.4])

    def relative(down: Array) -> Array:
        return v_n - np.column_stack([0.01 * down, -0.004 * down, 0.0 * down])  # the current grows with depth

    for k, number in enumerate(head.numbers):
        there = far / head.directions[k, 2] * (R_ns @ head.directions[k])[2]
        along[:, number] = relative(there) @ R_ns @ head.directions[k]
    down = far * R_ns[2, 2]
    found = by_mapped_beams(along, far, down, head, R_ns[2])
    inside = np.isfinite(found).all(axis=1)
    assert inside.sum() >= 14
    np.testing.assert_allclose(found[inside], (relative(down) @ R_ns)[inside], atol=1e-9)


def test_cells_in_earth_axes_are_turned_back_by_the_instruments_own_attitude():
    rpy, v_n = np.array([0.1, -0.05, 2.0]), np.array([[0.3, 0.1, 0.2]])
    by = {"north": v_n[:, 0], "east": v_n[:, 1], "down": v_n[:, 2], "roll": rpy[0], "pitch": rpy[1], "heading": rpy[2]}
    rows = layers("water: {knots: 1}").of(cells(10.0, range=np.array([5.0]), **by), LEVEL, None, Counter())
    np.testing.assert_allclose(rows.data[0, :3], v_n[0] @ matrix_from_rpy(rpy), atol=1e-12)


def test_the_window_follows_the_vehicle_and_stays_where_it_can():
    made, zero, first = layers("water: {knots: 5}"), np.zeros(9), []
    for depth in (21.0, 29.0, 19.5, 47.0, 500.0, 30.0):
        made._signals["depth"] = [9.9], [depth]
        far = np.arange(1.0, 28.0, 3.0)
        rows = made.of(
            cells(10.0, range=far, vx=zero, vy=zero, vz=zero), LEVEL, int(first[-1]) if first else None, Counter()
        )
        first.append(float(context(rows)[0, at.FIRST_KNOT]))
    assert first == [2.0, 2.0, 2.0, 4.0, 49.0, 3.0]


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({"range": np.ones(2)}, "no velocities"),
        ({"vx": np.ones(2), "vy": np.ones(2), "vz": np.ones(2)}, "without ranges"),
        ({"range": np.ones(2), "north": np.ones(2), "east": np.ones(2), "down": np.ones(2)}, "heading, roll and pitch"),
        ({"range": np.ones(2), "beam_1": np.ones(2)}, "where the beams point"),
    ],
)
def test_cells_that_cannot_be_used_are_named_in_one_line(columns, said):
    streams = {
        CELLS: cells(1.0, **columns),
        "depth": Stream("depth", ("depth",), np.ones(1), np.ones((1, 1)), np.ones(1)),
    }
    used, why = layer_sensors(parse_config(""), streams)
    assert not used and said in why and "\n" not in why
    assert "no depth" in layer_sensors(parse_config(""), {CELLS: cells(1.0, range=np.ones(1), vx=np.ones(1))})[1]


def test_a_table_without_ranges_and_one_of_another_clock_are_left_out_with_a_warning():
    with pytest.warns(match="cells without ranges"):
        assert usable_cells({"time": np.ones(3), "vx": np.ones(3)}, parse_config(""), "adcp") is None
    table = {"time": np.repeat([1e5, 1e5 + 1], 2), "range": np.tile([2.0, 4.0], 2), "vx": np.arange(4.0)}
    stream = usable_cells(table, parse_config(""), "adcp")
    log = Log.from_arrays(time=np.arange(0.0, 3.0, 0.1), depth=np.arange(30.0))
    with pytest.warns(match="profiles of the water have times"):
        assert CELLS not in log.with_profiles(stream)


def test_range_and_heading_of_the_table_are_not_those_of_other_sensors():
    table = {"time": [1.0, 1.0], "range": [2.0, 4.0], "heading": [0.1, 0.1], "vx": [0.1, 0.2]}
    stream = usable_cells(table, parse_config(""), "adcp")
    np.testing.assert_allclose(stream["adcp_range"], [2.0, 4.0])
    np.testing.assert_allclose(stream["adcp_heading"], 0.1)


def descending(
    seed: int = 1, knots: int | None = 4, surface_s: float = 40.0, count: int = 5, **setting: Any
) -> tuple[Log, Config, Array]:
    """A descent to 100 m without bottom lock in the middle, through sheared water, and where it ends."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
    import water
    from fault_campaign.instruments import log_table

    profiler = water.Profiler(count, 4.0, 4.0)
    dive, table = water.make_dive(water.Setting(profiler, surface_s=surface_s, depth=100.0, **setting), seed)
    dive.configuration["water"]["knots"] = knots
    config = Config.model_validate(dive.configuration)
    log = Log.from_frame(log_table(dive.streams), config)
    log = log.with_profiles(usable_cells({n: table[n].to_numpy() for n in table}, config, "adcp"))
    return log, config, dive.motion.local(np.array([dive.motion.duration]))[0]


@pytest.fixture(scope="module")
def descent() -> tuple[Log, Config]:
    """A short descent through three windows."""
    return descending()[:2]


def test_water_track_is_not_used_beside_the_profiles_that_it_is_a_mean_of(descent):
    log, config = descent
    track = replace(log["dvl"], sensor="dvl_water", data=log["dvl"].data[:, :3])
    both = replace(log, streams={**log.streams, "dvl_water": track})
    initial = initialise(both, config)
    assert WATER_LAYER in initial.instruments and "dvl_water" not in initial.instruments
    assert any(line.startswith("dvl_water is left out") for line in initial.assumptions)
    assert (
        "dvl_water"
        in initialise(replace(both, streams={**both.streams, CELLS: log[CELLS].take([])}), config).instruments
    )


@pytest.mark.slow
@pytest.mark.parametrize("knots", [4, 1])
def test_isam2_knows_the_track_as_the_filter_does(descent, knots):
    """Through moving windows; its knots keep their values for a segment of time, so a little differs."""
    pytest.importorskip("gtsam")
    from rovgraph.inference.graph.isam2 import run_isam2

    log, config = descent
    config = config.model_copy(update={"water": config.water.model_copy(update={"knots": knots})})
    initial = initialise(log, config)
    problem = assemble(log, initial).problem
    isam2 = run_isam2(problem, initial, update_s=1.0).filtered().trajectory
    filtered = smooth(log, config, "filtered").main.trajectory
    late = slice(len(problem) // 4, None)
    sd = np.sqrt(filtered.cov_p[late, 0, 0])
    off = np.abs(isam2.p_n - filtered.p_n)[late, :2] / sd[:, None]
    assert off.max() < 0.5 and np.median(off) < 0.05
    np.testing.assert_allclose(np.sqrt(isam2.cov_p[late, 0, 0]), sd, rtol=0.05)


def test_the_only_knot_follows_the_depth_as_the_current_changes_with_it():
    made, zero, first = layers("water: {knots: 1}"), np.zeros(2), []
    for depth in (20.0, 20.9, 21.1, 60.0):
        made._signals["depth"] = [9.9], [depth]
        profile = cells(10.0, range=np.array([4.0, 6.0]), vx=zero, vy=zero, vz=zero)
        (row,) = context(made.of(profile, LEVEL, first[-1] if first else None, Counter()))
        first.append(float(row[at.FIRST_KNOT]))
    np.testing.assert_allclose(first, [2.5, 2.5, 2.61, 6.5])
    keyframes = np.zeros((4, KEYFRAME))
    keyframes[:, FIRST_KNOT] = first
    problem = SimpleNamespace(keyframes=keyframes)
    water = Config().water.model_copy(update={"knots": 1})
    assert [len(new_knots(problem, k, water)) for k in range(4)] == [0, 0, 1, 1]
    (knot,) = new_knots(problem, 3, water)
    kept = np.exp(-38.9 / water.correlation_m)
    assert knot == ("current", "current", pytest.approx(kept), pytest.approx(0.3 * np.sqrt(1.0 - kept**2)))


@pytest.mark.slow
def test_one_knot_in_sheared_water_is_uncertain_and_not_wrong():
    """Where one current is carried down, it is off by several sds."""
    square = []
    for seed in range(4):
        log, config, end = descending(seed, knots=1)
        track = smooth(log, config, "smoothed").main.trajectory
        off = track.p_n[-1, :2] - end[:2]
        square.append(off @ np.linalg.solve(track.cov_p[-1, :2, :2], off) / 2.0)
    assert np.mean(square) < 2.0, square


@pytest.mark.slow
def test_a_current_that_changes_faster_than_stated_is_found_and_used():
    """At 0.04 m/s within 200 s it walks 4e-3 m/s/rts; half as much again is believed, for what is alike over depth."""
    log, config, _ = descending(surface_s=200.0, fast=0.04)
    slow = config.model_copy(update={"water": config.water.model_copy(update={"walk_mps": 5e-4})})
    found = smooth(log, slow)
    (noise,) = found.main.summary["noise_found"]
    assert noise["key"] == "water.walk_mps" and noise["values"] == pytest.approx(6e-3, rel=0.25)
    assert found.dive.initial.beliefs["water_layer_1"].walk == pytest.approx(noise["values"])
    assert not smooth(log, config, "smoothed").main.summary.get("noise_found")  # 6e-3, the default
    calm, config, _ = descending(surface_s=200.0)
    assert not smooth(calm, config, "smoothed").main.summary.get("noise_found")


@pytest.mark.slow
def test_chain_and_filter_agree_through_moving_windows(descent):
    """Going back over the filter's steps gives the smoother, through knots that others take the place of."""
    log, config = descent
    initial = initialise(log, config)
    smoother = assemble(log, initial)
    problem = smoother.problem
    moved = window_changes(problem)
    assert len(moved) > 5 and all(new_knots(problem, k, config.water) for k in moved.tolist())
    back, chain = replay(problem, initial).smoothed().trajectory, smoother.solve().trajectory
    sd = chain.to_frame()[["north_sd", "east_sd"]].to_numpy()
    late = slice(len(problem) // 4, None)
    assert (np.abs(back.p_n - chain.p_n)[late, :2] < 0.5 * sd[late]).all()
    np.testing.assert_allclose(back.to_frame()["north_sd"].to_numpy()[late], sd[late, 0], rtol=0.2)


@pytest.mark.slow
def test_a_dive_measurement_by_measurement_has_the_rows_of_the_whole_log(descent):
    log, config = descent
    initial = initialise(log, config)
    whole, live = assemble(log, initial).problem, assembly_of(initial)
    for m in log.measurements():
        live.insert(m)
        live.extend()
    live.extend(finish=True)
    one = live.problem
    np.testing.assert_array_equal(one.keyframes[:, FIRST_KNOT], whole.keyframes[:, FIRST_KNOT])
    rows = (problem.rows[problem.of_sensor(WATER_LAYER)] for problem in (one, whole))
    np.testing.assert_allclose(*rows, atol=1e-12)


def test_with_one_knot_a_layer_has_the_equation_of_water_track():
    rng, at_current = np.random.default_rng(3), np.zeros((1, at.LAYER_WIDTH))
    at_current[0, [at.ABOVE_AT, at.BELOW_AT]] = LAYOUT["current"].start
    calibration = {name: 0.1 * rng.standard_normal(v.dim) for name, v in TABLE.items()}
    state = State(matrix_from_rpy([[0.1, -0.2, 1.0]]), *rng.standard_normal((2, 1, 3)), np.zeros((1, 6)), calibration)
    rate = rng.standard_normal((1, 3))
    layer = WaterLayer(at_current, knots=1).predict(state, rate)
    track = DvlVelocity(np.zeros(3), "dvl_water").predict(state, rate)
    np.testing.assert_array_equal(layer[0], track[0])
    assert layer[1].keys() == track[1].keys()
    for name, by in track[1].items():
        np.testing.assert_array_equal(layer[1][name], by)


def test_the_current_of_a_dive_is_what_it_was_and_is_in_its_results(descent, tmp_path):
    """At the depths of its knots, within their sds; the page draws it."""
    from fault_campaign.water import draw

    from rovgraph.report.pages.dive import dive_section
    from rovgraph.report.pages.source import DiveSource

    log, config = descent
    done = smooth(log, config)
    found = done.main.current
    true = draw(np.random.default_rng([29, 1]), 250.0).at(found["depth"].to_numpy(), found["time"].to_numpy())
    off = (found[["north", "east"]].to_numpy() - true) / found[["north_sd", "east_sd"]].to_numpy()
    assert len(found) > 50 and set(np.diff(np.unique(found["depth"]))) == {10.0}
    assert np.abs(off).max() < 4.0 and 0.3 < np.sqrt(np.mean(off**2)) < 1.6
    source = DiveSource(tmp_path / "out", done.save(tmp_path / "out", figures=False, page=False))
    panels = {item.title: item for item in dive_section(source).items}
    assert len(panels["Current north"].traces[0]["marker"]["color"]) == len(found)


def test_a_dive_online_knows_the_current_as_its_filter_does(descent):
    from live import flown

    log, config = descent
    solutions = flown(SimpleNamespace(log=log, config=config), rate=1.0).solutions
    filtered = smooth(log, config, "filtered").main.trajectory
    last = solutions[-1]
    k = int(np.abs(filtered.time - last.time).argmin())
    np.testing.assert_allclose(last.position, filtered.p_n[k], atol=0.05 * last.position_sd[0])
    np.testing.assert_allclose(last.position_sd, np.sqrt(np.diag(filtered.cov_p[k])), rtol=0.05)
    assert [at.depth for at in last.current] == [100.0, 110.0, 120.0, 130.0]
    assert json.loads(json_line(last))["current"][0]["depth"] == 100.0
    assert not any("layer" in label for label in last.calibration)
    assert last.sensors[CELLS].used > 200  # rows that its profiles became


def test_profiles_that_a_section_states_may_begin_later(descent):
    from live import flown

    log, config = descent
    late = replace(log, streams={**log.streams, CELLS: log[CELLS].take(log[CELLS].time > 20.0)})
    late = replace(late, streams={name: s.take(s.time < 30.0) for name, s in late.streams.items()})
    assert flown(SimpleNamespace(log=late, config=config), rate=1.0).solutions[-1].current
    unstated = config.model_copy(update={"water": Config().water})
    assert not flown(SimpleNamespace(log=late, config=unstated), rate=1.0).solutions[-1].current


def test_a_json_line_may_hold_a_profile():
    row = JsonRow("-", lambda *_, **__: None, parse_config("units: {adcp_velocity: -mm/s}"))
    profile = [{"range": 4.0, "vx": 100, "vy": 0, "vz": -20}, {"range": 8.0, "vx": 120, "vy": None, "vz": 0}]
    message = row.message(json.dumps({"time": 7.0, "depth": 3.0, "adcp": profile}).encode(), 0.0)
    assert [reading.sensor for reading in message.readings] == ["depth", CELLS, CELLS]
    first = dict(zip(NAMES, message.readings[1].values, strict=True))
    assert message.stamp == 7.0 and first["adcp_range"] == 4.0
    assert first["adcp_vx"] == pytest.approx(-0.1) and first["adcp_vz"] == pytest.approx(0.02)
    with pytest.raises(Refused, match="expected a list of cells"):
        row.message(b'{"time": 7.0, "adcp": 3}', 0.0)


def findings(log: Log, config: Config) -> dict[str, str]:
    return {f.kind: f.text for f in profiles(log, config) if f.level == "warning"}


def test_check_finds_a_clock_and_a_sign_by_the_depth(descent):
    log, config = descent
    assert findings(log, config) == {}
    stream = log[CELLS]
    late = replace(log, streams={**log.streams, CELLS: replace(stream, time=stream.time + 3.0)})
    assert "+3.0 s late" in findings(late, config)["lag"]
    turned = stream.data.copy()
    turned[:, [NAMES.index(f"adcp_v{axis}") for axis in "xyz"]] *= -1.0
    away = replace(log, streams={**log.streams, CELLS: replace(stream, data=turned)})
    assert "state units: {adcp_velocity: -m/s}" in findings(away, config)["sign"]
    upwards = stream.data.copy()
    upwards[:, NAMES.index("adcp_vz")] *= -1.0
    rising = replace(log, streams={**log.streams, CELLS: replace(stream, data=upwards)})
    assert "if only the vertical one is wrong, {adcp_vz: -m/s}" in findings(rising, config)["sign"]


@pytest.fixture(scope="module")
def long_profiles() -> tuple[Log, Config]:
    """The same descent with profiles that overlap more."""
    return descending(0, knots=None, count=25, surface_s=60.0)[:2]


def changed(log: Log, **factors: float) -> Log:
    """A log with columns of its profiles times a factor."""
    data = log[CELLS].data.copy()
    for name, factor in factors.items():
        data[:, NAMES.index(f"adcp_{name}")] *= factor
    return replace(log, streams={**log.streams, CELLS: replace(log[CELLS], data=data)})


@pytest.mark.parametrize(
    "factor, remedy",
    [
        (1.0, "water.looks: down"),
        (100.0, "units: {adcp_range: cm}"),
        (1.0 / 0.3048, "units: {adcp_range: ft}"),
        (-1.0, "units: {adcp_range: -m}"),
    ],
)
def test_check_finds_where_cells_are_by_the_water_that_profiles_share(long_profiles, factor, remedy):
    """The remedy of a wrong sense leaves no finding; what a unit does to a range is what was done to it here."""
    log, config = long_profiles
    assert findings(log, config) == {}
    if "looks" in remedy:
        up = config.with_values(water={"looks": "up"})
        assert remedy in findings(log, up)["turned"]
    else:
        assert remedy in findings(changed(log, range=factor, cell=factor), config)["unit"]


def test_water_without_shear_shows_nothing_of_where_cells_are(long_profiles):
    """Whatever is stated: one current at all depths."""
    log, config = long_profiles
    cells, rng = log[CELLS], np.random.default_rng(4)
    data = cells.data.copy()
    along = [NAMES.index(f"adcp_v{axis}") for axis in "xyz"]
    first = data[np.searchsorted(cells.time, cells.time)][:, along]  # of each profile
    data[:, along] = first + rng.normal(0.0, [0.05, 0.05, 0.02], first.shape)
    still = replace(log, streams={**log.streams, CELLS: replace(cells, data=data)})
    for looks in ("down", "up"):
        assert findings(still, config.with_values(water={"looks": looks})) == {}


def test_check_finds_units_of_velocities_by_the_depth(long_profiles):
    log, config = long_profiles
    for unit, factor in (("mm/s", 1e3), ("cm/s", 1e2), ("ft/s", 1.0 / 0.3048)):
        found = findings(changed(log, vx=factor, vy=factor, vz=factor), config)
        assert f"units: {{adcp_velocity: {unit}}}" in found["unit"] and len(found) == 1


def test_check_finds_a_head_that_is_turned_and_a_clock_by_the_imu(long_profiles):
    """Level, so that the depth shows neither; the mounting that is named is the one that turns them back."""
    log, config = long_profiles
    cells = log[CELLS]
    level = replace(log, streams={**log.streams, "depth": replace(log["depth"], data=0.0 * log["depth"].data + 5.0)})
    late = replace(level, streams={**level.streams, CELLS: replace(cells, time=cells.time + 3.0)})
    lag = findings(late, config)["lag"]
    assert float(lag.split("delay_s: {adcp: ")[1].rstrip("}")) == pytest.approx(3.0, abs=0.2)
    data = cells.data.copy()
    x, y = NAMES.index("adcp_vx"), NAMES.index("adcp_vy")
    data[:, x], data[:, y] = cells.data[:, y], -cells.data[:, x]
    turned = replace(level, streams={**level.streams, CELLS: replace(cells, data=data)})
    text = findings(turned, config)["axes"]
    rpy = json.loads(text.split("dvl.mount_rpy_deg: ")[1].split("]")[0] + "]")
    np.testing.assert_allclose(rpy, [0.0, 0.0, 90.0], atol=8.0)


@pytest.mark.slow
def test_a_dive_whose_head_looks_the_other_way_is_not_trusted(long_profiles):
    log, config = long_profiles
    up = smooth(log, config.with_values(water={"looks": "up"}))
    assert up.verdict != "trusted" and any("state water.looks: down" in line for line in up.warnings)
    assert smooth(log, config).verdict == "trusted"


@pytest.mark.slow
def test_knots_that_are_too_far_apart_are_named(long_profiles):
    log, config = long_profiles
    far = smooth(log, config.with_values(water={"knot_m": 100.0}), "smoothed")
    lines = [alarm.text for alarm in far.alarms if alarm.sensor == WATER_LAYER]
    assert lines and all("state water.knot_m: 10" in line for line in lines)


@pytest.mark.slow
def test_a_dive_online_says_that_its_head_looks_the_other_way(long_profiles):
    from live import flown

    log, config = long_profiles
    up = SimpleNamespace(log=log, config=config.with_values(water={"looks": "up"}))
    events = [e for s in flown(up, rate=1.0).solutions for e in s.events]
    assert any(e.source == CELLS and "state water.looks: down" in e.text for e in events), events


@pytest.mark.parametrize("marked", [False, True])
def test_check_finds_a_bottom_within_the_range_that_nothing_marks(marked):
    """Echoes of the bottom move over the vehicle as it does: here from the fifth cell on."""
    rng, t, far = np.random.default_rng(2), np.arange(0.0, 120.0, 2.0), np.arange(2.0, 16.0, 2.0)
    over = np.column_stack([0.5 + 0.2 * np.sin(0.1 * t), 0.1 * np.cos(0.1 * t), 0.3 * np.cos(0.2 * t)])
    v = over[:, None] - np.where(far < 10.0, 0.25, 0.0)[None, :, None] * [1.0, 0.0, 0.0]
    v = (v + rng.normal(0.0, 0.02, v.shape)).reshape(-1, 3)
    columns = {f"v{axis}": v[:, k] for k, axis in enumerate("xyz")} | {"range": np.tile(far, len(t))}
    stream = cells(np.repeat(t, len(far)), **columns, **({"bottom": np.full(len(v), 11.0)} if marked else {}))
    depth = 20.0 + 1.5 * np.sin(0.2 * t)
    log = Log.from_arrays(time=t, depth=depth, dvl_vx=over[:, 0], dvl_vy=over[:, 1], dvl_vz=over[:, 2])
    found = findings(log.with_profiles(stream), parse_config(""))
    assert found == {} if marked else "from 10 m on move as the bottom" in found[""]


def test_a_simulated_dive_has_profiles_that_smoothing_takes(tmp_path):
    """By the equation of the estimate: with the true state and current, what is left is the noise of a cell."""
    made = simulate(
        "lawnmower", seed=3, choices=Choices(duration=60.0, depth=30.0, dropouts=((10.0, 50.0),), profiles=(4, 9))
    )
    made.save(tmp_path / "dive")
    log = read_log(tmp_path / "dive" / "log.csv")
    assert set(np.unique(log[CELLS]["adcp_range"])) == set(np.arange(4.0, 40.0, 4.0))
    world, truth = made.dive.hidden["world"], made.dive.truth
    config, table = Config(), made.dive.log_frame.dropna(subset=["adcp_vx"])
    table = table[(table["time"] > 10.0) & (table["time"] < 50.0)]
    k = np.searchsorted(truth.time, table["time"].to_numpy())
    R_ns = truth.R_nb[k] @ mount_matrix(config.dvl.mount_rpy_deg)
    depth = truth.p_n[k, 2] + table["adcp_range"].to_numpy() * R_ns[:, 2, 2]
    current = np.column_stack([np.interp(depth, world["current_depth"], c) for c in world["current_n"].T])
    water = truth.v_n[k] - np.column_stack([current, np.zeros(len(k))])
    off = table[["adcp_vx", "adcp_vy", "adcp_vz"]].to_numpy() - (water[:, None] @ R_ns)[:, 0]
    assert len(k) == 20 * 9 and np.ptp(current) > 0.2
    assert np.sqrt(np.mean(off**2, axis=0)) == pytest.approx(config.water.cell_sd_mps, rel=0.5)
    with pytest.raises(InputError, match="as \\(4, 25\\)"):
        Choices(profiles=(4, 0))


def test_cells_whose_vertical_velocity_is_noise_are_not_called_late():
    """The depth stands still for a while at the end, where noise is nearest to it."""
    rng, time = np.random.default_rng(1), np.arange(0.0, 100.0)
    depth = np.where(time < 70.0, 5.0 + 3.0 * np.sin(0.3 * time), 5.0)
    log = Log.from_arrays(time=time, depth=depth)
    three = {name: rng.normal(0.0, 0.01, 2 * len(time)) for name in ("vx", "vy", "vz")}
    table = {"time": np.repeat(time, 2), "range": np.tile([2.0, 4.0], len(time)), **three}
    stream = usable_cells(table, parse_config(""), "adcp")
    found = [*profiles(log.with_profiles(stream), parse_config(""))]
    assert [f.kind for f in found if f.level == "warning"] == []
