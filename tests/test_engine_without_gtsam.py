"""Keyframes, motions and what filters take of them need no GTSAM."""

import subprocess
import sys

import pytest

CODE = """
import sys
sys.modules["gtsam"] = None
import importlib, pkgutil
from collections import Counter
import numpy as np
import rovgraph.engine, rovgraph.kernels
for package in (rovgraph.engine, rovgraph.kernels):
    for module in pkgutil.iter_modules(package.__path__, package.__name__ + "."):
        importlib.import_module(module.name)
from rovgraph.config import Config, beliefs
from rovgraph.engine.log_assembly import assemble_log
from rovgraph.engine.time_offsets import TimeOffsets
from rovgraph.engine.transition import predict, transitions
from rovgraph.instruments import instruments
from rovgraph.log import Log, Stream
from rovgraph.state import State

config, time = Config(), np.arange(0.0, 3.0, 0.01)
data = np.tile([0.1, 0.0, -9.81, 0.0, 0.0, 0.2], (len(time), 1))
imu = Stream("imu", tuple("abcdef"), time, data, np.arange(len(time)))
sensors = instruments(config)
offsets, left_out = TimeOffsets.of(beliefs(config), sensors), Counter()
intervals = assemble_log(Log("log", {"imu": imu}), config, sensors, np.zeros(6), offsets, left_out).intervals
means = {name: belief.mean for name, belief in beliefs(config).items()}
state = State(np.eye(3)[None], np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 6)), means)
for interval in intervals[1:]:
    state = predict(interval, state)
    transitions([interval], [state])
assert len(intervals) > 3 and state.v_n[0, 0] > 0.2
"""


@pytest.mark.slow
def test_a_log_is_assembled_and_predicted_where_gtsam_cannot_be_imported():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
