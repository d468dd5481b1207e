"""Pages of results folders: the work of ``rovgraph report``."""

from pathlib import Path

from rovgraph.diagnosis.check import Report
from rovgraph.errors import InputError, as_path, kind_of
from rovgraph.report.pages.page import write
from rovgraph.report.pages.printing import find_browser, print_pdf
from rovgraph.report.pages.reporting import page_of
from rovgraph.report.pages.source import PAGE
from rovgraph.report.pages.studies import CAMPAIGN, campaign_page, check_page

PAGE_SUFFIX = ".html"


def report(*results: Path | str, out: Path | str | None = None, force: bool = False, pdf: bool = False) -> Path:
    """Write the page of a results folder, or one page that compares several dives; print it as a PDF if wanted.

    Parameters
    ----------
    results : results folders; several must be results of ``smooth``
    out : the page; None = ``report.html`` in the folder, or ``campaign.html`` in the current folder for several.
        A page of this default name is replaced
    force : replace an older file at ``out``
    pdf : print the page with Chromium, Chrome or Edge to a PDF beside it, such as ``report.pdf``; ``out`` may name
        either of them

    Returns
    -------
    Path : the page; with ``pdf`` the PDF

    Raises
    ------
    InputError : no results folder, unreadable files, a page that exists or cannot be written; no browser, or one that
        prints nothing
    """
    folders = [as_path(folder, "results") for folder in results]
    if not folders:
        raise InputError("report: give at least one results folder")
    if out is None:
        path = folders[0] / PAGE if len(folders) == 1 else Path(CAMPAIGN)
    else:
        given = as_path(out, "out")
        path = free_page(given.with_suffix(PAGE_SUFFIX) if pdf else given, force, "--out")
    printed = path.with_suffix(".pdf")
    if pdf:
        browser = find_browser()
        if out is not None:
            free_page(printed, force, "--out")
    html = page_of(folders[0]) if len(folders) == 1 else campaign_page(folders)
    write(path, html)
    if pdf:
        print_pdf(browser, path, printed)
    return printed if pdf else path


def report_check(found: Report, out: Path | str, force: bool = False) -> Path:
    """Write findings of `rovgraph.check` as a page, as ``rovgraph check --page`` does.

    Parameters
    ----------
    found : what `rovgraph.check` returned
    out : the page
    force : replace an older file

    Raises
    ------
    InputError : the page exists, or cannot be written
    """
    if not isinstance(found, Report):
        raise InputError(f"found: expected what rg.check returns, found {kind_of(found)}")
    path = free_page(as_path(out, "out"), force, "--page")
    write(path, check_page(found.as_dict(), found.source))
    return path


def free_page(path: Path, force: bool, option: str) -> Path:
    """A path that may be written.

    Raises
    ------
    InputError : it is a folder, or exists and ``force`` is not given
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give the name of a page, such as {path / PAGE}")
    if path.exists() and not force:
        raise InputError(f"{path} exists; choose another {option} or give --force")
    return path
