"""Native files: an autopilot's log and a DVL's log with another clock become one track, then files for a map.

With files of your own leave the first half out and name them: rg.convert(["dive.BIN", "dvl.csv"]). Here the two are
written from a simulated dive, so that you see what they hold. Writes native_files.png.
"""

import json
import struct
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import rovgraph as rg

SURFACE, DENSITY, GRAVITY = 101_325.0, 1024.0, 9.80665  # pressure [Pa], of the sea [kg/m3], [m/s2]
DVL_CLOCK = 1234.5  # what the DVL's clock reads at the autopilot's 0 s [s]
MESSAGES = {  # number, types and fields, as ArduPilot's .BIN declares them
    "PARM": (10, "QNf", "TimeUS,Name,Value"),
    "IMU": (11, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "MAG": (12, "QBhhh", "TimeUS,I,MagX,MagY,MagZ"),
    "BARO": (13, "QBf", "TimeUS,I,Press"),
}


def packed(name: str, time: float, *values: object) -> bytes:
    number, types, _ = MESSAGES[name]
    layout = "<" + types.replace("N", "16s")
    return b"\xa3\x95" + bytes([number]) + struct.pack(layout, round(1e6 * time), *values)


def declared(name: str) -> bytes:
    number, types, fields = MESSAGES[name]
    length = 3 + struct.calcsize("<" + types.replace("N", "16s"))
    return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, length, *map(str.encode, (name, types, fields)))


# two files of one dive
config = rg.parse_config("environment: {field_norm: 50, origin_lat_deg: 58.3, origin_lon_deg: 11.4}")  # field in µT
dive = rg.simulate("square", config, seed=4, choices=rg.Choices(duration=120))
log = dive.dive.log_frame
autopilot = [declared(name) for name in MESSAGES]
for name, value in {"BARO_PRIMARY": 0, "BARO1_GND_PRESS": SURFACE, "BARO_SPEC_GRAV": DENSITY / 1000}.items():
    autopilot.append(packed("PARM", 0.0, name.encode(), value))
for row in log.itertuples():  # cells are empty where a sensor has not measured
    if np.isfinite(row.acc_x):
        autopilot.append(packed("IMU", row.time, 0, row.gyr_x, row.gyr_y, row.gyr_z, row.acc_x, row.acc_y, row.acc_z))
    if np.isfinite(row.mag_x):
        autopilot.append(packed("MAG", row.time, 0, *(round(10 * x) for x in (row.mag_x, row.mag_y, row.mag_z))))  # mG
    if np.isfinite(row.depth):
        autopilot.append(packed("BARO", row.time, 0, SURFACE + DENSITY * GRAVITY * row.depth))
Path("dive.BIN").write_bytes(b"".join(autopilot))
pings = log[["time", "dvl_vx", "dvl_vy", "dvl_vz", "dvl_valid"]].dropna()
pings.assign(time=pings["time"] + DVL_CLOCK).to_csv("dvl.csv", index=False)

# one log, with an account of what came from where
converted = rg.convert(["dive.BIN", "dvl.csv"], dive.config)  # rg.read_log takes the same files, if you need no account
converted.save("log.csv", "vehicle.yaml", force=True)
clock = converted.report["clocks"][1]
print(f"{clock['file']}: {clock['offset_s']:.2f} ± {clock['sd_s']:.2f} s, by {clock['how']}")

# its track, and the track as files of other programs
result = rg.smooth(converted.log, converted.config, estimate="smoothed")
track = result.smoothed.trajectory
print(f"{result.verdict}, {rg.evaluate(track, dive.truth).rms_m:.2f} m rms")
for path in rg.export(result, ["geojson", "srt"], out="maps", force=True):
    print(path)

features = json.loads(Path("maps/track_smoothed.geojson").read_text())["features"]
figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
for feature in features:
    shape, places = feature["geometry"]["type"], feature["geometry"]["coordinates"]
    if shape == "LineString":
        axes.plot(*np.array(places)[:, :2].T, label="track")
    elif shape == "Polygon":
        axes.plot(*np.array(places[0])[:, :2].T, "C1", linewidth=0.5)
axes.plot([], [], "C1", label="95 % ellipses")
axes.set(
    xlabel="longitude [°]",
    ylabel="latitude [°]",
    title="maps/track_smoothed.geojson",
    aspect=1 / np.cos(np.radians(58.3)),
)
axes.ticklabel_format(useOffset=False)
axes.tick_params("x", rotation=30)
axes.legend()
figure.savefig("native_files.png", dpi=150)
