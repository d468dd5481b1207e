"""A piece of configuration: the keys that a calibration found, as YAML and within a whole configuration."""

from collections.abc import Mapping, Sequence
from typing import Any

from rovgraph.model.config import Config, yaml_text

Piece = Mapping[str, Any]


def piece_yaml(piece: Piece, remarks: Sequence[str]) -> str:
    """A piece as YAML that is a configuration by itself, under remarks."""
    return "".join(f"# {line}\n" for line in remarks) + yaml_text(dict(piece))


def with_piece(config: Config, piece: Piece) -> Config:
    """A configuration with the keys of a piece in the place of its own."""
    return Config.model_validate(_merged(config.model_dump(exclude_unset=True), piece))


def digits(value: float, count: int = 4) -> float:
    """A number as it is written into a piece, to a number of significant digits."""
    return float(f"{value:.{count}g}")


def _merged(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    out = dict(old)
    for key, value in new.items():
        inner = out.get(key)
        out[key] = _merged(inner if isinstance(inner, Mapping) else {}, value) if isinstance(value, Mapping) else value
    return out
