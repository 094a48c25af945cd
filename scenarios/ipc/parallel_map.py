"""Map of a function over items by several processes, in order."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from multiprocessing import get_context
from typing import TypeVar

from cosim.core.errors import MachineError
from cosim.core.progress import Progress

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def parallel_map(
    function: Callable[[_Item], _Result],
    items: Sequence[_Item],
    jobs: int,
    progress: Progress,
    stage: str,
) -> Iterator[_Result]:
    """Yield the result of each item in order; a single process is this one.

    stage: what is done, for progress and errors, such as "drawing scenarios".

    Raises MachineError if a process is killed.
    """
    with ExitStack() as stack:
        if min(jobs, len(items)) > 1:
            pool = ProcessPoolExecutor(jobs, get_context("spawn"), initializer=_ignore_ctrl_c)
            stack.callback(pool.shutdown, cancel_futures=True)
            results = pool.map(function, items)
        else:
            results = map(function, items)
        for number in range(len(items)):
            progress(stage, number / len(items))
            try:
                result = next(results)
            except BrokenProcessPool as error:
                raise MachineError(
                    f"{stage}: a process was ended: is there enough memory?"
                ) from error
            yield result


def _ignore_ctrl_c() -> None:
    """Ignore Ctrl-C in this process; its parent ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
