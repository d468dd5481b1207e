"""Short dives are estimated and judged as they were when tests/golden was recorded.

A change of the estimators, of their priors or of the rules that moves one of these numbers shows here. Where that is
meant, record anew and say in the changelog which dives moved and why:

python tests/test_golden.py --record [NAME ...]
"""

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from broken import changed_data
from dives import Simulated, as_log, changed, falcon, simulated, started, without
from live import message, turned
from test_no_imu import with_attitude

from rovgraph.diagnosis.alarm import Alarm
from rovgraph.dive import DiveEstimates, smooth
from rovgraph.geometry import Array
from rovgraph.inference.estimate import Estimate
from rovgraph.live.clocks import Clocks
from rovgraph.live.navigator import Navigator
from rovgraph.log import Log
from rovgraph.model.config import Config
from rovgraph.simulate import Choices, Style, Waves, scenario, simulate
from rovgraph.simulate.driven import Steps, VelocityControl, World, drive
from rovgraph.simulate.environment import Sea
from rovgraph.simulate.named import lake

GOLDEN = Path(__file__).parent / "golden"
# by how much numbers may differ from those of another machine, with other libraries and instructions
RELATIVE = 1e-6
ABSOLUTE = 1e-7  # [m, rad, 1, ...]
TIMES = 20  # at which a track is recorded
SLOW_RATES: dict[str, Any] = {"imu_rate": 25.0, "dvl_rate": 2.0, "depth_rate": 1.0}
FAILS_S = (20.0, 30.0)  # since the start
LIVELY = Style(5.0, 0.8, 1.0, Waves(heave=0.05, roll=0.1, pitch=0.08))  # at rest for a short time only

Case = tuple[Log, Config]


def falcon_dive(seconds: float = 40.0, seed: int = 1, config: Config | None = None, **truth: Any) -> Simulated:
    return simulated(config or falcon(), seconds, seed, style=LIVELY, **{**SLOW_RATES, **truth})


def plain() -> Case:
    case = falcon_dive()
    return case.log, case.config


def fixes() -> Case:
    case = falcon_dive(seed=2, fix_interval=2.0)
    return case.log, case.config


def ahrs() -> Case:
    case = falcon_dive(seed=3, config=falcon(heading={"sources": ["ahrs", "dvl"]}), ahrs_rate=5.0)
    return case.log, case.config


def no_imu() -> Case:
    """A vehicle that tells its own attitude, with a depth sensor."""
    heading, dvl = {"sources": ["vehicle"], "vehicle_sd_deg": 1.0}, {"velocity_sd_mps": [0.02, 0.02, 0.02]}
    config = falcon(heading=heading, dvl=dvl, tilt={"sd_deg": 0.5}, motion={"acc": 0.05, "rate_sd_dps": 3.0})
    case = falcon_dive(60.0, 4, config, imu_rate=50.0)
    log = without(case.log, "imu", "mag", "ahrs", "dvl_heading", "vehicle_heading")
    return with_attitude(log, case, np.random.default_rng(4)), config


def boat() -> Case:
    """A boat on the surface with a DVL, a compass and a satellite receiver."""
    heading, dvl = {"sources": ["vehicle"], "vehicle_sd_deg": 2.0}, {"velocity_sd_mps": [0.02, 0.02, 0.02]}
    config = falcon(heading=heading, dvl=dvl, tilt={"sd_deg": 0.5}, fix={"sd_m": 1.0})
    rates = {**SLOW_RATES, "imu_rate": 50.0, "fix_interval": 1.0}
    case = simulated(config, 60.0, 5, "lawnmower", LIVELY, **rates)
    log = without(case.log, "imu", "mag", "ahrs", "dvl_heading", "vehicle_heading", "depth")
    return with_attitude(log, case, np.random.default_rng(5)), config


def water_track() -> Case:
    case = falcon_dive(seed=6, water_track=True, dropouts=((20.0, 30.0),))
    return case.log, case.config


def places() -> Case:
    """Circles past places that are recognised, without bottom lock for half of one."""
    config = falcon(place={"sd_m": 0.1, "every_s": 0.5}, start={"position_sd_m": 0.01})
    path = scenario("circle", 60.0, 1.2, LIVELY)
    round_it = {"places": ((4.8, 4.5), (-4.8, 4.7)), "dropouts": ((25.0, 33.0),)}
    case = simulated(config, 60.0, 7, path, **SLOW_RATES, **round_it)
    return case.log, started(case)


def thrusters() -> Case:
    """Pushes on every axis in a current, the last ones without bottom lock."""
    config = changed(lake(), graph={"hydrodynamics": True})
    world = World.drawn(config, Choices(dropouts=((30.0, 40.0),)), 8)
    forces = np.array([[30.0, 0, 0, 0], [0, 90, 0, 0], [140, 0, 0, 40], [0, 220, 0, 0], [90, 60, 0, 0]])
    station = np.array([0.0, 0.0, 8.0, 0.5])
    pilot = Steps(VelocityControl(world.vehicle), forces, station, rest=5.0, push=4.5, pause=2.5)
    sea = Sea(np.array([0.06, -0.04, 0.0]), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))
    path = drive(world.vehicle, sea, pilot, station, pilot.duration)
    dive = simulate(path, world.truth(path, sea, lake=False), np.random.default_rng(8))
    north, east, down = dive.truth.p_n[0]
    start = {"north_m": north, "east_m": east, "down_m": down, "position_sd_m": 0.01}
    return as_log(dive.log_frame), changed(config, start=start)


def isam2() -> Case:
    case = falcon_dive(30.0, 9, falcon(graph={"solver": "isam2"}))
    return case.log, case.config


def frozen_dvl(seconds: float = 50.0) -> Case:
    def repeat(data: Array, time: Array) -> None:
        now = np.flatnonzero((time > FAILS_S[0]) & (time < FAILS_S[1]))
        data[now, :3] = data[now[0] - 1, :3]

    case = falcon_dive(seconds, 10)
    return changed_data("dvl", repeat)(case.log), case.config


def biased_dvl(seconds: float = 50.0) -> Case:
    def off(data: Array, time: Array) -> None:
        data[(time > FAILS_S[0]) & (time < FAILS_S[1]), 0] += 0.3

    case = falcon_dive(seconds, 11)
    return changed_data("dvl", off)(case.log), case.config


def compass_step() -> Case:
    """A magnetometer that steel turns by 8 degrees from half the dive on."""
    case = falcon_dive(seed=12)
    mag, middle = case.log["mag"], 20.0 + case.log["imu"].time[0]
    data = [
        turned(m, np.deg2rad(8.0)).values if m.time > middle else m.values
        for m in case.log.measurements()
        if m.sensor == "mag"
    ]
    log = replace(case.log, streams={**case.log.streams, "mag": replace(mag, data=np.array(data))})
    return log, case.config


def online_fixes() -> Case:
    case = falcon_dive(90.0, 13, fix_interval=2.0)
    return case.log, case.config


DIVES: dict[str, Callable[[], Case]] = {
    made.__name__: made
    for made in (
        plain,
        fixes,
        ahrs,
        no_imu,
        boat,
        water_track,
        places,
        thrusters,
        isam2,
        frozen_dvl,
        biased_dvl,
        compass_step,
    )
}
REPLAYS: dict[str, Callable[[], Case]] = {
    "online_fixes": online_fixes,
    "online_frozen_dvl": lambda: frozen_dvl(90.0),
    "online_biased_dvl": lambda: biased_dvl(90.0),
}
SLOW: frozenset[str] = frozenset()


def judged(verdict: str, alarms: list[Alarm]) -> dict[str, Any]:
    return {"verdict": verdict, "alarms": sorted([a.severity, a.kind, a.sensor] for a in alarms)}


def track(estimate: Estimate) -> dict[str, Any]:
    """Rows of time, north, east, down and their sds, heading and its sd [s, m, rad]."""
    t = estimate.trajectory
    t = t.take(np.linspace(0, len(t) - 1, TIMES).astype(int))
    rows = np.column_stack([t.time, t.p_n, t.p_sd, t.rpy[:, 2], t.rpy_sd[:, 2]])
    return {"track": rows.tolist()}


def estimated(estimate: Estimate) -> dict[str, Any]:
    """The track, what was estimated with its sd, and mean squares of the weighted residuals."""
    r = estimate.residuals
    squares = (r["weight"] * r["normalised"] ** 2).groupby(r["sensor"]).mean()
    constants = {c.label: [c.value, c.sd] for c in estimate.calibration if c.estimated}
    return {**track(estimate), "calibration": constants, "mean_squares": squares.to_dict()}


def smoothed_summary(dive: DiveEstimates) -> dict[str, Any]:
    return judged(dive.verdict, dive.alarms) | {
        e.kind: estimated(e) for e in dive.estimates if e.kind != "dead_reckoning"
    }


def online_summary(log: Log, config: Config) -> dict[str, Any]:
    """What a navigator says of a log at some times, and at its end."""
    nav, rows = Navigator(config, patient=True, clocks=Clocks(trust=True)), []
    measurements = list(log.measurements())
    due = np.linspace(measurements[0].time, measurements[-1].time, TIMES + 2)[1:-1]
    solution = None
    for m in measurements:
        nav.take(message(m))
        if len(rows) < TIMES and nav.time >= due[len(rows)] and (solution := nav.solution()) is not None:
            s = solution
            rows.append([s.time, *s.position, *s.position_sd, s.rpy[2], s.rpy_sd[2]])
    nav.finish()
    last = nav.solution() or solution
    assert last is not None
    rows = [[float(value) for value in row] for row in rows]
    constants = {label: list(map(float, pair)) for label, pair in last.calibration.items()}
    alarms = list(nav.alarms.history.values())
    return judged(last.verdict, alarms) | {"online": {"track": rows, "calibration": constants}}


def summary(name: str) -> dict[str, Any]:
    return online_summary(*REPLAYS[name]()) if name in REPLAYS else smoothed_summary(smooth(*DIVES[name]()))


def differences(expected: Any, found: Any, where: str = "") -> Iterator[str]:
    """Where two summaries are not the same, a line each."""
    if isinstance(expected, dict) and isinstance(found, dict):
        for key in sorted({*expected, *found}):
            yield from differences(expected.get(key), found.get(key), f"{where}/{key}")
    elif isinstance(expected, list) and isinstance(found, list) and len(expected) == len(found):
        for k, (one, other) in enumerate(zip(expected, found, strict=True)):
            yield from differences(one, other, f"{where}/{k}")
    elif isinstance(expected, float) and isinstance(found, float):
        if not np.isclose(found, expected, RELATIVE, ABSOLUTE, equal_nan=True):
            yield f"{where}: {found!r}, was {expected!r}"
    elif expected != found:
        yield f"{where}: {found!r}, was {expected!r}"


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n in SLOW)) for n in (*DIVES, *REPLAYS)])
def test_a_dive_is_estimated_and_judged_as_it_was(name):
    expected = json.loads((GOLDEN / f"{name}.json").read_text(encoding="utf-8"))
    assert not list(differences(expected, summary(name)))


def test_every_recorded_dive_is_run():
    assert {path.stem for path in GOLDEN.glob("*.json")} == {*DIVES, *REPLAYS}


def test_a_number_that_moved_a_missing_one_and_another_alarm_are_differences():
    one = {"alarms": [["doubtful", "held", "dvl"]], "x": [1000.0, 2.0, 0.0]}
    assert not list(differences(one, {**one, "x": [1000.0 + 5e-4, 2.0, 5e-8]}))
    assert list(differences(one, {**one, "x": [1000.0, 2.00001, 2e-7]})) == [
        "/x/1: 2.00001, was 2.0",
        "/x/2: 2e-07, was 0.0",
    ]
    assert len(list(differences(one, {"alarms": [["wrong", "held", "dvl"]]}))) == 2


def written(what: dict[str, Any]) -> str:
    """JSON with a row of numbers on a line, to ten digits."""

    def rounded(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: rounded(one) for key, one in value.items()}
        if isinstance(value, list):
            return [rounded(one) for one in value]
        return float(f"{value:.10g}") if isinstance(value, float) else value

    def lines(value: Any, indent: str) -> str:
        inner = indent + " "
        if isinstance(value, dict) and value:
            own = (f"{inner}{json.dumps(key)}: {lines(one, inner)}" for key, one in value.items())
            return "{\n" + ",\n".join(own) + f"\n{indent}}}"
        if isinstance(value, list) and value and isinstance(value[0], list):
            return "[\n" + ",\n".join(inner + json.dumps(one) for one in value) + f"\n{indent}]"
        return json.dumps(value)

    return lines(rounded(what), "") + "\n"


if __name__ == "__main__":
    import time

    assert sys.argv[1:2] == ["--record"], __doc__
    for name in sys.argv[2:] or (*DIVES, *REPLAYS):
        begun = time.process_time()
        made = summary(name)
        (GOLDEN / f"{name}.json").write_text(written(made), encoding="utf-8")
        print(f"{name}: {made['verdict']}, {time.process_time() - begun:.1f} s, {made['alarms']}", flush=True)
