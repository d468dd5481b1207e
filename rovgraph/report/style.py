"""The style of all figures: sizes, colours that stay distinct for the colour-blind and in grey print, time axes."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from rovgraph.geometry import Array
from rovgraph.inference.estimate import Estimate
from rovgraph.report.colours import ESTIMATES
from rovgraph.report.colours import OTHER as OTHER_COLOUR

DPI = 150
WIDTH = 7.2  # [in], the text width of a page
MOST_POINTS = 5000  # of a line; more cannot be seen

# each with a line style, so that grey prints can be read
LINES: dict[str, dict[str, Any]] = {
    "smoothed": {"linestyle": "-", "linewidth": 1.2, "zorder": 4},
    "filtered": {"linestyle": (0, (4, 1.5)), "linewidth": 1.0, "zorder": 3},
    "dead_reckoning": {"linestyle": (0, (1, 1.2)), "linewidth": 1.0, "zorder": 2},
    "reference": {"linestyle": (0, (6, 1.5, 1, 1.5)), "linewidth": 0.9, "zorder": 5},
}
for _kind, _look in LINES.items():
    _look["color"] = ESTIMATES[_kind]
OTHER: dict[str, Any] = {"color": OTHER_COLOUR, "linestyle": "-.", "linewidth": 1.0, "zorder": 2}

_RC: dict[str, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titley": 1.0,  # where it stands anyway, but not measured again at every layout
    "axes.labelsize": 9,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "lines.solid_capstyle": "round",
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-3, 5),
    "pdf.fonttype": 42,  # text stays text that can be searched and edited
    "svg.hashsalt": "rovgraph",  # the same names of parts in each run
}


@contextlib.contextmanager
def style() -> Iterator[None]:
    """The style of all figures, whatever the user's matplotlibrc; restored afterwards."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_RC)  # type: ignore[arg-type]
        yield


def new_figure(height: float, width: float = WIDTH) -> Figure:
    """An empty figure without pyplot's global state; sizes in inches."""
    return Figure(figsize=(width, height), dpi=DPI, layout="constrained")


def save(figure: Figure, path: Path) -> Path:
    """Write a figure in the format of the path's suffix, a PNG drawn once (`Figure.savefig` lays it out twice).

    PDF and SVG carry no date, so equal results are equal files.
    """
    if path.suffix != ".png":
        date = {".pdf": "CreationDate", ".svg": "Date"}[path.suffix]
        figure.savefig(path, metadata={"Creator": "rovgraph", date: None})
        return path
    for axes in figure.axes:
        axes.spines[:].set_in_layout(False)  # nowhere beyond the ticks, and slow to measure
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    opaque = np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])
    about = PngInfo()
    about.add_text("Software", "rovgraph")
    Image.fromarray(opaque).save(path, dpi=(DPI, DPI), compress_level=3, pnginfo=about)
    return path


def line_of(kind: str) -> dict[str, Any]:
    """Colour, style and width of an estimate's lines."""
    return LINES.get(kind, OTHER)


def name_of(kind: str) -> str:
    """An estimate's name in a legend."""
    return kind.replace("_", " ")


@dataclass(frozen=True)
class TimeAxis:
    """Time since the start, in seconds or, for long dives, minutes.

    Attributes
    ----------
    start, end : [s], in the log's epoch
    """

    start: float
    end: float

    @staticmethod
    def of(estimate: Estimate) -> "TimeAxis":
        """The clock of an estimate's trajectory."""
        return TimeAxis(float(estimate.trajectory.time[0]), float(estimate.trajectory.time[-1]))

    @property
    def minutes(self) -> bool:
        return self.end - self.start > 1200.0

    @property
    def label(self) -> str:
        return "time since start [min]" if self.minutes else "time since start [s]"

    def __call__(self, time: Array) -> Array:
        return (np.asarray(time, float) - self.start) / (60.0 if self.minutes else 1.0)

    def name_axis(self, axes: Axes) -> None:
        """Name and limit a time axis."""
        low, high = self(np.array([self.start, self.end]))
        axes.set_xlabel(self.label)
        if high > low:
            axes.set_xlim(low, high)


def thin(n: int, most: int = MOST_POINTS) -> NDArray[np.int64]:
    """At most ``most`` indices spread over n, both ends kept."""
    if n <= most:
        return np.arange(n)
    return np.linspace(0, n - 1, most).round().astype(np.int64)


def panel_grid(figure: Figure, count: int, columns: int) -> list[Axes]:
    """``count`` panels, row by row, with one common time axis."""
    lines = -(-count // columns)
    grid = figure.subplots(lines, columns, sharex=True, squeeze=False)
    panels: list[Axes] = list(grid.flat)
    for axes in panels[count:]:
        axes.remove()
    return panels[:count]


def name_lowest(panels: Sequence[Axes], columns: int, clock: TimeAxis) -> None:
    """Name the time axis under the lowest panel of every column."""
    for axes in panels[-columns:]:
        clock.name_axis(axes)
        axes.tick_params(labelbottom=True)


def legend_below(figure: Figure, panels: Sequence[Axes], ncols: int = 4, scale: float = 1.0) -> None:
    """One legend under all panels: everything that occurs in any of them, once."""
    found: dict[str, Artist] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    if found:
        look = {"ncols": ncols, "markerscale": scale, "handlelength": 2.6, "columnspacing": 1.6}
        figure.legend(found.values(), found.keys(), loc="outside lower center", **look)
