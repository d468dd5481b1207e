"""Sources of messages: from a URL to a link and a decoder.

A link yields bytes as they come; a decoder makes messages of them, whatever the link. May import what `rovgraph.live`
may. Begin with `source` (`Source`, `Link`, `Decoder`), then `links` and `json_lines`; `open_sources` takes URLs apart
and reports errors in them. docs/online-sources.md is the contract.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from rovgraph.errors import InputError, kind_of, warn
from rovgraph.live.sources import doppler
from rovgraph.live.sources.doppler import NucleusDecoder, Pd4Decoder, pd6, tracker
from rovgraph.live.sources.json_lines import json_lines
from rovgraph.live.sources.links import FileLink, SerialLink, StandardInput, TcpLink, TelemetryReplay, UdpLink
from rovgraph.live.sources.mavlink import MavlinkDecoder, MavlinkOptions
from rovgraph.live.sources.nmea import nmea
from rovgraph.live.sources.replay import LogReplay, log_replay, refuse_other_epochs
from rovgraph.live.sources.source import Decoder, LinkSource, Notify, Source
from rovgraph.live.sources.ugps import RATE_HZ, UgpsPolling, ugps
from rovgraph.live.warnings import Warnings
from rovgraph.log.units import nearest
from rovgraph.model.config import Config
from rovgraph.readers.mavlink import IMUS

LOOPBACK = "127.0.0.1"
_OPTIONS = re.compile(r"\?(?=\w+=)")  # a question mark in a file's name is not an option


@dataclass(frozen=True)
class SourceUrl:
    """A URL: ``scheme:place?option=value&...``.

    Attributes
    ----------
    url : as a person gave it
    scheme : in front of the first colon
    place : what stands between
    options : as text
    """

    url: str
    scheme: str
    place: str
    options: Mapping[str, str]

    def inner(self) -> "SourceUrl":
        """The place, as an address of its own: of ``nmea:tcp://host:1`` that of ``tcp://host:1``."""
        scheme, _, place = self.place.partition(":")
        return SourceUrl(self.url, scheme, place, self.options)

    def host_port(self, default_host: str | None = None, default_port: int | None = None) -> tuple[str, int]:
        """Host and port of ``//host:port``.

        Raises
        ------
        InputError : one of them is missing without a default, or wrong
        """
        try:
            parts = urlsplit(f"//{self.place.removeprefix('//')}")
            host, port = parts.hostname or default_host, parts.port or default_port
        except ValueError:
            host = port = None
        else:
            if parts.path not in ("", "/") or parts.username is not None:
                host = port = None
        if host is None or port is None:
            raise InputError(f"{self.url}: expected {self.scheme}://host:port with a port from 1 to 65535")
        return host, port

    def take(self, readers: Mapping[str, Callable[[str], Any]]) -> dict[str, Any]:
        """Options that were given, read.

        Parameters
        ----------
        readers : name -> from text to value; raises ValueError, whose message states what was expected

        Raises
        ------
        InputError : unknown option, or a value that cannot be read
        """
        out = {}
        for name, text in self.options.items():
            if name not in readers:
                known = f"nearest is {nearest(name, readers)!r} of {', '.join(readers)}" if readers else "it has none"
                raise InputError(f"{self.url}: unknown option {name!r}; {known}")
            try:
                out[name] = readers[name](text)
            except ValueError as error:
                raise InputError(f"{self.url}: option {name}: {text!r}, {error}") from None
        return out


def parse_address(url: str) -> SourceUrl:
    """A URL taken apart; what has no colon has an empty scheme.

    Raises
    ------
    InputError : an option given twice
    """
    head, *tail = _OPTIONS.split(url, maxsplit=1)
    pairs = parse_qsl(tail[0], keep_blank_values=True) if tail else []
    if len(pairs) > len(dict(pairs)):
        raise InputError(f"{url}: an option is given twice")
    scheme, colon, place = head.partition(":")
    return SourceUrl(url, scheme if colon else "", place if colon else head, dict(pairs))


def positive(text: str) -> float:
    """A number above 0, from an option's text."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0.0 < value < float("inf"):
        raise ValueError("expected a number above 0")
    return value


def whole(lowest: int, highest: int) -> Callable[[str], int]:
    """Reader of a whole number within bounds."""

    def read(text: str) -> int:
        if not (text.isdecimal() and lowest <= int(text) <= highest):
            raise ValueError(f"expected a whole number from {lowest} to {highest}")
        return int(text)

    return read


def one_of(*known: str) -> Callable[[str], str]:
    """Reader of one of some words."""

    def read(text: str) -> str:
        if text not in known:
            raise ValueError(f"expected one of {', '.join(known)}")
        return text

    return read


FASTEST_HZ = 50.0  # of polling
MAVLINK_BAUD, NMEA_BAUD, DOPPLER_BAUD = 115200, 4800, 115200
DEVICES = ("/dev/", "COM")
Opener = Callable[[SourceUrl, Notify, Config, float], Source]
FORMS = {
    "-": "-",
    "tcp": "tcp://host:port",
    "udp": "udp://[host]:port",
    "waterlinked": "waterlinked://host[:port]",
    "mavlink": "mavlink:udpin:host:port",
    "nmea": "nmea:/dev/ttyUSB0",
    "pd4": "pd4:tcp://host:port",
    "pd6": "pd6:/dev/ttyUSB0",
    "cerulean": "cerulean:udp://:27000",
    "nucleus": "nucleus:tcp://host:port",
    "ugps": "ugps:http://host",
    "file": "file:log.csv",
}

_baud = whole(50, 4_000_000)


def open_sources(
    urls: Sequence[str],
    warnings: Warnings | None = None,
    config: Config | None = None,
    speed: str = "1",
) -> tuple[Source, ...]:
    """Sources of URLs; see `open_source`.

    Raises
    ------
    InputError : no URL, one of them is wrong, or occurs twice; logs that are not on one clock
    """
    if not urls:
        raise InputError(f"expected at least one source, such as {', '.join(FORMS.values())}")
    for url in urls:
        if not isinstance(url, str):
            raise InputError(f"source: expected an address as text, such as file:log.csv, found {kind_of(url)}")
        if urls.count(url) > 1:
            raise InputError(f"{url}: given twice; each source can be read once")
    warnings = warnings or Warnings()
    opened = tuple(open_source(url, warnings, config, speed) for url in urls)
    logs = [source for source in opened if isinstance(source, LogReplay)]
    refuse_other_epochs(logs)
    begin = min((log.span[0] for log in logs), default=None)
    return tuple(replace(source, begin=begin) if isinstance(source, LogReplay) else source for source in opened)


def open_source(
    url: str,
    warnings: Warnings | None = None,
    config: Config | None = None,
    speed: str = "1",
) -> Source:
    """The source of a URL; docs/online-sources.md lists them.

    Parameters
    ----------
    url : as a person gives it
    warnings : where those of the source go
    config : for columns, units, declination and gravity
    speed : of files, a number or "max"; their option ``speed`` goes before it

    Raises
    ------
    InputError : a URL that is unknown or malformed, a file or port that cannot be opened, a library that is missing
    """
    address = parse_address(url)
    if address.scheme == "" and address.place == "-":
        address = SourceUrl(url, "-", "", address.options)
    opener = _OPENERS.get(address.scheme)
    if opener is None:
        raise _unknown(address)
    notify = partial((warnings or Warnings()).complain, url)
    return opener(address, notify, config or Config(), pace_of(speed))


def pace_of(speed: str) -> float:
    """Recorded seconds per second of a speed: a number, or "max".

    Raises
    ------
    InputError : it is neither
    """
    try:
        return _pace(speed)
    except ValueError as error:
        raise InputError(f"speed: {speed!r}, {error}") from None


def _pace(text: str) -> float:
    if text == "max":
        return math.inf
    try:
        return positive(text)
    except ValueError:
        raise ValueError("expected a number above 0, or max") from None


def _unknown(address: SourceUrl) -> InputError:
    """Message on a URL of unknown form, with the form that was probably meant."""
    known = f"known are {', '.join(FORMS.values())}"
    if Path(address.url).suffix.lower() == ".tlog":
        meant = f"mavlink:{address.url}"
    elif Path(address.url).is_file():
        meant = f"file:{address.url}"
    elif address.scheme in ("udpin", "tcpin", "udpout"):
        meant = f"mavlink:udpin:{address.place.rpartition('udpin:')[2]}"
    elif address.url.startswith(DEVICES):
        meant = f"nmea:{address.url} or mavlink:{address.url}"
    else:
        meant = FORMS[nearest(address.scheme or address.url, FORMS)]
    return InputError(f"{address.url}: unknown kind of source; did you mean {meant}? {known}")


def _standard_input(address: SourceUrl, notify: Notify, config: Config, pace: float) -> Source:
    address.take({})
    return LinkSource(address.url, StandardInput(), json_lines(address.url, notify, config))


def _network(address: SourceUrl, notify: Notify, config: Config, pace: float) -> Source:
    address.take({})
    return _networked(address, notify, json_lines(address.url, notify, config), end=b"\n")


def _waterlinked(address: SourceUrl, notify: Notify, config: Config, pace: float) -> Source:
    address.take({})
    link = TcpLink(*address.host_port(default_port=doppler.PORT), notify)
    return LinkSource(address.url, link, doppler.waterlinked(address.url, notify))


def _ugps(address: SourceUrl, notify: Notify, config: Config, pace: float) -> Source:
    inner = address.inner()
    if inner.scheme != "http":
        raise InputError(f"{address.url}: expected {FORMS['ugps']}, such as ugps:http://192.168.2.94")
    rate = address.take({"rate": positive}).get("rate", RATE_HZ)
    link = UgpsPolling(*inner.host_port(default_port=80), min(rate, FASTEST_HZ), notify)
    return LinkSource(address.url, link, ugps(address.url, notify, config))


def _doppler(make: Callable[[str, Notify], Decoder], end: bytes = b"") -> Opener:
    """Opener of a Doppler instrument at a TCP or UDP port, or a serial one."""

    def opener(address: SourceUrl, notify: Notify, config: Config, pace: float) -> Source:
        inner, decoder = address.inner(), make(address.url, notify)
        if inner.scheme in ("tcp", "udp"):
            address.take({})
            return _networked(inner, notify, decoder, end)
        if not _is_device(address.place):
            scheme = address.scheme
            raise InputError(f"{address.url}: expected {scheme}:tcp://host:port or {scheme}:/dev/ttyUSB0")
        baud = address.take({"baud": _baud}).get("baud", DOPPLER_BAUD)
        return LinkSource(address.url, SerialLink(address.place, baud, notify), decoder)

    return opener


def _file(address: SourceUrl, notify: Notify, config: Config, pace: float) -> Source:
    pace = address.take({"speed": _pace}).get("speed", pace)
    return log_replay(address.url, address.place.removeprefix("//"), config, pace)


def _nmea(address: SourceUrl, notify: Notify, config: Config, pace: float) -> Source:
    inner = address.inner()
    if inner.scheme in ("tcp", "udp"):
        address.take({})
        return _networked(inner, notify, nmea(address.url, notify, config), end=b"\n")
    if _is_device(address.place):
        baud = address.take({"baud": _baud}).get("baud", NMEA_BAUD)
        link = SerialLink(address.place, baud, notify)
        return LinkSource(address.url, link, nmea(address.url, notify, config))
    path = _existing(address)
    pace = address.take({"speed": _pace}).get("speed", pace)
    return LinkSource(address.url, FileLink(path), nmea(address.url, notify, config, recorded=True), pace=pace)


def _mavlink(address: SourceUrl, notify: Notify, config: Config, pace: float) -> Source:
    inner = address.inner()
    recorded = address.place.lower().endswith((".tlog", ".tlog.gz"))
    serial = _is_device(address.place)
    if not (recorded or serial or inner.scheme in ("tcp", "udp", "udpin")):
        raise InputError(
            f"{address.url}: expected mavlink:udpin:host:port, mavlink:tcp:host:port, mavlink:/dev/ttyACM0 "
            "or mavlink:file.tlog; nothing is sent to a vehicle, so a connection that must send first is not supported"
        )
    options = address.take(
        _MAVLINK_OPTIONS | ({"speed": _pace} if recorded else {}) | ({"baud": _baud} if serial else {})
    )
    options = {name: value for name, value in options.items() if name not in DEPTH_OPTIONS}
    pace, baud = options.pop("speed", pace), options.pop("baud", MAVLINK_BAUD)
    decoder = MavlinkDecoder(address.url, notify, config, MavlinkOptions(**options))
    if recorded:
        return LinkSource(address.url, TelemetryReplay(_existing(address)), decoder, pace=pace)
    if serial:
        device, _, rate = address.place.partition(",")  # as pymavlink has it
        return LinkSource(address.url, SerialLink(device, int(rate) if rate.isdecimal() else baud, notify), decoder)
    return _networked(inner, notify, decoder)


DEPTH_OPTIONS = {"surface": "surface_hpa", "density": "density_kgm3"}  # that have become keys of ``depth``


def with_depth_options(urls: Sequence[str], config: Config) -> Config:
    """A configuration with what options of mavlink URLs state of surface and water, as they did before it had keys.

    Raises
    ------
    InputError : no such surface or density

    Warns
    -----
    DataWarning : the key that takes the option's place
    """
    for url in urls:
        address = parse_address(url)
        for name in DEPTH_OPTIONS.keys() & address.options.keys() if address.scheme == "mavlink" else ():
            (value,) = replace(address, options={name: address.options[name]}).take({name: positive}).values()
            config = config.changed(depth={DEPTH_OPTIONS[name]: value})
            warn(f"{url}: option {name} will go; state depth: {{{DEPTH_OPTIONS[name]}: {value:g}}} instead")
    return config


_MAVLINK_OPTIONS = {
    "system": whole(1, 255),
    "component": whole(1, 255),
    "imu": one_of(*IMUS),
    "pressure": whole(1, 3),
    **dict.fromkeys(DEPTH_OPTIONS, positive),
}


def _networked(inner: SourceUrl, notify: Notify, decoder: Decoder, end: bytes = b"") -> Source:
    """A source over TCP, as a client, or over UDP, listening."""
    if inner.scheme == "tcp":
        return LinkSource(inner.url, TcpLink(*inner.host_port(), notify), decoder)
    return LinkSource(inner.url, UdpLink(*inner.host_port(LOOPBACK), inner.url, end), decoder, lossy=True)


def _is_device(place: str) -> bool:
    return place.startswith(DEVICES)


def _existing(address: SourceUrl) -> Path:
    path = Path(address.place.removeprefix("//"))
    if not path.is_file():
        raise InputError(f"{address.url}: no such file {path}; expected a file, a device, {FORMS[address.scheme]}")
    return path


_OPENERS: dict[str, Opener] = {
    "-": _standard_input,
    "tcp": _network,
    "udp": _network,
    "waterlinked": _waterlinked,
    "mavlink": _mavlink,
    "nmea": _nmea,
    "pd4": _doppler(Pd4Decoder),
    "pd6": _doppler(pd6, end=b"\n"),
    "cerulean": _doppler(tracker, end=b"\n"),
    "nucleus": _doppler(NucleusDecoder),
    "ugps": _ugps,
    "file": _file,
}


__all__ = ["Source", "open_source", "open_sources"]
