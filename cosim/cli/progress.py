"""How the command line says what takes its time: a moving line in a terminal, a plain line for each
stage elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from cosim.cli.console import err
from cosim.core.telling import Tell, duration

_SURE = 0.03
_SURE_S = 3.0
"""Of less of a stage than this share, or after less time, nothing is concluded."""
AGAIN_S = 30.0
"""Without a terminal a stage whose share is known gets a further line after this time, and so
on."""


@contextmanager
def doing(first: str, console: Console = err) -> Iterator[Tell]:
    """Say on standard error what is being done until the block ends; the block tells when it comes
    to the next stage.

    >>> with doing("reading the city") as tell:
    ...     tell("simulating to 20 s", 0.5)
    """
    if console.is_terminal:
        columns = (
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            TimeElapsedColumn(),
        )
        with Progress(*columns, console=console, transient=True) as bars:
            task = bars.add_task(first, total=None)
            now = first
            began = time.monotonic()

            def move(stage: str, share: float | None = None) -> None:
                nonlocal now, began
                if stage != now:
                    now = stage
                    began = time.monotonic()
                bars.update(
                    task, description=stage_in_words(stage, share, time.monotonic() - began)
                )

            yield move
        return
    said = ""
    began = 0.0
    last = 0.0

    def tell(stage: str, share: float | None = None) -> None:
        nonlocal said, began, last
        now_s = time.monotonic()
        if stage != said:
            said, began, last = stage, now_s, now_s
            console.print(f"{stage} ...", soft_wrap=True, markup=False, highlight=False)
        elif share is not None and now_s - last >= AGAIN_S:
            last = now_s
            words = (
                f"{stage_in_words(stage, share, now_s - began)}, after {duration(now_s - began)}"
            )
            console.print(words, soft_wrap=True, markup=False, highlight=False)

    tell(first)
    yield tell


def stage_in_words(stage: str, share: float | None, since_s: float) -> str:
    """A stage, how much of it is done, and how long the rest takes, judged by the `since_s` seconds
    it took so far."""
    if share is None:
        return stage
    words = f"{stage}: {100.0 * share:.0f} %"
    if share < _SURE or since_s < _SURE_S:
        return words
    return f"{words}, about {duration(since_s * (1.0 - share) / share)} left"
