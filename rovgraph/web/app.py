"""The addresses of the page: docs/live-page.md lists them."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from importlib.resources import files

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket

from rovgraph.live.commands import Command, RemoveMark
from rovgraph.live.marks import MOST_MARKS
from rovgraph.web import cockpit
from rovgraph.web.broadcast import Broadcast
from rovgraph.web.charts import Charts
from rovgraph.web.guard import ASSETS, DATA_LAKE
from rovgraph.web.metrics import Metrics
from rovgraph.web.requests import Allowance, MarkBody, PositionBody, Refusal, read_body

Offer = Callable[[Command], bool]


def application(broadcast: Broadcast, charts: Charts, offer: Offer | None) -> Starlette:
    """The application behind the guard.

    Parameters
    ----------
    broadcast : to pages
    charts : drawn below the track
    offer : takes commands, and says whether there was room; None = nothing can be changed
    """

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        task = asyncio.create_task(broadcast.run())
        yield
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    static = str(files("rovgraph.web").joinpath("assets"))
    routes: list[BaseRoute] = [
        Route("/", _page(static)),
        Mount(ASSETS.rstrip("/"), StaticFiles(directory=static)),
        *_reading(broadcast),
        *_commands(broadcast, offer, Allowance()),
        *charts.routes(lambda: broadcast.view.newest),
        WebSocketRoute("/live", broadcast.serve),
        WebSocketRoute(DATA_LAKE, _data_lake(broadcast)),
    ]
    return Starlette(routes=routes, lifespan=lifespan, exception_handlers={Refusal: _refused})


def _page(static: str) -> Callable[[Request], Response]:
    def page(request: Request) -> Response:
        return FileResponse(f"{static}/index.html")

    return page


def _reading(broadcast: Broadcast) -> list[BaseRoute]:
    """What only tells something."""
    view, metrics = broadcast.view, Metrics(broadcast)

    async def state(request: Request) -> Response:
        return JSONResponse(view.state())

    async def track(request: Request) -> Response:
        return JSONResponse(view.geojson(), media_type="application/geo+json")

    async def events(request: Request) -> Response:
        since = request.query_params.get("since", "0")
        if not since.isascii() or not since.isdigit():
            raise Refusal(422, "since: expected the number of an event")
        return JSONResponse(view.events(int(since[:15])))

    async def numbers(request: Request) -> Response:
        return Response(metrics.text(), media_type="text/plain; version=0.0.4; charset=utf-8")

    async def service(request: Request) -> Response:
        return JSONResponse(cockpit.service())

    async def extras(request: Request) -> Response:
        return JSONResponse(cockpit.extras(), headers={"access-control-allow-origin": "*"})

    return [
        Route("/api/state", state),
        Route("/api/track.geojson", track),
        Route("/api/events", events),
        Route("/metrics", numbers),
        Route("/register_service", service),
        Route("/cockpit_extras.json", extras),
    ]


def _commands(broadcast: Broadcast, offer: Offer | None, allowance: Allowance) -> list[BaseRoute]:
    """What changes something: each goes into the estimator's queue, and is answered before it is done."""
    view = broadcast.view

    def give(command: Command) -> None:
        if offer is None:
            raise Refusal(403, "nothing can be changed here")
        if view.newest is None:
            raise Refusal(409, "there is no position yet")
        if not offer(command):
            raise Refusal(503, "the estimator is too far behind; try again")

    async def mark(request: Request) -> Response:
        allowance.take()
        body = await read_body(request, MarkBody)
        if len(view.marks.all) >= MOST_MARKS:
            raise Refusal(409, f"there are {MOST_MARKS} marks already; remove one first")
        give(body.command())
        return JSONResponse({}, 202)

    async def remove(request: Request) -> Response:
        allowance.take()
        number = request.path_params["number"]
        if all(mark.number != number for mark in view.marks.all):
            raise Refusal(404, f"there is no mark {number}")
        give(RemoveMark(number))
        return JSONResponse({}, 202)

    async def position(request: Request) -> Response:
        allowance.take()
        body = await read_body(request, PositionBody)
        give(body.command())
        return JSONResponse({}, 202)

    return [
        Route("/api/marks", mark, methods=["POST"]),
        Route("/api/marks/{number:number}", remove, methods=["DELETE"]),
        Route("/api/position", position, methods=["POST"]),
    ]


def _data_lake(broadcast: Broadcast) -> Callable[[WebSocket], object]:
    async def data_lake(socket: WebSocket) -> None:
        await broadcast.serve_values(socket, cockpit.data_lake_values)

    return data_lake


async def _refused(request: Request, error: Exception) -> Response:
    assert isinstance(error, Refusal)
    return JSONResponse({"error": str(error)}, error.status)
