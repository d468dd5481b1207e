"""A configuration completed by what files know: only where it states nothing itself."""

from collections.abc import Iterator, Mapping
from typing import Any

from rovgraph.config.reading import Config, parse_model


def completed(config: Config, settings: Mapping[str, Any], source: str) -> tuple[Config, dict[str, Any]]:
    """The configuration with the settings that it does not state itself.

    Parameters
    ----------
    settings : keys and values, nested as in YAML
    source : of the settings, for messages

    Returns
    -------
    config : Config
    used : dotted key -> value, of the settings that hold now

    Raises
    ------
    InputError : settings that no configuration may have
    """
    stated = config.model_dump(exclude_unset=True)
    used: dict[str, Any] = {}
    for path, value in leaves(settings):
        section = stated
        for name in path[:-1]:
            section = section.setdefault(name, {})
        if path[-1] not in section:
            section[path[-1]] = value
            used[".".join(path)] = value
    return (parse_model(Config, stated, source), used) if used else (config, {})


def leaves(settings: Mapping[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every path of names with its value.

    >>> list(leaves({"dvl": {"mount_rpy_deg": [180, 0, 0]}, "name": "dive"}))
    [(('dvl', 'mount_rpy_deg'), [180, 0, 0]), (('name',), 'dive')]
    """
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from leaves(value, (*above, str(name)))
        else:
            yield (*above, str(name)), value
