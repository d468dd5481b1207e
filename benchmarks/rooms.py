"""What can be counted in the text of a checkout: its modules, who imports whom, lines, parameters, names of classes.

Only the standard library: nothing of the package is imported. Imports count wherever they stand, inside functions
and for type checkers too, and the root package is a module as any other. ``from a import b`` imports a.b where
that is a module, and a otherwise.
"""

import ast
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

ARCHITECTURE = Path("tests") / "test_architecture.py"  # whose LAYERS are the layers of its checkout, bottom first


@dataclass(frozen=True)
class Rooms:
    """The package in a checkout's folder ``root``."""

    root: Path
    package: str = "rovgraph"

    @cached_property
    def sources(self) -> dict[str, str]:
        """Text of each module by its path in the package."""
        folder = self.root / self.package
        return {str(path.relative_to(folder)): path.read_text() for path in sorted(folder.rglob("*.py"))}

    @cached_property
    def trees(self) -> dict[str, ast.Module]:
        """By the name of a module."""
        return {self.name_of(path): ast.parse(text) for path, text in self.sources.items()}

    def name_of(self, path: str) -> str:
        """Of the module at a path in the package."""
        parts = (self.package, *Path(path).with_suffix("").parts)
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)

    def lines(self, *globs: str) -> int:
        """Of modules."""
        named = [name for name in self.sources if any(Path(name).match(glob) for glob in globs)]
        return sum(len(self.sources[name].splitlines()) for name in named)

    @cached_property
    def longest(self) -> int:
        """Lines of the longest module."""
        return max(len(text.splitlines()) for text in self.sources.values())

    @cached_property
    def parameters(self) -> list[int]:
        """How many each function has, without self and cls, most first; options of `cli` and `api` are not counted."""
        inside = [tree for name, tree in self.trees.items() if name.split(".")[1:2] not in (["cli"], ["api"])]
        return sorted((count for tree in inside for count in _parameters(tree)), reverse=True)

    @cached_property
    def imports(self) -> dict[str, set[str]]:
        """The other modules of the package that each imports."""
        out = {}
        for path in self.sources:
            name = self.name_of(path)
            within = name if path.endswith("__init__.py") else name.rpartition(".")[0]
            out[name] = (set(_imported(self.trees[name], within, self.trees)) & self.trees.keys()) - {name}
        return out

    @property
    def with_one_importer(self) -> int:
        """Modules that exactly one other module imports."""
        importers = Counter(other for others in self.imports.values() for other in others)
        return sum(count == 1 for count in importers.values())

    @property
    def in_cycles(self) -> int:
        """Modules that import themselves by way of others."""
        reached = {name: _reached(name, self.imports) for name in self.imports}
        return sum(name in others for name, others in reached.items())

    @property
    def upwards(self) -> int | None:
        """Imports of what is in no lower layer. The root, which exports the API, stands between it and the commands.

        None where the layers are not found.
        """
        layers = _layers(self.root / ARCHITECTURE)
        if layers is None:
            return None
        level: dict[str, float] = {member: n for n, members in enumerate(layers) for member in members}
        level |= {"": level["cli"] - 0.5, "__main__": len(layers)}
        of = {name: (*name.split("."), "")[1] for name in self.imports}  # the part of a name that has a layer
        pairs = ((of[name], of[other]) for name, others in self.imports.items() for other in others)
        return sum(own != other and level[other] >= level[own] for own, other in pairs)

    @property
    def shared_class_names(self) -> tuple[int, int]:
        """Names of more than one class at the top of a module: of all classes, and of those without underscore."""
        of = Counter(n.name for tree in self.trees.values() for n in tree.body if isinstance(n, ast.ClassDef))
        shared = [name for name, count in of.items() if count > 1]
        return len(shared), sum(not name.startswith("_") for name in shared)


def _parameters(tree: ast.Module) -> Iterator[int]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            a = node.args
            names = [one.arg for one in (*a.posonlyargs, *a.args, *a.kwonlyargs)]
            yield len(names) - (names[:1] in (["self"], ["cls"])) + (a.vararg is not None) + (a.kwarg is not None)


def _imported(tree: ast.Module, within: str, modules: Mapping[str, object]) -> Iterator[str]:
    """Names of modules that a module of the package ``within`` imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = within.split(".")
            parents = above[: len(above) + 1 - node.level] if node.level else []
            base = ".".join([*parents, *([node.module] if node.module else [])])
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                yield inner if inner in modules else base


def _reached(name: str, imports: Mapping[str, set[str]]) -> set[str]:
    """Modules that an import of a module leads to."""
    reached: set[str] = set()
    left = list(imports[name])
    while left:
        other = left.pop()
        if other not in reached:
            reached.add(other)
            left += imports[other]
    return reached


def _layers(path: Path) -> tuple[set[str], ...] | None:
    if not path.exists():
        return None
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "LAYERS":
            return tuple(ast.literal_eval(node.value))
    return None
