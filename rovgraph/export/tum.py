"""TUM, for `evo_ape` and others: ``time x y z qx qy qz qw``, north, east, down."""

from pathlib import Path

from rovgraph.export.formats import ExportFormat, Options
from rovgraph.export.track import Track
from rovgraph.trajectory import TUM


def write(track: Track, path: Path, options: Options) -> None:
    """Every keyframe, or at a rate."""
    track.at_rate(options.rate).trajectory.write_tum(path)


FORMATS = (ExportFormat("tum", "TUM", TUM, write),)
