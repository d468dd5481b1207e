"""A page: sections to one HTML file, with everything in it."""

import contextlib
import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from rovgraph.errors import InputError
from rovgraph.pages.parts import Image, Missing, Panel, Section, Table, Text

KINDS = {Panel: "panel", Table: "table", Text: "text", Image: "image", Missing: "missing"}


def render(
    title: str,
    sections: Sequence[Section],
    clock: Mapping[str, Any] | None = None,
    cursor: Mapping[str, Any] | None = None,
    origin: Mapping[str, float] | None = None,
) -> str:
    """The page's HTML.

    Parameters
    ----------
    title : of the page; any text
    sections : in order
    clock : unit and end of the time axis; None = nothing on the page has a time
    cursor : the track that the slider moves along, its arrays packed
    origin : latitude and longitude of north = east = 0
    """
    panels = {
        f"{section.key}-{k}": item.as_dict()
        for section in sections
        for k, item in enumerate(section.items)
        if isinstance(item, Panel)
    }
    data = {"panels": panels, "clock": clock, "cursor": cursor, "origin": origin}
    return _environment().get_template("page.html").render(title=title, sections=sections, data=_safe_json(data))


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
        loader=PackageLoader("rovgraph.pages"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.globals |= {"kind_of": lambda item: KINDS[type(item)], "asset": _asset, "shade": _shade}
    return environment


@cache
def _asset(name: str) -> Markup:
    """A file of ours that goes into the page as it is."""
    return Markup((files("rovgraph.pages") / "assets" / name).read_text(encoding="utf-8"))


def _safe_json(data: Mapping[str, Any]) -> Markup:
    """JSON within a script element: nothing in it can end the element."""
    text = json.dumps(data, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)


def _shade(value: float) -> str:
    """Background of a correlation: blue for positive, orange for negative, light enough for black text."""
    rgb = "0,114,178" if value > 0 else "213,94,0"
    return f"rgba({rgb},{0.55 * min(abs(value), 1.0):.2f})"
