"""The prior of a compass by what is known of it, and what an error of the heading does beyond its linear part."""

from dataclasses import replace

import numpy as np
import pytest
from dives import Simulated, batch, changed, fed, kept, renewed, simulated
from live import flown

from rovgraph.dive import smooth
from rovgraph.inference import estimate
from rovgraph.inference.estimate import second_order
from rovgraph.inference.fixed_lag import FixedLag
from rovgraph.inference.initialise import initialise
from rovgraph.inference.smoother import smoothed
from rovgraph.inference.trajectory import Trajectory
from rovgraph.log import Log
from rovgraph.model.config import Config, beliefs, parse_config
from rovgraph.simulate import Truth
from rovgraph.simulate.files import known

DEG = np.deg2rad(1.0)
ALONE = parse_config("heading: {sources: [ahrs]}\nimu: {lever_arm_m: [0.1, 0, 0]}\nenvironment: {dip_deg: 72}")
OFF = 15.0  # of the compass [deg]
LATE_S = 45.0  # of the first fix


@pytest.fixture(scope="module")
def case() -> Simulated:
    """A straight way whose only compass is off."""
    off = {"ahrs_offset": np.array([OFF * DEG]), "ahrs_deviation": np.zeros(2)}
    return simulated(ALONE, 60.0, 3, "straight", ahrs_rate=10.0, dvl_rate=2.0, fix_interval=1.0, calibration=off)


@pytest.fixture(scope="module")
def log(case) -> Log:
    """Of it, without fixes."""
    return Log(case.log.source, {s: stream for s, stream in case.log.streams.items() if s != "fix"})


def priors(log: Log, config: Config, *expected: str) -> tuple[float, float]:
    """sds of offset and deviation in the effective configuration [deg]."""
    b = initialise(log, config, expected)
    entries = b.config.calibration
    assert b.assumptions[0].startswith("nothing checks the compass") == (entries.ahrs_offset.sd_deg == 10.0)
    return entries.ahrs_offset.sd_deg, entries.ahrs_deviation.sd_deg


WIDE, USUAL = (10.0, 5.0), (5.0, 3.0)


def test_the_prior_is_wide_where_heading_rests_on_one_compass_that_nobody_calibrated(log):
    assert priors(log, ALONE) == WIDE
    first = initialise(log, ALONE).assumptions[0]
    assert "rests on ahrs_offset, sd 10 deg" in first
    assert all(remedy in first for remedy in ("a fix at the end", "a second compass", "two full turns"))


@pytest.mark.parametrize(
    ("yaml", "expected"),
    [
        ("calibration: {ahrs_offset: {sd_deg: 5}}", USUAL),
        ("calibration: {ahrs_offset: {sd_deg: 2}}", (2.0, 3.0)),
        ("calibration: {ahrs_deviation: {sd_deg: 1}}", (5.0, 1.0)),
        ("calibration: {ahrs_offset: {mean_deg: 3}}", USUAL),
        ("calibration: {ahrs_offset: {estimate: false}}", USUAL),
        ("calibration: {ahrs_offset: {estimate: true}}", WIDE),
        ("calibration: {mag_offset: {sd_deg: 1}}", WIDE),
        ("imu: {preset: xsens-mti-g-710}", USUAL),
        ("dvl: {preset: waterlinked-a50}", WIDE),
        ("imu: {mag: {centre: [0.1, 0, 0]}}", WIDE),
        ("start: {heading_deg: 0}", USUAL),
        ("start: {heading_deg: 0, heading_sd_deg: 9.9}", USUAL),
        ("start: {heading_deg: 0, heading_sd_deg: 10}", WIDE),
        ("start: {heading_sd_deg: 1}", WIDE),
    ],
)
def test_what_is_stated_of_the_compass_or_of_the_heading_keeps_the_usual_prior(log, yaml, expected):
    stated = parse_config(yaml).model_dump(exclude_unset=True)
    assert priors(log, changed(ALONE, **stated)) == expected


def test_fixes_or_a_second_compass_keep_the_usual_prior(case, log):
    assert priors(case.log, ALONE) == USUAL
    with_mag = changed(ALONE, heading={"sources": ["mag", "ahrs"]})
    assert priors(log, with_mag) == USUAL


def test_online_fixes_that_may_come_check_nothing_yet_and_a_compass_that_is_named_will(log):
    assert priors(log, ALONE, "fix") == WIDE
    assert "no fix so far" in initialise(log, ALONE, ["fix"]).assumptions[0]
    both = changed(ALONE, heading={"sources": ["ahrs", "dvl"]})
    alone = replace(log, streams={s: stream for s, stream in log.streams.items() if s != "dvl_heading"})
    assert priors(alone, both) == WIDE
    assert priors(alone, both, "dvl_heading") == USUAL


@pytest.mark.parametrize(("yaml", "wide"), [("", True), ("imu: {mag: {centre: [0.01, 0, 0]}}", False)])
def test_of_a_magnetometer_the_hard_iron_is_what_a_calibration_finds(log, yaml, wide):
    stated = parse_config(yaml).model_dump(exclude_unset=True)
    given = initialise(log, changed(ALONE, heading={"sources": ["mag"]}, **stated)).config.calibration
    assert (given.mag_offset.sd_deg, given.hard_iron.sd) == ((10.0, 0.033) if wide else (5.0, 0.02))


def test_the_effective_configuration_gives_the_same_priors_again(log):
    b = initialise(log, ALONE)
    again = initialise(log, parse_config(b.config.to_yaml()))
    assert again.config.calibration == b.config.calibration
    assert parse_config(ALONE.to_yaml()).calibration == ALONE.calibration  # what is left to the log stays so


def test_a_simulated_compass_is_as_good_as_its_prior_and_its_estimator_knows(case):
    assert beliefs(ALONE)["ahrs_offset"].sd == pytest.approx(5.0 * DEG)
    offsets = [Truth(ALONE).draw_calibration(np.random.default_rng(s))["ahrs_offset"][0] / DEG for s in range(150)]
    assert np.std(offsets) == pytest.approx(5.0, rel=0.2)
    told = known(case.dive, ALONE).calibration
    assert (told.ahrs_offset.sd_deg, told.ahrs_deviation.sd_deg) == USUAL


# the second order


@pytest.mark.parametrize("sd_deg", [5.0, 10.0, 15.0])
def test_the_second_order_is_what_an_error_of_the_heading_does_along_the_way(sd_deg):
    s, d = sd_deg * DEG, np.array([240.0, -180.0])
    theta = s * np.random.default_rng(1).standard_normal(400_000)
    cosine, sine = np.cos(theta), np.sin(theta)
    moved = np.column_stack([cosine * d[0] - sine * d[1], sine * d[0] + cosine * d[1]]) - d
    across = np.array([-d[1], d[0]])
    found = second_order(s**2 * across[None])[0]
    along = d / 300.0
    assert along @ found @ along == pytest.approx(np.mean((moved @ along) ** 2), rel=0.08)
    total = s**2 * np.outer(across, across) + found
    np.testing.assert_allclose(total, moved.T @ moved / len(moved), atol=0.08 * np.trace(total))
    if sd_deg == 5.0:  # of a compass as calibrated it is nothing
        assert np.trace(found) < 0.01 * np.trace(total)


def both(log: Log, config: Config, monkeypatch) -> list[tuple[Trajectory, Trajectory]]:
    """Tracks of the smoother, of the filter, and live, as they are and with linear covariances."""
    initial, passed = initialise(log, config), []
    live = fed(FixedLag(initial, 5.0, 0.3, passed=passed.append), log)
    track = [s.keyframe for s in passed], [s.known for s in passed]
    best, filtered = batch(log, config).optimum(), renewed(log, config)

    def tracks() -> list[Trajectory]:
        return [smoothed(best, initial).trajectory, filtered.solve().trajectory, live.trajectory(*track)]

    whole = tracks()
    with monkeypatch.context() as patch:
        patch.setattr(estimate, "rests_on_doubtful_compass", lambda initial: False)
        return list(zip(whole, tracks(), strict=True))


def test_every_track_has_the_second_order_where_nothing_checks_the_compass(log, monkeypatch):
    for whole, linear in both(log, ALONE, monkeypatch):
        more = whole.cov_p[-1] - linear.cov_p[-1]
        d = (whole.p_n[-1] - whole.p_n[0])[:2]
        s = linear.rpy_sd[-1, 2]
        assert 9.0 * DEG < s < 12.0 * DEG
        np.testing.assert_allclose(more[:2, :2], 0.75 * s**4 * np.outer(d, d), atol=0.15 * np.trace(more))
        assert not more[2].any()
        np.testing.assert_array_equal(whole.p_n, linear.p_n)
        assert np.linalg.eigvalsh(whole.cov_p).min() > 0.0


def test_no_track_has_it_where_the_compass_is_calibrated(log, monkeypatch):
    for whole, linear in both(log, changed(ALONE, calibration={"ahrs_offset": {"sd_deg": 5}}), monkeypatch):
        np.testing.assert_array_equal(whole.cov_p, linear.cov_p)


def test_a_position_that_fixes_show_has_none_of_it(case, monkeypatch):
    vague = changed(ALONE, calibration={"ahrs_offset": {"sd_deg": 20}})
    for whole, linear in both(case.log, vague, monkeypatch):
        assert (whole.p_sd[-1] < 1.01 * linear.p_sd[-1]).all()


def test_a_compass_that_is_off_by_two_sds_is_within_the_sd_of_the_track(case, log):
    end = case.truth.p_n[-1, :2]
    for config, limit in ((ALONE, 4.5), (changed(ALONE, calibration={"ahrs_offset": {"sd_deg": 5}}), np.inf)):
        track = smooth(log, config, "smoothed").estimates[0].trajectory
        error = track.p_n[-1, :2] - end
        nees = 0.5 * error @ np.linalg.solve(track.cov_p[-1, :2, :2], error)
        assert nees < limit
    assert nees > 2.5


def test_online_says_so_first_and_fixes_that_come_late_end_it(case):
    late = kept(case.log, "fix", case.log["fix"].time > LATE_S)
    flight = flown(replace(case, log=late))
    assumed = [e.text for s in flight.solutions for e in s.events if e.kind == "assumed"]
    assert assumed[0].startswith("nothing checks the compass")
    error = np.linalg.norm(flight.errors, axis=1)
    before = np.searchsorted(flight.time, LATE_S - 1.0)
    assert error[before] > 1.0 and error[before] < 4.0 * flight.sd_at(LATE_S - 1.0)
    assert flight.sd_at(59.0) < 1.5 < flight.sd_at(LATE_S - 1.0)
