"""A dive that is not what the configuration says is not trusted, and the line names the instrument and a remedy.

python tests/test_alarms.py 1 6 [PATH] prints what is said of every broken dive of the seeds from 1 to 5.
"""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from broken import BROKEN, late
from dives import (
    LIVELY,
    Simulated,
    altered,
    attitude_errors,
    changed,
    falcon,
    position_errors,
    rms,
    simulated,
    true_at,
    without,
)
from test_places import circle

from rovgraph.cli.app import main
from rovgraph.diagnosis.alarm import Statistic, alarm_of, verdict_of
from rovgraph.diagnosis.constants import TIME_OFFSETS
from rovgraph.diagnosis.statistics import find_alarms
from rovgraph.dive import DiveEstimates, smooth
from rovgraph.geometry import rotate, transpose
from rovgraph.inference.chain_optimum import ChainOptimum
from rovgraph.inference.initialise import initialise
from rovgraph.inference.score_test import score_test
from rovgraph.inference.smoother import assemble
from rovgraph.log import Log
from rovgraph.model.config import load_config, mount_matrix
from rovgraph.rules import RULES

SECONDS = 200.0
SHIPPED, SHIPPED_S = Path(__file__).parents[1] / "data" / "falcon", 160.0

# what breaks -> the verdict, the kind of the alarm that names it, and words of its line
SAID = {
    "DVL y sign flipped": ("wrong", "axes", "dvl: its axes are left-handed and should be dvl_vx, -dvl_vy, dvl_vz"),
    "IMU mounted 2, 1, 3 degrees off": ("wrong", "held", "check imu.mount_rpy_deg"),
    "DVL biased by 0.3 m/s for 20 s": ("wrong", "taken out", "dvl: contradicts all other sensors"),
    "DVL frozen for a minute": ("doubtful", "frozen", "dvl: repeats its values for 60 s"),
    "depth stuck": ("doubtful", "frozen", "depth: repeats its values for 140 s"),
    "DVL 0.3 s late": ("wrong", "clock", "s late relative to the IMU's"),
    "DVL noise three times as stated": ("doubtful", "too large", "raise dvl.velocity_sd_mps"),
    "fixes 8 m off for a minute": ("doubtful", "lasting", "fix: residuals of north do not average out"),
    "gyro scale 0.5 %": ("doubtful", "held", "estimate calibration.gyr_scale"),
    "gyro warms up": ("doubtful", "bias drift", "raise imu.noise.gyr_walk"),
}


NOISE = {  # found in the dive, and believed
    "DVL noise three times as stated": ("dvl: its noise is 2.", "dvl.velocity_sd_mps"),
    "fixes 8 m off for a minute": ("fix: its errors are correlated over ", "calibration.fix_error"),
}


def broken(name: str, seed: int, path: str = "falcon", find_noise: bool = False) -> tuple[Simulated, DiveEstimates]:
    case = simulated(falcon(graph={"find_noise": find_noise}), SECONDS, seed, path, **BROKEN[name].truth)
    return case, smooth(BROKEN[name].breaks(case.log), case.config)


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * ("biased" in n)) for n in BROKEN])
def test_what_is_broken_is_named_with_a_remedy(name):
    verdict, kind, words = SAID[name]
    _, dive = broken(name, 1)
    assert dive.verdict == verdict
    lines = [alarm.text for alarm in dive.alarms if alarm.kind == kind]
    assert any(words in line for line in lines), dive.warnings
    assert all("\n" not in line for line in dive.warnings)


@pytest.mark.slow
@pytest.mark.parametrize("name", NOISE)
def test_what_is_found_is_said_believed_and_doubted_where_it_moves_the_track(name):
    case, dive = broken(name, 1, find_noise=True)
    begins, key = NOISE[name]
    assert any(line.startswith(begins) and key in line for line in dive.assumptions), dive.assumptions
    assert dive.verdict == ("doubtful" if "fix" in name else "trusted"), dive.warnings
    assert all(alarm.kind in ("found", "rivals") for alarm in dive.alarms)
    track = dive.estimates[0].trajectory
    assert (position_errors(track, case) < 4.0 * np.linalg.norm(track.p_sd, axis=1)).all()


def test_a_healthy_dive_is_trusted():
    case = simulated(falcon(), SECONDS, 1, fix_interval=2.0)
    dive = smooth(case.log, case.config)
    assert (dive.verdict, dive.warnings) == ("trusted", [])
    assert {s.kind for s in dive.statistics} >= {
        "held",
        "moved",
        "rejected",
        "too large",
        "lasting",
        "imu",
        "estimates",
    }


def test_fixes_that_are_late_are_named_with_the_delay_that_mends_them():
    case = simulated(falcon(fix={"sd_m": 0.5}), 120.0, 1, fix_interval=2.0)
    dive = smooth(late("fix", 2.0)(case.log), case.config, "smoothed")
    assert dive.verdict != "trusted"
    (delay,) = re.findall(r"state delay_s: \{fix: ([0-9.]+)\}", "\n".join(dive.warnings))
    assert float(delay) == pytest.approx(2.0, abs=0.5)


def test_a_dvl_whose_z_axis_points_the_other_way_gets_its_mounting():
    case = simulated(falcon(), SECONDS, 1)
    config = falcon(dvl={"mount_rpy_deg": [0.0, 0.0, case.config.dvl.mount_rpy_deg[2]]})
    dive = smooth(case.log, config)
    assert dive.verdict == "wrong"
    true = list(case.config.dvl.mount_rpy_deg)
    assert any(f"state dvl.mount_rpy_deg: {true}" in line for line in dive.warnings), dive.warnings


@pytest.mark.slow
def test_a_considered_mounting_that_is_turned_by_90_degrees_makes_the_dive_wrong():
    frame, stated = pd.read_csv(SHIPPED / "log.csv.gz"), load_config(SHIPPED / "config.yaml")
    turned = {"dvl": {"mount_rpy_deg": [180.0, 0.0, 135.0]}, "calibration": {"dvl_yaw": {"estimate": "considered"}}}
    config = changed(stated, graph={"find_noise": False}, **turned)
    dive = smooth(Log.from_frame(frame[frame["time"] < SHIPPED_S]), config, "smoothed")
    assert dive.verdict == "wrong"
    assert "check dvl.mount_rpy_deg" in dive.warnings[0], dive.warnings


@pytest.mark.parametrize(("name", "off"), [("dvl_scale", 0.02), ("dvl_pitch", 0.03), ("gyr_scale", 0.005)])
def test_a_constant_that_is_held_wrongly_is_found_with_its_value(name, off):
    case = simulated(falcon(), SECONDS, 2, calibration={name: off * np.ones(3 if name == "gyr_scale" else 1)})
    best = assemble(case.log, initialise(case.log, case.config)).optimum()
    assert isinstance(best, ChainOptimum)
    found = score_test(best, [name])
    mean = case.config.dvl.mount_rpy_deg[1] if name == "dvl_pitch" else 0.0
    assert all(abs(r.step - (off - np.deg2rad(mean))) < 4.0 * r.sd + 0.15 * off for r in found)
    assert max(r.significance for r in found) > 5.0


@pytest.mark.parametrize("kind", ["places", "isam2"])
def test_a_constant_that_is_held_wrongly_is_found_on_dives_of_every_solver(kind):
    wrong = {"calibration": {"dvl_pitch": np.array([0.03])}}
    if kind == "places":
        case = circle(1, **wrong)
    else:
        case = simulated(falcon(graph={"solver": "isam2"}), 60.0, 2, imu_rate=50.0, dvl_rate=2.0, **wrong)
    (found,) = [s for s in smooth(case.log, case.config, "smoothed").statistics if "dvl_pitch is held" in s.cause]
    assert found.kind == "held"
    assert found.severity is not None
    plain = without(case.log, "place")
    chain = smooth(plain, changed(case.config, graph={"solver": "batch"}), "smoothed")
    (same,) = [s for s in chain.statistics if "dvl_pitch is held" in s.cause]
    assert found.figure == pytest.approx(same.figure, rel=0.1)


def test_constants_that_are_held_rightly_are_standard_normal_where_they_are_released():
    steps = []
    for seed in range(1, 5):
        case = simulated(falcon(), 120.0, seed)
        best = assemble(case.log, initialise(case.log, case.config)).optimum()
        found = score_test(best, ["dvl_roll", "dvl_pitch", "dvl_scale", "gyr_scale", *TIME_OFFSETS])
        steps += [r.step / r.sd for r in found]
    assert len(steps) == 36
    assert 0.5 < float(np.std(steps)) < 1.6
    assert np.abs(steps).max() < 4.5


def test_alarms_of_a_filter_alone_need_no_smoother():
    case = simulated(falcon(), 100.0, 1)
    assert smooth(case.log, case.config, "filtered").verdict == "trusted"
    broken = smooth(BROKEN["DVL 0.3 s late"].breaks(case.log), case.config, "filtered")
    assert any(line.startswith("dvl: up to") for line in broken.warnings)


@pytest.mark.slow
def test_a_field_that_changes_along_the_way_is_named_and_the_remedy_mends_it():
    case = simulated(falcon(heading={"sources": ["mag"]}), 150.0, 2, "lawnmower", imu_rate=50.0)
    mag, begin = case.log["mag"], case.log["imu"].time[0]
    share = np.clip((mag.time - begin - 60.0) / 20.0, 0.0, 1.0)
    dip, east = np.deg2rad(72.0 + 8.0 * share), np.deg2rad(case.config.environment.declination_deg)
    across = np.column_stack([np.cos(dip) * np.cos(east), np.cos(dip) * np.sin(east), np.sin(dip)])
    more = (1.0 + 0.15 * share)[:, None] * across - across[0]
    imu_axes = rotate(transpose(true_at(case, mag.time).R_nb), more) @ mount_matrix(case.config.imu.mount_rpy_deg)
    log = without(altered(case.log, "mag", mag.data + imu_axes), "dvl_heading")
    held = smooth(log, case.config, "smoothed")
    assert any("calibration.field_dip.walk_deg: 0.05" in alarm.text for alarm in held.alarms), held.warnings
    walk = {"field_dip": {"walk_deg": 0.05}, "field_scale": {"walk": 0.001}}
    walking = smooth(log, changed(case.config, calibration=walk), "smoothed")
    assert walking.verdict == "trusted"
    off = [rms(attitude_errors(dive.estimates[0].trajectory, case)[:, 2]) for dive in (held, walking)]
    assert off[1] < 0.1 * off[0]


def statistic(figure: float, kind: str = "rejected", sensor: str = "dvl") -> Statistic:
    """One whose figure is given in units of its lower limit."""
    limit = RULES[kind].doubtful
    return Statistic(kind, sensor, 10.0, 70.0, figure * limit, "something is so", "do something")


def test_the_worst_alarm_is_the_verdict():
    assert [alarm_of(statistic(f)) is None for f in (0.5, 1.0, 1.1)] == [True, True, False]
    alarms = find_alarms([statistic(0.5), statistic(2.0), statistic(3.0), statistic(2.0, sensor="mag")], 0.0)
    assert [(a.sensor, a.figure / a.limit) for a in alarms] == [
        ("dvl", pytest.approx(3.0)),
        ("mag", pytest.approx(2.0)),
    ]
    assert verdict_of(alarms) == "doubtful"
    assert verdict_of(find_alarms([statistic(11.0), statistic(2.0, sensor="mag")], 0.0)) == "wrong"
    assert verdict_of([]) == "trusted"
    any_is_too_much = [Statistic("taken out", "dvl", 0.0, s, s, "is so", "do") for s in (3.0, 5.0)]
    assert [a.figure for a in find_alarms(any_is_too_much, 0.0)] == [5.0]
    assert alarms[0].text == "dvl: something is so; do something"


def test_two_sensors_that_measure_the_same_and_are_both_odd_contradict_each_other():
    numbers = [statistic(2.0, "lasting", "dvl"), statistic(3.0, "lasting", "depth"), statistic(2.0, "lasting", "mag")]
    (pair,) = [alarm for alarm in find_alarms(numbers, 0.0) if alarm.kind == "contradiction"]
    assert pair.sensor == "depth, dvl" or pair.sensor == "dvl, depth"
    assert "10 to 70 s" in pair.text


@pytest.fixture(scope="module")
def flipped(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flipped")
    frame = simulated(falcon(), 100.0, 1, style=LIVELY).dive.log_frame
    frame["dvl_vy"] *= -1.0
    frame.to_csv(folder / "log.csv", index=False)
    (folder / "config.yaml").write_text(falcon().to_yaml(), encoding="utf-8")
    return folder


@pytest.mark.parametrize(("options", "code"), [([], 0), (["--strict"], 3)])
def test_smooth_says_its_verdict_first_and_strict_returns_it(flipped, monkeypatch, capsys, options, code):
    out = flipped / f"results{code}"
    given = ["smooth", flipped / "log.csv", "--config", flipped / "config.yaml", "--no-figures", "--out", out]
    monkeypatch.setattr(sys, "argv", ["rovgraph", *map(str, given), *options])
    with pytest.raises(SystemExit) as end:
        main()
    assert (end.value.code or 0) == code
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "verdict: wrong"
    assert lines[1].startswith("wrong: dvl: its axes are left-handed")
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["verdict"] == "wrong"
    assert summary["alarms"][0]["kind"] == "axes"
    assert set(summary["alarms"][0]) == {"kind", "sensor", "severity", "from_s", "to_s", "figure", "limit", "text"}


if __name__ == "__main__":
    paths = sys.argv[3:] or ["falcon"]
    for name in BROKEN:
        verdicts, named = [], 0
        for seed in range(int(sys.argv[1]), int(sys.argv[2])):
            for path in paths:
                case, dive = broken(name, seed, path)
                track = dive.estimates[0].trajectory
                off = position_errors(track, case) / np.linalg.norm(track.p_sd, axis=1)
                named += any(SAID[name][2] in a.text for a in dive.alarms if a.kind == SAID[name][1])
                verdicts.append(dive.verdict)
                print(f"  {path} {seed}: {dive.verdict}, {off.max():.1f} sd; {(dive.warnings or ['-'])[0]}")
        counts = ", ".join(f"{verdicts.count(v)} {v}" for v in ("trusted", "doubtful", "wrong"))
        print(f"{name}: {counts}; named in {named} of {len(verdicts)}", flush=True)
