"""The server of the live page, in a thread of its own, and its addresses; docs/live-page.md lists them.

Beside the page there are addresses for BlueOS, Cockpit and Prometheus. BlueOS looks for ``/register_service`` on every
port, Cockpit for the widgets that ``cockpit_extras`` names. Cockpit's data lake takes ``name=value`` from a WebSocket,
one value per message. Prometheus reads the newest state as metrics.

The body of a request becomes a command, or a refusal of one line.
"""

import asyncio
import contextlib
import math
import threading
import time
import unicodedata
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Self, TypeVar

import uvicorn
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator
from starlette.applications import Starlette
from starlette.convertors import IntegerConvertor, register_url_convertor
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket

from rovgraph._version import __version__
from rovgraph.errors import as_path, as_paths
from rovgraph.live.marks import MOST_MARKS, Command, DropMark, Marks, RemoveMark, SetPosition
from rovgraph.live.solution import Solution
from rovgraph.live.warnings import Warnings
from rovgraph.web import broadcast
from rovgraph.web.broadcast import Broadcast, Connection, PageSocket
from rovgraph.web.charts import Charts, read_charts
from rovgraph.web.guard import (
    ASSETS,
    DATA_LAKE,
    LARGEST_HEADERS,
    Guard,
    ListenAddress,
    listening,
    parse_address,
    parse_origin,
    token_of,
)
from rovgraph.web.view import PageLimits, View, ellipse_sd

PREFIX = "rovgraph-"  # of names in the data lake


def cockpit_service() -> dict[str, Any]:
    """Answer to ``GET /register_service``."""
    return {
        "name": "rovgraph",
        "description": "Where the vehicle is, and how sure that is",
        "icon": "mdi-map-marker-path",
        "company": "rovgraph",
        "version": __version__,
        "webpage": "",
        "api": "",
        "new_page": False,
        "works_in_relative_paths": True,
        "extras": {"cockpit": "/cockpit_extras.json"},
    }


def cockpit_extras() -> dict[str, Any]:
    """The widget that Cockpit offers: the page itself, without its panels. Cockpit refuses one without an icon."""
    widget = {
        "name": "rovgraph",
        "config_iframe_url": None,
        "iframe_url": "/#widget",
        "iframe_icon": "/assets/icon.svg",
        "use_extension_path_as_base_url": True,
        "version": __version__,
    }
    return {
        "target_system": "Cockpit",
        "target_cockpit_api_version": "1.0.0",
        "widgets": [widget],
        "actions": [],
    }


def data_lake_values(view: View) -> list[str]:
    """The newest solution for Cockpit's data lake; what is not known is left out."""
    s = view.newest
    if s is None:
        return []
    north, east, down = s.position.tolist()
    dvl = s.sensors.get("dvl")
    values: dict[str, float | str | None] = {
        "north-m": north,
        "east-m": east,
        "depth-m": down,
        "position-sd-m": ellipse_sd(s),
        "heading-deg": math.degrees(float(s.rpy[2])) % 360.0,
        "heading-sd-deg": math.degrees(float(s.rpy_sd[2])),
        "speed-mps": math.sqrt(float(s.velocity @ s.velocity)),
        "altitude-m": s.altitude,
        "distance-m": s.distance,
        "latitude-deg": s.latitude,
        "longitude-deg": s.longitude,
        "lock-lost-s": None if dvl is None else dvl.failed_s,
        "verdict": s.verdict,
    }
    return [f"{PREFIX}{name}={_text(value)}" for name, value in values.items() if _known(value)]


def _known(value: float | str | None) -> bool:
    return isinstance(value, str) or (value is not None and math.isfinite(value))


def _text(value: float | str | None) -> str:
    return value if isinstance(value, str) else f"{value:.9g}"


STATES = ("ok", "silent", "frozen", "no lock", "rejected")
VERDICTS = ("trusted", "doubtful", "wrong")


class MetricsCollector:
    """Collects what `/metrics` answers.

    Parameters
    ----------
    broadcast : with the view
    """

    def __init__(self, broadcast: Broadcast) -> None:
        self._broadcast = broadcast
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(self)

    def text(self) -> bytes:
        """In Prometheus's text format."""
        return generate_latest(self._registry)

    def collect(self) -> Iterator[Metric]:
        """All metrics, as the client library asks for them."""
        yield GaugeMetricFamily("rovgraph_pages", "Pages that watch.", self._broadcast.pages)
        yield CounterMetricFamily("rovgraph_pages_dropped", "Pages that did not read.", self._broadcast.dropped)
        s = self._broadcast.view.newest
        if s is None:
            return
        for name, about, value in (
            ("time_seconds", "Time of the newest solution, by the estimate's clock.", s.time),
            ("position_sd_metres", "Standard deviation along the longer axis of the ellipse.", ellipse_sd(s)),
            ("depth_metres", "Depth, positive down.", float(s.position[2])),
            ("heading_degrees", "Heading, clockwise from north.", math.degrees(float(s.rpy[2])) % 360.0),
            ("heading_sd_degrees", "Its standard deviation.", math.degrees(float(s.rpy_sd[2]))),
            ("distance_metres", "Distance travelled.", s.distance),
            ("predicted_seconds", "How far the IMU alone carried the solution.", s.predicted_s),
            ("update_seconds", "Time that the newest update of the filter took.", s.update_s),
        ):
            yield GaugeMetricFamily(f"rovgraph_{name}", about, value)
        if s.latency_s is not None:
            yield GaugeMetricFamily("rovgraph_latency_seconds", "From measurement to solution.", s.latency_s)
        yield _one_of("rovgraph_verdict", "1 for the verdict of the estimate.", "verdict", VERDICTS, {"": s.verdict})
        states = {name: health.state for name, health in s.sensors.items()}
        yield _one_of("rovgraph_sensor_state", "1 for the state of each sensor.", "state", STATES, states)
        age = GaugeMetricFamily("rovgraph_sensor_age_seconds", "Since its last measurement.", labels=["sensor"])
        count = CounterMetricFamily("rovgraph_measurements", "Measurements met.", labels=["sensor", "outcome"])
        for name, health in s.sensors.items():
            age.add_metric([name], health.age)
            count.add_metric([name, "used"], health.used)
            count.add_metric([name, "rejected"], health.rejected)
        yield from (age, count)


def _one_of(name: str, about: str, label: str, values: tuple[str, ...], of: dict[str, str]) -> Metric:
    """1 for what it is and 0 for what it is not, as Prometheus has states."""
    named = list(of) != [""]
    metric = GaugeMetricFamily(name, about, labels=["sensor", label] if named else [label])
    for sensor, now in of.items():
        for value in values:
            metric.add_metric([sensor, value] if named else [value], float(value == now))
    return metric


LARGEST_BODY = 4096  # [bytes]
FARTHEST_M = 1e5  # n is flat
JOINERS = "\u200c\u200d"  # of letters and emoji
BURST, PER_S = 20, 5.0  # commands that are taken at once, and a second in the long run


class _Number(IntegerConvertor):
    """A number in a path; one of thousands of digits, which Python does not convert, is none."""

    regex = "[0-9]{1,10}"


register_url_convertor("number", _Number())


class Refusal(Exception):
    """A request that is not taken: status and one line."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


def _plain(text: str) -> str:
    """Text in one line, without control characters and without those that turn its direction."""
    spaced = "".join(" " if unicodedata.category(c) in ("Cc", "Cs") else c for c in text)
    return " ".join("".join(c for c in spaced if c in JOINERS or unicodedata.category(c) != "Cf").split())


Metres = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M, allow_inf_nan=False)]
Name = Annotated[str, Field(max_length=80), AfterValidator(_plain)]


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class MarkBody(_Body):
    """``POST /api/marks``: a mark where the vehicle is, or a way-point with both north and east."""

    name: Name = ""
    north: Metres | None = None
    east: Metres | None = None

    @model_validator(mode="after")
    def _both_or_none(self) -> "MarkBody":
        if (self.north is None) != (self.east is None):
            raise ValueError("north and east belong together")
        return self

    def command(self) -> DropMark:
        return DropMark(self.name, self.north, self.east)


class PositionBody(_Body):
    """``POST /api/position``: where the vehicle is now."""

    north: Metres
    east: Metres
    sd: Annotated[float, Field(ge=0.01, le=1e4, allow_inf_nan=False)]

    def command(self) -> SetPosition:
        return SetPosition(self.north, self.east, self.sd)


B = TypeVar("B", bound=_Body)


async def read_body(request: Request, kind: type[B]) -> B:
    """The body of a request.

    Raises
    ------
    Refusal : it is no JSON, too large, or not what is expected
    """
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        raise Refusal(415, "expected the content type application/json")
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > LARGEST_BODY:
            raise Refusal(413, f"expected at most {LARGEST_BODY} bytes")
    try:
        return kind.model_validate_json(body)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise Refusal(422, f"{where}: {first['msg']}" if where else first["msg"]) from None


class Allowance:
    """How many commands are still taken: `BURST` at once, `PER_S` in the long run, of all pages together."""

    def __init__(self) -> None:
        self._left, self._at = float(BURST), time.monotonic()

    def take(self) -> None:
        """Use one.

        Raises
        ------
        Refusal : there is none left
        """
        now = time.monotonic()
        self._left = min(float(BURST), self._left + PER_S * (now - self._at))
        self._at = now
        if self._left < 1.0:
            raise Refusal(429, f"more than {PER_S:g} commands a second; wait a moment")
        self._left -= 1.0


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
    view, metrics = broadcast.view, MetricsCollector(broadcast)

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
        return JSONResponse(cockpit_service())

    async def extras(request: Request) -> Response:
        return JSONResponse(cockpit_extras(), headers={"access-control-allow-origin": "*"})

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
        await broadcast.serve_values(socket, data_lake_values)

    return data_lake


async def _refused(request: Request, error: Exception) -> Response:
    assert isinstance(error, Refusal)
    return JSONResponse({"error": str(error)}, error.status)


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
