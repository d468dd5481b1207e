"""What the live page costs: latency on the loopback, and the filter's updates with none and with ten pages.

python benchmarks/live_page.py LOG CONFIG [--pages 0 10] [--rounds 2] [--speed 2]

Pages run in this process, the estimator in another. Compare rounds: on a busy machine the 99th percentile is the
machine's.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

ONLINE = [sys.executable, "-c", "from rovgraph.cli.app import main; main()", "online"]


def watch(url: str, latencies: list[float]) -> None:
    """Read what a page reads, and how late it was after the solution [s]."""
    try:
        with connect(url, max_size=None, open_timeout=60) as link:
            while True:
                news = json.loads(link.recv())
                if news.get("points") and "sent" in news:
                    latencies.append(time.time() - news["sent"] + news["age_s"])
    except (OSError, WebSocketException):  # the dive is over
        return


def measure(log: Path, config: Path, pages: int, speed: str) -> None:
    """One dive with so many pages."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        options = ["--config", config, "--speed", speed, "--http", "127.0.0.1:0", "--no-refine", "--out", out]
        command = [*ONLINE, f"file:{log}", *map(str, options)]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as dive:
            assert dive.stderr is not None
            url = next(line for line in dive.stderr if line.startswith("live page: ")).split()[-1]
            latencies: list[float] = []
            address = url.replace("http", "ws") + "live"
            for _ in range(pages):
                threading.Thread(target=watch, args=(address, latencies), daemon=True).start()
            dive.stderr.read()
        updates = json.loads((out / "summary.json").read_text())["updates"]
    late = 1e3 * np.percentile(latencies, (50, 95)) if latencies else np.full(2, np.nan)
    print(
        f"{pages:2d} pages: updates mean {updates['mean_ms']:.2f} ms, p99 {updates['p99_ms']:.1f} ms; "
        f"latency p50 {late[0]:.0f} ms, p95 {late[1]:.0f} ms",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("config", type=Path)
    parser.add_argument("--pages", type=int, nargs="+", default=[0, 10])
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--speed", default="2")
    given = parser.parse_args()
    for _ in range(given.rounds):
        for pages in given.pages:
            measure(given.log, given.config, pages, given.speed)


if __name__ == "__main__":
    main()
