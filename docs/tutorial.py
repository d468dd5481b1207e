# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # From a raw log to a track you trust
#
# You get a log that somebody recorded and a note about the vehicle. This page goes from there to a track, with the
# mistakes that people make on the way: wrong units, a mounting that nobody wrote down, and noise that is stated too
# small. It is a notebook: open `docs/tutorial.py` in Jupyter (with [jupytext](https://jupytext.readthedocs.io)).
#
# The raw log is made here from a simulated dive, so that the truth is known at the end. The logger writes rates in
# degrees per second, depths that count upwards, times in milliseconds, and its own column names.

# %%
import warnings

import matplotlib.pyplot as plt

import rovgraph as rg

warnings.simplefilter("ignore", rg.DataWarning)  # rg.check shows the same, and more

vehicle = rg.parse_config("""
dvl: {mount_rpy_deg: [180, 0, -45], velocity_sd_mps: [0.01, 0.01, 0.005]}
calibration: {dvl_yaw: {estimate: true, sd_deg: 5}}
""")
dive = rg.simulate("square", vehicle, seed=4, choices=rg.Choices(duration=150, speed=0.5))
raw = dive.dive.log_frame.copy()
for axis in "xyz":
    raw[f"gyr_{axis}"] *= 57.29578
raw["depth"] *= -1.0
raw["time"] *= 1000.0
raw = raw.rename(columns={"time": "stamp_ms", "depth": "z"})
raw.head(3).dropna(axis="columns", how="all")

# %% [markdown]
# ## The names
#
# Without a configuration rovgraph does not find the columns that it needs, and names one that is missing. Bad input
# is always one line.

# %%
try:
    rg.Log.from_frame(raw)
except rg.InputError as error:
    print(error)

# %% [markdown]
# ## The units
#
# Map the names, and look at the log before you estimate anything. `check` compares sensors that measure the same
# motion, so a wrong unit or sign shows.


# %%
def look(settings: str) -> None:
    """What a check of the log finds with some settings."""
    config = rg.parse_config(settings)
    for finding in rg.check(rg.Log.from_frame(raw, config), config).findings:
        if finding.level != "ok":
            print(f"{finding.level}: {finding.sensor}: {finding.text}")


names = "columns: {time: stamp_ms, depth: z}\n"
look(names + "units: {time: ms}")

# %% [markdown]
# The gyro's rates are 57 times too large, and the depth has the wrong sign. One word in the configuration corrects
# each; the file stays as it is.

# %%
units = names + "units: {time: ms, gyr: deg/s, depth: -m}\n"
look(units)

# %% [markdown]
# ## The mounting
#
# The DVL remains: no mounting is stated, so rovgraph assumes that its axes are the vehicle's. The dive is too calm for
# the check to notice, but the estimate shows it. Read the verdict and its first line before you look at the track:

# %%
units += "calibration: {dvl_yaw: {estimate: true, sd_deg: 5}}\n"  # the yaw of a mounting is known to 5° or so


def smooth(settings: str) -> rg.Result:
    """The estimate with some settings, and what it says of itself."""
    config = rg.parse_config(settings)
    result = rg.smooth(rg.Log.from_frame(raw, config), config, estimate="smoothed")
    print(f"verdict: {result.verdict}, {len(result.alarms)} alarms")
    for alarm in result.alarms[:1]:
        print(alarm.text)
    return result


straight = smooth(units)

# %% [markdown]
# The first line is the cause, and the others follow from it. It says to turn the DVL over, by a roll of 180°. That is
# half of the truth, because rovgraph chooses among quarter turns only. The note about the vehicle says "z up, x about
# 45° to port of forward", so the mounting has a roll of 180° and a yaw of −45° ([mountings](mounting.md)).

# %%
mounted = smooth(units + "dvl: {mount_rpy_deg: [180, 0, -45], velocity_sd_mps: [0.01, 0.01, 0.005]}")

# %% [markdown]
# ## The noise
#
# The next mistake: "accuracy 1 mm/s" in the data sheet, stated as the noise of a ping. Here `smooth` finds that the
# residuals vary more than that, solves the dive again with the noise that it found, and lists it among its
# assumptions. Do not rely on this; [state the noise](noise.md).

# %%
precise = smooth(units + "dvl: {mount_rpy_deg: [180, 0, -45], velocity_sd_mps: [0.001, 0.001, 0.001]}")
for assumption in precise.assumptions:
    if "noise" in assumption:
        print(assumption)
print("used in the end:", precise.config.dvl.velocity_sd_mps)

# %% [markdown]
# With the right noise the normalised residuals have a mean square near 1, sensor by sensor:

# %%
residuals = mounted.smoothed.residuals.query("weight > 0")
(residuals["normalised"] ** 2).groupby(residuals["sensor"]).mean().round(2)

# %% [markdown]
# ## What the dive could not show
#
# `narrowing` is the sd after the dive divided by that before it. Near 1 means that the dive did not change your prior.
# That is so for the compass offset: without position fixes nothing shows it, and it may rotate the whole track.

# %%
for label in ("dvl_yaw", "mag_offset", "dvl_compass_offset"):
    found = mounted.calibration[label]
    print(f"{label}: {57.3 * found.value:.1f} ± {57.3 * found.sd:.1f}°, narrowing {found.sd / found.prior_sd:.2f}")

# %% [markdown]
# ## The track
#
# For your own dives you do not know the truth. Here you do, so compare: the error should be about as large as the sd.
# The normalised error squared is 2 on average over many dives; a single dive may well have 0.3 or 5.

# %%
metrics = rg.evaluate(mounted.smoothed.trajectory, dive.truth)
print(f"rms {metrics.rms_m:.2f} m over {metrics.distance_m:.0f} m, normalised error squared {metrics.nees:.1f}")

figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
for name, result in (("mounting not stated", straight), ("mounting as noted", mounted)):
    position = result.smoothed.trajectory.position
    axes.plot(position[:, 1], position[:, 0], label=f"{name}: {result.verdict}")
axes.plot(dive.truth.position[:, 1], dive.truth.position[:, 0], "k--", linewidth=0.8, label="truth")
axes.set(xlabel="east [m]", ylabel="north [m]", aspect="equal")
_ = axes.legend()

# %% [markdown]
# Continue with [your own log](own-log.md). If something looks odd, see [troubleshooting](troubleshooting.md), which is
# ordered by symptom.
