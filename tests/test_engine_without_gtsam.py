"""Problems and their solvers need no GTSAM, but for `rovgraph.inference.graph`."""

import subprocess
import sys

import pytest

CODE = """
import sys
sys.modules["gtsam"] = None
import importlib, pkgutil
import numpy as np
import rovgraph.inference, rovgraph.kernels, rovgraph.problem
for package in (rovgraph.inference, rovgraph.kernels, rovgraph.problem):
    for module in pkgutil.iter_modules(package.__path__, package.__name__ + "."):
        if module.name != "rovgraph.inference.graph":
            importlib.import_module(module.name)
from rovgraph.model.config import Config, beliefs
from rovgraph.problem.assembly import Assembly
from rovgraph.sensors.instruments import instruments
from rovgraph.kernels.motion import transitions
from rovgraph.log import Log, Stream

config, time = Config(), np.arange(0.0, 3.0, 0.01)
data = np.tile([0.1, 0.0, -9.81, 0.0, 0.0, 0.2], (len(time), 1))
imu = Stream("imu", tuple("abcdef"), time, data, np.arange(len(time)))
assembly = Assembly(config, instruments(config), np.zeros(6), beliefs(config))
assembly.take(Log("log", {"imu": imu}))
assembly.extend(finish=True)
problem = assembly.problem
R, p, v, bias = np.eye(3)[None], np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 6))
for motion in problem.motions:
    there = [np.empty((1, *shape)) for shape in ((3, 3), (3,), (3,), (15, 15), (15, 15))]
    transitions(motion[None], R, p, v, bias, *there)
    R, p, v = there[:3]
assert len(problem) > 3 and v[0, 0] > 0.2
"""


@pytest.mark.slow
def test_a_log_is_assembled_and_predicted_where_gtsam_cannot_be_imported():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
