"""Compare two mountings: is the DVL turned to port or to starboard?

Nobody wrote it down. Give the estimate a chance to correct each of them: whenever the vehicle speeds up or turns, the
IMU shows where forward is. The estimate stays at the right mounting and moves many sd away from the wrong one, and the
verdict says so. Writes mountings.png.
"""

import math
from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd

import rovgraph as rg

DIVE = Path(__file__).parents[1] / "data" / "falcon"

text = (DIVE / "config.yaml").read_text()  # it estimates dvl_yaw, with 5° about the mounting that is stated
frame = pd.read_csv(DIVE / "log.csv.gz")
frame = frame[frame["time"] < frame["time"].iloc[0] + 150.0]

figure, (track, yaw) = plt.subplots(1, 2, figsize=(9, 4.5), layout="constrained")
for k, (name, yaw_deg) in enumerate((("starboard", 45.0), ("port", -45.0))):
    config = rg.parse_config(text.replace("[180.0, 0.0, 45.0]", f"[180.0, 0.0, {yaw_deg}]"))
    result = rg.smooth(rg.Log.from_frame(frame, config), config, estimate="smoothed")
    found = result.calibration["dvl_yaw"]
    value, sd = math.degrees(found.value), math.degrees(found.sd)
    print(f"stated {yaw_deg:g} ± 5°, found {value:.1f} ± {sd:.1f}°: {result.verdict}")
    for alarm in result.alarms[:1]:
        print(f"  {alarm.text}")
    position = result.smoothed.trajectory.position
    track.plot(position[:, 1], position[:, 0], label=f"{name}: {result.verdict}")
    yaw.errorbar(2 * k, yaw_deg, 5.0, fmt="o", color=f"C{k}", capsize=4, mfc="white")
    yaw.errorbar(2 * k + 1, value, sd, fmt="o", color=f"C{k}", capsize=4)

track.set(xlabel="east [m]", ylabel="north [m]", aspect="equal", title="The track with each mounting")
track.legend(loc="center")
yaw.set(xlim=(-0.7, 3.7), ylabel="yaw of the DVL ± sd [°]", title="What became of the mounting")
yaw.set_xticks(range(4), ["starboard,\nstated", "found", "port,\nstated", "found"])
figure.savefig("mountings.png", dpi=150)
