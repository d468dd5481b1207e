"""Pictures of both pages. ROVGRAPH_PICTURES=docs/images and ``pytest -m slow`` of this file make those of the docs."""

import os
from pathlib import Path

import numpy as np
import pytest
from browsers import chromium
from PIL import Image

import rovgraph as rg

ROOT = Path(__file__).parents[1]
FALCON = ROOT / "data" / "falcon"
LIVE = {"width": 1280, "height": 860}
REPORT = {"width": 1280, "height": 1640}  # the first screen and the dive
COLOURS = 64
LEAST_COLOURS = 200  # an empty page, or one of plain text alone, has fewer

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


@pytest.fixture
def pictures(tmp_path) -> Path:
    return ROOT / os.environ.get("ROVGRAPH_PICTURES", tmp_path)


@pytest.fixture(scope="module")
def config() -> rg.Config:
    return rg.load_config(FALCON / "config.yaml")


@pytest.fixture
def log(config, monkeypatch) -> rg.Log:
    monkeypatch.chdir(ROOT)  # the page shows the name of its log
    return rg.read_log("data/falcon/log.csv.gz", config)


def take(page, path: Path) -> None:
    """Keep what the page shows, in few colours, and see that something is drawn."""
    page.wait_for_timeout(500)
    page.screenshot(path=path)
    with Image.open(path) as picture:
        shown = picture.convert("RGB")
    assert len(np.unique(np.asarray(shown).reshape(-1, 3), axis=0)) > LEAST_COLOURS
    shown.quantize(COLOURS).save(path, optimize=True)


def test_the_report_begins_with_track_verdict_and_dive(browser, pictures, tmp_path, log, config):
    rg.smooth(log, config).save(tmp_path / "dive", figures=False)
    page = browser.new_context(viewport=REPORT, offline=True).new_page()
    page.goto((tmp_path / "dive" / "report.html").as_uri())
    take(page, pictures / "report.png")


def test_the_live_page_shows_track_and_sensors(browser, pictures, log, config):
    with rg.live_page("127.0.0.1:0") as server:
        solutions = rg.Online(config).replay(log)
        for solution in solutions:
            server.send(solution)
            if solution.time > 300.0:
                break
        page = browser.new_context(viewport=LIVE).new_page()
        page.goto(server.url)
        page.wait_for_selector("#gauges b", timeout=60_000)
        page.click("#fit")
        server.send(next(solutions))  # or the page would say how long there was none
        take(page, pictures / "live-page.png")
