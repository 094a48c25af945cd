"""How the command line says what takes its time: a moving line in a terminal, a plain line for each stage elsewhere."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from cosim.telling import Tell

err = Console(stderr=True)


@contextmanager
def doing(first: str, console: Console = err) -> Iterator[Tell]:
    """Say on standard error what is being done until the block ends; the block tells when it comes to the next stage.

    >>> with doing("reading the city") as tell:
    ...     tell("simulating to 20 s", 0.5)
    """
    if console.is_terminal:
        columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
        with Progress(*columns, console=console, transient=True) as bars:
            task = bars.add_task(first, total=None)
            yield lambda stage, share=None: bars.update(task, description=_in_words(stage, share))
        return
    said = ""

    def tell(stage: str, share: float | None = None) -> None:
        nonlocal said
        if stage != said:
            said = stage
            console.print(f"{stage} ...", soft_wrap=True, markup=False, highlight=False)

    tell(first)
    yield tell


def _in_words(stage: str, share: float | None) -> str:
    return stage if share is None else f"{stage}: {100.0 * share:.0f} %"
