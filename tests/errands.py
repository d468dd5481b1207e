"""What the tests give to other processes; light, since each of them has to load it."""

import os
import signal
from pathlib import Path


def errand(task):
    """A number's square; 2 kills its process the first time, 9 each time, 5 raises once, 7 each time; marks in a folder."""
    number, marks = task
    mark = Path(marks) / str(number)
    again = mark.exists()
    mark.touch()
    if number == 9 or (number == 2 and not again):
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 7 or (number == 5 and not again):
        raise OSError("the disk was busy")
    return number * number
