"""Files as people really have them: each with what `rovgraph check` says of it. A bug report becomes a line there."""

import csv
import re
import warnings
from pathlib import Path

import pytest

from rovgraph.cli.app import main

FIELD = Path(__file__).parent / "data" / "field"
with (FIELD / "expected.csv").open(encoding="utf-8", newline="") as table:
    ROWS = list(csv.DictReader(table))


@pytest.mark.parametrize("row", ROWS, ids=[f"{row['files']} {row['options']}".strip() for row in ROWS])
def test_a_file_from_the_field_is_read_or_refused_by_its_right_name(row, tmp_path, capfd, monkeypatch):
    config = tmp_path / "vehicle.yaml"
    config.write_text(row["options"] or "{}", encoding="utf-8")
    files = [str(FIELD / name) for name in row["files"].split()]
    monkeypatch.setattr("sys.argv", ["rovgraph", "check", *files, "--config", str(config)])
    with pytest.raises(SystemExit) as done, warnings.catch_warnings():
        main()
    code = done.value.code or 0
    said = " ".join("".join(capfd.readouterr()).split())
    assert code == int(row["exit"]), said
    assert re.search(row["says"], said), said
    assert "Traceback" not in said


def test_every_file_of_the_corpus_has_a_line_and_all_are_small():
    named = {name for row in ROWS for name in row["files"].split()}
    there = [path for path in FIELD.iterdir() if path.name != "expected.csv"]
    assert {path.name for path in there} == named
    assert sum(path.stat().st_size for path in there) < 300_000
