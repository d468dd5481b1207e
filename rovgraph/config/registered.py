"""Sections of the configuration that grow with what is registered.

A section gets its keys when its class is made; `add_key` and `remove_key` change them afterwards, and those of all
that has the section inside.
"""

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from rovgraph.config.sections import Section


def add_key(section: type[BaseModel], key: str, entry: type[BaseModel]) -> None:
    """Let a section have one key more, a section of its own that is all defaults.

    Raises
    ------
    ValueError : the section has that key already
    """
    if key in section.model_fields:
        raise ValueError(f"{section.__name__} has the key {key!r} already")
    section.model_fields[key] = FieldInfo(annotation=entry, default_factory=entry)
    _rebuild(section)


def remove_key(section: type[BaseModel], key: str) -> None:
    """Take a key out again."""
    del section.model_fields[key]
    _rebuild(section)


def _rebuild(section: type[BaseModel]) -> None:
    """Validate a section by the keys that it has now, wherever it stands."""
    section.model_rebuild(force=True)
    changed: list[object] = [section]
    for model in Section.__subclasses__():  # in the order of their making: what is inside another comes first
        if any(field.annotation is one for field in model.model_fields.values() for one in changed):
            model.model_rebuild(force=True)
            changed.append(model)
