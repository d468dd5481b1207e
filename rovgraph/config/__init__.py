"""The configuration: YAML, every key optional, an unknown key is an error.

`Config` holds what an estimator believes about the vehicle, its sensors and the sea.
`load_config` reads a file, `Config.to_yaml` writes the effective one, `describe` lists
all keys, `beliefs` gives the calibration variables of `rovgraph.calibration` their priors.
"""

from rovgraph.config.completion import completed
from rovgraph.config.reading import (
    Config,
    beliefs,
    config_or_defaults,
    describe,
    load_config,
    mount_matrix,
    parse_config,
    parse_model,
    read_yaml,
    register_settings,
    unregister_settings,
    with_priors_stated,
    yaml_text,
)
from rovgraph.config.sections import AS_WRITTEN, FileSettings, ImuNoise, Mag, SensorSettings, TableSettings

__all__ = [
    "AS_WRITTEN",
    "Config",
    "FileSettings",
    "ImuNoise",
    "Mag",
    "SensorSettings",
    "TableSettings",
    "beliefs",
    "completed",
    "config_or_defaults",
    "describe",
    "load_config",
    "mount_matrix",
    "parse_config",
    "parse_model",
    "read_yaml",
    "register_settings",
    "unregister_settings",
    "with_priors_stated",
    "yaml_text",
]
