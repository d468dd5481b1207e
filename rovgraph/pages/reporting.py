"""The page of a results folder, whichever command made it."""

from pathlib import Path

from rovgraph.errors import InputError
from rovgraph.pages.about import PAGE
from rovgraph.pages.dive import dive_page
from rovgraph.pages.page import write
from rovgraph.pages.source import DiveSource, Source, damage_named
from rovgraph.pages.studies import study_page_of


def page_of(folder: Path) -> str:
    """HTML of the page of a results folder.

    Raises
    ------
    InputError : no results folder of rovgraph, a file that cannot be read, or a command without a page
    """
    source = Source.read(folder)
    with damage_named(folder):
        if "main_estimate" in source.summary:
            return dive_page(DiveSource(source.folder, source.summary))
        maker = study_page_of(source)
        if maker is None:
            raise InputError(f"{folder}: holds no results that have a page; give a results folder of smooth or a study")
        return maker(source)


def write_page(folder: Path) -> None:
    """Write the page of a results folder as ``report.html`` into it.

    Raises
    ------
    InputError : of `page_of`; or it cannot be written
    """
    write(folder / PAGE, page_of(folder))
