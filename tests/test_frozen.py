"""Measurements that a sensor repeats although the vehicle moves are found and left out."""

import numpy as np
import pytest
from dives import Simulated, altered, falcon, kept, position_errors, rms, simulated

from rovgraph.config import Config
from rovgraph.dive import smooth
from rovgraph.geometry import Array
from rovgraph.log import Log
from rovgraph.log.frozen import equal_runs, frozen_stretches, without_frozen
from rovgraph.simulate import CALM, Style

FROM, TO = 60.0, 120.0
STEADY = Style(waves=CALM)


@pytest.fixture(scope="module")
def case() -> Simulated:
    return simulated(falcon(), 200.0, seed=3, ahrs_rate=10.0)


def during(log: Log, sensor: str) -> Array:
    time = log[sensor].time
    return (time >= FROM) & (time <= TO)


def held(log: Log, sensor: str) -> Log:
    """A log in which a sensor repeats its last value for a minute."""
    data, now = log[sensor].data.copy(), during(log, sensor)
    data[now, :3] = data[np.flatnonzero(now)[0] - 1, :3]
    return altered(log, sensor, data)


@pytest.mark.parametrize("sensor", ["dvl", "mag", "dvl_heading", "ahrs", "depth"])
def test_a_value_held_for_a_minute_is_frozen_and_no_other_is(case, sensor):
    (found,) = frozen_stretches(held(case.log, sensor), case.config)
    assert (found.sensor, found.kind) == (sensor, "held")
    assert found.first == pytest.approx(FROM, abs=0.5)
    assert found.last == pytest.approx(TO, abs=0.5)
    assert frozen_stretches(case.log, case.config) == []


def test_without_frozen_leaves_out_the_stretch_alone(case):
    log, (found,) = without_frozen(held(case.log, "dvl"), case.config)
    assert len(log["dvl"]) == len(case.log["dvl"]) - len(found.time)
    assert not ((log["dvl"].time >= found.first) & (log["dvl"].time <= found.last)).any()
    assert without_frozen(case.log, case.config)[0] is case.log


def test_values_that_a_recorder_writes_several_times_are_not_frozen(case):
    data = case.log["dvl"].data.copy()
    data[:, :3] = np.repeat(data[::25, :3], 25, axis=0)[: len(data)]
    assert frozen_stretches(altered(case.log, "dvl", data), case.config) == []


def test_a_depth_of_coarse_resolution_is_frozen_only_where_the_dvl_moves_up_or_down(case):
    coarse = altered(case.log, "depth", np.round(case.log["depth"].data))
    assert max(equal_runs(coarse["depth"].data) @ [-1, 1]) > 100
    assert frozen_stretches(coarse, case.config) == []


def test_a_vehicle_whose_imu_never_changes_holds_its_values():
    """A simulation without noise, on a straight course."""
    case = simulated(falcon(), 100.0, path="straight", noise=False, style=STEADY)
    assert frozen_stretches(case.log, Config()) == []


def test_a_frozen_dvl_costs_no_more_than_one_that_is_silent(case):
    """Its last value, believed for a minute, took the track 18 m away at an sd of 0.3 m."""
    frozen, silent = held(case.log, "dvl"), kept(case.log, "dvl", ~during(case.log, "dvl"))
    dive, best = smooth(frozen, case.config), smooth(silent, case.config)
    assert dive.left_out["dvl", "frozen"] == (~during(frozen, "dvl")).size - len(silent["dvl"]) + 1
    for estimate, other in zip(dive.estimates[:2], best.estimates[:2], strict=True):
        error, least = position_errors(estimate.trajectory, case), position_errors(other.trajectory, case)
        assert rms(error) < 1.5 * rms(least) + 0.02
        assert (error < 4.0 * np.linalg.norm(estimate.trajectory.p_sd, axis=1) + 0.05).all()
