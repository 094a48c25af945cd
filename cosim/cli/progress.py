"""Show the progress of a task: a live line in a terminal, else a plain line per stage."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import Progress as Bars
from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

from cosim.cli.console import err
from cosim.core.progress import Progress, time_left_s
from cosim.core.units import duration

REPEAT_S = 30.0
"""Seconds between the lines of a long stage whose share is known, without a terminal."""


@contextmanager
def doing(first: str, console: Console = err) -> Iterator[Progress]:
    """Show a stage on standard error until the block ends, and yield a callback for later stages.

    >>> with doing("reading the city") as progress:
    ...     progress("simulating to 20 s", 0.5)
    """
    if console.is_terminal:
        columns = (
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            TimeElapsedColumn(),
        )
        with Bars(*columns, console=console, transient=True) as bars:
            task = bars.add_task(first, total=None)
            now = first
            began = time.monotonic()

            def move(stage: str, share: float | None = None, /) -> None:
                nonlocal now, began
                if stage != now:
                    now = stage
                    began = time.monotonic()
                bars.update(
                    task, description=stage_in_words(stage, share, time.monotonic() - began)
                )

            yield move
        return
    yield stages_in_lines(console, first)


def stages_in_lines(console: Console = err, first: str = "") -> Progress:
    """Return a callback that prints a line when a stage begins, and more if it takes long."""
    shown = ""
    began = 0.0
    last = 0.0

    def show(stage: str, share: float | None = None, /) -> None:
        nonlocal shown, began, last
        now_s = time.monotonic()
        if stage != shown:
            shown, began, last = stage, now_s, now_s
            console.print(f"{stage} ...", soft_wrap=True, markup=False, highlight=False)
        elif share is not None and now_s - last >= REPEAT_S:
            last = now_s
            words = (
                f"{stage_in_words(stage, share, now_s - began)}, after {duration(now_s - began)}"
            )
            console.print(words, soft_wrap=True, markup=False, highlight=False)

    if first:
        show(first)
    return show


def stage_in_words(stage: str, share: float | None, since_s: float) -> str:
    """Return the text of a stage with its share done and time left.

    share: of the stage that is done, 0 to 1; None if unknown.
    since_s: seconds since the stage began, from which the time left is estimated.
    """
    if share is None:
        return stage
    words = f"{stage}: {100.0 * share:.0f} %"
    left_s = time_left_s(share, since_s)
    return words if left_s is None else f"{words}, about {duration(left_s)} left"
