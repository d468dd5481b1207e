"""Look at residuals: is the noise that you stated the noise of the dive?

A normalised residual is (measured - predicted) / sd. Over a dive that is as configured its spread is a bit
below 1 for a smoother, and no sensor's residuals keep their sign for long. Writes residuals.png.
"""

from pathlib import Path

import matplotlib.pyplot as plt

import rovgraph as rg

DIVE = Path(__file__).parents[1] / "data" / "falcon"

config = rg.load_config(DIVE / "config.yaml")
result = rg.smooth(rg.read_log(DIVE / "log.csv.gz", config), config)

residuals = result.smoothed.residuals  # one row per component of each measurement
residuals["name"] = residuals["sensor"] + " " + residuals["component"]
used = residuals[residuals["weight"] > 0.0]  # 0 = rejected
table = used.groupby("name")["normalised"].agg(["count", "mean", "std"])
table["rejected"] = residuals[residuals["weight"] == 0.0].groupby("name").size()
print(table.fillna({"rejected": 0}).astype({"rejected": int}).round(2))

figure, panels = plt.subplots(len(table), figsize=(8, 1.2 * len(table)), sharex=True, layout="constrained")
for axes, name in zip(panels, table.index, strict=True):
    rows = residuals[residuals["name"] == name]
    rejected = rows["weight"] == 0.0
    axes.plot(rows["time"][~rejected], rows["normalised"][~rejected], ".", markersize=1.5)
    axes.plot(rows["time"][rejected], rows["normalised"][rejected].clip(-5, 5), "x", color="C3", markersize=4)
    axes.axhspan(-2, 2, color="0.9", zorder=0)
    axes.set(ylim=(-5.5, 5.5), yticks=[-2, 0, 2])
    axes.set_ylabel(name, rotation=0, ha="right", va="center")
panels[0].set_title("Normalised residuals; grey: two sd; crosses: rejected")
panels[-1].set_xlabel("time [s]")
figure.savefig("residuals.png", dpi=150)
