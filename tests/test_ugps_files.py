"""Records of a Water Linked UGPS: rows of a real logger's CSV, and the same in the other forms that loggers write."""

import csv
import io
import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recordings import check_refused_or_whole, close, first, read
from wire import Heard

from rovgraph.errors import InputError
from rovgraph.live.message import SHIP_GEODETIC
from rovgraph.live.sources import open_source
from rovgraph.live.sources.source import LinkSource
from rovgraph.live.sources.ugps import UgpsPolling, ugps
from rovgraph.log.streams import STREAMS
from rovgraph.model.config import Config

# of Pier 59, Seattle, 2023-06-05, wl_ugps_acoustic_analysis; a row of each kind
REAL = b"""\
position_valid,std,x,y,z,distance_r0,distance_r1,distance_r2,distance_r3,nsd_r0,nsd_r1,nsd_r2,nsd_r3,rssi_r0,rssi_r1,rssi_r2,rssi_r3,valid_r0,valid_r1,valid_r2,valid_r3,timestamp
True,1.6796700954437256,7.112783908843994,1.7669514417648315,0.688177227973938,7.693600177764893,7.032800197601318,7.032800197601318,7.3632001876831055,-68.95360565185547,-83.38611602783203,-69.29487609863281,-80.70590209960938,-59.917930603027344,-59.22956848144531,-58.30794143676758,-68.60413360595703,1,1,1,1,1685982370.6930826
True,1.686783790588379,7.162590980529785,1.785159707069397,0.6419087052345276,7.788000106811523,7.127200126647949,7.127200126647949,7.457600116729736,-92.70735931396484,-102.17768096923828,-95.27056884765625,-99.7479476928711,-61.04520034790039,-59.26542282104492,-59.13703918457031,-68.00485229492188,1,1,1,1,1685982371.199762
False,2.6163408756256104,7.162590980529785,1.785159707069397,0.6419087052345276,-1,-1,-1,-1,-69.82518768310547,-71.3760986328125,-68.2000732421875,-94.08704376220703,-95.01461029052734,-97.3840560913086,-94.75250244140625,-107.76217651367188,0,0,0,0,1685982371.7048862
True,1.691664457321167,6.845580101013184,2.3571224212646484,0.9583797454833984,7.882400035858154,7.22160005569458,7.268799781799316,7.552000045776367,-68.8969955444336,-75.83838653564453,-70.03821563720703,-94.19837951660156,-61.66582489013672,-58.74509048461914,-61.48708724975586,-68.01136016845703,1,1,1,1,1685982381.3302565
True,1.691664457321167,6.845580101013184,2.3571224212646484,0.9583797454833984,7.882400035858154,7.22160005569458,7.268799781799316,7.552000045776367,-68.8969955444336,-75.83838653564453,-70.03821563720703,-94.19837951660156,-61.66582489013672,-58.74509048461914,-61.48708724975586,-68.01136016845703,1,1,1,1,1685982381.839538
"""
START = 1685982370.0
ROWS = list(csv.DictReader(io.StringIO(REAL.decode())))


def nested(row: dict[str, str], **master: float) -> dict[str, object]:
    """A row as the interface answers."""
    lists = {
        f"receiver_{name}": [float(row[f"{name}_r{k}"]) for k in range(4)]
        for name in ("distance", "nsd", "rssi", "valid")
    }
    answer = {name: float(row[name]) for name in ("std", "x", "y", "z")} | lists
    answer |= {"position_valid": row["position_valid"] == "True"}
    return {"timestamp": float(row["timestamp"]), "position/acoustic/raw": answer, "position/master": master}


MASTER = {"lat": 47.6, "lon": -122.3, "orientation": 269.5, "fix_quality": 2, "hdop": 0.8, "cog": -1, "sog": 0.2}


def flat(row: dict[str, str]) -> dict[str, object]:
    """A row as another logger names it."""
    out = {f"acoustic_{name}": row[name] for name in "xyz"} | {"acoustic_valid": row["position_valid"]}
    for name in ("distance", "valid", "rssi", "nsd"):
        out |= {f"receiver_{name}_{k}": row[f"{name}_r{k}"] for k in range(4)}
    return {"timestamp": row["timestamp"], **out} | {f"master_{name}": value for name, value in MASTER.items()}


def as_csv(rows: list[dict[str, object]]) -> bytes:
    out = io.StringIO()
    writer = csv.DictWriter(out, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue().encode()


FORMS = {
    "columns": REAL,
    "lists in cells": as_csv(
        [{"timestamp": row["timestamp"]} | nested(row)["position/acoustic/raw"] for row in ROWS]  # type: ignore[operator]
    ),
    "named by answer": as_csv([flat(row) for row in ROWS]),
    "JSON lines": b"\n".join(json.dumps(nested(row, **MASTER)).encode() for row in ROWS),
    "JSON array": json.dumps([flat(row) for row in ROWS], indent=2).encode(),
}


@pytest.mark.parametrize("form", FORMS)
def test_valid_answers_are_taken_once_in_every_form(form, tmp_path):
    recording = read(FORMS[form], tmp_path)
    usbl = first(recording, "usbl").columns
    close(usbl["time"] - START, [0.6930826, 1.199762, 11.3302565])
    close(usbl["usbl_x"], [7.112783908843994, 7.162590980529785, 6.845580101013184])
    close(usbl["usbl_y"], [1.7669514417648315, 1.785159707069397, 2.3571224212646484])
    close(usbl["usbl_z"], [0.688177227973938, 0.6419087052345276, 0.9583797454833984])
    assert recording.settings == {"usbl": {"frame": "ship", "stamp": "arrival", "one_way": True}}
    assert recording.notes == ("5 answers of a UGPS: 3 are used, 1 repeat the one before, 1 are not valid",)
    assert sum(each.count for each in recording.left) == 2
    assert any("depth" in line for line in recording.warnings)


@pytest.mark.parametrize("form", ["named by answer", "JSON lines", "JSON array"])
def test_the_topside_is_the_ship(form, tmp_path):
    recording = read(FORMS[form], tmp_path)
    ship = first(recording, "ship").columns
    close([ship["ship_lat"][0], ship["ship_lon"][0]], [47.6, -122.3])
    close(np.degrees(first(recording, "ship_heading").columns["ship_heading"]), 269.5)


@pytest.mark.parametrize(
    ("master", "sensors"),
    [
        ({"orientation": -1}, ["usbl", "ship"]),
        ({"fix_quality": 0}, ["usbl", "ship_heading"]),
        ({"lat": 0.0, "lon": 0.0, "orientation": -1.0}, ["usbl"]),
    ],
)
def test_a_topside_without_compass_or_fix_says_so(master, sensors, tmp_path):
    data = b"\n".join(json.dumps(nested(row, **(MASTER | master))).encode() for row in ROWS)
    assert [channel.sensor for channel in read(data, tmp_path).channels] == sensors


def test_distances_to_receivers_that_heard_the_locator_can_be_chosen(tmp_path):
    deaf = REAL.replace(b"1,1,1,1,1685982370", b"1,0,1,1,1685982370")
    recording = read(deaf, tmp_path, range="receiver_distance")
    assert [channel.sensor for channel in recording.channels] == ["range"]
    ranges = first(recording, "range").columns
    assert ranges["range_receiver"].tolist() == [0, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3]
    close(ranges["range"][:3], [7.693600177764893, 7.032800197601318, 7.3632001876831055])
    assert recording.settings == {"range": {"stamp": "arrival", "one_way": True}}
    both = read(deaf, tmp_path, range="receiver_distance", usbl="x, y, z")
    assert [channel.sensor for channel in both.channels] == ["range", "usbl"]
    with pytest.raises(InputError, match="range cannot come from"):
        read(deaf, tmp_path, range="other")


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (REAL.replace(b"True", b"False"), "none of 5 records has a valid position"),
        (b"position_valid,x,y,z,timestamp\nTrue,1,2,3,\n", "no record has a time"),
    ],
)
def test_records_without_use_are_refused(data, said, tmp_path):
    with pytest.raises(InputError, match=said):
        read(data, tmp_path)


def test_lines_that_are_cut_are_counted(tmp_path):
    recording = read(REAL + REAL.splitlines()[1][:50] + b"\n", tmp_path)
    assert len(first(recording, "usbl").columns["time"]) == 3
    assert any(each.reason == "more or fewer cells than the header" for each in recording.left)


@given(
    changes=st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=4)), max_size=8),
    form=st.sampled_from(list(FORMS)),
)
def test_changed_bytes_raise_nothing_but_a_refusal(changes, form, tmp_path_factory):
    data = bytearray(FORMS[form])
    for place, new in changes:
        data[place % len(data) : place % len(data) + 2] = new
    check_refused_or_whole(read, bytes(data), tmp_path_factory.getbasetemp())


class Topside(BaseHTTPRequestHandler):
    """Answers with the rows in their order, the third by HTTP 500, then with the last one for ever."""

    asked = 0

    def do_GET(self) -> None:
        if self.path == "/api/v1/position/master":
            answer: object = MASTER
        else:
            assert self.path == "/api/v1/position/acoustic/raw"
            k = Topside.asked
            Topside.asked += 1
            if k == 2:
                self.send_error(500)
                return
            row = ROWS[min(k - (k > 2), len(ROWS) - 1)]
            answer = nested(row)["position/acoustic/raw"]
        body = json.dumps(answer).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


def test_live_answers_are_polled_through_http_500_and_silence():
    Topside.asked = 0
    heard, stop = Heard(), threading.Event()
    config = Config().changed(usbl={"frame": "ship"})
    with ThreadingHTTPServer(("127.0.0.1", 0), Topside) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        link = UgpsPolling("127.0.0.1", server.server_address[1], 50.0, heard)
        messages = LinkSource("u", link, ugps("u", heard, config)).messages(stop)
        found = []
        for message in messages:
            found.append(message)
            if sum(r.sensor == "usbl" for m in found for r in m.readings) == 3 and Topside.asked > 8:
                break
            if Topside.asked > 200:
                break
        server.shutdown()
    usbl = np.array([r.values for m in found for r in m.readings if r.sensor == "usbl"])
    x = STREAMS["usbl"].index("usbl_x")
    close(usbl[:, x : x + 3].T, [[7.112783908843994, 7.162590980529785, 6.845580101013184],
                                 [1.7669514417648315, 1.785159707069397, 2.3571224212646484],
                                 [0.688177227973938, 0.6419087052345276, 0.9583797454833984]])  # fmt: skip
    close(next(r.values for m in found for r in m.readings if r.sensor == SHIP_GEODETIC)[:2], [47.6, -122.3])
    assert heard.kinds["HTTP 500"] == 1 and heard.kinds["not valid"] == 1
    late = threading.Timer(0.3, stop.set)
    late.start()
    assert list(messages) == []
    assert heard.kinds["unreachable"] >= 1 and "frame" not in heard.kinds


@pytest.mark.parametrize("url", ["ugps:192.168.2.94", "ugps:http://", "ugps:http://host?rate=0", "ugps:tcp://host:1"])
def test_addresses_of_no_interface_are_refused(url):
    with pytest.raises(InputError, match="ugps"):
        open_source(url)
