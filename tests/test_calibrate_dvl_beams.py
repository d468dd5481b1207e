"""Where the beams of a DVL point is found in a dive that shows it, and refused in a line where it does not."""

import numpy as np
import pytest
from wire import report

import rovgraph as rg
from rovgraph.cli.app import main
from rovgraph.log import Log
from rovgraph.model.config import parse_config
from rovgraph.sensors.dvl_beam import beam_geometry

HEAD = parse_config("dvl: {beams: {angle_deg: 25, azimuth_deg: [40, 160, 275, 330], first_number: 0}}").dvl


def dive(count: int = 400, sway: float = 0.2, sign: float = 1.0, noise: float = 0.003, late: int = 0) -> Log:
    """Pings of a vehicle that goes forward and backward, sideways, up and down; the DVL solves them itself."""
    rng = np.random.default_rng(3)
    t = 0.2 * np.arange(count)
    v = np.column_stack([0.5 * np.sin(0.2 * t), sway * np.sin(0.31 * t), 0.1 * np.sin(0.13 * t)])
    d = beam_geometry(HEAD).directions
    b = v @ d.T + noise * rng.standard_normal((count, 4))
    made = b @ np.linalg.pinv(d).T
    columns = {f"dvl_beam_velocity_{k}": sign * np.roll(b[:, k], late) for k in range(4)}
    return Log.from_arrays({"time": t, **columns}, time=t, dvl=made, source="dive.csv")


def test_angle_and_azimuths_come_back_within_their_sds():
    found = rg.calibrate_dvl_beams(dive())
    assert found.numbers == (0, 1, 2, 3) and found.pings == 400
    assert abs(found.angle_deg - 25.0) < 3.0 * found.angle_sd_deg < 0.5
    error = np.abs(found.azimuth_deg - np.array([40.0, 160.0, 275.0, 330.0]))
    assert (error < 4.0 * found.azimuth_sd_deg).all() and found.azimuth_sd_deg.max() < 1.0
    config = parse_config(found.to_yaml())
    assert config.dvl.beams.first_number == 0 and len(config.dvl.beams.azimuth_deg) == 4


def test_without_noise_the_geometry_is_exact():
    found = rg.calibrate_dvl_beams(dive(noise=0.0))
    np.testing.assert_allclose([found.angle_deg, *found.azimuth_deg], [25.0, 40.0, 160.0, 275.0, 330.0], atol=1e-3)


REFUSED = {
    "straight ahead": ({"sway": 0.0, "noise": 0.02, "count": 60}, "drive forward"),
    "few": ({"count": 20}, "20 pings have both beams and a velocity, expected 30 or more"),
    "sign": ({"sign": -1.0}, "their sign is reversed"),
    "clock": ({"late": 60}, "correct their unit, sign or clock"),
}


@pytest.mark.parametrize(("how", "said"), REFUSED.values(), ids=REFUSED.keys())
def test_a_dive_that_does_not_show_it_is_refused_in_one_line(how, said):
    with pytest.raises(rg.InputError) as caught:
        rg.calibrate_dvl_beams(dive(**how))
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_log_without_beams_is_refused():
    t = np.arange(50.0)
    with pytest.raises(rg.InputError, match="has no velocities along beams"):
        rg.calibrate_dvl_beams(Log.from_arrays(time=t, dvl=np.ones((50, 3))))


def test_the_command_prints_what_the_library_finds(tmp_path, capsys, monkeypatch):
    """Reports of a Water Linked DVL."""
    log, lines = dive(), []
    beams = log["dvl_beams"]
    for k in range(len(beams)):
        transducers = [
            {"id": i, "velocity": beams[f"dvl_beam_velocity_{i}"][k], "distance": 2.0, "beam_valid": True}
            for i in range(4)
        ]
        vx, vy, vz = log["dvl"].data[k, :3].tolist()
        stamp = round(1e6 * (1_750_000_000.0 + beams.time[k]))
        lines.append(report(vx=vx, vy=vy, vz=vz, velocity_valid=True, time_of_validity=stamp, transducers=transducers))
    path = tmp_path / "dvl.jsonl"
    path.write_bytes(b"".join(lines))
    capsys.readouterr()
    monkeypatch.setattr("sys.argv", ["rovgraph", "calibrate", "dvl-beams", str(path)])
    try:
        main()
    except SystemExit as stop:
        assert not stop.code
    assert capsys.readouterr().out == rg.calibrate_dvl_beams(rg.read_log([path])).to_yaml()
