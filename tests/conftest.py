"""What holds for all tests."""

import importlib
import os
import signal

import pytest
from hypothesis import HealthCheck, settings

# how long an example takes says something about the machine only; the same examples each time, so that a failure stays
SAME = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True)
settings.register_profile("any machine", SAME)
settings.register_profile("other examples", SAME, derandomize=False, database=None)  # --hypothesis-profile
settings.load_profile("any machine")

os.environ.pop("COLUMNS", None)  # or commands would fold their sentences

# whoever starts the tests in the background has them ignore SIGINT, and so would every command that they interrupt
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_configure(config: pytest.Config) -> None:
    """Kernels are compiled once, before there are workers that would each do it."""
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        importlib.import_module("rovgraph.kernels.filtering")


LONGEST = ("test_consistency", "test_online", "test_thesis_study", "test_compare", "test_batch", "test_fixed_lag")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The files that take longest come first, so that no worker is left with one of them at the end."""
    place = {name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(LONGEST)))
