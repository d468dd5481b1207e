"""What the tests give to other processes; light, since each of them has to load it."""

import os
import signal
from pathlib import Path


def errand(task):
    """A number's square, with a folder for marks; 2 kills its process once, 9 always, 5 raises once, 7 always."""
    number, marks = task
    mark = Path(marks) / str(number)
    again = mark.exists()
    mark.touch()
    if number == 9 or (number == 2 and not again):
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 7 or (number == 5 and not again):
        raise OSError("the disk was busy")
    return number * number
