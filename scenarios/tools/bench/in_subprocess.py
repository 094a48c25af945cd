"""Work in a process of its own, whatever becomes of it."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from cosim.core.errors import EngineError


def alone(work: Callable[[Any], Any], size: float) -> Any:
    """Run `work(size)` in a fresh process. Raises what it raises there, EngineError when its
    process dies."""
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_into, args=(theirs, work, size), daemon=True)
    process.start()
    theirs.close()
    try:
        found = mine.recv()
    except EOFError:
        process.join()
        code = process.exitcode or 0
        how = (
            f"was killed by {signal.Signals(-code).name}"
            if code < 0
            else f"ended with exit code {code}"
        )
        raise EngineError(f"the process that draws or measures it {how}") from None
    finally:
        process.kill()
        process.join()
    if isinstance(found, Exception):
        raise found
    return found


def _into(pipe: Connection, work: Callable[[Any], Any], size: float) -> None:
    """Send what `work(size)` gives or raises."""
    try:
        found = work(size)
    except Exception as error:  # noqa: BLE001  it is raised again where the work was given out
        found = error
    pipe.send(found)
