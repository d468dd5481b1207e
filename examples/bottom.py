"""The bottom under a track: a Teledyne PD0 file in beam coordinates is smoothed beam by beam, and its ranges drawn.

With a file of your own: python examples/bottom.py FILE.PD0 20, with the angle of its beams from the vertical in
degrees. Without one, a PD0 file of a simulated dive over a sloping bottom is written first. Writes bottom.png.
"""

import struct
import sys
import time as calendar
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import rovgraph as rg

BEGAN = 1_750_000_000  # Unix time of the simulated dive
AZIMUTHS = np.array([270, 90, 0, 180])  # of beams 1 to 4: port, starboard, forward, aft [deg]
SLOPE, DEPTH = np.array([0.08, -0.05]), 15.0  # of the simulated bottom: deeper a metre to the north and east; [m]


def ensemble(stamp: float, rpy: np.ndarray, depth: float, velocity: np.ndarray, below: np.ndarray) -> bytes:
    """Attitude [rad], depth [m], and bottom track by four beams: velocities along them [m/s], distances down [m]."""
    fixed, variable, track = bytearray(59), bytearray(65), bytearray(81)
    struct.pack_into("<HBBHxxB", fixed, 0, 0x0000, 50, 40, 0x4249, 4)
    struct.pack_into("<BhhB", fixed, 25, 0b00111, 0, 0, 0b1111101)  # beam coordinates; sensors that it has
    fixed[58] = 30  # angle of the beams [deg]
    date = calendar.gmtime(stamp)
    struct.pack_into("<HH7B", variable, 0, 0x0080, 1, date.tm_year % 100, *date[1:6], round(100 * (stamp % 1)))
    roll, pitch, heading = np.rad2deg(rpy)
    angles = round(100 * (heading % 360)) % 36000, round(100 * pitch), round(100 * roll)
    struct.pack_into("<HHHhh", variable, 14, 1500, round(10 * depth), *angles)  # sound speed first [m/s]
    values = [*np.round(100 * below).astype(int), *np.round(1000 * velocity).astype(int)]
    struct.pack_into("<H14x4H4h", track, 0, 0x0600, *values)
    struct.pack_into("<12B", track, 32, *[200] * 4, *[80] * 4, *[100] * 4)  # correlation, amplitude, percent good
    struct.pack_into("<4h", track, 50, *[-32768] * 4)  # no velocity of the water
    records = [bytes(fixed), bytes(variable), bytes(track)]
    *offsets, length = np.cumsum([6 + 2 * len(records), *map(len, records)]).tolist()
    whole = struct.pack("<HHBB3H", 0x7F7F, length, 0, len(records), *offsets) + b"".join(records)
    return whole + struct.pack("<H", sum(whole) & 0xFFFF)


def simulated(path: Path) -> Path:
    """A PD0 file of a simulated dive, two pings a second."""
    truth = rg.simulate("lawnmower", seed=2, choices=rg.Choices(duration=240)).truth
    track = truth.at(np.arange(1.0, 239.0, 0.5))
    azimuth, angle = np.deg2rad(AZIMUTHS), np.deg2rad(30.0)
    sine, cosine = np.sin(angle), np.cos(angle)
    d = np.column_stack(
        [sine * np.cos(azimuth), sine * np.sin(azimuth), np.full(4, cosine)]
    )  # forward, starboard, down
    d_n = np.einsum("nij,kj->nki", track.R_nb, d)
    height = DEPTH + track.position[:, :2] @ SLOPE - track.position[:, 2]
    ranges = height[:, None] / (d_n @ [*-SLOPE, 1.0])
    rng = np.random.default_rng(4)
    velocity = np.einsum("nki,ni->nk", d_n, track.velocity) + rng.normal(0.0, 0.01, ranges.shape)
    below = cosine * ranges * (1.0 + rng.normal(0.0, 0.01, ranges.shape))
    depth = track.position[:, 2] + rng.normal(0.0, 0.05, len(track.time))
    pings = zip(BEGAN + track.time, track.rpy, depth, velocity, below, strict=True)
    path.write_bytes(b"".join(ensemble(*ping) for ping in pings))
    return path


own = len(sys.argv) == 3
path, angle_deg = (Path(sys.argv[1]), float(sys.argv[2])) if own else (simulated(Path("dive.PD0")), 30.0)
config = rg.parse_config(f"""
dvl: {{velocity_sd_mps: [0.02, 0.02, 0.01], beams: {{angle_deg: {angle_deg}, azimuth_deg: {AZIMUTHS.tolist()}}}}}
calibration: {{dvl_compass_offset: {{estimate: true, sd_deg: 3}}}}
""")
result = rg.smooth(rg.read_log(path, config), config)
for alarm in result.alarms:
    print(alarm.text)
bottom = result.bottom
if bottom is None:
    sys.exit(f"{path}: has no ranges")
track = result.smoothed.trajectory
under = bottom.under(track)
tilt = np.rad2deg(np.arctan(np.hypot(under["slope_north"], under["slope_east"])))
print(
    f"verdict: {result.verdict}; {len(bottom.soundings)} soundings, their noise {bottom.noise:.2g} times that assumed"
)
print(
    f"altitude {np.nanmin(under['altitude']):.1f} to {np.nanmax(under['altitude']):.1f} m, "
    f"± {np.nanmedian(under['altitude_sd']):.2f} m; the bottom slopes by {np.nanmedian(tilt):.1f}°"
)

figure, (plan, profile) = plt.subplots(1, 2, figsize=(10, 4.5), layout="constrained")
used = bottom.soundings.query("used == 1")
drawn = plan.scatter(used["east"], used["north"], s=4, c=used["depth"], cmap="viridis_r")
plan.plot(track.position[:, 1], track.position[:, 0], "k-", linewidth=0.8)
plan.set(xlabel="east [m]", ylabel="north [m]", aspect="equal", title="soundings, and the track over them")
figure.colorbar(drawn, label="depth [m]")
seconds, depth, sd = track.time - track.time[0], under["bottom_depth"], under["altitude_sd"]
profile.plot(seconds, track.position[:, 2], "C0-", label="vehicle")
profile.plot(used["time"] - track.time[0], used["depth"], ".", color="0.7", markersize=2, label="soundings")
profile.plot(seconds, depth, "C5-", label="bottom under the vehicle, ± 2 sd of the altitude")
profile.fill_between(seconds, depth - 2 * sd, depth + 2 * sd, color="C5", alpha=0.3, linewidth=0)
profile.set(xlabel="time [s]", ylabel="depth [m]", title=f"{path.name}: {result.verdict}")
profile.invert_yaxis()
profile.legend()
figure.savefig("bottom.png", dpi=150)
