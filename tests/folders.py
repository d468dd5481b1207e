"""Results folders side by side."""

import json
from pathlib import Path


def same_files(one: Path, other: Path) -> None:
    """Two folders hold the same bytes, but for the times that the work took."""
    names = sorted(path.name for path in one.iterdir())
    assert names == sorted(path.name for path in other.iterdir()) and names
    for name in names:
        if name == "summary.json" and "seconds" in json.loads((one / name).read_text(encoding="utf-8")):
            assert _without_times(one / name) == _without_times(other / name)
        else:
            assert (one / name).read_bytes() == (other / name).read_bytes(), name


def _without_times(summary: Path) -> dict[str, object]:
    content = json.loads(summary.read_text(encoding="utf-8"))
    del content["seconds"]
    return content
