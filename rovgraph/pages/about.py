"""What a page was made of: configuration, versions, files with checksums, and the command to make it again."""

import hashlib
import shlex
from pathlib import Path

from rovgraph.pages.parts import Item, Missing, Section, Table, Text
from rovgraph.pages.source import Source
from rovgraph.report.folder import SUMMARY

PAGE = "report.html"


def about_section(source: Source, command: str = "") -> Section:
    """Configuration, versions, files and, where it is known, the command."""
    items: list[Item] = []
    if command:
        items.append(
            Text("Command to reproduce it, where the log and the config.yaml of this folder are", command, shown=True)
        )
    versions = {"rovgraph": source.summary.get("version"), **(source.summary.get("versions") or {})}
    items.append(Table("Versions", ("", ""), [(name, str(v)) for name, v in versions.items()]))
    items.append(_files(source))
    found = (source.text(name) for name in ("config.yaml", "study.yaml"))
    config = next(filter(None, found), None)
    items.append(
        Text("Configuration in effect", config) if config else Missing("Configuration", "config.yaml is missing")
    )
    return Section("about", "Configuration, versions and files", (), items)


def smooth_command(source: Source) -> str:
    """What makes the same results from the effective configuration."""
    kinds = [k for k in ("smoothed", "filtered") if k in (source.summary.get("estimates") or {})]
    logs = [Path(name).name for name in str(source.summary.get("log", "LOG")).split(" + ")]
    words = ["rovgraph", "smooth", *logs, "--config", "config.yaml", "--out", "again"]
    return shlex.join(words + (["--estimate", kinds[0]] if len(kinds) == 1 else []))


def _files(source: Source) -> Table:
    rows = []
    log = source.summary.get("input")
    if isinstance(log, dict):
        rows.append((f"{log.get('path')} (the log)", f"{log.get('bytes')}", str(log.get("sha256"))))
    for path in sorted(source.folder.iterdir()):
        if path.is_file() and path.name not in (PAGE, SUMMARY):  # which says how long the work took
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            rows.append((path.name, str(path.stat().st_size), digest))
    return Table("Files", ("file", "bytes", "SHA-256"), rows)
