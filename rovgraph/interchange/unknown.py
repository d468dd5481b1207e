"""What a file is that is given as a log and is none, and which command reads it."""

from collections.abc import Sequence
from pathlib import Path

from rovgraph.config import Config
from rovgraph.tables import encoding_of, names_of

TRACK = {"time", "north", "east"}
SUMMARY = "summary.json"
BEGINNINGS = {  # formats that are known by name and not read
    b"PK\x03\x04": "is a ZIP archive; unpack it first",
    b"ULog\x01\x12\x35": "is a PX4 ULog; convert it with ulog2csv (pip install pyulog), and give its tables",
    b"\x80" * 16: "is a recording of a Rowe DVL or ADCP, which is not read; export it as PD0 with Rowe's software",
}
FOXGLOVE = (b'"topic"', b'"message"', b'"receiveTime"')  # of a message exported as JSON


def purpose(path: Path, head: bytes) -> str:
    """What a file of this program's is good for; "" where it is none of them.

    Parameters
    ----------
    head : its first bytes, of a directory b""
    """
    if path.is_dir():
        if (path / SUMMARY).is_file():
            return (
                f"is a results folder; rovgraph evaluate {path / 'trajectory_smoothed.csv'} REFERENCE reads its track"
            )
        return ""
    for beginning, what in BEGINNINGS.items():
        if head.startswith(beginning):
            return what
    if all(word in head for word in FOXGLOVE):
        return "is an export of Foxglove as JSON; give the bag or MCAP file that it comes from"
    text = head.decode("utf-8", errors="replace")
    lines = text.splitlines()
    header = set(names_of(head))
    if header >= TRACK:
        return f"is a track, not a log; rovgraph evaluate {path} REFERENCE compares it"
    keys = {line.partition(":")[0] for line in lines if ":" in line and not line.startswith((" ", "#"))}
    if path.suffix in (".yaml", ".yml") and keys & set(Config.model_fields):
        return "is a configuration; give it with --config"
    return ""


def is_text(head: bytes) -> bool:
    """Whether a file that begins like this may be a table of text."""
    return encoding_of(head) is not None


def refusal(path: Path, titles: Sequence[str]) -> str:
    """Why a file that is no table of text cannot be read."""
    return f"{path}: is binary data in an unknown format; expected one of: {', '.join(titles)}"
