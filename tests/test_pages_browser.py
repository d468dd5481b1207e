"""Pages in a real browser: offline, without an error, with one cursor, readable at both widths, and accessible."""

import re

import pytest
from browsers import chromium, until
from test_pages import dive, folder  # noqa: F401

from rovgraph.api.reporting import report

WIDTHS = (400, 1600)


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def page_file(folder, tmp_path_factory):  # noqa: F811
    return report(folder, out=tmp_path_factory.mktemp("page") / "mail attachment.html")


@pytest.fixture(scope="module", params=WIDTHS)
def page(request, browser, page_file):
    """The page, opened with the network forbidden; it keeps what was ``said`` on its console and ``asked`` for."""
    context = browser.new_context(viewport={"width": request.param, "height": 900}, offline=True)
    page = context.new_page()
    page.said, page.asked = [], []
    page.on("console", lambda message: page.said.append(message.text))
    page.on("pageerror", lambda error: page.said.append(str(error)))
    page.on("request", lambda request: page.asked.append(request.url))
    page.goto(page_file.as_uri())
    page.evaluate("rovgraph.drawAll()")
    yield page
    context.close()


def frames(page, count=3):
    page.evaluate(
        f"new Promise(done => {{ let n = {count}; const f = () => n-- ? requestAnimationFrame(f) : done(); f(); }})"
    )


def test_a_page_opens_without_a_request_and_without_a_word_on_the_console(page):
    assert page.said == []
    assert [url for url in page.asked if not url.startswith(("file:", "data:", "blob:"))] == []
    assert page.evaluate("document.querySelectorAll('figure[data-panel]').length") == page.evaluate(
        "rovgraph.drawn.size"
    )
    assert page.evaluate("rovgraph.drawn.size") > 20


def test_a_page_is_no_wider_than_its_window(page):
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_every_axis_has_a_name_that_is_seen_and_the_unit_of_what_has_one(page):
    names = page.evaluate(
        """[...rovgraph.drawn.values()].flatMap(e => ["x", "y"].map(axis => {
            const title = e.plot.querySelector(`.g-${axis}title text`), box = title && title.getBoundingClientRect();
            const plot = e.plot.getBoundingClientRect();
            const inside = box && box.left >= plot.left - 2 && box.right <= plot.right + 2 && box.width > 0;
            return [e.panel.title, title ? title.textContent : "", !!inside];
        }))"""
    )
    assert [row for row in names if not row[1] or not row[2]] == []
    without = {"residual / sd", "density", "autocorrelation", "difference / its sd", "1 = lock", "count"}
    assert [text for _, text, _ in names if "[" not in text and text not in without] == []


def test_every_axis_has_a_number(page):
    bare = page.evaluate(
        """[...rovgraph.drawn.values()].flatMap(e => ["x", "y"].filter(
            axis => ![...e.plot.querySelectorAll(`.${axis}tick text`)].some(text => text.textContent.trim())
        ).map(axis => `${e.panel.title}: ${axis}`))"""
    )
    assert bare == []


def test_the_readout_invents_nothing_where_nothing_was_measured(page):
    """From 30 to 50 s the DVL saw no bottom."""
    panel = page.locator("figure", has_text="Velocity along the DVL's x axis")
    panel.scroll_into_view_if_needed()
    told = {}
    for time in (20, 40, 70):
        page.evaluate(f"rovgraph.setTime({time})")
        frames(page)
        told[time] = panel.locator(".readout").inner_text()
    assert "measured" in told[20] and "measured" in told[70]
    assert told[40] == "at 40 s: smoothed unknown"
    assert told[20].endswith("m/s")


def test_the_first_screen_has_map_verdict_and_numbers(browser, page_file):
    for width, height in ((1600, 900), (400, 800)):
        context = browser.new_context(viewport={"width": width, "height": height}, offline=True)
        page = context.new_page()
        page.goto(page_file.as_uri())
        page.wait_for_selector("#track .vehicle", state="attached")
        for part in ("#track .plot", ".card .verdict", ".numbers"):
            box = page.locator(part).first.bounding_box()
            assert box["y"] >= 0 and box["y"] + box["height"] <= page.locator("#cursor").bounding_box()["y"], part
        context.close()


def test_a_folded_part_is_drawn_when_it_is_opened(browser, page_file):
    context = browser.new_context(viewport={"width": 1600, "height": 900}, offline=True)
    page = context.new_page()
    page.goto(page_file.as_uri())
    residuals = "[...rovgraph.drawn.keys()].filter(key => key.startsWith('residuals-')).length"
    assert page.evaluate(residuals) == 0
    page.click("nav a[href='#residuals']")
    until(page, f"{residuals} > 0")
    context.close()


def test_icons_never_cover_a_legend(page):
    covered = page.evaluate(
        """[...rovgraph.drawn.values()].filter(e => {
            const icons = e.plot.querySelector(".modebar"), legend = e.plot.querySelector(".legend");
            return icons && legend && icons.getBoundingClientRect().bottom > legend.getBoundingClientRect().top + 1;
        }).map(e => e.panel.title)"""
    )
    assert covered == []


def test_the_printed_page_has_two_sheets(browser, page_file):
    page = browser.new_context(offline=True).new_page()
    page.goto(page_file.as_uri())
    page.wait_for_selector("#track .vehicle", state="attached")
    assert len(re.findall(rb"/Type\s*/Page\b", page.pdf(format="A4"))) == 2


def test_the_slider_moves_the_vehicle_and_tells_where_it_is(page):
    at = "(() => { const v = document.querySelector('.map .vehicle'); return [+v.dataset.x, +v.dataset.y]; })()"
    page.locator("figure.map").scroll_into_view_if_needed()
    page.evaluate("rovgraph.setTime(0)")
    frames(page)
    before, told = page.evaluate(at), page.locator("#now").inner_text()
    page.locator("#time").focus()
    for _ in range(8):
        page.keyboard.press("PageUp")  # a keyboard is enough
    frames(page)
    after = page.evaluate(at)
    assert abs(after[0] - before[0]) + abs(after[1] - before[1]) > 5
    assert page.locator("#now").inner_text() != told
    place = (
        "(() => { const v = rovgraph.vehicle(+document.getElementById('time').value); return [v.north, v.east]; })()"
    )
    north, east = page.evaluate(place)
    expected = page.evaluate(
        f"""(() => {{ const e = [...rovgraph.drawn.values()].find(e => e.panel.kind === "map"), f = e.plot._fullLayout;
        return [f.xaxis._offset + f.xaxis.d2p({east}), f.yaxis._offset + f.yaxis.d2p({north})]; }})()"""
    )
    assert after == pytest.approx(expected, abs=1.0)


def test_the_mouse_over_one_plot_moves_the_cursor_of_all(page):
    plot = page.locator("#dive figure.time .plot").first
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    page.mouse.move(box["x"] + 0.7 * box["width"], box["y"] + 0.4 * box["height"])
    frames(page)
    time = float(page.locator("#time").input_value())
    end = page.evaluate("+document.getElementById('time').max")
    assert 0.5 * end < time < 0.9 * end
    other = page.locator("#separation figure.time .plot").first
    other.scroll_into_view_if_needed()
    frames(page)
    line = float(other.locator("svg.cursor line").get_attribute("x1"))
    expected = other.evaluate(f"p => p._fullLayout.xaxis._offset + p._fullLayout.xaxis.d2p({time})")
    assert line == pytest.approx(expected, abs=1.0)
    assert "at " in page.locator("#separation .readout").first.inner_text()


def test_zooming_one_time_axis_zooms_all(page):
    page.evaluate("rovgraph.setTime(30)")
    page.locator("#closer").click()
    ranges = """[...rovgraph.drawn.values()].filter(e => e.panel.kind === "time")
        .map(e => e.plot._fullLayout.xaxis.range.join())"""
    page.wait_for_timeout(500)
    seen = set(page.evaluate(ranges))
    page.locator("#all").click()
    page.wait_for_timeout(500)
    assert len(seen) == 1
    assert seen != set(page.evaluate(ranges))


def test_contrast_names_and_keyboard_pass_axe(browser, page_file):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe is not installed: not tested")
    context = browser.new_context(viewport={"width": 1200, "height": 900}, offline=True)
    page = context.new_page()
    page.goto(page_file.as_uri())
    page.evaluate("rovgraph.drawAll()")
    found = axe.Axe().run(page)
    context.close()
    assert [(v["id"], v["nodes"][0]["html"][:120]) for v in found.response["violations"]] == []
