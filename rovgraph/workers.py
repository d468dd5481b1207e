"""Work spread over the machine's cores, in processes that end when they are no longer wanted."""

import contextlib
import multiprocessing
import multiprocessing.process
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.synchronize import Event
from typing import TypeVar

from rovgraph.errors import InputError
from rovgraph.process import ONE_THREAD, be_frugal

Task = TypeVar("Task")
Result = TypeVar("Result")

UNGUARDED = (
    "worker processes ended while they started; they import your script again, so that it has to be a file with its "
    "work under if __name__ == '__main__'"
)


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def workers(count: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that an error or an interrupt within the block ends at once.

    They are started afresh (spawned) with the first tasks, which `submit` has to be given
    within `starting`; what they call has to be importable.

    Raises
    ------
    InputError : a process was killed from outside, or none could start
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):  # a worker, which imports the caller's script
        sys.exit(1)  # quietly: the caller says why
    before = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")
    started = context.Event()
    pool = ProcessPoolExecutor(count, context, _prepare, (started,))
    try:
        yield pool
    except BaseException as error:
        for child in set(multiprocessing.active_children()) - before:
            child.terminate()
        pool.shutdown(cancel_futures=True)  # waits for the pool's own thread, which would complain at exit
        if isinstance(error, BrokenProcessPool):
            killed = "a worker process was killed (out of memory?); try again with fewer of them"
            raise InputError(killed if started.is_set() else UNGUARDED) from None
        raise
    pool.shutdown()
    if not started.is_set():
        raise InputError(UNGUARDED)


@contextlib.contextmanager
def starting() -> Iterator[None]:
    """Around what starts processes: they inherit one thread for each library, and no interrupts."""
    with _environment(ONE_THREAD), _interrupts_held_back():
        yield


def in_workers(
    function: Callable[[Task], Result], tasks: Sequence[Task], jobs: int, progress: Callable[[float], None]
) -> list[Result]:
    """``function`` of every task, in the order of the tasks: in processes of their own, or in this one if one does.

    Parameters
    ----------
    function, tasks : what to do, picklable
    jobs : number of processes
    progress : called with the share of tasks that are done

    Raises
    ------
    InputError : a process was killed from outside, or none could start
    """
    if min(jobs, len(tasks)) == 1:  # a process more would only import everything once more
        results = []
        for done, task in enumerate(tasks, 1):
            results.append(function(task))
            progress(done / len(tasks))
        return results
    with workers(min(jobs, len(tasks))) as pool:
        with starting():
            futures = [pool.submit(function, task) for task in tasks]
        for done, future in enumerate(as_completed(futures), 1):
            future.result()
            progress(done / len(tasks))
        return [future.result() for future in futures]


def _prepare(started: Event) -> None:
    """In a worker: leave interrupts to the parent, and end when the parent has ended, however it did."""
    started.set()
    be_frugal()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_the_parent, daemon=True).start()


def _end_with_the_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextlib.contextmanager
def _environment(changes: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """An interrupt waits for the end of the block; processes started within never see one."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with _interrupts_kept():
            yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _interrupts_kept() -> Iterator[None]:
    """One that another thread takes, a progress bar's, Python handles in the main thread even where that blocks it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL if handler is None else handler)
        if came:
            signal.raise_signal(signal.SIGINT)
