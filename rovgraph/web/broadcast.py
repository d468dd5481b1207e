"""News to every page that watches: encoded once, and a page that does not read is dropped."""

import asyncio
import contextlib
import json
import time
from collections import deque
from collections.abc import Callable, Coroutine
from dataclasses import replace
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from rovgraph.live.solution import Solution
from rovgraph.web.connections import unanswered
from rovgraph.web.guard import SUBPROTOCOL
from rovgraph.web.track import COLUMNS
from rovgraph.web.view import UNITS, Cursor, View

PERIOD_S = 0.05  # least time between messages to a page
IDLE_S = 1.0  # after which a page is told that there is nothing new
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
        self._encoded: dict[Cursor, tuple[str | None, Cursor]] = {}  # what each is told, and has then

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
        """All of the track to a page, then news, until it goes, speaks or does not read."""
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
                told = view.cursor  # before: marks that change meanwhile are told again
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
    """Return when a page goes, or says something, which pages do by requests only.

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
