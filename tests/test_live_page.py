"""The live page: what pages are told, what they may ask, and who is kept out."""

import asyncio
import json
import re
import socket
import threading
import time
from dataclasses import replace
from pathlib import Path

import httpx
import numpy as np
import pytest
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

import rovgraph as rg
from rovgraph.cli.app import main
from rovgraph.errors import InputError
from rovgraph.live.marks import DropMark, Marks, RemoveMark, SetPosition
from rovgraph.live.session import Feed
from rovgraph.live.solution import Event, SensorHealth, Solution
from rovgraph.model.origin import lat_lon
from rovgraph.web import broadcast
from rovgraph.web import broadcast as broadcasting
from rovgraph.web import view as tracking
from rovgraph.web.broadcast import Broadcast
from rovgraph.web.charts import Charts, read_charts
from rovgraph.web.guard import LARGEST_HEADERS, Guard, parse_address, parse_origin, token_of
from rovgraph.web.page import BURST, LARGEST_BODY, MOST_CONNECTIONS, application
from rovgraph.web.view import PIECE, LiveTrack, PageLimits, View

NASTY = "</script><script>alert(1)</script> \"quotes' & δύτης 潜水"
TOKEN = "a-token-of-24-characters"
ASSETS = Path(broadcasting.__file__).parent / "assets"
HERE = {"host": "127.0.0.1:8080"}
OWN = {**HERE, "origin": "http://127.0.0.1:8080"}


def solution(time: float = 0.0, north: float = 0.0, **changes: object) -> Solution:
    known = Solution(
        time,
        np.array([north, 2.0, 3.0]),
        np.array([0.3, 0.4, 0.0]),
        np.array([0.0, 0.0, 0.5]),
        np.array([0.3, 0.4, 0.1]),
        np.full(3, 0.01),
        np.full(3, 0.02),
        0.0,
        calibration={"dvl_yaw": (0.77, 0.01)},
        sensors={"dvl": SensorHealth("ok", 0.1, 10, 1), "mag": SensorHealth("ok", 0.1, 10, 0)},
    )
    return replace(known, **changes)


class Server:
    """The application without a socket."""

    def __init__(self, token: str | None = None, origins: tuple[str, ...] = (), charts: Charts | None = None) -> None:
        self.marks, self.commands = Marks(), []
        self.view = View(self.marks, PageLimits())
        self.broadcast = Broadcast(self.view)
        app = application(self.broadcast, charts or Charts(()), lambda command: self.commands.append(command) or True)
        self.client = TestClient(Guard(app, token, origins), base_url="http://127.0.0.1:8080")

    def show(self, *solutions: Solution) -> None:
        for one in solutions:
            self.view.take(one, time.monotonic())


@pytest.fixture
def server():
    return Server()


# what pages are told


def test_the_state_has_the_solution_and_what_a_pilot_asks_beyond_it(server):
    lost = SensorHealth("no lock", 0.1, 10, 3, failed_s=7.0)
    events = (Event(1.0, "dvl", "no lock", NASTY),)
    server.show(solution(1.0, events=events, sensors={"dvl": lost}, altitude=4.5))
    state = server.client.get("/api/state").json()
    assert (state["north"], state["speed"], state["altitude"], state["lock_lost_s"]) == (0.0, 0.5, 4.5, 7.0)
    assert state["sensors"]["dvl"] | {"state": "no lock", "rejected": 3, "reason": NASTY} == state["sensors"]["dvl"]
    assert state["limits"] == [{"kind": "silence", "text": "dvl: no lock for 7 s"}]
    assert server.client.get("/api/events").json()[0]["text"] == NASTY
    assert server.client.get("/api/events?since=1").json() == []
    assert server.client.get("/api/events?since=x").status_code == 422


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        ({"position_sd": np.array([6.0, 0.1, 0.1])}, "position"),
        ({"position_sd": np.full(3, np.nan)}, "position"),
        ({"rpy_sd": np.array([0.0, 0.0, 0.3])}, "heading"),
        ({"sensors": {"mag": SensorHealth("rejected", 0.1, 1, 9)}}, "heading"),
        ({"sensors": {"depth": SensorHealth("silent", 9.0, 1, 0, 9.0)}}, "silence"),
    ],
)
def test_the_page_raises_an_alarm_beyond_its_limits(server, change, kind):
    server.show(solution())
    assert server.view.state()["limits"] == []
    server.show(solution(1.0, **change))
    assert [one["kind"] for one in server.view.state()["limits"]] == [kind]


def test_the_track_is_geojson_where_the_origin_is_known(server):
    server.show(*(solution(float(k), 10.0 * k) for k in range(3)))
    assert server.client.get("/api/track.geojson").json()["geometry"] is None
    server.show(solution(3.0, 30.0, origin=lat_lon(-30.0, -2.0, (58.0, 15.0))))
    track = server.client.get("/api/track.geojson").json()
    first, *_, last = track["geometry"]["coordinates"]
    assert last == pytest.approx([15.0, 58.0, -3.0], abs=1e-6)
    assert (58.0 - first[1]) * 111_370 == pytest.approx(30.0, rel=2e-3)
    assert len(track["properties"]["points"]) == 4


def test_a_track_of_any_length_stays_bounded_and_in_order(monkeypatch):
    monkeypatch.setattr(tracking, "MOST", 11 * PIECE)
    track = LiveTrack()
    for k in range(11 * PIECE + 10):
        track.add(solution(0.1 * k, 0.2 * k))
    assert len(track) < 11 * PIECE and track.edition == 1
    points = [point for piece in track.pieces() for point in json.loads(piece)]
    assert len(points) == len(track) > 5 * PIECE
    assert (np.diff([point[0] for point in points]) > 0).all()


def test_metrics_are_read_by_prometheus(server):
    from prometheus_client.parser import text_string_to_metric_families

    server.show(solution(sensors={NASTY: SensorHealth("silent", 9.0, 1, 2)}))
    families = {f.name: f.samples for f in text_string_to_metric_families(server.client.get("/metrics").text)}
    assert families["rovgraph_position_sd_metres"][0].value == pytest.approx(0.4)
    states = {s.labels["state"]: s.value for s in families["rovgraph_sensor_state"]}
    assert states["silent"] == 1.0 and sum(states.values()) == 1.0
    assert families["rovgraph_measurements"][1].labels == {"sensor": NASTY, "outcome": "rejected"}


def test_blueos_and_cockpit_find_the_page(server):
    service = server.client.get("/register_service").json()
    assert service["works_in_relative_paths"] is True
    extras = server.client.get(service["extras"]["cockpit"]).json()
    (widget,) = extras["widgets"]
    assert extras["target_system"] == "Cockpit" and widget["use_extension_path_as_base_url"] is True
    assert all(server.client.get(widget[name]).status_code == 200 for name in ("iframe_url", "iframe_icon"))
    page = server.client.get("/").text
    assert re.findall(r'(?:src|href)="(/|https?:|//)', page) == []


# what pages may ask


def test_commands_reach_the_estimator_as_they_were_meant(server):
    server.show(solution())
    for path, body in (("marks", {"name": NASTY}), ("marks", {"name": "w\n", "north": 1, "east": 2.5})):
        assert server.client.post(f"/api/{path}", json=body, headers=OWN).status_code == 202
    assert server.client.post("/api/position", json={"north": 1, "east": 2, "sd": 3}, headers=OWN).status_code == 202
    for _ in range(7):
        server.marks.drop("", solution())
    assert server.client.delete("/api/marks/7", headers=OWN).status_code == 202
    assert server.commands == [DropMark(NASTY), DropMark("w", 1.0, 2.5), SetPosition(1.0, 2.0, 3.0), RemoveMark(7)]


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("marks", "{"),
        ("marks", '{"name": 1}'),
        ("marks", '{"north": 1}'),
        ("marks", '{"other": 1}'),
        ("position", '{"north": 1, "east": 2}'),
        ("position", '{"north": NaN, "east": 2, "sd": 1}'),
        ("position", '{"north": 1e9, "east": 2, "sd": 1}'),
        ("position", '{"north": 1, "east": 2, "sd": 0}'),
        ("position", '{"north": true, "east": 2, "sd": 1}'),
    ],
)
def test_a_command_that_cannot_be_meant_is_refused_in_one_line(server, path, body):
    server.show(solution())
    answer = server.client.post(f"/api/{path}", content=body, headers={**OWN, "content-type": "application/json"})
    assert answer.status_code == 422
    assert "\n" not in answer.json()["error"]
    assert server.commands == []


def test_before_the_first_position_nothing_can_be_marked(server):
    assert server.client.post("/api/marks", json={}, headers=OWN).status_code == 409


@pytest.mark.parametrize("number", ["7", "9" * 400, "9" * 5000])
def test_what_is_not_there_is_not_found(server, number):
    server.show(solution())
    assert server.client.delete(f"/api/marks/{number}", headers=OWN).status_code == 404
    assert server.client.get(f"/api/charts/{number}.png").status_code == 404
    assert server.client.get(f"/api/charts/0/1/2/{number}.png").status_code == 404
    assert server.commands == []


def test_marks_are_limited(server, monkeypatch):
    monkeypatch.setattr("rovgraph.web.page.MOST_MARKS", 2)
    server.show(solution())
    for _ in range(2):
        server.marks.drop("", solution())
    answer = server.client.post("/api/marks", json={}, headers=OWN)
    assert answer.status_code == 409 and "2 marks already" in answer.json()["error"]
    server.marks.remove(1)
    assert server.client.post("/api/marks", json={}, headers=OWN).status_code == 202


def test_marks_of_a_resumed_run_are_told_with_the_first_solution(server):
    server.marks.drop("x", solution())
    told = server.view.cursor
    assert json.loads(server.view.update(told))["time"] is None
    server.show(solution())
    assert len(json.loads(server.view.update(told))["marks"]) == 1


def test_marks_are_told_when_they_change(server):
    server.show(solution())
    first = server.view.update(replace(server.view.cursor, marks=-1))
    assert json.loads(first)["marks"] == []
    told = server.view.cursor
    assert "marks" not in json.loads(server.view.update(told))
    server.marks.drop("x", solution())
    assert [mark["name"] for mark in json.loads(server.view.update(told))["marks"]] == ["x"]
    server.marks.remove(1)
    assert json.loads(server.view.update(told))["marks"] == []


def test_names_have_no_controls_of_direction(server):
    server.show(solution())
    for name in ("a\u202egnp.exe", "a\u2066\x1b[31mb\u2069\ufeff", "\u202e", "a\u200db"):
        assert server.client.post("/api/marks", json={"name": name}, headers=OWN).status_code == 202
    assert [command.name for command in server.commands] == ["agnp.exe", "a [31mb", "", "a\u200db"]


# who is kept out


def test_a_flood_of_commands_is_cut_off(server):
    server.show(solution())
    statuses = [server.client.post("/api/marks", json={}, headers=OWN).status_code for _ in range(3 * BURST)]
    assert statuses[:BURST] == [202] * BURST
    assert statuses.count(429) > BURST
    assert len(server.commands) < 2 * BURST


def test_a_body_that_is_too_large_is_refused(server):
    server.show(solution())
    answer = server.client.post("/api/marks", json={"name": "x" * LARGEST_BODY}, headers=OWN)
    assert answer.status_code == 413


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:8081", "https://127.0.0.1"])
def test_another_site_changes_nothing_and_hears_nothing(server, origin):
    server.show(solution())
    foreign = {**HERE, "origin": origin}
    assert (
        server.client.post("/api/position", json={"north": 1, "east": 2, "sd": 3}, headers=foreign).status_code == 403
    )
    assert server.client.delete("/api/marks/1", headers=foreign).status_code == 403
    for path in ("/live", "/cockpit"):
        with pytest.raises(WebSocketDisconnect), server.client.websocket_connect(path, headers=foreign):
            pass
    form = server.client.post("/api/marks", content="{}", headers={**OWN, "content-type": "text/plain"})
    assert form.status_code == 415
    assert server.commands == []


def test_a_name_that_points_here_is_not_this_computer(server):
    for host in ("evil.example", "evil.example:8080", "127.0.0.1.evil.example", "192.168.2.2", "0.0.0.0"):
        assert server.client.get("/api/state", headers={"host": host}).status_code == 403
    for host in ("localhost:1", "127.0.0.1", "127.0.0.2:8090", "[::1]:8080"):
        assert server.client.get("/api/state", headers={"host": host}).status_code == 200


def test_elsewhere_a_token_is_needed_and_is_taken_from_headers_alone():
    server = Server(TOKEN)
    server.show(solution())
    paths = ("/api/state", "/api/track.geojson", "/api/events", "/metrics", "/api/charts")
    for path in paths:
        assert server.client.get(path).status_code == 401
        assert server.client.get(f"{path}?token={TOKEN}").status_code == 401
        assert server.client.get(path, headers={"authorization": f"Bearer {TOKEN}x"}).status_code == 401
        assert server.client.get(path, headers={"authorization": f"Bearer {TOKEN}"}).status_code == 200
    assert server.client.post("/api/marks", json={}, headers=OWN).status_code == 401
    assert server.client.get("/").status_code == server.client.get("/assets/page.js").status_code == 200
    with pytest.raises(WebSocketDisconnect), server.client.websocket_connect("/live", headers=OWN):
        pass


def test_the_token_is_compared_in_constant_time(monkeypatch):
    compared = []
    monkeypatch.setattr("hmac.compare_digest", lambda a, b: compared.append((a, b)) or False)
    Server(TOKEN).client.get("/api/state", headers={"authorization": f"Bearer {TOKEN}"})
    assert compared == [(TOKEN.encode(), TOKEN.encode())]


def test_cockpit_reads_values_without_a_token_only_where_its_origin_is_named():
    with rg.live_page("0.0.0.0:0", origins=["http://192.168.2.2"]) as page:
        page.send(solution())
        url = f"ws://127.0.0.1:{page.address.port}"
        with connect(f"{url}/cockpit", origin="http://192.168.2.2", open_timeout=20) as link:
            assert link.recv(timeout=20) == "rovgraph-north-m=0"
        for path, origin in (("/cockpit", "http://192.168.2.3"), ("/live", "http://192.168.2.2")):
            with pytest.raises(InvalidStatus), connect(f"{url}{path}", origin=origin, open_timeout=20):
                pass
        protocols = [Subprotocol("rovgraph"), Subprotocol(f"token.{page.token}")]
        with connect(f"{url}/live", subprotocols=protocols, open_timeout=20) as link:
            assert link.subprotocol == "rovgraph"


def test_every_answer_forbids_foreign_code_and_foreign_frames():
    server = Server(None, ("http://192.168.2.2",))
    for path in ("/", "/assets/page.js", "/api/state", "/nowhere"):
        policy = server.client.get(path).headers["content-security-policy"]
        rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
        assert rules["default-src"] == "'none'" and rules["script-src"] == "'self'" and rules["style-src"] == "'self'"
        assert rules["frame-ancestors"] == "'self' http://192.168.2.2"
        assert "unsafe" not in policy
    page = server.client.get("/").text
    assert not re.search(r"<script(?![^>]*src=)|\son\w+=|\sstyle=", page)
    assert not any(re.search(r"innerHTML|\beval\(|new Function|https?://", f.read_text()) for f in ASSETS.glob("*.js"))


def test_every_element_that_the_scripts_ask_for_is_on_the_page_and_every_import_is_there():
    html = (ASSETS / "index.html").read_text()
    known = re.findall(r'\bid="([^"]+)"', html)
    assert len(known) == len(set(known))
    for script in ASSETS.glob("*.js"):
        text = script.read_text()
        wanted = re.findall(r'(?:\bat|getElementById|asked)\("([^"]+)"\)', text)
        wanted += re.findall(r'this\.gauge\("(\w+)"', text)
        assert set(wanted) <= set(known), script.name
        for names, module in re.findall(r'^import \{([^}]*)\} from "\./([^"]+)";', text, re.MULTILINE):
            exported = re.findall(
                r"^export (?:async )?(?:const|class|function) (\w+)", (ASSETS / module).read_text(), re.M
            )
            assert {name.strip() for name in names.split(",")} <= set(exported), f"{script.name}: {module}"


def luminance(colour: str) -> float:
    """Relative luminance of #rgb or #rrggbb, as WCAG 2.2 defines it."""
    digits = colour[1:] if len(colour) == 7 else "".join(2 * one for one in colour[1:])
    parts = [int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)]
    linear = [x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4 for x in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    dark, light = sorted((luminance(one), luminance(other)))
    return (light + 0.05) / (dark + 0.05)


@pytest.mark.parametrize("look", ["daylight", "dark"])
def test_text_and_track_stand_out_in_both_looks(look):
    daylight, dark = re.findall(r":root\S* \{(.*?)\}", (ASSETS / "page.css").read_text(), re.DOTALL)
    colours = dict(re.findall(r"--([\w-]+): (#\w+);", daylight if look == "daylight" else dark))
    texts = [(ink, paper) for ink in ("ink", "soft", "good", "warn", "bad") for paper in ("paper", "sea")]
    texts += [("on-fill", "good-fill"), ("on-fill", "bad-fill"), ("on-warn", "warn-fill"), ("paper", "sure")]
    lines = [(line, "sea") for line in (*(f"sd-{k}" for k in range(8)), "sure", "line")]
    for pairs, least in ((texts, 4.5), (lines, 3.0)):
        assert [pair for pair in pairs if contrast(colours[pair[0]], colours[pair[1]]) < least] == []


@pytest.mark.parametrize(
    "path", ["/assets/../page.py", "/assets/%2e%2e/page.py", "/assets/..%2fpage.py", "/assets//etc/passwd", "/../x"]
)
def test_no_path_leaves_the_assets(server, path):
    assert server.client.get(path).status_code == 404


def test_tiles_that_lead_out_of_their_folder_are_not_served(tmp_path):
    secret = tmp_path / "secret.png"
    secret.write_bytes(b"secret")
    folder = tmp_path / "tiles" / "3" / "4"
    folder.mkdir(parents=True)
    (folder / "5.png").write_bytes(b"tile")
    (folder / "6.png").symlink_to(secret)
    server = Server(charts=read_charts([tmp_path / "tiles"]))
    assert server.client.get("/api/charts/0/3/4/5.png").content == b"tile"
    for path in ("3/4/6", "3/4/7", "../../secret", "3/4/..%2f..%2f..%2fsecret"):
        assert server.client.get(f"/api/charts/0/{path}.png").status_code == 404


# charts


def test_charts_are_placed_once_the_origin_is_known(tmp_path):
    ring = [[15.0, 58.0], [15.001, 58.0], [15.001, 58.001], [15.0, 58.0]]
    shapes = [
        {"type": "Feature", "properties": {"name": NASTY}, "geometry": {"type": "Polygon", "coordinates": [ring]}},
        {"type": "Feature", "properties": None, "geometry": {"type": "Point", "coordinates": [15.0, 58.0, 7.0]}},
    ]
    (tmp_path / "c.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": shapes}))
    server = Server(charts=read_charts([tmp_path / "c.geojson"]))
    assert "origin" in server.client.get("/api/charts").json()["missing"]
    server.show(solution(0.0, 100.0, origin=lat_lon(-100.0, -2.0, (58.0, 15.0))))
    area, point = server.client.get("/api/charts").json()["charts"][0]["shapes"]
    assert area["name"] == NASTY and area["form"] == "area"
    assert point["points"][0] == pytest.approx([100.0, 2.0], abs=0.01)
    assert area["points"][2][0] - area["points"][1][0] == pytest.approx(111.4, rel=2e-3)


def test_a_geotiff_lies_where_its_coordinates_say(tmp_path):
    rasterio = pytest.importorskip("rasterio", reason="rasterio is not installed: no GeoTIFF was read")
    place = rasterio.transform.from_origin(500_000.0, 6_429_000.0, 2.0, 2.0)
    values = np.arange(60, dtype=np.float32).reshape(1, 6, 10)
    with rasterio.open(
        tmp_path / "c.tif", "w", driver="GTiff", height=6, width=10, count=1, dtype="float32", crs="EPSG:32633",
        transform=place, nodata=0.0,
    ) as file:  # fmt: skip
        file.write(values)
    server = Server(charts=read_charts([tmp_path / "c.tif"]))
    server.show(solution(origin=lat_lon(0.0, -2.0, (58.0, 15.0))))
    (chart,) = server.client.get("/api/charts").json()["charts"]
    corner, right, below = np.array(chart["corners"])
    assert np.linalg.norm(right - corner) == pytest.approx(20.0, rel=2e-3)
    assert np.linalg.norm(below - corner) == pytest.approx(12.0, rel=2e-3)
    image = server.client.get("/api/charts/0.png").content
    with rasterio.MemoryFile(image) as memory, memory.open() as png:
        assert png.shape == (6, 10) and png.read(4)[0, 0] == 0 and png.read(4)[1:].min() == 255


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"crs": 'LOCAL_CS["pool",UNIT["metre",1]]'}, "cannot be converted to WGS 84 .* gdal_translate"),
        ({"at": (1e8, 1e9)}, "gdal_translate"),
        ({"crs": "EPSG:4326", "at": (15.0, 6e6)}, "outside its coordinate system"),
        ({"dtype": "complex64"}, "complex values"),
    ],
    ids=["local", "outside", "degrees", "complex"],
)
def test_a_geotiff_that_cannot_be_shown_is_refused_in_one_line(tmp_path, changes, says):
    rasterio = pytest.importorskip("rasterio", reason="rasterio is not installed: no GeoTIFF was read")
    wanted = {"crs": "EPSG:32633", "at": (5e5, 6.4e6), "dtype": "float32"} | changes
    place = rasterio.transform.from_origin(*wanted.pop("at"), 2.0, 2.0)
    path = tmp_path / "c.tif"
    with rasterio.open(path, "w", driver="GTiff", height=4, width=4, count=1, transform=place, **wanted) as file:
        file.write(np.ones((1, 4, 4), wanted["dtype"]))
    with pytest.raises(InputError, match=says) as error:
        read_charts([path])
    assert "\n" not in str(error.value) and str(path) in str(error.value)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("c.tif", b"II*\0broken", "no GeoTIFF"),
        ("c.geojson", b'{"type": "Feature"', "no GeoJSON"),
        ("c.geojson", b'{"type": "Point", "coordinates": [500000, 6400000]}', "degrees"),
        ("c.geojson", b'{"type": "FeatureCollection", "features": []}', "vertices"),
        ("c.bmp", b"", "expected a GeoTIFF"),
    ],
)
def test_a_broken_chart_is_refused_in_one_line(tmp_path, name, content, says):
    if name.endswith(".tif"):
        pytest.importorskip("rasterio", reason="rasterio is not installed: no GeoTIFF was read")
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=says) as error:
        read_charts([tmp_path / name])
    assert "\n" not in str(error.value) and name in str(error.value)


# addresses


@pytest.mark.parametrize("text", ["", "a:b", "127.0.0.1:99999", "http://127.0.0.1:80", "127.0.0.1:80/x", "nonsense"])
def test_an_address_that_is_none_is_refused(text):
    with pytest.raises(InputError, match="--http"):
        parse_address(text)


@pytest.mark.parametrize("text", ["*", "http://a b", "http://a; script-src *", "ftp://a", "http://a/x"])
def test_an_origin_that_is_none_is_refused(text):
    with pytest.raises(InputError, match="--http-origin"):
        parse_origin(text)


def test_only_the_loopback_goes_without_a_token():
    assert [parse_address(a).loopback for a in ("8080", "127.0.0.5:1", "[::1]:1", "localhost:1")] == [True] * 4
    assert not any(parse_address(a).loopback for a in ("0.0.0.0:1", "[::]:1", "192.168.2.2:1", "boat.local:1"))


def test_a_token_is_kept_in_its_file_for_its_owner_alone(tmp_path):
    path = tmp_path / "token"
    token = token_of(path)
    assert token_of(path) == token and len(token) >= 24
    assert path.stat().st_mode & 0o077 == 0
    path.write_text("short")
    with pytest.raises(InputError, match="--http-token"):
        token_of(path)


def test_a_port_in_use_is_one_line():
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(InputError, match="choose another"):
        rg.live_page(f"127.0.0.1:{taken.getsockname()[1]}")


@pytest.mark.parametrize("fault", ["port", "chart", "origin", "limit"])
def test_the_command_refuses_what_the_library_refuses_and_touches_nothing(monkeypatch, capsys, tmp_path, fault):
    (tmp_path / "c.geojson").write_text("{")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1] if fault == 'port' else 0}"
        wrong, options = {
            "port": ({}, []),
            "chart": ({"charts": [tmp_path / "c.geojson"]}, ["--chart", tmp_path / "c.geojson"]),
            "origin": ({"origins": ["*"]}, ["--http-origin", "*"]),
            "limit": ({"position_sd_limit_m": 0.0}, ["--position-sd-limit", 0]),
        }[fault]
        with pytest.raises(InputError) as refused:
            rg.live_page(address, **wrong)
        given = ["online", "tcp://127.0.0.1:1", "--http", address, *options, "--out", tmp_path / "new"]
        monkeypatch.setattr("sys.argv", ["rovgraph", *map(str, given)])
        with pytest.raises(SystemExit) as stop:
            main()
    assert stop.value.code == 2
    assert capsys.readouterr().err.splitlines() == [f"error: {refused.value}"]
    assert not (tmp_path / "new").exists()


# the server, over its socket


@pytest.fixture
def page():
    with rg.live_page("127.0.0.1:0", Feed([]).offer) as shown:
        yield shown


def live(shown):
    return connect(f"ws://127.0.0.1:{shown.address.port}/live", open_timeout=20, max_size=None)


def until(link, kind):
    while (news := json.loads(link.recv(timeout=20)))["type"] != kind:
        pass
    return news


def test_a_page_that_comes_back_gets_the_whole_track(page):
    for k in range(PIECE + 100):
        page.send(solution(0.1 * k, float(k)))
    end = time.monotonic() + 20
    while len(page.broadcast.view.track) < PIECE + 100 and time.monotonic() < end:
        time.sleep(0.02)
    for _ in range(2):
        with live(page) as link:
            news = [json.loads(link.recv(timeout=20)) for _ in range(4)]
        assert [one["type"] for one in news] == ["begin", "track", "track", "state"]
        assert [p[1] for one in news for p in one.get("points", [])] == list(range(PIECE + 100))


def test_what_is_new_comes_once_and_soon(page):
    with live(page) as link:
        until(link, "begin")
        points, delays = [], []
        for k in range(30):
            page.send(solution(0.1 * k, float(k), events=(Event(0.1 * k, "dvl", "kind", str(k)),)))
            sent = time.monotonic()
            while not points or points[-1][1] != k:
                news = until(link, "state")
                points += news["points"]
            delays.append(time.monotonic() - sent)
            time.sleep(0.01)
        assert [p[1] for p in points] == list(range(30))
        assert np.percentile(delays, 50) < 0.15


def test_a_page_is_told_in_which_units_a_person_reads_the_calibration(page):
    with live(page) as link:
        units = until(link, "begin")["units"]
    assert units["dvl_yaw"] == units["field_dip"] == [pytest.approx(57.29578), "°"]
    assert units["dvl_time_offset"] == [1.0, "s"] and units["dvl_scale"] == [1.0, ""]


def test_a_page_that_speaks_is_closed(page):
    with live(page) as link:
        link.send("x")
        with pytest.raises(ConnectionClosed, match="1008"):
            while True:
                link.recv(timeout=20)


class SpeaksAsItIsTold:
    """A page's socket that says something at the very moment when the first message has gone out."""

    def __init__(self):
        self.scope, self.closed = {}, None
        self.gone = asyncio.Event()

    async def accept(self, subprotocol):
        asyncio.get_running_loop().call_later(0.01, self.gone.set)

    async def send_text(self, text):
        await self.gone.wait()

    async def receive_text(self):
        await self.gone.wait()

    async def close(self, code):
        self.closed = code


def test_a_page_that_speaks_while_it_is_told_something_is_closed_too():
    async def serve():
        socket = SpeaksAsItIsTold()
        async with asyncio.timeout(5.0):
            await Broadcast(View(Marks(), PageLimits())).serve(socket)
        return socket.closed

    assert asyncio.run(serve()) == 1008


HANDSHAKE = (
    b"GET /live HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


def test_a_page_that_does_not_read_is_dropped_and_the_others_go_on(page, monkeypatch):
    monkeypatch.setattr(broadcasting, "STALL_S", 0.5)
    text = "x" * 20_000
    with socket.create_connection(("127.0.0.1", page.address.port)) as deaf, live(page) as link:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.sendall(HANDSHAKE)
        end, k = time.monotonic() + 40, 0
        while not page.broadcast.dropped:
            assert time.monotonic() < end
            k += 1
            page.send(solution(float(k), float(k), events=(Event(float(k), "dvl", "kind", text),) * 20))
            while True:
                if until(link, "state")["time"] == float(k):
                    break
        assert page.broadcast.pages == 1
        assert httpx.get(page.address.url + "api/state", timeout=20).json()["time"] == float(k)


def test_a_page_that_answers_no_ping_is_dropped_and_counted(monkeypatch):
    """What little it was sent fits into its buffers."""
    monkeypatch.setattr(broadcast, "PING_S", 0.3)
    monkeypatch.setattr(broadcast, "PONG_S", 0.3)
    with rg.live_page("127.0.0.1:0") as page, socket.create_connection(("127.0.0.1", page.address.port)) as deaf:
        deaf.sendall(HANDSHAKE)
        end = time.monotonic() + 20
        while not page.broadcast.dropped:
            assert time.monotonic() < end
            time.sleep(0.05)
        assert page.broadcast.pages == 0
        metrics = httpx.get(page.address.url + "metrics", timeout=20).text
        assert "rovgraph_pages_dropped_total 1.0" in metrics


def test_the_estimator_only_queues_and_never_waits(page):
    """Also while the server's thread is stuck."""
    stuck = threading.Event()
    asyncio.run_coroutine_threadsafe(_block(stuck), _loop(page))
    begin = time.thread_time()
    for k in range(1000):
        page.send(solution(float(k)))
    assert time.thread_time() - begin < 1.0
    stuck.set()


async def _block(stuck: threading.Event) -> None:
    stuck.wait(20)


def _loop(page) -> asyncio.AbstractEventLoop:
    end = time.monotonic() + 20
    while page.broadcast._loop is None:
        assert time.monotonic() < end
        time.sleep(0.01)
    return page.broadcast._loop


def test_a_header_that_is_too_long_is_refused(page):
    with socket.create_connection(("127.0.0.1", page.address.port), timeout=20) as link:
        link.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"x" * 100_000)
        assert b"400" in link.recv(100)


@pytest.mark.parametrize("size", [LARGEST_HEADERS, 70_000])
def test_headers_that_are_too_long_are_refused_whole_and_in_pieces(page, size):
    with socket.create_connection(("127.0.0.1", page.address.port), timeout=20) as link:
        link.sendall(b"GET /api/state HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"x" * size + b"\r\n\r\n")
        assert link.recv(100).split()[1] in (b"400", b"431")
    headers = {"X": "x" * 10_000}
    assert httpx.get(page.address.url + "api/state", headers=headers, timeout=20).status_code == 200


def test_what_clients_do_wrong_is_not_told_on_the_terminal(page, caplog, capfd):
    with socket.create_connection(("127.0.0.1", page.address.port), timeout=20) as link:
        link.sendall(b"\x16\x03\x01 garbage\r\n\r\n")
        assert b"400" in link.recv(100)
    page._server.config.limit_concurrency = 0
    assert httpx.get(page.address.url + "api/state", timeout=20).status_code == 503
    assert caplog.text == "" and capfd.readouterr().err == ""


def test_too_many_pages_are_turned_away(page, monkeypatch):
    monkeypatch.setattr(broadcasting, "MOST_PAGES", 1)
    with live(page) as link:
        until(link, "begin")
        with pytest.raises(InvalidStatus), live(page):
            pass


START = b"GET /api/state HTTP/1.1\r\nHost: 127.0.0.1\r\n"
HEAD = b"POST /api/marks HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\nContent-Length: 9\r\n\r\n{"


@pytest.mark.slow
@pytest.mark.parametrize("said", [b"", START], ids=["silent", "half"])
def test_connections_without_a_whole_request_lock_nobody_out(page, monkeypatch, said):
    monkeypatch.setattr(broadcast, "REQUEST_S", 4.0)
    url, links = f"{page.address.url}api/state", []
    try:
        for _ in range(MOST_CONNECTIONS + 6):
            links.append(socket.create_connection(("127.0.0.1", page.address.port), timeout=20))
            links[-1].sendall(said)
        assert httpx.get(url, timeout=20).status_code == 503
        end = time.monotonic() + 20
        while httpx.get(url, timeout=20).status_code == 503 and time.monotonic() < end:
            time.sleep(0.1)
        assert httpx.get(url, timeout=20).status_code == 200
    finally:
        for link in links:
            link.close()


@pytest.mark.parametrize("said", [b"", START, HEAD, START + b"\r\n" + START], ids=["silent", "half", "body", "second"])
def test_a_connection_without_a_whole_request_is_ended(page, monkeypatch, said):
    monkeypatch.setattr(broadcast, "REQUEST_S", 0.5)
    with socket.create_connection(("127.0.0.1", page.address.port), timeout=20) as link:
        link.sendall(said)
        while link.recv(1000):
            pass
