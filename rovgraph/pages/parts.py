"""What a page is made of: sections of panels, tables and text, with arrays packed for the browser."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

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
    """A line; ``look`` has ``dash``, ``width``, or keys of Plotly's trace."""
    style = {"color": colour, "width": look.pop("width", 1.5), "dash": look.pop("dash", "solid")}
    return {"name": name, "mode": "lines", "line": style, "x": packed(x), "y": packed(y), **look}


def points(name: str, x: ArrayLike, y: ArrayLike, colour: str, **look: Any) -> Trace:
    """Markers; ``look`` has ``size``, ``symbol``, or keys of Plotly's trace."""
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
    kind : "time", "map" (equal scales, the cursor is the vehicle) or "xy"
    note : how to read it
    levels : horizontal lines that a reader compares with [unit of y]
    spans : from, to, colour: times that are shaded
    log : which axes are logarithmic, of "x" and "y"
    wide : over the whole width
    names : of the places 1, 2, ... on the y axis, the first on top
    reach : what is shown of y at first, to both sides of zero; 0 = all
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
    reach: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """What ``page.js`` draws."""
        chosen = {"kind": self.kind, "x": self.x, "y": self.y, "title": self.title, "traces": [*self.traces]}
        spans = [list(s) for s in self.spans]
        more = {"log": self.log, "names": [*self.names], "reach": self.reach}
        return {**chosen, "levels": [*self.levels], "spans": spans, **more}


@dataclass(frozen=True)
class Table:
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


Item = Panel | Table | Text | Image | Missing


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes
    ----------
    key : its anchor
    title : its heading
    lead : sentences under the heading
    items : panels, tables and text in order
    lists : title -> lines, such as warnings
    """

    key: str
    title: str
    lead: Sequence[str] = ()
    items: Sequence[Item] = ()
    lists: Mapping[str, Sequence[str]] = field(default_factory=dict)
