"""Monte Carlo in ten lines: does the error stay within what the standard deviation promises?

Each simulated dive draws its own noise, biases and mounting errors from what the configuration believes. The mean
normalised error squared (NEES) of north and east tends to 2 if the covariances are right. Writes monte_carlo.png.
"""

import matplotlib.pyplot as plt
import numpy as np

import rovgraph as rg

errors, sds, nees = [], [], []
for seed in range(1, 11):
    dive = rg.simulate("lawnmower", seed=seed, choices=rg.Choices(duration=60))
    track = rg.smooth(dive.log, dive.config, estimate="smoothed").smoothed.trajectory
    errors.append((track.position - dive.truth.at(track.time).position)[-1, :2])
    sds.append(track.p_sd[-1, :2])
    nees.append(rg.evaluate(track, dive.truth).nees)
error, sd = np.array(errors), np.array(sds)
print(f"NEES {np.mean(nees):.1f} over {len(nees)} dives; 95 of 100 such runs give 1.0 to 3.4 if the sd is right")
print(f"end: {np.sqrt((error**2).sum(axis=1).mean()):.2f} m rms, promised {np.sqrt((sd**2).sum(axis=1).mean()):.2f} m")

figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
axes.errorbar(error[:, 1], error[:, 0], xerr=sd[:, 1], yerr=sd[:, 0], fmt="o", capsize=2)
axes.plot(0, 0, "k+", markersize=12)
axes.set(xlabel="error east [m]", ylabel="error north [m]", title="End of ten dives, with one sd")
figure.savefig("monte_carlo.png", dpi=150)
