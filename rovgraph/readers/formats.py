"""Native formats, recognised by their content: one module each, registered here or by an entry point.

A package of its own adds a format with an entry point of the group ``rovgraph.formats`` that names a `Format`. Files
that are not logs are explained, with the command that reads them.
"""

import gzip
import importlib
import shutil
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Protocol

from rovgraph.errors import InputError, in_one_line, warn
from rovgraph.log.tables import encoding_of, names_of
from rovgraph.model.config import Config, TableSettings
from rovgraph.readers.recording import Recording

HEAD = 65536  # bytes of a file that a format is recognised by
LIKELY = 0.5  # confidence from which a file is taken to be of a format
OWN: tuple[str, ...] = (  # modules of this package, each with a `FORMAT`
    "own_log",
    "dataflash",
    "tlog",
    "blueos",
    "waterlinked",
    "ugps",
    "pd0",
    "pd4",
    "pd6",
    "cerulean",
    "ad2cp",
    "nucleus",
    "stdbin",
    "imc",
    "rosbag",
    "nmea",
    "gpx",
    "xsens",
    "xsens_mtb",
    "microstrain",
    "vectornav",
    "vectornav_sentences",
)
GROUP = "rovgraph.formats"


@dataclass(frozen=True)
class ReadingOptions:
    """A user's options for reading files.

    Attributes
    ----------
    choose : sensor -> instance, message or topic that feeds it, where a file has several
    progress : called with the bytes read so far and those of the file
    table : names, units, angles and times of rovgraph's own log, by a configuration (docs/log-format.md)
    arrival : use the stamps of arrival, at least some: rows whose own stamps are wrong are kept
    """

    choose: Mapping[str, str] = field(default_factory=dict)
    progress: Callable[[int, int], None] = lambda done, total: None
    table: TableSettings = field(default_factory=TableSettings)
    arrival: bool = False


class Format(Protocol):
    """A native format.

    Attributes
    ----------
    name : short, for options and messages, such as "dataflash"
    title : for people, such as "ArduPilot DataFlash log"
    extra : the extra of this package that its reader needs ("" = none)
    """

    name: str
    title: str
    extra: str

    def recognise(self, path: Path, head: bytes) -> float:
        """How sure it is, 0 to 1, that a file is of this format, by its first `HEAD` bytes; it reads no more.

        A directory, as some bags are, has the head b"".
        """

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        """Everything in the file that a log can hold, and an account of the rest.

        Raises
        ------
        InputError : nothing in it can be used; what is in part damaged is read in part, and counted
        """


@cache
def formats() -> tuple[Format, ...]:
    """All formats: this package's own, then those of entry points; one that cannot be loaded is a warning."""
    found: list[Format] = [importlib.import_module(f"{__package__}.{name}").FORMAT for name in OWN]
    for entry in entry_points(group=GROUP):
        try:
            found.append(entry.load())
        except Exception as error:  # whatever another package does
            warn(f"format {entry.name} of {entry.value} cannot be loaded and is left out ({in_one_line(error)})")
    return tuple(found)


def recognise(path: Path) -> Format | None:
    """The format that a file, gzipped or not, is most likely of; None where none is likely."""
    head = head_of(path)
    plain = path.with_suffix("") if path.suffix == ".gz" else path
    sure = [(_confidence(format_, plain, head), -k) for k, format_ in enumerate(formats())]
    confidence, k = max(sure, default=(0.0, 0))
    return formats()[-k] if confidence >= LIKELY else None


def _confidence(format_: Format, path: Path, head: bytes) -> float:
    try:
        return float(format_.recognise(path, head))
    except Exception:  # whatever another package does with a head that is not its own
        return 0.0


def read_recording(path: Path | str, options: ReadingOptions | None = None, format_: Format | None = None) -> Recording:
    """Read a file, or a bag that is a directory, of any format that is known, gzipped or not.

    Parameters
    ----------
    format_ : that it is in; None = as recognised

    Raises
    ------
    InputError : no such file, an unknown format, a reader that is not installed, nothing that can be used in it
    """
    options, path = ReadingOptions() if options is None else options, Path(path)
    format_ = recognise(path) if format_ is None else format_
    if format_ is None:
        known = ", ".join(each.title for each in formats())
        raise InputError(f"{path}: is in an unknown format; expected one of: {known}")
    with unpacked(path) as plain:
        try:
            recording = format_.read(plain, options)
        except ImportError as error:
            missing = (error.name or "").partition(".")[0]
            raise InputError(
                f"{path}: reading a {format_.title} needs {missing}; install it with: "
                f"pip install 'rovgraph[{format_.extra}]'"
            ) from None
        except InputError as error:
            error.args = (str(error).replace(str(plain), str(path)),)
            raise
        except MemoryError:
            raise InputError(f"{path}: what it holds does not fit into the memory that is free; split it") from None
        except Exception as error:  # whatever a damaged file does to a reader
            raise InputError(f"{path}: cannot be read as a {format_.title} ({in_one_line(error)}); damaged?") from error
    said = tuple(text.replace(str(plain), str(path)) for text in recording.warnings)
    return replace(recording, path=str(path), warnings=said)


@contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """The file itself, or a copy without gzip's compression that is there within the block.

    Raises
    ------
    InputError : no such file, damaged compression, no space for the copy
    """
    if not _head(path).startswith(b"\x1f\x8b"):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / path.name.removesuffix(".gz")
        try:
            with gzip.open(path) as packed, plain.open("wb") as out:
                shutil.copyfileobj(packed, out, 1 << 20)
        except (EOFError, zlib.error, gzip.BadGzipFile):
            raise InputError(f"{path}: gzip data are damaged or cut off; copy the file again") from None
        except OSError as error:
            raise InputError(f"{path}: cannot be unpacked into {folder} ({error.strerror}); unpack it first") from None
        yield plain


def head_of(path: Path) -> bytes:
    """The first `HEAD` bytes of a file, without gzip's compression; b"" of a directory.

    Raises
    ------
    InputError : no such file, empty, or it cannot be read
    """
    head = _head(path)
    if not head.startswith(b"\x1f\x8b"):
        return head
    try:
        with gzip.open(path) as packed:
            return packed.read(HEAD)
    except (OSError, EOFError, zlib.error):
        return b""


def _head(path: Path) -> bytes:
    if path.is_dir():
        return b""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the name") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    if not head:
        raise InputError(f"{path}: is empty, expected a recording")
    return head


TRACK = {"time", "north", "east"}
SUMMARY = "summary.json"
BEGINNINGS = {  # formats that are known by name and not read
    b"PK\x03\x04": "is a ZIP archive; unpack it first",
    b"ULog\x01\x12\x35": "is a PX4 ULog; convert it with ulog2csv (pip install pyulog), and give its tables",
    b"\x80" * 16: "is a recording of a Rowe DVL or ADCP, which is not read; export it as PD0 with Rowe's software",
}
FOXGLOVE = (b'"topic"', b'"message"', b'"receiveTime"')  # of a message exported as JSON


LIVE_RECORDING = "received.csv"


def purpose(path: Path, head: bytes) -> str:
    """The use of a file of this program's; "" for other files.

    Parameters
    ----------
    head : its first bytes, of a directory b""
    """
    if path.is_dir():
        tracks = [path / f"trajectory_{kind}.csv" for kind in ("smoothed", "filtered")]
        track = next((track for track in tracks if track.is_file()), tracks[0])
        if (path / LIVE_RECORDING).is_file():
            return f"is the folder of a live dive; its log is {path / LIVE_RECORDING}"
        if (path / SUMMARY).is_file():
            return f"is a results folder; rovgraph evaluate {track} REFERENCE reads its track"
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
    """Why a file that is not a table of text cannot be read."""
    return f"{path}: is binary data in an unknown format; expected one of: {', '.join(titles)}"
