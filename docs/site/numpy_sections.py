"""Let griffe read our docstrings: ``name : what it is`` describes a name whose type stands in the signature."""

import re

from griffe import Extension, Object

SECTIONS = re.compile(
    r"^(?P<head>[ ]*(?:Parameters|Attributes|Returns|Yields|Raises|Warns)\n[ ]*-+\n)(?P<body>(?:(?!\n\n|\n[ ]*\n).)*)",
    re.MULTILINE | re.DOTALL,
)
ENTRY = re.compile(r"^(\*{0,2}\w[\w, ]*?) : (.+)$", re.MULTILINE)


def described(section: re.Match[str]) -> str:
    """Its entries with the description on a line of its own, each name by itself."""

    def entry(line: re.Match[str]) -> str:
        return "\n".join(f"{name.strip()}\n    {line[2]}" for name in line[1].split(","))

    return section["head"] + ENTRY.sub(entry, section["body"])


class NumpySections(Extension):
    """Rewrites each docstring before it is parsed."""

    def on_object(self, *, obj: Object, **kwargs: object) -> None:
        if obj.docstring is not None:
            obj.docstring.value = SECTIONS.sub(described, obj.docstring.value)
