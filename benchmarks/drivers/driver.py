"""What the drivers have in common: a command by its name, its answer as JSON, processor time.

A driver is run with PYTHONPATH at the checkout whose package it measures.
"""

import json
import os
import resource
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import rovgraph


def processor() -> float:
    """Processor time of this process and of its children that have ended [s]."""
    spent = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(s.ru_utime + s.ru_stime for s in spent)


def run(commands: Mapping[str, Callable[..., Any]]) -> None:
    """Call the command that the arguments name, with the others, and print what it returns."""
    assert Path(rovgraph.__file__).parents[1] == Path(os.environ["PYTHONPATH"]).resolve(), rovgraph.__file__
    name, *given = sys.argv[1:]
    print(json.dumps(commands[name](*given)))
