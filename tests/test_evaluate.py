"""The metrics are what a ruler and a protractor would give."""

import json
import sys

import numpy as np
import pytest

from rovgraph.cli.app import main
from rovgraph.errors import DataWarning, InputError
from rovgraph.geometry import exp_rotation, matrix_from_rpy, rotate
from rovgraph.inference.trajectory import Trajectory
from rovgraph.lab.evaluate import evaluate, normalised_error, read_reference


def track(n: int = 201, offset=(0.0, 0.0, 0.0), turn_deg: float = 0.0, sd: float = np.nan) -> Trajectory:
    """A quarter of a circle of 100 m radius in 100 s, the body along it."""
    time = np.linspace(0.0, 100.0, n)
    angle = 0.5 * np.pi * time / 100.0
    p_n = np.column_stack([100 * np.sin(angle), 100 * (1 - np.cos(angle)), 0.01 * time])
    rpy = np.column_stack([0 * angle, 0 * angle, angle + np.deg2rad(turn_deg)])
    cov = np.broadcast_to(sd**2 * np.eye(3), (n, 3, 3))
    return Trajectory(time, p_n + offset, matrix_from_rpy(rpy), np.zeros((n, 3)), cov, cov, cov)


def test_a_constant_offset_is_measured_in_every_metric():
    m = evaluate(track(offset=(3.0, 4.0, 12.0), turn_deg=-2.0), track())
    assert (m.epochs, m.duration_s, m.coverage) == (201, 100.0, 1.0)
    assert m.distance_m == pytest.approx(50 * np.pi, rel=1e-4)
    for value in (m.rms_m, m.mean_m, m.max_m, m.end_m):
        assert value == pytest.approx(5.0)
    assert m.rms_3d_m == pytest.approx(13.0) and m.rms_down_m == pytest.approx(12.0)
    assert m.drift_percent == pytest.approx(100 * 5.0 / m.distance_m)
    assert m.heading_rms_deg == pytest.approx(2.0) and m.heading_mean_deg == pytest.approx(-2.0)
    assert m.nees is None and m.inside_ellipse is None and not m.aligned


def test_the_largest_error_is_named_with_its_time():
    estimate = track()
    estimate.p_n[50, 0] += 7.0
    m = evaluate(estimate, track())
    assert (m.max_m, m.max_at_s, m.end_m) == (pytest.approx(7.0), 25.0, pytest.approx(0.0))
    assert m.rms_m == pytest.approx(7.0 / np.sqrt(201)) and m.mean_m == pytest.approx(7.0 / 201)


def test_estimate_is_interpolated_to_the_reference():
    assert evaluate(track(2001), track(101)).max_m < 1e-3
    assert evaluate(track(2001), track(101)).epochs == 101


def test_from_counts_from_the_trajectorys_beginning():
    estimate = track()
    estimate.p_n[:100] += 50.0
    late = Trajectory.certain(estimate.time + 1e6, estimate.p_n, estimate.R_nb, estimate.v_n)
    truth = Trajectory.certain(late.time, track().p_n, late.R_nb, late.v_n)
    assert evaluate(late, truth, start=50.0).max_m == pytest.approx(0.0)
    assert evaluate(late, truth).max_m > 50.0


@pytest.mark.parametrize(
    ("start", "said"),
    [
        (5000.0, "from 5000 s on: the trajectory lasts only 100.0 s"),
        (-5.0, "from -5 s on: expected 0 or more"),
        (np.nan, "from nan s on: expected 0 or more"),
    ],
)
def test_a_start_outside_the_trajectory_is_refused(start, said):
    with pytest.raises(InputError, match=said):
        evaluate(track(), track(), start)


def test_coverage_is_the_part_of_the_reference_that_was_compared():
    whole = track()
    half = Trajectory.certain(whole.time[:101], whole.p_n[:101], whole.R_nb[:101], whole.v_n[:101])
    assert evaluate(half, whole).coverage == pytest.approx(101 / 201)


def test_no_common_time_is_refused():
    late = Trajectory.certain(track().time + 1e3, track().p_n, track().R_nb, track().v_n)
    with pytest.raises(InputError, match="same clock"):
        evaluate(late, track())


def test_alignment_takes_out_a_turn_and_a_shift_and_says_so():
    truth, R, shift = track(), exp_rotation([0, 0, np.deg2rad(25.0)]), np.array([5.0, -3.0, 2.0])
    moved = Trajectory.certain(truth.time, rotate(R, truth.p_n) + shift, R @ truth.R_nb, truth.v_n)
    m = evaluate(moved, truth, align=True)
    assert m.aligned and m.rms_m == pytest.approx(0.0, abs=1e-9) and m.heading_rms_deg == pytest.approx(0.0, abs=1e-9)
    assert m.turned_deg == pytest.approx(-25.0)
    np.testing.assert_allclose([m.shift_north_m, m.shift_east_m], -(R.T @ shift)[:2])
    assert m.rms_down_m == pytest.approx(2.0)  # depth is not aligned
    assert evaluate(moved, truth).rms_m > 5.0


def test_honest_covariances_give_two_and_small_ones_do_not():
    rng, n = np.random.default_rng(3), 5001
    for sd, nees, inside in ((2.0, 2.0, 0.99), (1.0, 8.0, 0.683)):
        estimate = track(n, sd=sd)
        noisy = estimate.p_n + 2.0 * rng.standard_normal((n, 3))
        estimate = Trajectory(estimate.time, noisy, estimate.R_nb, estimate.v_n, *[estimate.cov_p] * 3)
        m = evaluate(estimate, track(n))
        assert m.nees == pytest.approx(nees, rel=0.05)
        assert m.inside_ellipse == pytest.approx(inside, abs=0.02)


def test_normalised_error_uses_the_correlation_and_skips_what_is_not_known():
    P = np.array([[[4.0, 1.5], [1.5, 1.0]], [[np.nan] * 2] * 2, [[0.0, 0.0], [0.0, 0.0]], [[1.0, 2.0], [2.0, 1.0]]])
    e = np.array([[1.0, -2.0]] * 4)
    value = normalised_error(e, P)
    assert value[0] == pytest.approx(e[0] @ np.linalg.solve(P[0], e[0]))
    assert np.isnan(value[1:]).all()


def test_reference_with_repeated_empty_and_unsorted_rows_is_mended_with_warnings(tmp_path):
    path = tmp_path / "r.csv"
    path.write_text("time,north,east,sats\n3,3,0,9\n1,1,0,9\n1,9,9,9\n2,,0,9\n0,0,0,9\n")
    with pytest.warns(DataWarning) as caught:
        reference = read_reference(path)
    assert reference.time.tolist() == [0, 1, 3] and reference.p_n[:, 0].tolist() == [0, 1, 3]
    assert sorted(str(w.message).split(": ")[1].split(" were")[0] for w in caught) == [
        "1 rows with a repeated time",
        "1 rows without time, north or east",
    ]


def test_reference_without_depth_and_attitude_gives_only_horizontal_errors(tmp_path):
    path = tmp_path / "r.csv"
    path.write_text("time,north,east\n0,0,0\n50,70,30\n")
    m = evaluate(track(), read_reference(path))
    assert m.epochs == 2 and m.rms_3d_m is None and m.heading_rms_deg is None and m.rms_down_m is None


def run(monkeypatch, capsys, *arguments: str) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["rovgraph", "evaluate", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    captured = capsys.readouterr()
    return int(stop.value.code or 0), captured.out, captured.err


@pytest.fixture
def files(tmp_path) -> tuple[str, str]:
    track(offset=(3.0, 4.0, 0.0), sd=2.0).write_csv(tmp_path / "estimate.csv")
    track().write_csv(tmp_path / "truth.csv.gz")
    return str(tmp_path / "estimate.csv"), str(tmp_path / "truth.csv.gz")


def test_command_prints_a_table_with_units(files, monkeypatch, capsys):
    code, out, err = run(monkeypatch, capsys, *files)
    assert code == 0 and err == ""
    assert "5.000 m" in out and "6.25" in out and "aligned" not in out
    assert "aligned, taken out" in run(monkeypatch, capsys, *files, "--align")[1]


def test_to_leaves_out_the_end(files, monkeypatch, capsys):
    estimate = track()
    estimate.p_n[150:] += 50.0
    assert evaluate(estimate, track(), end=74.0).max_m == pytest.approx(0.0)
    assert evaluate(estimate, track(), start=20.0, end=40.0).epochs == 41
    assert evaluate(estimate, track(), end=40.0).coverage == 1.0
    code, out, _ = run(monkeypatch, capsys, *files, "--json", "--from", "20", "--to", "40")
    assert code == 0 and json.loads(out)["epochs"] == 41
    for wrong in ("20", "10", "nan"):
        code, _, err = run(monkeypatch, capsys, *files, "--from", "20", "--to", wrong)
        assert code == 2 and "the end is not after the start" in err
    assert "from 20.0 s to 20.1 s" in run(monkeypatch, capsys, *files, "--from", "20", "--to", "20.1")[2]


def test_command_prints_json(files, monkeypatch, capsys):
    code, out, _ = run(monkeypatch, capsys, *files, "--json", "--from", "50")
    metrics = json.loads(out)
    assert code == 0 and metrics["rms_m"] == pytest.approx(5.0, abs=1e-4)
    assert metrics["epochs"] == 101 and metrics["turned_deg"] is None


@pytest.mark.parametrize(
    "content", ["", "time,north\n0,1\n", "time,north,east\n0,a,1\n1,2,3\n", "time,north,east\n900,1,1\n901,2,2\n"]
)
def test_command_refuses_bad_references_in_one_line(files, tmp_path, monkeypatch, capsys, content):
    (tmp_path / "bad.csv").write_text(content)
    code, _, err = run(monkeypatch, capsys, files[0], str(tmp_path / "bad.csv"))
    assert code == 2 and err.startswith("error: ") and err.count("\n") == 1
    assert run(monkeypatch, capsys, files[0], str(tmp_path / "none.csv"))[0] == 2
    assert run(monkeypatch, capsys, files[0], files[1], "--from", "nan")[0] == 2
