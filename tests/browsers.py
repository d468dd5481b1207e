"""A headless browser for pages, where one is found, and a program that only prints as one does."""

import contextlib
import shutil
import sys
import time
from pathlib import Path

import pytest

PRINTS = "pathlib.Path(out).write_bytes(b'%PDF-1.4 of ' + sys.argv[-1].encode())"
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


def until(page, expression: str, seconds: float = 20.0) -> None:
    """Wait for an expression of a page to be true; pages forbid the way in which Playwright waits."""
    end = time.monotonic() + seconds
    while not page.evaluate(expression):
        assert time.monotonic() < end, f"not within {seconds:g} s: {expression}"
        page.wait_for_timeout(50)


def printing_browser(program: Path, does: str = PRINTS) -> Path:
    """A program that is called as Chromium is to print; it keeps the words of its call beside it."""
    program.parent.mkdir(exist_ok=True)
    lines = [
        f"#!{sys.executable}",
        "import pathlib, sys",
        "pathlib.Path(__file__ + '.called').write_text(' '.join(sys.argv[1:]))",
        "out = next(word.partition('=')[2] for word in sys.argv if word.startswith('--print-to-pdf='))",
        does,
    ]
    program.write_text("\n".join(lines))
    program.chmod(0o755)
    return program
