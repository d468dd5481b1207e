"""Smooth a log: from the dive that ships with rovgraph to its track and its uncertainty.

Run it from anywhere: python examples/smooth.py. It writes smooth.png into the current folder.
"""

from pathlib import Path

import matplotlib.pyplot as plt

import rovgraph as rg

DIVE = Path(__file__).parents[1] / "data" / "falcon"

config = rg.load_config(DIVE / "config.yaml")
log = rg.read_log(DIVE / "log.csv.gz", config)
result = rg.smooth(log, config)

print(f"verdict: {result.verdict}")
for alarm in result.alarms:
    print(alarm.text)
track = result.smoothed.trajectory
print(f"{track.distance:.0f} m in {track.time[-1] - track.time[0]:.0f} s")
north, east, down = track.position[-1]
sd_north, sd_east, sd_down = track.p_sd[-1]
print(
    f"ends {north:.2f} ± {sd_north:.2f} m north, {east:.2f} ± {sd_east:.2f} m east, {down:.2f} ± {sd_down:.2f} m deep"
)

result.save("smoothed", force=True, figures=False)  # the folder of `rovgraph smooth`

figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
for estimate, style in ((result.dead_reckoning, "k:"), (result.filtered, "C1--"), (result.smoothed, "C0-")):
    position = estimate.trajectory.position
    axes.plot(position[:, 1], position[:, 0], style, linewidth=1, label=estimate.kind.replace("_", " "))
axes.set(xlabel="east [m]", ylabel="north [m]", aspect="equal", title=f"Falcon: {result.verdict}")
axes.legend()
figure.savefig("smooth.png", dpi=150)
