"""A page as a PDF, printed by a Chromium that is on the machine."""

import os
import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

from rovgraph.errors import InputError

BROWSER = "ROVGRAPH_BROWSER"  # environment variable: path or name
BROWSERS = (
    *("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge", "microsoft-edge"),
    "chrome-headless-shell",
)
SECONDS = 120.0  # after which a browser is given up
SETTLE_MS = 10_000  # of the page's own time, for its map to be drawn


def find_browser() -> str:
    """Path of the browser that ``ROVGRAPH_BROWSER`` names, or of the first of `BROWSERS` on PATH.

    Raises
    ------
    InputError : there is none
    """
    named = os.environ.get(BROWSER)
    found = next(filter(None, map(shutil.which, [named] if named else BROWSERS)), None)
    if found is None and named:
        raise InputError(f"{BROWSER}={named}: no such program; name a Chromium, Chrome or Edge")
    if found is None:
        raise InputError(
            f"no browser found to print with; install Chromium, or set {BROWSER} to the path of Chrome or Edge"
        )
    return found


def print_pdf(browser: str, page: Path, out: Path) -> None:
    """Print a page to a PDF, which appears whole or not at all.

    Parameters
    ----------
    browser : as of `find_browser`
    page, out : the page and the PDF

    Raises
    ------
    InputError : the PDF cannot be written, or the browser made none
    """
    try:
        # beside the PDF and without a dot: a browser in a sandbox sees neither /tmp nor hidden folders
        with TemporaryDirectory(prefix="printing-", dir=out.parent, ignore_cleanup_errors=True) as temporary:
            printed = Path(temporary, "page.pdf").resolve()
            said = _run(browser, page, printed)
            if not printed.is_file() or printed.read_bytes()[:5] != b"%PDF-":
                raise InputError(f"{browser} printed no PDF of {page}{said}; another browser: set {BROWSER}")
            printed.replace(out)
    except OSError as error:
        raise InputError(f"{out}: cannot be printed ({error.strerror or error})") from error


def _run(browser: str, page: Path, printed: Path) -> str:
    """Run the browser without a window; the last line that it said."""
    root = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []  # it refuses to sandbox root
    command = [
        *(browser, "--headless", "--disable-gpu", "--no-first-run", "--no-pdf-header-footer", *root),
        *(f"--user-data-dir={printed.parent / 'profile'}", f"--virtual-time-budget={SETTLE_MS}"),
        *(f"--print-to-pdf={printed}", page.resolve().as_uri()),
    ]
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=SECONDS)
    except subprocess.TimeoutExpired:
        return f" within {SECONDS:.0f} s"
    lines = (done.stderr.decode(errors="replace").strip() or f"exit code {done.returncode}").splitlines()
    return f": {lines[-1][:200]}"
