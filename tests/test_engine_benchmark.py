"""The benchmarks of cost run, judge by their targets and say what is missing."""

import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def rows(script: str, *arguments: str) -> list[list[str]]:
    """Cells of the table that a benchmark prints, without its head."""
    command = [sys.executable, str(BENCHMARKS / script), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-500:]
    lines = [line for line in done.stdout.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


@pytest.fixture
def engine(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import engine

    return engine


@pytest.mark.slow
def test_a_row_of_this_checkout_is_measured_and_a_missing_log_is_said(tmp_path):
    found = rows("engine.py", "--quick", "--no-base", "--rows", "filter", "ictineu", "--ictineu", str(tmp_path))
    (name, base, now, *_), left_out = found
    assert (name, base) == ("filter of data/falcon", "")
    assert now.endswith(" s") and float(now.split()[0]) > 0.0
    assert left_out[0] == "ictineu" and "the log is not there" in left_out[-1]


def test_ratios_are_of_what_it_was_to_what_it_is_and_judged_by_the_target(engine):
    def last(base, now, target):
        return [cell.strip() for cell in engine.Line("x", "s", base, now, target).row(True).strip("|").split("|")][1:]

    assert last(40.0, 1.0, engine.times_less(40)) == ["40 s", "1 s", "40", "40 times less", "met"]
    assert last(39.0, 1.0, engine.times_less(40))[-1] == "not met"
    assert last(None, 1.0, engine.times_less(40)) == ["", "1 s", "", "40 times less", ""]
    assert last(None, 121.0, engine.at_most(120, "s"))[-1] == "not met"
    assert last(50.0, 125.0, engine.at_least(120))[2:] == ["2.5", "at least 120", "met"]
    assert last(2.0, 6.1, engine.TRIPLE)[-1] == "not met"
    assert engine.Line("x", "s", 40.0, 1.0, engine.times_less(40)).row(False).endswith("|  |")


def test_what_a_command_costs_once_is_not_multiplied(engine):
    assert engine.scaled(None, lambda checkout, dives: 5.0 + 2.0 * dives, 3, 30) == pytest.approx(65.0)


@pytest.mark.slow
def test_processor_time_and_memory_are_those_of_the_command_and_an_error_is_its_last_line(engine):
    checkout = engine.Checkout(engine.ROOT, "now.py")
    spins = "import time\nwhile time.process_time() < 0.3: pass\nx = b'x' * 10**8\nprint('done')"
    alone, child = (
        checkout.python("-c", code)
        for code in (spins, f"import subprocess, sys; subprocess.run([sys.executable, '-c', {spins!r}])")
    )
    for cost in (alone, child):
        assert cost.processor >= 0.3 and cost.memory > 0.1 and cost.said == "done\n"
    with pytest.raises(engine.Failed, match=r"exit code 2: error: .*nowhere"):
        checkout.rovgraph("smooth", "nowhere.csv")


def test_a_commit_is_checked_out_for_as_long_as_it_is_measured(engine, tmp_path, monkeypatch):
    def git(*arguments: str) -> str:
        who = ["-c", "user.name=a", "-c", "user.email=a@b"]
        return subprocess.run(
            ["git", "-C", str(tmp_path), *who, *arguments], capture_output=True, text=True, check=True
        ).stdout

    git("init", "--quiet")
    (tmp_path / "file").write_text("then")
    git("add", "file")
    git("commit", "--quiet", "-m", "first")
    (tmp_path / "file").write_text("now")
    monkeypatch.setattr("checkouts.ROOT", tmp_path)
    with engine.checkout_of(git("rev-parse", "HEAD").strip()) as path:
        assert (path / "file").read_text() == "then"
    assert not path.exists() and len(git("worktree", "list").splitlines()) == 1
    with pytest.raises(engine.Failed, match="give one with --base"), engine.checkout_of("0000000"):
        pass


@pytest.mark.slow
def test_overheads_are_measured_beside_their_references():
    found = rows("overheads.py", "--rows", "recorder", "checkpoint")
    assert [row[0] for row in found] == ["1000 rows recorded", "a checkpoint of 50 arrays"]
    assert all(float(row[4]) > 0.0 for row in found)
