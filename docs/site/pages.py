"""Pages of the site that are made of what stands elsewhere: a hook of mkdocs.

README, changelog and the like stay where GitHub and packages look for them; examples, help texts and docstrings have
no second copy. A public name without a docstring ends the build.
"""

import inspect
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from typer.main import get_command
from typer.testing import CliRunner

import rovgraph as rg
from rovgraph import extend
from rovgraph.cli.app import app

ROOT = Path(__file__).parents[2]
ELSEWHERE = {  # page or file of the site -> file of the project
    "index.md": "README.md",
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "security.md": "SECURITY.md",
    "licence.md": "LICENSE",
    "benchmarks.md": "benchmarks/README.md",
    "falcon.md": "data/falcon/README.md",
    "bluerov2.yaml": "configs/bluerov2.yaml",
}
FOLDERS = {"examples": "examples.md"}  # folder of the project -> page that shows it
RETURNED = (  # classes that the functions return, beside those of `rg.__all__`
    "rovgraph.inference.estimate.Estimate",
    "rovgraph.inference.estimate.CalibrationEstimate",
    "rovgraph.diagnosis.Alarm",
    "rovgraph.api.online.LiveRun",
    "rovgraph.live.solution.Solution",
    "rovgraph.live.solution.Event",
)
FIRST = ("smooth", "residuals", "mountings", "native_files", "own_sensor", "live")  # of the examples, others by name
LINK = re.compile(r'(\]\(|<img src=")(?!\w+:)([^)#\s"]+)')
IMAGE = re.compile(r'<img [^>]*?src="(?!\w+:)([^"]+)"')


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    made = {page: (ROOT / source).read_text(encoding="utf-8") for page, source in ELSEWHERE.items()}
    made |= {"examples.md": examples(), "commands.md": commands(), "api-reference.md": api_reference()}
    for page, text in made.items():
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Let links between files of the project be links between pages."""
    source = ROOT / ELSEWHERE.get(page.file.src_uri, f"docs/{page.file.src_uri}")
    pages = {ROOT / path: name for name, path in ELSEWHERE.items()}
    pages |= {ROOT / folder: name for folder, name in FOLDERS.items()}

    def on_the_site(link: re.Match[str]) -> str:
        target = Path(os.path.normpath(source.parent / link[2]))
        return f"{link[1]}{pages.get(target) or os.path.relpath(target, ROOT / 'docs')}"

    return LINK.sub(on_the_site, markdown)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> None:
    """Look for the pictures of a page, which mkdocs does not do for those of HTML.

    Raises
    ------
    PluginError : one is missing
    """
    folder = os.path.dirname(page.file.src_uri)  # noqa: PTH120
    absent = [src for src in IMAGE.findall(html) if os.path.normpath(f"{folder or '.'}/{src}") not in files.src_uris]
    if absent:
        raise PluginError(f"{page.file.src_uri}: no picture {', '.join(absent)}")


def examples() -> str:
    """Each script with its docstring as prose."""
    parts = [
        "# Examples\n\nEach script runs as it stands and ends with a figure, which it writes into the current folder: "
        "`python examples/smooth.py`. The data come with the project. `export.py` needs `pip install '.[examples]'`.\n"
    ]
    scripts = {path.stem: path for path in sorted((ROOT / "examples").glob("*.py"))}
    for path in (scripts[name] for name in dict.fromkeys([*FIRST, *scripts])):
        text = path.read_text(encoding="utf-8")
        _, about, code = text.split('"""', 2)
        title, _, rest = about.partition("\n")
        parts.append(f'## {title.rstrip(".")}\n{rest}\n```python title="examples/{path.name}"\n{code.strip()}\n```\n')
    return "\n".join(parts)


def commands() -> str:
    """The help text of every command."""
    parts = ["# Commands\n\nWhat `rovgraph COMMAND --help` prints. Exit codes: 0 done, 2 bad input, 3 not trusted.\n"]
    for words in _commands(get_command(app), []):
        shown = CliRunner().invoke(app, [*words, "--help"], env={"TERMINAL_WIDTH": "88", "NO_COLOR": "1"})
        text = "\n".join(line.rstrip() for line in shown.output.strip("\n").splitlines())
        parts.append(f"## {' '.join(['rovgraph', *words])}\n\n```text\n{text}\n```\n")
    return "\n".join(parts)


def _commands(command: click.Command, words: list[str]) -> Iterator[list[str]]:
    yield words
    for name, inner in getattr(command, "commands", {}).items():
        yield from _commands(inner, [*words, name])


def api_reference() -> str:
    """Every public name.

    Raises
    ------
    PluginError : one of them, or a public method, has no docstring
    """
    public = {name: getattr(rg, name) for name in rg.__all__} | dict(_extension_points())
    bare = [where for name, what in public.items() for where in _undocumented(name, what)]
    if bare:
        raise PluginError(f"public names without a docstring: {', '.join(bare)}")
    parts = ["# API, name by name\n\nAll names of `import rovgraph as rg`; [api.md](api.md) shows how they are used.\n"]
    for name in rg.__all__:
        what = getattr(rg, name)
        parts.append(_entry(f"{what.__module__}.{what.__qualname__}", f"rg.{name}"))
    parts.append("# What they return\n")
    parts += [_entry(path, path.rpartition(".")[2]) for path in RETURNED]
    parts.append("# For extensions: rovgraph.extend\n")
    parts += [_entry(f"{what.__module__}.{what.__qualname__}", f"extend.{name}") for name, what in _extension_points()]
    return "\n".join(parts)


def _extension_points() -> Iterator[tuple[str, Any]]:
    """Classes and functions of `rovgraph.extend`, but for `Config`, which stands above."""
    for name in extend.__all__:
        what = getattr(extend, name)
        if (inspect.isclass(what) or inspect.isfunction(what)) and what is not rg.Config:
            yield name, what


def _entry(path: str, heading: str) -> str:
    return f"::: {path}\n    options: {{heading: {heading}, toc_label: {heading}, heading_level: 2}}\n"


def _undocumented(name: str, what: object) -> Iterator[str]:
    """The name, and public methods and properties, that neither have a docstring nor stand among the attributes."""
    about = (what.__doc__ or "").strip()
    if not about:
        yield name
    if inspect.isclass(what) and what.__module__.startswith("rovgraph"):
        for member, value in vars(what).items():
            callable_or_property = inspect.isfunction(value) or isinstance(value, property | classmethod | staticmethod)
            if member.startswith("_") or not callable_or_property or inspect.getdoc(getattr(what, member)):
                continue
            if not re.search(rf"^ *([\w, ]+, )?{member}(, [\w, ]+)? :", about, re.MULTILINE):
                yield f"{name}.{member}"
