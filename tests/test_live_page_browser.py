"""The live page in a real browser: it shows what comes, sends what is wanted, and runs nobody's text."""

import time

import numpy as np
import pytest
from browsers import chromium, until
from test_live_page import NASTY, solution

import rovgraph as rg
from rovgraph.live.marks import DropMark, Marks, SetPosition
from rovgraph.live.solution import Event, SensorHealth
from rovgraph.web.view import STEP_M

WIDTHS = (400, 1600)
SLOWEST_MS = 100.0
HOUR = 12_000  # points of an hour at a third of a metre a second
OVER_THE_MAP = """() => {
    const map = document.getElementById("map-frame").getBoundingClientRect();
    const over = (box) => box.bottom > map.top && box.top < map.bottom && box.left < map.right && box.right > map.left;
    const all = [...document.querySelectorAll("button, #legend, #alarms")];
    return all.filter((one) => over(one.getBoundingClientRect())).map((one) => one.id);
}"""


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


@pytest.fixture
def dive():
    """A page's server, and the commands that it was given."""
    commands, marks = [], Marks()
    marks.drop(NASTY, solution())
    with rg.live_page("127.0.0.1:0", lambda command: commands.append(command) or True, marks) as page:
        yield page, commands


def opened(browser, dive, width):
    """The page once it is live, and what it complained of."""
    page = browser.new_context(viewport={"width": width, "height": 800}, color_scheme="light").new_page()
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.on("dialog", lambda dialog: errors.append(dialog.message))
    page.goto(dive[0].url)
    page.wait_for_selector("#gauges b", timeout=60_000)
    return page, errors


@pytest.mark.parametrize("width", WIDTHS)
def test_the_page_shows_the_dive_and_runs_nobodys_text(browser, dive, width):
    bad = {NASTY: SensorHealth("silent", 9.0, 1, 0, 9.0), "dvl": SensorHealth("no lock", 0.1, 5, 0, 7.0)}
    dive[0].send(solution(1.0, sensors=bad, events=(Event(1.0, NASTY, "kind", NASTY),)))
    page, errors = opened(browser, dive, width)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for place in ("#sensors", "#marks", "#events"):
        assert NASTY in page.inner_text(place)
    assert "no lock for 7 s" in page.inner_text("#alarms")
    assert "28.6°" in page.inner_text("#gauges")
    assert "dvl_yaw 44.12 ± 0.57 °" in page.text_content("#learnt")
    sizes = page.evaluate("[...document.querySelectorAll('#tools button')].map(b => b.getBoundingClientRect().height)")
    assert min(sizes) >= 48
    assert "no lock" in page.inner_text("#status") and "trusted" in page.inner_text("#status")
    assert not page.is_visible("#learnt")
    assert page.evaluate(OVER_THE_MAP) == []
    assert errors == []


def test_home_depth_and_heading_of_a_dive(browser, dive):
    for k in range(200):
        dive[0].send(solution(5.0 * k, 0.5 * k, position=np.array([0.5 * k, 2.0 + 0.5 * k, 3.0 + 0.01 * k])))
    page, errors = opened(browser, dive, 1600)
    until(page, "rovgraph.map.state.time === 995")
    home = page.inner_text(".gauge.home")
    assert "140.7 m" in home and "225°" in home
    assert "0:16:35" in page.inner_text("#times")
    assert page.evaluate("rovgraph.map.track.since(995 - 600).length") == 121
    assert "bottom" not in page.inner_text(".gauge.depth")
    dive[0].send(solution(1000.0, 100.0, altitude=4.0))
    until(page, "rovgraph.map.state.time === 1000")
    assert "dashed: bottom" in page.inner_text(".gauge.depth")
    assert errors == []


def test_colours_and_sound_are_chosen_and_remembered(browser, dive):
    dive[0].send(solution(1.0))
    page, errors = opened(browser, dive, 1600)
    assert page.evaluate("document.documentElement.dataset.look") == "daylight"
    page.click("#sound")  # first: any touch elsewhere lets the page sound, and then this button mutes it
    until(page, "document.getElementById('sound').textContent === 'Sound on'")
    page.click("#look")
    dive[0].send(solution(2.0, position_sd=np.full(3, 9.0)))
    until(page, "rovgraph.siren.played >= 2")  # the sound of the button, and the alarm
    page.click("#sound")
    page.reload()
    page.wait_for_selector("#gauges b")
    assert page.evaluate("document.documentElement.dataset.look") == "dark"
    assert page.inner_text("#sound") == "Sound off"
    assert errors == []


def test_no_sound_is_made_before_the_page_is_touched(browser, dive):
    dive[0].send(solution(1.0, position_sd=np.full(3, 9.0)))
    page, errors = opened(browser, dive, 1600)
    assert page.inner_text("#sound") == "Sound: tap"
    assert page.evaluate("[rovgraph.siren.played, rovgraph.siren.context]") == [0, None]
    page.keyboard.press("x")
    until(page, "rovgraph.siren.played === 1")  # repeated while it lasts
    assert errors == []


def test_way_point_and_position_go_where_the_map_was_tapped(browser, dive):
    dive[0].send(solution(1.0, 100.0))
    page, errors = opened(browser, dive, 1600)

    def arrived(count):  # one by one: requests of a page may overtake each other
        end = time.monotonic() + 20
        while len(dive[1]) < count and time.monotonic() < end:
            page.wait_for_timeout(50)

    box = page.locator("#map").bounding_box()
    x, y, metre = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2, page.evaluate("rovgraph.map.scale")
    for wanted in ("waypoint", "position"):
        page.mouse.click(x + 5 * metre, y - 4 * metre)
        page.click(f"#point-dialog button[value={wanted}]")
        if wanted == "waypoint":
            page.fill("#mark-name", NASTY)
            page.click("#mark-save")
            arrived(1)
        else:
            page.fill("#position-sd", "0.1")
            assert "outlier" in page.inner_text("#position-doubt")
            page.fill("#position-sd", "3")
            assert "outlier" not in page.inner_text("#position-doubt")
            page.click("#position-dialog button[value=save]")
    arrived(2)
    page.focus("#map")
    page.keyboard.press("m")
    arrived(3)
    waypoint, position, mark = dive[1]
    assert isinstance(waypoint, DropMark) and waypoint.name == NASTY
    assert (waypoint.north, waypoint.east) == pytest.approx((104.0, 7.0), abs=0.2)
    assert isinstance(position, SetPosition) and position.sd == 3.0
    assert (position.north, position.east) == pytest.approx((104.0, 7.0), abs=0.2)
    assert mark == DropMark("")
    assert errors == []


@pytest.mark.parametrize("widget", ["", "#widget"])
def test_with_a_token_the_page_opens_by_its_address_or_by_asking(browser, widget):
    with rg.live_page("0.0.0.0:0") as server:
        server.send(solution(1.0))
        here = f"http://127.0.0.1:{server.address.port}/"
        page = browser.new_context().new_page()
        page.goto(here + widget)
        page.fill("#token", server.token, timeout=20_000)
        page.click("#login button")
        page.wait_for_selector("#gauges b", state="attached", timeout=20_000)
        assert page.locator("#panels").is_visible() == (not widget)
        page = browser.new_context().new_page()
        page.goto(f"{here}#token={server.token}")
        page.wait_for_selector("#gauges b", timeout=20_000)
        assert server.token not in page.url


def test_a_page_that_lost_its_server_says_so(browser, dive):
    dive[0].send(solution(1.0))
    page, _ = opened(browser, dive, 400)
    dive[0].close()
    page.wait_for_selector("#connection.bad", timeout=20_000)
    assert "old" in page.inner_text("#connection")


def test_an_hours_track_is_drawn_within_a_frame_of_100_ms(browser, dive):
    turns = np.cumsum(np.random.default_rng(1).normal(0.0, 0.05, HOUR))
    north, east = np.cumsum(3 * STEP_M * np.cos(turns)), np.cumsum(3 * STEP_M * np.sin(turns))
    sd = 0.1 + 4.0 * np.abs(np.sin(np.arange(HOUR) / 500))
    for k in range(HOUR):
        place, own = np.array([north[k], east[k], 3.0]), np.array([sd[k], sd[k], 0.1])
        dive[0].send(solution(0.3 * k, position=place, position_sd=own))
    page, errors = opened(browser, dive, 1600)
    end = time.monotonic() + 60
    while page.evaluate("rovgraph.map.track.length") < HOUR:
        assert time.monotonic() < end
        page.wait_for_timeout(100)
    page.click("#fit")
    times = page.evaluate(
        """() => Array.from({length: 20}, () => {
            const begin = performance.now();
            rovgraph.map.draw();
            return performance.now() - begin;
        })"""
    )
    print("frames of an hour's track [ms]: median", np.median(times), "slowest", max(times))
    assert np.median(times) < SLOWEST_MS
    assert errors == []
