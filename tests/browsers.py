"""A headless browser for pages, where one is found."""

import contextlib
import shutil

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome", "msedge")


@contextlib.contextmanager
def chromium():
    """A headless Chromium of Playwright's own or of the system; skips, saying so, where there is none."""
    playwright = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed: no page was opened")
    with playwright.sync_playwright() as engine:
        path = next(filter(None, map(shutil.which, NAMES)), None)
        try:
            browser = engine.chromium.launch(executable_path=path, args=["--no-sandbox"])
        except playwright.Error:
            pytest.skip("no browser was found: no page was opened; playwright install chromium-headless-shell gets one")
        yield browser
        browser.close()
