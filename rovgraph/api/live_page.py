"""The live page: what ``rovgraph online --http`` opens."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rovgraph.errors import InputError
from rovgraph.live.commands import Command
from rovgraph.live.marks import Marks
from rovgraph.live.warnings import Warnings

if TYPE_CHECKING:
    from rovgraph.web.page import LivePage

NEEDED = {"starlette", "uvicorn", "websockets", "prometheus_client"}


def live_page(
    address: str = "127.0.0.1:8080",
    offer: Callable[[Command], bool] | None = None,
    marks: Marks | None = None,
    charts: Sequence[Path | str] = (),
    origins: Sequence[str] = (),
    token: Path | str | None = None,
    position_sd_limit_m: float = 5.0,
    warnings: Warnings | None = None,
) -> "LivePage":
    """Serve the live page; give it each solution with `send`, and `close` it at the end (docs/live-page.md).

    Parameters
    ----------
    address : ``host:port``; another host than the loopback asks pages for a token, which is in the page's `url`
    offer : takes the commands of pages; None = pages only look
    marks : shown on the map
    charts : GeoTIFF or GeoJSON files, or folders of tiles, below the track
    origins : of other pages, such as Cockpit's, that may frame the page and read values without a token
    token : file that keeps the token; None = a new one each time
    position_sd_limit_m : beyond which the page raises an alarm
    warnings : told if the server fails

    Raises
    ------
    InputError : a library that is missing, an address that cannot be listened at, a chart that cannot be read
    """
    try:
        from rovgraph.web.page import LivePage
        from rovgraph.web.view import Limits
    except ImportError as error:
        if error.name is None or error.name.partition(".")[0] not in NEEDED:
            raise
        raise InputError(f"--http needs {error.name}; install it with: pip install 'rovgraph[web]'") from None
    if not 0.0 < position_sd_limit_m < float("inf"):
        raise InputError(f"--position-sd-limit {position_sd_limit_m:g}: expected metres, more than 0")
    limits = Limits(position_sd_m=position_sd_limit_m)
    return LivePage(address, offer, marks, charts, origins, token, limits, warnings)
