"""A run whose notices, stages and episodes are shown on standard error."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from cosim.cli.console import err
from cosim.cli.progress import doing
from cosim.cli.run_progress import Board
from cosim.core.telling import Tell

if TYPE_CHECKING:
    from scenarios.ipc.messages import Hear
    from scenarios.runs.planning import PlannedRun
    from scenarios.runs.transport import HeldRun


def notice(words: str) -> None:
    """Print a notice in a line on standard error."""
    err.print(words, soft_wrap=True, markup=False, highlight=False)


class EpisodeBars:
    """Shows notices, stages and the progress of episodes (`scenarios.runs.run.Reporter`)."""

    def say(self, words: str) -> None:
        """Print a notice."""
        notice(words)

    def stage(self, words: str) -> AbstractContextManager[Tell]:
        """Show a stage that takes its time."""
        return doing(words)

    def planned(self, plan: PlannedRun) -> None:
        """Check nothing more."""

    def opening(self, plan: PlannedRun, folder: Path) -> AbstractContextManager[None]:
        """Keep no log."""
        return nullcontext()

    @contextmanager
    def running(self, plan: PlannedRun, run: HeldRun) -> Iterator[Hear]:
        """Show how far each episode is."""
        board = Board(plan.picked, {one.id for one in plan.picked} - {one.id for one in run.todo})
        with board.bars:
            yield board.tell
