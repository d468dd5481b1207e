"""What is considered, online: it stays in the sd when a sensor joins, and when the filter goes on from iSAM2."""

from collections.abc import Callable

import numpy as np
import pytest
from dives import Simulated, falcon, simulated
from live import message

from rovgraph.inference.filter_step import Gaussian
from rovgraph.live.clocks import Clocks
from rovgraph.live.intake import joined
from rovgraph.live.navigator import Navigator
from rovgraph.log import Measurement
from rovgraph.model.calibration import TABLE

CONSIDERED = [name for name, variable in TABLE.items() if variable.considered]
END_S = 34.0


@pytest.fixture(scope="module")
def case() -> Simulated:
    config = falcon(calibration={name: {"estimate": "considered"} for name in CONSIDERED})
    return simulated(config, END_S, seed=1, dvl_rate=4.0, water_track=True)


def flown(case: Simulated, used: Callable[[Measurement], bool], smooth: bool = False) -> Navigator:
    """A navigator that has taken the dive."""
    nav = Navigator(case.config, patient=True, reinitialise=False, smooth=smooth, clocks=Clocks(trust=True))
    for m in case.log.measurements():
        if m.time < END_S and used(m):
            nav.take(message(m))
    return nav


def newest(nav: Navigator) -> Gaussian:
    assert nav.engine is not None
    return nav.engine.snapshots[-1].known


def test_a_filter_that_a_sensor_joins_knows_no_more_than_before(case):
    nav = flown(case, lambda m: m.sensor != "dvl_water")
    assert nav.engine is not None
    before, engine = nav.engine.oldest().known, nav.engine.filter
    other = joined(nav.engine, "dvl_water")
    after = other.snapshots[0].known
    for name in engine.layout.columns:
        if name in CONSIDERED:
            continue
        own, there = engine.layout.columns[name], other.filter.layout.columns[name]
        np.testing.assert_allclose(after.covariance[there, there], before.covariance[own, own], rtol=1e-12)
    np.testing.assert_array_equal(after.L, before.L)
    assert (np.abs(before.B) > 0.0).any()


def test_a_filter_that_goes_on_from_isam2_has_what_is_considered_in_its_sd(case):
    alone, smooth = (newest(flown(case, lambda m: m.sensor != "dvl_water", way)) for way in (False, True))
    part = [np.sqrt(np.diag(known.B @ known.B.T))[3:6] for known in (alone, smooth)]
    assert (part[0][:2] > 0.01).all()
    np.testing.assert_allclose(part[1][:2], part[0][:2], rtol=0.5)


def test_after_a_sensor_has_joined_no_way_leads_back_to_keyframes_without_it(case):
    nav = flown(case, lambda m: m.sensor != "dvl_water" or m.time > END_S - 1.0)
    assert nav.engine is not None and "dvl_water" in nav.engine.initial.instruments
    size = nav.engine.filter.layout.size
    assert all(len(mark.known.P) == size for mark in [*nav.engine.snapshots, *nav._incoherence._recent])
