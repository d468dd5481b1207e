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
    """Serve the live page (docs/live-page.md). Pass each solution to its `send`, and `close` it at the end.

    Parameters
    ----------
    address : ``host:port``; a host other than the loopback requires a token, which is in the page's `url`
    offer : called with commands of pages; None = pages are read-only
    marks : to show on the map
    charts : GeoTIFF or GeoJSON files, or folders of tiles, to show under the track
    origins : of other pages, such as Cockpit's, that may frame the page and read values without a token
    token : file that holds the token; None = a new token each time
    position_sd_limit_m : position sd beyond which the page raises an alarm
    warnings : receives failures of the server

    Raises
    ------
    InputError : a missing library, an address that cannot be used, a chart that cannot be read
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
