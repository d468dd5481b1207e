"""Writes a results folder completely or not at all, with the versions that computed it.

It is written under a temporary name beside its final place and renamed at the end, so that an error, a full disk or
Ctrl-C leaves neither half a result nor a lost old one.
"""

import contextlib
import errno
import json
import os
import platform
import re
import secrets
import shutil
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from rovgraph import compatibility
from rovgraph._version import __version__
from rovgraph.errors import InputError, warn

SUMMARY, ACOUSTICS_FILE, SOUNDINGS_FILE = "summary.json", "acoustics.csv", "soundings.csv"
CURRENT_FILE = "current.csv"
STAMP = {  # in every summary: the folder is ours
    "program": "rovgraph",
    "version": __version__,
    "format": compatibility.RESULTS,
}


def beacon_names_of(config: str) -> list[str]:
    """Names of the acoustic beacons of a config.yaml, in the order of their variables; none if it is bad."""
    from rovgraph.model.config import parse_config

    part = re.search(r"^beacons:.*\n([ #-].*\n)*", config, re.MULTILINE)  # to parse all of it takes long
    try:
        return [str(beacon.name) for beacon in parse_config(part[0], "config.yaml").beacons] if part else []
    except InputError:
        return []


def check_writable(path: Path, force: bool, inputs: Sequence[Path | None] = ()) -> None:
    """Refuse early what `results_folder` would refuse after the work.

    Parameters
    ----------
    path : the folder to make
    force : replace an older results folder
    inputs : files that are read, which the folder must not hold; None = an option that was not given

    Raises
    ------
    InputError : ``path`` holds something that must not be replaced, or cannot be made
    """
    with _one_line(path):
        path = _resolved(path)
        for each in inputs:
            if each is not None and _resolved(each).is_relative_to(path) and path.is_dir():
                raise InputError(f"{each}: lies in {path}, which would be replaced; choose another --out")
        _check_target(path, force)
        parent = _nearest_existing(path.parent)
        if not parent.is_dir():
            raise InputError(f"{path}: {parent} is a file, not a folder; choose another --out")
        probe = _hidden(parent, "probe")
        probe.mkdir()
        probe.rmdir()


@contextlib.contextmanager
def results_folder(path: Path, force: bool = False, inputs: Sequence[Path] = ()) -> Iterator[Path]:
    """A temporary folder that becomes ``path`` when the block ends without an error.

    Parameters
    ----------
    path : the folder to make, its parents too
    force : replace an older results folder; nothing else is ever replaced
    inputs : as of `check_writable`

    Yields
    ------
    Path : the folder to write into

    Raises
    ------
    InputError : as `check_writable`; or writing failed (a full disk), and nothing is kept
    """
    check_writable(path, force, inputs)
    final = _resolved(path)
    temporary = _hidden(_nearest_existing(final.parent), "partial")
    made = [p for p in final.parents if not p.exists()]
    try:
        with _one_line(path):
            temporary.mkdir()
        with _one_line(path, inside=temporary):
            yield temporary
        with _one_line(path):
            final.parent.mkdir(parents=True, exist_ok=True)
            _install(temporary, final, force)
    except BaseException:
        _remove(temporary)
        for parent in made:
            with contextlib.suppress(OSError):
                parent.rmdir()  # only where empty
        raise


@contextlib.contextmanager
def results_files(paths: Sequence[Path], force: bool = False) -> Iterator[list[Path]]:
    """Temporary files, of the same names, that become ``paths`` when the block ends without an error.

    Parameters
    ----------
    paths : files to write, in folders that exist
    force : replace older files

    Raises
    ------
    InputError : a file exists and ``force`` is not given, is there twice, or cannot be written; then nothing is kept
    """
    places = [_resolved(path) for path in paths]
    for path, place in zip(paths, places, strict=True):
        if places.count(place) > 1:
            raise InputError(f"{path} is to be written twice; choose different names")
        if path.is_dir():
            raise InputError(f"{path} is a folder, not a file; choose another name")
        if path.exists() and not force:
            raise InputError(f"{path} exists; choose another name or give --force")
    folders = {path: _hidden(_resolved(path).parent, "partial") for path in paths}
    try:
        for path, folder in folders.items():
            with _one_line(path):
                folder.mkdir()
        with _one_line(paths[0]):
            yield [folders[path] / path.name for path in paths]
        for path, folder in folders.items():
            with _one_line(path):
                (folder / path.name).replace(_resolved(path))
    finally:
        for folder in folders.values():
            _remove(folder)


def _resolved(path: Path) -> Path:
    return Path(os.path.realpath(path))  # Path.resolve raises on a loop of links


def _check_target(path: Path, force: bool) -> None:
    """Refuse a file, a foreign folder, and without ``force`` any that is not empty."""
    if not path.exists():
        return
    if not path.is_dir():
        raise InputError(f"{path} is a file, not a folder; choose another --out")
    if not any(path.iterdir()):
        return
    if not force:
        raise InputError(f"{path} exists; choose another --out or give --force")
    if not _is_ours(path):
        raise InputError(f"{path} is not a results folder of rovgraph, so --force keeps it; choose another --out")


def _is_ours(folder: Path) -> bool:
    """Whether the folder holds a summary that rovgraph wrote."""
    try:
        summary = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(summary, dict) and summary.get("program") == STAMP["program"]


def _nearest_existing(path: Path) -> Path:
    while not path.exists() and path != path.parent:
        path = path.parent
    return path


def _hidden(parent: Path, kind: str) -> Path:
    return parent / f".rovgraph-{secrets.token_hex(4)}.{kind}"


def _install(new: Path, final: Path, force: bool) -> None:
    """Rename ``new`` to ``final``; the old one is removed only after that."""
    _check_target(final, force)  # again: the work may have taken an hour
    if not final.exists():
        new.rename(final)
        return
    old = _hidden(final.parent, "old")
    try:
        final.rename(old)
        new.rename(final)
    except BaseException:
        if old.exists() and not final.exists():
            old.rename(final)
        raise
    _remove(old)
    if old.exists():
        warn(f"{old} holds the replaced results and could not be removed")


def _remove(folder: Path) -> None:
    """Remove a folder as far as possible, also when interrupted while doing so."""
    try:
        shutil.rmtree(folder, ignore_errors=True)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


@contextlib.contextmanager
def _one_line(path: Path, inside: Path | None = None) -> Iterator[None]:
    """Turn an error of the file system into an `InputError` about ``path``.

    With ``inside``, errors about files elsewhere (a log that cannot be read) pass.
    """
    try:
        yield
    except OSError as error:
        about = error.filename if isinstance(error.filename, str) else None
        if inside is not None and about is not None and not Path(about).is_relative_to(inside):
            raise
        reason = (error.strerror or str(error) or type(error).__name__).splitlines()[0]
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        remedy = "free space or choose another --out" if full else "choose another --out"
        raise InputError(f"{path}: cannot be written ({reason}), nothing was kept; {remedy}") from error


LIBRARIES = ("numpy", "scipy", "pandas", "numba", "gtsam")


def versions() -> dict[str, str | None]:
    """Python and library -> version; None where a library is not installed, as GTSAM on Windows."""
    return {"python": platform.python_version(), **{name: _installed(name) for name in LIBRARIES}}


def _installed(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
