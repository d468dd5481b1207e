"""Sends news to every page: encoded once, and a page that does not read is dropped.

Connections of clients may be slow, silent or hostile: each has a deadline. uvicorn by itself waits for a request
without limit, and keeps a closed connection until all is read.
"""

import asyncio
import contextlib
import json
import logging
import time
from collections import deque
from collections.abc import Callable, Coroutine
from dataclasses import replace
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from rovgraph.live.solution import Solution
from rovgraph.web.guard import SUBPROTOCOL
from rovgraph.web.view import COLUMNS, UNITS, Cursor, View

REQUEST_S = 10.0  # for a whole request, from the connection or the answer before it on
ANSWER_S = 60.0  # for the client to read the answer
PING_S, PONG_S = 5.0, 10.0  # between pings to a page, and for it to answer one
FAREWELL_S = 5.0  # for a WebSocket to end after its page was dropped
UNANSWERED = 1011  # a WebSocket's code of a ping without an answer

_faults = logging.getLogger(__name__)  # of the server alone: errors of clients are of no use to the pilot
_faults.setLevel(logging.ERROR)


class Connection(H11Protocol):
    """HTTP that ends a connection at its deadline."""

    def __init__(self, *args: Any, **named: Any) -> None:
        super().__init__(*args, **named)
        self.logger = _faults
        self._deadline: asyncio.TimerHandle | None = None
        self._answered: RequestResponseCycle | None = None  # the newest request that came in full

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._expect(REQUEST_S)

    def connection_lost(self, exc: Exception | None) -> None:
        self._expect(None)
        super().connection_lost(exc)

    def handle_events(self) -> None:
        super().handle_events()
        if self.cycle is not None and self.cycle is not self._answered and not self.cycle.more_body:
            self._answered = self.cycle
            self._expect(ANSWER_S)

    def on_response_complete(self) -> None:
        self._expect(REQUEST_S)
        super().on_response_complete()

    def handle_websocket_upgrade(self, event: Any) -> None:
        self._expect(None)
        super().handle_websocket_upgrade(event)

    def _expect(self, seconds: float | None) -> None:
        """Set the deadline again; None = no deadline."""
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = None if seconds is None else self.loop.call_later(seconds, self.transport.abort)


class PageSocket(WebSocketsSansIOProtocol):
    """A WebSocket that reports when its page answers no ping, and drops unread messages at its end."""

    def __init__(self, *args: Any, **named: Any) -> None:
        super().__init__(*args, **named)
        self.logger = _faults

    def keepalive_timeout(self) -> None:
        self.queue.put_nowait({"type": "websocket.disconnect", "code": UNANSWERED})
        super().keepalive_timeout()
        self.transport.abort()

    def on_task_complete(self, task: asyncio.Task[None]) -> None:
        super().on_task_complete(task)
        self.loop.call_later(FAREWELL_S, self.transport.abort)


def unanswered(gone: WebSocketDisconnect) -> bool:
    """Whether a page was lost because it answered no ping."""
    return gone.code == UNANSWERED


PERIOD_S = 0.05  # least time between messages to a page
IDLE_S = 1.0  # after which a page is sent a message without news
STALL_S = 5.0  # a page that takes longer to read one message, when its buffers are full, is dropped
MOST_PAGES = 32


class Broadcast:
    """Pages that watch, and the queue between them and the estimator.

    Parameters
    ----------
    view : what they see

    Attributes
    ----------
    pages : that watch now
    dropped : pages that did not read
    """

    QUEUED = 20_000  # solutions that may wait for the server's thread

    def __init__(self, view: View) -> None:
        self.view = view
        self.pages = self.dropped = 0
        self._queue: deque[tuple[Solution, float]] = deque(maxlen=self.QUEUED)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._woken = False
        self._arrived = asyncio.Event()
        self._news, self._edition = asyncio.Condition(), 0
        self._encoded: dict[Cursor, tuple[str | None, Cursor]] = {}  # message to each, and its cursor after it

    def put(self, solution: Solution) -> None:
        """Take a solution; in the estimator's thread, and all that is done there."""
        self._queue.append((solution, time.monotonic()))
        if self._loop is not None and not self._woken:
            self._woken = True
            with contextlib.suppress(RuntimeError):  # the server has ended
                self._loop.call_soon_threadsafe(self._arrived.set)

    async def run(self) -> None:
        """Work off the queue, as long as the server runs."""
        self._loop = asyncio.get_running_loop()
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(IDLE_S):
                    await self._arrived.wait()
            self._woken = False
            self._arrived.clear()
            await self._take()
            async with self._news:
                self._encoded.clear()
                self._edition += 1
                self._news.notify_all()
            await asyncio.sleep(PERIOD_S)

    async def _take(self) -> None:
        """What the estimator has put, without holding up its thread for long."""
        count = 0
        while self._queue:
            self.view.take(*self._queue.popleft())
            count += 1
            if count % 20 == 0:
                await asyncio.sleep(0)

    async def serve(self, socket: WebSocket) -> None:
        """All of the track to a page, then news, until it closes, sends or does not read."""
        if self.pages >= MOST_PAGES:
            await socket.close(1013, f"{MOST_PAGES} pages watch already")
            return
        await socket.accept(SUBPROTOCOL if SUBPROTOCOL in socket.scope.get("subprotocols", []) else None)
        await self._hold(socket, self._feed(socket))

    async def serve_values(self, socket: WebSocket, values: Callable[[View], list[str]]) -> None:
        """One message for each value, at every change."""
        if self.pages >= MOST_PAGES:
            await socket.close(1013, f"{MOST_PAGES} pages watch already")
            return
        await socket.accept()

        async def feed() -> None:
            while True:
                edition = self._edition
                for value in values(self.view):
                    await self._send(socket, value)
                await self._changed(edition)

        await self._hold(socket, feed())

    async def _hold(self, socket: WebSocket, feed: Coroutine[Any, Any, None]) -> None:
        """Run a feed until it or its page ends."""
        self.pages += 1
        tasks = [asyncio.ensure_future(feed), asyncio.ensure_future(_silence(socket))]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            self.dropped += any(isinstance(task.exception(), TimeoutError) for task in done)
        finally:
            self.pages -= 1
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            with contextlib.suppress(Exception):  # it may be gone, or not read this either
                async with asyncio.timeout(0.2):
                    await socket.close(1008)

    async def _feed(self, socket: WebSocket) -> None:
        view, cursor = self.view, None
        while True:
            edition = self._edition
            if cursor is None:
                cursor, pieces = replace(view.cursor, marks=-1), list(view.track.pieces())
                begin = {"type": "begin", "columns": COLUMNS, "units": UNITS, "events": view.events()}
                await self._send(socket, json.dumps(begin))
                for piece in pieces:
                    await self._send(socket, f'{{"type":"track","points":{piece}}}')
            if cursor not in self._encoded:
                told = view.cursor  # before: marks that change meanwhile are sent again
                self._encoded[cursor] = view.update(cursor), told
            message, told = self._encoded[cursor]
            cursor = None if message is None else told
            if message is not None:
                await self._send(socket, message)
                await self._changed(edition)

    async def _changed(self, edition: int) -> None:
        async with self._news:
            await self._news.wait_for(lambda: self._edition != edition)

    async def _send(self, socket: WebSocket, text: str) -> None:
        async with asyncio.timeout(STALL_S):  # wait_for of Python 3.11 may lose the cancellation by `_hold`
            await socket.send_text(text)


async def _silence(socket: WebSocket) -> None:
    """Return when a page closes, or sends a message, which pages do by requests only.

    Raises
    ------
    TimeoutError : it answers no ping, as what it was sent before is not read
    """
    try:
        await socket.receive_text()
    except WebSocketDisconnect as gone:
        if unanswered(gone):
            raise TimeoutError from None
    except KeyError:  # it was no text
        pass
