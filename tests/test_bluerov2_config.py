"""configs/bluerov2.yaml works, and docs/bluerov2.md explains each of its lines."""

import re
from pathlib import Path

import numpy as np
import pytest
from autopilot_files import dataflash_of, short_dive

import rovgraph as rg
from rovgraph.log import Log
from rovgraph.model.config import load_config
from rovgraph.model.presets import presets
from rovgraph.readers.formats import read_recording

ROOT = Path(__file__).parents[1]
CONFIG = ROOT / "configs" / "bluerov2.yaml"


def stated() -> list[str]:
    """Keys of the file with their section, those that are commented out too."""
    keys, section = [], ""
    for line in CONFIG.read_text(encoding="utf-8").splitlines()[2:]:
        found = re.match(r"(#? ?)( *)(?:# )?(\w+):", line)
        if found and not found[2]:
            section = found[3]
            inline = re.match(r"# \w+: \{(\w+):", line)
            keys += [f"{section}.{inline[1]}"] if inline else []
        elif found:
            keys.append(f"{section}.{found[3]}")
    return keys


def test_every_line_is_explained():
    page = (ROOT / "docs" / "bluerov2.md").read_text(encoding="utf-8")
    assert {"imu.preset", "dvl.lever_arm_m", "environment.declination_deg", "depth.sd_m"} <= set(stated())
    assert [key for key in stated() if f"| `{key}" not in page] == []


def test_its_presets_are_there():
    config = load_config(CONFIG)
    assert {config.imu.preset, config.dvl.preset} <= set(presets())
    assert config.calibration.dvl_scale.sd == pytest.approx(0.0101)


@pytest.mark.slow
def test_a_dive_recorded_by_the_autopilot_is_smoothed_with_it(tmp_path):
    path = tmp_path / "dive.BIN"
    frame = short_dive(5.0)
    path.write_bytes(dataflash_of(frame, np.deg2rad(5.0), 101_800.0))
    recording = read_recording(path)
    config = load_config(CONFIG)
    config = config.model_copy(
        update={"environment": config.environment.model_copy(update=recording.settings["environment"])}
    )
    first = {channel.sensor: channel.columns for channel in reversed(recording.channels)}
    result = rg.smooth(Log.from_arrays(*(first[s] for s in ("imu", "mag", "depth", "dvl")), config=config), config)
    before = rg.smooth(Log.from_frame(frame.drop(columns="ahrs_yaw"), config), config)
    ends = [r.smoothed.trajectory.to_frame()[["north", "east", "down"]].iloc[-1] for r in (result, before)]
    np.testing.assert_allclose(ends[0], ends[1], atol=0.02)  # the file costs centimetres at the most
