"""What reading large native files costs: memory and processor time, a file of each format in a process of its own.

    python benchmarks/recordings.py
    python benchmarks/recordings.py --megabytes 1000 --formats dataflash ros2-mcap

Files hold what a vehicle records: an IMU at 200 Hz or more, a magnetometer, attitude, depth and a DVL, and in bags
images, too, or nothing else. They are made in a temporary folder, which needs the space. Nothing is asserted.
"""

import argparse
import itertools
import os
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

TESTS = Path(__file__).parents[1] / "tests"
sys.path.insert(0, str(TESTS))  # where the writers are
RATE = 400.0  # of the IMU [Hz]
READ = """
import resource, sys, time
from pathlib import Path
import rovgraph as rg
from rovgraph.interchange.formats import read_recording
before, base = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
{work}
print(time.process_time() - before, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, base / 1024, rows)
"""
WORKS = {
    "read": "rows = sum(len(c.columns['time']) for c in read_recording({path!r}).channels)",
    "convert": "converted = rg.convert([{path!r}]); converted.save({out!r}); rows = len(converted.log['imu'])",
}


def dataflash(path: Path, size: int) -> None:
    """A `.BIN`, the same seconds again and again with their own times."""
    from autopilot_files import DataFlashWriter

    with path.open("wb") as file:
        file.write(DataFlashWriter().parameters(BARO_PRIMARY=0, BARO1_GND_PRESS=101_325.0).bytes())
        header = len(DataFlashWriter().bytes())
        for second in itertools.count():
            writer = DataFlashWriter()
            for k in range(int(RATE)):
                at = 1e6 * (second + k / RATE)
                writer.add("IMU", at, 0, 0.01, 0.02, 0.03, 0.1, 0.2, -9.8, 1, 1)
                if k % 4 == 0:
                    writer.add("MAG", at, 0, 200, 10, 430, 0, 0, 0, 1, round(at) % 2**32)
                    writer.add("ATT", at, 100, 200, 9000)
                    writer.add("XKF1", at, 0, 1.0)
                if k % 40 == 0:
                    writer.add("BARO", at, 0, 0.0, 120_000.0 + second % 100, 1000, round(1e-3 * at) % 2**32)
                    writer.add("VISO", at, 0.1, 0, 0, 0, 0.05, 0.0, 0.0, 90.0)
            file.write(writer.bytes()[header:])
            if file.tell() > size:
                return


def telemetry(path: Path, size: int) -> None:
    """A `.tlog` of messages at 100 Hz."""
    from autopilot_files import mavlink

    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    with path.open("wb") as file:
        for k in itertools.count():
            at = 10.0 + 0.01 * k
            us, ms = round(1e6 * at), round(1e3 * at)
            sent = [
                mavlink.MAVLink_highres_imu_message(us, 0.1, 0.2, -9.8, 0.01, 0.02, 0.03, 0, 0, 0, 0, 0, 0, 0, 0x3F),
                mavlink.MAVLink_attitude_message(ms, 0.1, 0.2, 0.3, 0, 0, 0),
                mavlink.MAVLink_scaled_pressure2_message(ms, 1200.0, 0.0, 1000),
            ]
            for message in sent:
                file.write(struct.pack(">Q", round(1e6 * (1.7e9 + at))) + bytes(message.pack(sender)))
            if file.tell() > size:
                return


def bag(form: str, images: bool = True) -> Callable[[Path, int], None]:
    """A bag that is mostly images, or one without any: the same messages again and again with their own stamps."""

    def made(path: Path, size: int) -> None:
        import bags
        import numpy as np

        image = {"height": 240, "width": 320, "encoding": "mono8", "is_bigendian": 0, "step": 320}
        image |= {"data": np.zeros(240 * 320, np.uint8)}
        often = [bags.imu(0.0, (0.1, 0.2, -9.8), (0.01, 0.02, 0.03))]
        seldom = [bags.marine_dvl(0.0, (0.5, 0.0, 0.0)), bags.pressure(0.0, 120_000.0)]
        seldom += [bags.Sent(0.0, "/camera", "sensor_msgs/msg/Image", image)] * images
        maker = bags.Maker(form)
        contents = {each.topic: bytearray(maker.message(each)) for each in often + seldom}
        with bags.opened(path, form) as writer:
            lines = {e.topic: writer.add_connection(e.topic, e.type, typestore=maker.store) for e in often + seldom}
            written = 0
            for k in itertools.count():
                stamp = round(1e9 * (bags.START + k / RATE))
                for each in often if k % 40 else often + seldom:
                    struct.pack_into("<II", contents[each.topic], 4, *divmod(stamp, 10**9))  # of the header
                    writer.write(lines[each.topic], stamp + 4_000_000, bytes(contents[each.topic]))
                    written += len(contents[each.topic]) + 40
                if written > size:
                    return

    return made


FORMATS: dict[str, tuple[str, Callable[[Path, int], None]]] = {
    "dataflash": ("dive.BIN", dataflash),
    "tlog": ("dive.tlog", telemetry),
    "ros2-sqlite": ("dive", bag("sqlite")),
    "ros2-mcap": ("dive", bag("mcap")),
    "ros1": ("dive.bag", bag("ros1")),
    "mcap-imu": ("dive", bag("mcap", images=False)),
    "ros1-imu": ("dive.bag", bag("ros1", images=False)),
}


def measure(path: Path, work: str) -> tuple[float, float, float, int]:
    """Processor time [s]; largest memory, and that before reading [MB]; rows."""
    out = str(path.parent / "log.csv")
    code = READ.format(work=WORKS[work].format(path=str(path), out=out))
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, env=environment)
    if done.returncode:
        raise SystemExit(f"{path.name}: {(done.stderr.splitlines() or ['failed'])[-1]}")
    seconds, most, base, rows = done.stdout.split()[-4:]
    return float(seconds), float(most), float(base), int(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megabytes", type=float, default=300.0, help="size of each file")
    parser.add_argument("--formats", nargs="+", choices=FORMATS, default=list(FORMATS))
    parser.add_argument("--works", nargs="+", choices=WORKS, default=["read"], help="read alone, or convert to CSV")
    options = parser.parse_args()
    print(f"{'format':12} {'work':8} {'MB':>6} {'CPU s':>7} {'MB/s':>6} {'peak MB':>8} {'before':>7} {'rows':>9}")
    for name in options.formats:
        file, make = FORMATS[name]
        with TemporaryDirectory() as folder:
            path = Path(folder) / file
            began = time.process_time()
            make(path, int(1e6 * options.megabytes))
            print(f"# {name} made in {time.process_time() - began:.0f} s", file=sys.stderr)
            files = [each for each in path.rglob("*") if each.is_file()] if path.is_dir() else [path]
            size = sum(each.stat().st_size for each in files) / 1e6
            for work in options.works:
                seconds, most, base, rows = measure(path, work)
                figures = f"{seconds:7.1f} {size / seconds:6.1f} {most:8.0f} {base:7.0f} {rows:9}"
                print(f"{name:12} {work:8} {size:6.0f} {figures}")


if __name__ == "__main__":
    main()
