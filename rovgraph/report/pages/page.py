"""A page: sections of panels, tables and text, rendered to one HTML file with all its data.

Arrays are packed for the browser. Series are thinned for display: the extremes of every interval are kept, so that
peaks stay visible.
"""

import base64
import contextlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from numpy.typing import ArrayLike, NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array

Trace = dict[str, Any]  # of Plotly, whose arrays are packed; "t" holds the times of points that stand over no time


RESOLVED = 1e-4  # of the range of what is drawn, or of its unit


def packed(values: ArrayLike) -> str:
    """Numbers as base64 of little-endian float32, which the browser reads without parsing.

    Numbers far from zero, such as northings of a grid, are float64 behind a colon.
    """
    numbers = np.asarray(values, float)
    known = numbers[np.isfinite(numbers)]
    off = np.abs(known - known.astype(np.float32)).max(initial=0.0)
    far = off > 0.0 and off > RESOLVED * max(float(np.ptp(known)), 1.0)
    text = base64.b64encode(numbers.astype("<f8" if far else "<f4").tobytes()).decode("ascii")
    return f":{text}" if far else text


def line(name: str, x: ArrayLike, y: ArrayLike, colour: str, **look: Any) -> Trace:
    """A line; ``look`` has ``dash``, ``width``, ``sd`` (packed) and ``band`` (sds to each side), or Plotly's keys."""
    style = {"color": colour, "width": look.pop("width", 1.5), "dash": look.pop("dash", "solid")}
    return {"name": name, "mode": "lines", "line": style, "x": packed(x), "y": packed(y), **look}


def points(name: str, x: ArrayLike, y: ArrayLike, colour: str | Sequence[str], **look: Any) -> Trace:
    """Markers, of one colour or one each; ``look`` has ``size``, ``symbol``, or keys of Plotly's trace."""
    style = {"color": colour, "size": look.pop("size", 4), "symbol": look.pop("symbol", "circle")}
    return {"name": name, "mode": "markers", "marker": style, "x": packed(x), "y": packed(y), **look}


def bars(name: str, x: ArrayLike, y: ArrayLike, colour: str, width: float, **look: Any) -> Trace:
    """Bars of one width; ``look`` has keys of Plotly's trace."""
    colours = {"color": colour}
    return {"name": name, "type": "bar", "x": packed(x), "y": packed(y), "width": width, "marker": colours, **look}


@dataclass(frozen=True)
class Panel:
    """A plot.

    Attributes
    ----------
    title : what is shown
    x, y : names of the axes with their units; of a panel over time, ``x`` is that of the page's clock
    traces : lines, points and bars
    kind : "time", "map" (equal scales, the cursor is the vehicle), "plan" (equal scales) or "xy"
    note : how to read it
    levels : horizontal lines that a reader compares with [unit of y]
    spans : from, to, colour: times that are shaded
    log : which axes are logarithmic, of "x" and "y"
    wide : over the whole width
    names : of the places 1, 2, ... on the y axis, the first on top
    limits : low, high of y at first; None = all
    key : name in files and configuration, in small print
    down : y grows downwards
    ticks : the only values of y that there are
    ramp : colours from low to high with their two labels, beside the title
    """

    title: str
    x: str
    y: str
    traces: Sequence[Trace]
    kind: str = "time"
    note: str = ""
    levels: Sequence[float] = ()
    spans: Sequence[tuple[float, float, str]] = ()
    log: str = ""
    wide: bool = True
    names: Sequence[str] = ()
    limits: tuple[float, float] | None = None
    key: str = ""
    down: bool = False
    ramp: tuple[Sequence[str], str, str] | None = None
    ticks: Sequence[float] = ()

    def as_dict(self) -> dict[str, Any]:
        """Data for ``page.js``."""
        chosen = {"kind": self.kind, "x": self.x, "y": self.y, "title": self.title, "traces": [*self.traces]}
        spans = [list(s) for s in self.spans]
        more = {"log": self.log, "names": [*self.names], "ticks": [*self.ticks]}
        shown = {"limits": self.limits, "down": self.down}
        return {**chosen, "levels": [*self.levels], "spans": spans, **more, **shown}


@dataclass(frozen=True)
class PageTable:
    """Rows of text.

    Attributes
    ----------
    title, head, rows : a cell is text, or a number between -1 and 1 where ``shaded``
    note : how to read it
    shaded : cells are coloured by their number: a matrix of correlations
    """

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[Any]]
    note: str = ""
    shaded: bool = False


@dataclass(frozen=True)
class Text:
    """Verbatim text under a title, folded unless ``shown``."""

    title: str
    text: str
    shown: bool = False


@dataclass(frozen=True)
class Image:
    """A figure of the folder, as PNG."""

    title: str
    png: bytes

    @property
    def address(self) -> str:
        """A data address, so that nothing is loaded."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode("ascii")


@dataclass(frozen=True)
class Missing:
    """What cannot be shown, and why, in a line."""

    title: str
    why: str


Item = Panel | PageTable | Text | Image | Missing


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes
    ----------
    key : its anchor
    title : its heading
    lead : sentences under the heading
    items : panels, tables and text in order
    lists : title -> lines, such as warnings; open where they are few
    finding : folded under the heading, with this sentence on what it shows
    well : whether that is as it should be; None = neither
    """

    key: str
    title: str
    lead: Sequence[str] = ()
    items: Sequence[Item] = ()
    lists: Mapping[str, Sequence[str]] = field(default_factory=dict)
    finding: str = ""
    well: bool | None = None


@dataclass(frozen=True)
class Opening:
    """The first screen of a dive: a map, and beside it the verdict and a few numbers.

    Attributes
    ----------
    chart : the map, or why there is none
    verdict : a word, which chooses the colour
    sentences : what it means, the first one large
    facts : date, place and vehicle, as far as they are known
    numbers : name -> value of the dive
    counts : what there is to read on in the section ``verdict``, such as "2 alarms"
    print_notes : on the second printed page only: title -> text
    tables : on the second printed page only
    """

    chart: Panel | Missing
    verdict: str
    sentences: Sequence[str]
    facts: Sequence[str]
    numbers: Mapping[str, str]
    counts: Sequence[str] = ()
    print_notes: Mapping[str, str] = field(default_factory=dict)
    tables: Sequence[PageTable] = ()


KINDS = {Panel: "panel", PageTable: "table", Text: "text", Image: "image", Missing: "missing"}


def render(
    title: str,
    sections: Sequence[Section],
    clock: Mapping[str, Any] | None = None,
    cursor: Mapping[str, Any] | None = None,
    origin: Mapping[str, float] | None = None,
    opening: Opening | None = None,
) -> str:
    """The page's HTML.

    Parameters
    ----------
    title : of the page; any text
    sections : in order
    clock : unit and end of the time axis; None = nothing on the page has a time
    cursor : the track that the slider moves along, its arrays packed
    origin : latitude and longitude of north = east = 0
    opening : the first screen; None = the page begins with its first section
    """
    panels = {
        f"{section.key}-{k}": item.as_dict()
        for section in sections
        for k, item in enumerate(section.items)
        if isinstance(item, Panel)
    }
    if opening is not None and isinstance(opening.chart, Panel):
        panels["track"] = opening.chart.as_dict()
    data = _safe_json({"panels": panels, "clock": clock, "cursor": cursor, "origin": origin})
    return _environment().get_template("page.html").render(title=title, sections=sections, data=data, opening=opening)


def write(path: Path, html: str) -> None:
    """Write a page; the file appears whole or not at all.

    Raises
    ------
    InputError : it cannot be written
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        partial.write_text(html, encoding="utf-8", errors="replace")
        partial.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); choose another --out") from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("rovgraph.report.pages"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.globals |= {"kind_of": lambda item: KINDS[type(item)], "asset": _asset, "shade": _shade}
    environment.filters["explained"] = _explained
    return environment


@cache
def _asset(name: str) -> Markup:
    """A file of this package that goes into the page unchanged."""
    return Markup((files("rovgraph.report.pages") / "assets" / name).read_text(encoding="utf-8"))


def _safe_json(data: Mapping[str, Any]) -> Markup:
    """JSON within a script element: nothing in it can end the element."""
    text = json.dumps(data, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)


TERMS = {
    "nees": "normalised estimation error squared: squared error over its variance; 1 per dimension on the average",
    "separation": "filtered minus smoothed, over the sd that this difference should have",
    "considered": "held at its mean, with its uncertainty in the sd of everything else (Schmidt's consider variable)",
}  # words of the field that a reader may not know


def _explained(text: object) -> Markup:
    """Escaped text whose first use of each term has a tooltip."""
    left = dict(TERMS)

    def mark(found: re.Match[str]) -> str:
        meaning = left.pop(found[0].lower(), None)
        return found[0] if meaning is None else f'<abbr title="{escape(meaning)}">{found[0]}</abbr>'

    return Markup(re.sub(rf"\b(?:{'|'.join(TERMS)})\b", mark, str(escape(text)), flags=re.IGNORECASE))


def _shade(value: float) -> str:
    """Background of a correlation: blue for positive, orange for negative, light enough for black text."""
    rgb = "0,114,178" if value > 0 else "213,94,0"
    return f"rgba({rgb},{0.55 * min(abs(value), 1.0):.2f})"


STRETCHES = 700  # of a series; a screen is hardly wider
GAP = 5.0  # usual periods


def extremes(*series: Array, stretches: int = STRETCHES) -> NDArray[np.intp]:
    """Indices of the smallest and largest value of each stretch, of every series, both ends kept.

    Parameters
    ----------
    series : ndarray, shape (n,), drawn together; NaN is a gap, and one of each stretch of gaps is kept
    stretches : of equal length in samples

    Returns
    -------
    ndarray of int, increasing, at most 2 + 3 times ``stretches`` for each series
    """
    n = len(series[0])
    if n <= 2 * stretches:
        return np.arange(n)
    size = -(-n // stretches)
    chosen = [np.array([0, n - 1])]
    for values in series:
        padded = np.full(size * stretches, np.nan)
        padded[:n] = values
        blocks = padded.reshape(stretches, size)
        begin = np.arange(stretches) * size
        unknown = np.isnan(blocks)
        chosen.append(begin + np.where(unknown, np.inf, blocks).argmin(axis=1))
        chosen.append(begin + np.where(unknown, -np.inf, blocks).argmax(axis=1))
        gap = unknown.any(axis=1)
        chosen.append((begin + unknown.argmax(axis=1))[gap])
    index = np.unique(np.concatenate(chosen))
    return index[index < n]


def broken(time: Array, values: Array) -> tuple[Array, Array]:
    """A line that breaks where nothing was measured: NaN at both ends of every gap of `GAP` usual periods or more.

    Parameters
    ----------
    time, values : ndarray, shape (n,), time increasing
    """
    period = np.diff(time)
    usual = float(np.median(period)) if len(period) else 0.0
    gaps = np.flatnonzero(period > GAP * max(usual, 1e-6))
    ends = np.column_stack([time[gaps] + usual, time[gaps + 1] - usual]).ravel()
    place = np.repeat(gaps + 1, 2)
    return np.insert(time, place, ends), np.insert(values, place, np.nan)


def cloud(values: Array, most: int = 1500) -> NDArray[np.intp]:
    """Indices of points: some spread evenly, so that the density shows, and the extremes of every stretch."""
    return np.union1d(spread(len(values), most), extremes(values, stretches=200))


def spread(n: int, most: int) -> NDArray[np.intp]:
    """At most ``most`` indices spread evenly over n, both ends kept."""
    return np.arange(n) if n <= most else np.unique(np.linspace(0, n - 1, most).round().astype(np.intp))
