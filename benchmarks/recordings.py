"""What large native files cost: memory and time of reading, and of the command that converts them.

    python benchmarks/recordings.py
    python benchmarks/recordings.py --megabytes 1000 --formats ardusub dataflash ros2-mcap ros1 --works read convert

Files hold what a vehicle records: "ardusub" the messages of the sample in ../shared/data, "dataflash" an IMU at 400 Hz
and little else, bags an IMU at 400 Hz, depth, a DVL and images, or the IMU and its like alone. They are made in a
temporary folder, which needs the space, and each is read in a process of its own. Nothing is asserted.
"""

import argparse
import gzip
import itertools
import os
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

TESTS = Path(__file__).parents[1] / "tests"
SAMPLE = Path(__file__).parents[2] / "shared" / "data" / "ardusub" / "ardusub_small.BIN.gz"
sys.path.insert(0, str(TESTS))  # where the writers are
RATE = 400.0  # of the IMU [Hz]
WORKS = {
    "read": "from rovgraph.readers import read_recording; read_recording({path!r})",
    "convert": "import sys; from rovgraph.cli.app import main; sys.argv[1:] = ['convert', {path!r}, '--out', {out!r}]; "
    "main()",
}
COUNTERS = {"TimeUS": ("<u8", 1e6), "S": ("<u4", 1e6), "SMS": ("<u4", 1e3)}  # fields that are times, and their rates
DESCRIBING = {"FMT", "FMTU", "UNIT", "MULT", "PARM"}  # of a log, which stand in it once


def repeated(log: bytes, path: Path, size: int) -> None:
    """A `.BIN` of the messages of another, again and again with their own times."""
    from autopilot_files import PACKED

    formats = {128: (89, "FMT", "", "")}
    at, once, body = 0, bytearray(), bytearray()
    stamps: dict[str, list[int]] = {name: [] for name in COUNTERS}
    while at + 89 < len(log):
        length, name, _, _ = formats[log[at + 2]]
        if name == "FMT":
            kind, size_, *texts = struct.unpack_from("<BB4s16s64s", log, at + 3)
            formats[kind] = (size_, *(text.rstrip(b"\0").decode() for text in texts))
        if name in DESCRIBING:
            once += log[at : at + length]
        else:
            form, columns = formats[log[at + 2]][2:]
            for k, column in enumerate(columns.split(",")):
                if column in COUNTERS and form[k] in "QI":
                    before = struct.calcsize("<" + "".join(PACKED[c] for c in form[:k]))
                    stamps[column].append(len(body) + 3 + before)
            body += log[at : at + length]
        at += length
    views = {name: np.ndarray(len(body) - 7, dtype, body, 0, (1,)) for name, (dtype, _) in COUNTERS.items()}
    times = views["TimeUS"][stamps["TimeUS"]]
    span = 1e-6 * round(float(times.max() - times.min()), -5) + 0.1  # in whole tenths of a second
    with path.open("wb") as file:
        file.write(once)
        while file.tell() < size:
            file.write(body)
            for name, (_, rate) in COUNTERS.items():
                views[name][stamps[name]] += round(span * rate)


def ardusub(path: Path, size: int) -> None:
    """A `.BIN` of the messages that a real ArduSub 4.1 logged by default: an IMU at 25 Hz, and 25 other kinds."""
    repeated(gzip.decompress(SAMPLE.read_bytes()), path, size)


def dataflash(path: Path, size: int) -> None:
    """A `.BIN` of an IMU at 400 Hz and little else."""
    from autopilot_files import DataFlashWriter

    writer = DataFlashWriter().parameters(BARO_PRIMARY=0, BARO1_GND_PRESS=101_325.0)
    for k in range(int(10 * RATE)):
        at = 1e6 * k / RATE
        writer.add("IMU", at, 0, *np.random.default_rng(k).standard_normal(6), 1, 1)
        if k % 4 == 0:
            writer.add("MAG", at, 0, 200, 10, 430, 0, 0, 0, 1, round(at))
            writer.add("ATT", at, 100, 200, 9000)
            writer.add("XKF1", at, 0, 1.0)
        if k % 40 == 0:
            writer.add("BARO", at, 0, 0.0, 120_000.0 + k, 1000, round(1e-3 * at))
            writer.add("VISO", at, 0.1, 0, 0, 0, 0.05, 0.0, 0.0, 90.0)
    repeated(writer.bytes() + bytes(89), path, size)


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
    "ardusub": ("dive.BIN", ardusub),
    "dataflash": ("dive.BIN", dataflash),
    "tlog": ("dive.tlog", telemetry),
    "ros2-sqlite": ("dive", bag("sqlite")),
    "ros2-mcap": ("dive", bag("mcap")),
    "ros1": ("dive.bag", bag("ros1")),
    "mcap-imu": ("dive", bag("mcap", images=False)),
    "ros1-imu": ("dive.bag", bag("ros1", images=False)),
}


def measure(path: Path, work: str) -> tuple[float, float, float]:
    """Seconds of wall-clock and of processor time, and largest memory [MB], of a process with its imports."""
    code = WORKS[work].format(path=str(path), out=str(path.parent / "log.csv"))
    with (path.parent / "said.txt").open("w+") as said:
        began = time.monotonic()
        child = subprocess.Popen([sys.executable, "-W", "ignore", "-c", code], stdout=said, stderr=said)
        _, status, used = os.wait4(child.pid, 0)
        wall, child.returncode = time.monotonic() - began, os.waitstatus_to_exitcode(status)
        if child.returncode:
            said.seek(0)
            raise SystemExit(f"{path.name}: {(said.read().splitlines() or ['failed'])[-1]}")
    return wall, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megabytes", type=float, default=300.0, help="size of each file")
    parser.add_argument("--formats", nargs="+", choices=FORMATS, default=list(FORMATS))
    parser.add_argument("--works", nargs="+", choices=WORKS, default=["read"], help="read alone, or convert to CSV")
    options = parser.parse_args()
    print(f"{'format':12} {'work':8} {'MB':>6} {'wall s':>7} {'CPU s':>7} {'MB/s':>6} {'peak MB':>8} {'CSV MB':>7}")
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
                wall, seconds, most = measure(path, work)
                log = path.parent / "log.csv"
                written = f"{log.stat().st_size / 1e6:7.0f}" if log.exists() else ""
                figures = f"{wall:7.1f} {seconds:7.1f} {size / seconds:6.1f} {most:8.0f} {written}"
                print(f"{name:12} {work:8} {size:6.0f} {figures}", flush=True)


if __name__ == "__main__":
    main()
