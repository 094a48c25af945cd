"""The progress display of a run."""

from __future__ import annotations

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

err = Console(stderr=True)


class Board:
    """The progress display of a run: one bar for the suite, one for each episode under way."""

    def __init__(self, total: int, done: int, lengths_m: dict[str, float]) -> None:
        self.bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=err,
        )
        self._lengths_m = lengths_m
        self._all = self.bars.add_task("episodes", total=total, completed=done, note="")
        self._tasks: dict[str, TaskID] = {}

    def tell(self, message: object) -> None:
        """Take in what a worker says."""
        from scenarios.messages import Compares, Done, Waits
        from scenarios.messages import Progress as Report

        if isinstance(message, Report):
            task = self._tasks.get(message.scenario)
            if task is None:
                length_m = round(self._lengths_m[message.scenario])
                task = self.bars.add_task(f"  {message.scenario}", total=length_m, note="")
                self._tasks[message.scenario] = task
            note = f"m  {message.time_s:.0f} s simulated, {message.failures} failures"
            self.bars.update(task, completed=round(message.route_s_m), note=note)
        elif isinstance(message, Compares):
            if message.scenario in self._tasks:
                note = f"m  the street without the robot: {100.0 * message.share:.0f} %"
                self.bars.update(self._tasks[message.scenario], note=note)
        elif isinstance(message, Waits):
            err.print(f"{message.scenario}: {message.reason}", soft_wrap=True, highlight=False, markup=False)
        elif isinstance(message, Done):
            task = self._tasks.pop(message.scenario, None)
            if task is not None:
                self.bars.remove_task(task)
            self.bars.advance(self._all)
            err.print(f"{message.scenario}: {message.status}")
