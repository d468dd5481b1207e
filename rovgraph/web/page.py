"""The server of the live page, in a thread of its own."""

import threading
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import uvicorn

from rovgraph.errors import as_path, as_paths
from rovgraph.live.marks import Marks
from rovgraph.live.solution import Solution
from rovgraph.live.warnings import Warnings
from rovgraph.web import broadcast
from rovgraph.web.app import Offer, application
from rovgraph.web.broadcast import Broadcast, Connection, PageSocket
from rovgraph.web.charts import read_charts
from rovgraph.web.guard import LARGEST_HEADERS, Guard, ListenAddress, listening, parse_address, parse_origin, token_of
from rovgraph.web.view import PageLimits, View

START_S, CLOSE_S = 10.0, 2.0
MOST_CONNECTIONS = 64
LARGEST_MESSAGE = 1 << 10  # from a page's WebSocket, on which pages send no data [bytes]


class LivePage:
    """Shows solutions to all that open the page.

    `send` is called with each solution and only queues it. The server stops with `close`, or at the end of a ``with``.

    Parameters
    ----------
    address : ``host:port`` to listen at; another than the loopback asks for a token
    offer : takes commands of pages, such as `rovgraph.live.session.Feed.offer`; None = pages only look
    marks : of the run, shown on the map
    charts : GeoTIFF or GeoJSON files, or folders of tiles, below the track
    origins : of other pages that may frame this one
    token : file that keeps the token; None = a new one each time
    limits : beyond which the page raises an alarm
    warnings : receives a failure of the server

    Attributes
    ----------
    address : where it listens; port 0 has become a free one
    token : that pages need; None on the loopback

    Raises
    ------
    InputError : an address that cannot be listened at, a chart that cannot be read, an invalid origin or token
    """

    def __init__(
        self,
        address: str,
        offer: Offer | None = None,
        marks: Marks | None = None,
        charts: Sequence[Path | str] = (),
        origins: Sequence[str] = (),
        token: Path | str | None = None,
        limits: PageLimits | None = None,
        warnings: Warnings | None = None,
    ) -> None:
        wanted, origins = parse_address(address), [parse_origin(origin) for origin in origins]
        self._warnings = warnings or Warnings()
        shown = read_charts(as_paths(charts, "charts"))
        self.token = None if wanted.loopback else token_of(None if token is None else as_path(token, "token"))
        self._socket = listening(wanted)
        self.address = ListenAddress(wanted.host, self._socket.getsockname()[1])
        self.broadcast = Broadcast(View(marks or Marks(), limits or PageLimits()))
        guard = Guard(application(self.broadcast, shown, offer), self.token, origins)
        self._server = uvicorn.Server(
            uvicorn.Config(
                guard,
                log_config=None,
                access_log=False,
                lifespan="on",
                http=Connection,
                ws=PageSocket,
                ws_ping_interval=broadcast.PING_S,
                ws_ping_timeout=broadcast.PONG_S,
                ws_max_size=LARGEST_MESSAGE,
                ws_per_message_deflate=False,
                limit_concurrency=MOST_CONNECTIONS,
                h11_max_incomplete_event_size=LARGEST_HEADERS,
                timeout_graceful_shutdown=1,
                server_header=False,
            )
        )
        self._thread = threading.Thread(target=self._run, name="live page", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """URL for a person; a token follows ``#``, which browsers do not send."""
        return self.address.url if self.token is None else f"{self.address.url}#token={self.token}"

    def send(self, solution: Solution) -> None:
        """Show a solution."""
        self.broadcast.put(solution)

    def close(self) -> None:
        """Stop serving."""
        self._server.should_exit = True
        self._thread.join(CLOSE_S)
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _run(self) -> None:
        try:
            self._server.run(sockets=[self._socket])
        except Exception as error:  # the estimate continues without its page
            self._warnings.complain(self.address.url, "failed", f"the page is gone: {type(error).__name__}: {error}")
