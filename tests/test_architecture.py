"""Imports go downwards only, heavy libraries stay where they belong, and help loads few modules."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import rovgraph

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "rovgraph"

# Bottom first, the package itself among them. Members of one layer are independent: they may not import each other.
LAYERS = (
    {"errors", "process", "_version"},
    {"compatibility", "distributions", "geometry"},
    {"dates"},
    {"kernels"},
    {"model"},
    {"sensors"},
    {"log"},
    {"rules"},
    {"problem"},
    {"inference"},
    {"simulate"},
    {"diagnosis"},
    {"dive", "readers"},
    {"live", "lab"},
    {"report", "web"},
    {"api", "extend"},
    {"rovgraph"},  # the package itself, which promises the names of the API
    {"cli"},
)
LEVEL = {member: level for level, members in enumerate(LAYERS) for member in members}

# library -> the only package that may import it
CONFINED = {
    "gtsam": "inference.graph",
    "numba": "kernels",
    "matplotlib": "report",
    "jinja2": "report.pages",
    "typer": "cli",
    "starlette": "web",
    "uvicorn": "web",
}
HEAVY = {"numba", "numpy", "scipy", "pandas", "gtsam", "matplotlib", "jinja2"}


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}
del MODULES["rovgraph.__main__"]  # calls the command line; nothing imports it


def for_types_only(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) in {"TYPE_CHECKING", "typing.TYPE_CHECKING"}


def imported(tree: ast.AST, package: str, types_too: bool) -> set[str]:
    """Names of all modules that a syntax tree imports, inside functions too.

    For ``from a import b`` this is ``a.b`` where that is a module of ours, and ``a`` otherwise.
    """
    found: set[str] = set()
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
            base = ".".join([*parents, *([node.module] if node.module else [])])
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                found.add(inner if inner in MODULES else base)
        elif types_too or not for_types_only(node):
            found |= imported(node, package, types_too)
        else:
            found |= set().union(*(imported(branch, package, types_too) for branch in node.orelse))
    return found


def imports_of(name: str, types_too: bool = True) -> set[str]:
    path = MODULES[name]
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    return imported(ast.parse(path.read_text(encoding="utf-8")), package, types_too)


GRAPH = {name: imports_of(name) for name in MODULES}


def member(name: str) -> str:
    """The part of a name that has a layer: ``log`` of ``rovgraph.log.rows``; the package itself has one, too."""
    return name.split(".")[1] if "." in name else name


def first_party(names: set[str]) -> set[str]:
    """Our own modules among imported names."""
    return {n for n in names if n.split(".")[0] == "rovgraph"}


def test_every_module_has_a_layer():
    assert {member(name) for name in MODULES} == set(LEVEL)


@pytest.mark.parametrize("name", MODULES)
def test_imports_go_downwards_only(name):
    own = member(name)
    wrong = {other for other in first_party(GRAPH[name]) if member(other) != own and LEVEL[member(other)] >= LEVEL[own]}
    assert not wrong, f"{name} ({own}) imports {sorted(wrong)}, which do not stand below it"


def test_no_cycles():
    """Within a package too; a package's ``__init__`` counts as what it imports."""
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, "cycle: " + " -> ".join([*path[path.index(name) :], name])
        if name not in done:
            for other in sorted(first_party(GRAPH[name])):
                visit(other, (*path, name))
            done.add(name)

    for name in MODULES:
        visit(name, ())


@pytest.mark.parametrize(("library", "owner"), CONFINED.items())
def test_a_library_stays_with_its_owner(library, owner):
    users = {name for name, names in GRAPH.items() if any(n.split(".")[0] == library for n in names)}
    strangers = {name for name in users if not f"{name}.".startswith(f"rovgraph.{owner}.")}
    assert users, f"nothing imports {library}"
    assert not strangers, f"only rovgraph/{owner} imports {library}"


def test_a_kernel_is_called_from_python_or_by_its_address_but_linked_into_none():
    """The cache keeps no more of it than its machine code; what kernels share is a helper."""
    trees = {path.stem: ast.parse(path.read_text(encoding="utf-8")) for path in (PACKAGE / "kernels").glob("*.py")}
    functions = [node for tree in trees.values() for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]

    def decorated(node: ast.FunctionDef, by: str) -> bool:
        names = (d.func if isinstance(d, ast.Call) else d for d in node.decorator_list)
        return any(isinstance(name, ast.Name) and name.id == by for name in names)

    kernels = {node.name for node in functions if decorated(node, "kernel")}
    compiled = [node for node in functions if any(decorated(node, by) for by in ("kernel", "helper", "view_helper"))]
    assert len(kernels) > 20 and len(compiled) > 100
    for node in compiled:
        arguments = {argument.arg for argument in node.args.args}  # a kernel's address among them
        called = {c.func.id for c in ast.walk(node) if isinstance(c, ast.Call) and isinstance(c.func, ast.Name)}
        assert not (called - arguments) & kernels, node.name


def test_no_drawers():
    """A module is named after what it is about."""
    vague = {"utils", "util", "common", "helpers", "misc", "tools"}
    assert not vague & {part for name in MODULES for part in name.split(".")}


def test_the_package_lists_all_layers_in_their_order():
    listed = rovgraph.__doc__.rpartition("----\n")[2].strip().rstrip(".").split("/")
    assert [set(re.findall(r"\w+", members)) for members in listed] == list(reversed(LAYERS))


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)


def test_importing_the_package_loads_nothing_of_it_and_no_library():
    """What a program pays for ``import rovgraph``; everything else is paid for by its first use."""
    done = run("import sys; before = set(sys.modules); import rovgraph; print(*(set(sys.modules) - before))")
    loaded = set(done.stdout.split())
    assert "rovgraph" in loaded, done.stderr
    assert {name.split(".")[0] for name in loaded} - sys.stdlib_module_names == {"rovgraph"}
    assert first_party(loaded) == {"rovgraph", "rovgraph._version"}
    assert len(loaded) <= 10


HELP = """
import sys
from rovgraph.cli import app
sys.argv = ["rovgraph", *{arguments!r}]
try:
    app.main()
except SystemExit as stop:
    assert not stop.code
print("MODULES", *sys.modules)
"""


@pytest.mark.parametrize(
    "command",
    [
        [],
        ["demo"],
        ["smooth"],
        ["online"],
        ["report"],
        ["evaluate"],
        ["compare"],
        ["check"],
        ["config"],
        ["convert"],
        ["simulate"],
        ["observe"],
        ["plan"],
        ["calibrate"],
        ["calibrate", "magnetometer"],
        ["calibrate", "noise"],
        ["study"],
        ["study", "misalignment"],
    ],
)
def test_help_loads_nothing_heavy(command):
    done = run(HELP.format(arguments=[*command, "--help"]))
    assert done.returncode == 0, done.stderr
    assert "Usage: rovgraph" in done.stdout
    loaded = set(done.stdout.rpartition("MODULES ")[2].split())
    assert sorted(loaded & HEAVY) == []


def test_smoothing_a_log_of_a_healthy_dive_loads_no_library_that_it_does_not_need(tmp_path):
    log, config = (ROOT / "data" / "falcon" / name for name in ("log.csv.gz", "config.yaml"))
    arguments = ["smooth", str(log), "--config", str(config), "--out", str(tmp_path / "out"), "--no-figures"]
    done = run(HELP.format(arguments=[*arguments, "--estimate", "smoothed"]))
    assert done.returncode == 0, done.stderr
    loaded = set(done.stdout.rpartition("MODULES ")[2].split())
    assert "numba" in loaded
    assert sorted(loaded & {"gtsam", "matplotlib", "scipy.optimize", "scipy.signal", "scipy.stats"}) == []


PLAIN = """
import sys
import typer
app = typer.Typer(add_completion=False)
app.command()(lambda: None)
sys.argv = ["plain", "--help"]
try:
    app()
except SystemExit:
    pass
print("MODULES", *sys.modules)
"""


def test_help_loads_what_typer_does_and_the_commands_only():
    """Help is instant: a bare typer program loads every library that it loads."""

    def loaded(code: str) -> set[str]:
        return set(run(code).stdout.rpartition("MODULES ")[2].split())

    names, plain = loaded(HELP.format(arguments=["--help"])), loaded(PLAIN)
    assert {member(name) for name in first_party(names)} == {"cli", "errors", "process", "rovgraph", "_version"}
    libraries = {name.split(".")[0] for name in names} - sys.stdlib_module_names - {"rovgraph"}
    assert libraries <= {name.split(".")[0] for name in plain}
    modules = [name for name in names if name.split(".")[0] in libraries]
    assert len(modules) <= 1.2 * len([name for name in plain if name.split(".")[0] in libraries])
