"""KITTI odometry poses, for `evo` and others: the first three rows of each pose's matrix, without time."""

from pathlib import Path

import numpy as np

from rovgraph.export.formats import ExportFormat, Options
from rovgraph.export.track import Track


def write(track: Track, path: Path, options: Options) -> None:
    """Every keyframe, or at a rate; axes north, east, down."""
    t = track.at_rate(options.rate).trajectory
    poses = np.concatenate([t.R_nb, t.p_n[:, :, None]], axis=2)
    np.savetxt(path, poses.reshape(len(t), 12), fmt="%.9f")


FORMATS = (ExportFormat("kitti", "KITTI poses", ".kitti.txt", write),)
