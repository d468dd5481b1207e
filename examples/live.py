"""Live from a socket: JSON lines come in over TCP, solutions come out while the vehicle moves.

The "vehicle" is a thread that sends the first 40 s of the dive that ships, ten times as fast as it was. With a
vehicle of your own leave it out and give rg.Online the address of your driver. Writes live.png.
"""

import contextlib
import socket
import threading
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import rovgraph as rg

DIVE = Path(__file__).parents[1] / "data" / "falcon"
SPEED, DURATION = 10.0, 40.0  # seconds of the dive per second; how much of it [s]


def send(server: socket.socket, rows: pd.DataFrame) -> None:
    """The vehicle: each row of the log as a JSON line when its time has come."""
    lines = rows.to_json(orient="records", lines=True).splitlines()
    connection, _ = server.accept()
    begin = time.monotonic()
    with server, connection, contextlib.suppress(ConnectionError):  # the reader has had enough
        for due, line in zip(rows["time"] - rows["time"].iloc[0], lines, strict=True):
            time.sleep(max(0.0, begin + due / SPEED - time.monotonic()))
            connection.sendall(line.encode() + b"\n")
        connection.recv(1)  # until the reader hangs up


log = pd.read_csv(DIVE / "log.csv.gz")
log = log[log["time"] < log["time"].iloc[0] + DURATION]
server = socket.create_server(("127.0.0.1", 0))
port = server.getsockname()[1]
threading.Thread(target=send, args=(server, log), daemon=True).start()

solutions = []
run = rg.Online(rg.load_config(DIVE / "config.yaml"), rate_hz=2.0).run(f"tcp://127.0.0.1:{port}")
for solution in run:
    solutions.append(solution)
    for event in solution.events:
        print(f"{event.time:.1f} s {event.source}: {event.text}")
    if solution.time > log["time"].iloc[-1] - 1.0:
        break  # ends the run, which would wait for more otherwise
print(f"{len(solutions)} solutions, the last at {solution.position.round(2)} m ± {solution.position_sd.round(2)} m")
latency = sorted(1e3 * solution.latency_s for solution in solutions)
print(f"latency {latency[len(latency) // 2]:.1f} ms (median)")

figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
times = [solution.time for solution in solutions]
for k, name in enumerate(("north", "east")):
    position = np.array([solution.position[k] for solution in solutions])
    sd = np.array([solution.position_sd[k] for solution in solutions])
    axes.plot(times, position, label=name)
    axes.fill_between(times, position - 2 * sd, position + 2 * sd, alpha=0.3)
axes.set(xlabel="time [s]", ylabel="position ± 2 sd [m]", title=f"Live: {solution.verdict}")
axes.legend()
figure.savefig("live.png", dpi=150)
