"""Progress of a run on standard error: notices, stages and episodes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import AbstractContextManager, contextmanager, nullcontext
from math import fsum
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from cosim.cli.console import err, notice
from cosim.cli.progress import doing
from cosim.core.progress import Progress as Stages
from cosim.core.progress import time_left_s
from cosim.core.units import duration

if TYPE_CHECKING:
    from cosim.spec.scenario import Scenario
    from scenarios.ipc.messages import MessageHandler
    from scenarios.runs.planning import PlannedRun
    from scenarios.runs.transport import LockedRun


SETUP_M = 30.0
"""Metres of route that take as long to simulate as the start of an episode."""
PACED_SETUP_M = 3.0
"""The same per unit of pace in a paced run, whose episodes take longer while starts do not."""
EPISODE_SHARE = 0.74
"""Share of the episode itself in the work of an episode with a counterfactual."""
BAR_COLUMNS = 12
"""Width of a bar in characters, so that the display fits 80 columns."""


class RemainingWork:
    """Remaining work of a run. An episode weighs its route length plus its start, in metres.

    lengths_m: route length by scenario id.
    setup_m: weight of an episode's start.
    """

    def __init__(self, lengths_m: Mapping[str, float], setup_m: float = SETUP_M) -> None:
        self._lengths_m = lengths_m
        self._setup_m = setup_m
        self._shares: dict[str, float] = {}

    def at(self, scenario: str, share: float) -> None:
        """Record the share of an episode that is done, 0 to 1."""
        self._shares[scenario] = min(share, 1.0)

    @property
    def share(self) -> float:
        """Share of the run that is done, 0 to 1."""
        if not self._lengths_m:
            return 1.0
        done_m = fsum(
            self._setup_m + self._lengths_m[name] * share for name, share in self._shares.items()
        )
        return done_m / fsum(self._setup_m + length_m for length_m in self._lengths_m.values())

    def seconds(self, since_s: float) -> float | None:
        """Return the estimated seconds left after `since_s` seconds; None if it is too early."""
        return time_left_s(self.share, since_s)


class ProgressDisplay:
    """Progress display of a run: a bar for the run and one for each running episode.

    done: ids of the scenarios that were finished before.
    compared: whether each episode has a counterfactual.
    pace: limit of the speed in times real time; 0 for none.
    """

    def __init__(
        self,
        scenarios: Sequence[Scenario],
        done: Set[str],
        *,
        compared: bool = False,
        pace: float = 0.0,
        console: Console = err,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        text = ("{task.description}", "{task.fields[count]}", "{task.fields[note]}")
        name, count, note = (TextColumn(words, markup=False) for words in text)
        self.bars = Progress(
            name, BarColumn(BAR_COLUMNS), count, note, TimeElapsedColumn(), console=console
        )
        lengths_m = {s.id: s.route_line.length_m for s in scenarios if s.id not in done}
        self.left = RemainingWork(
            lengths_m, min(SETUP_M, PACED_SETUP_M * pace) if pace else SETUP_M
        )
        self._scenarios = {s.id: s for s in scenarios}
        self._finished = len(done)
        self._alone = EPISODE_SHARE if compared else 1.0
        self._console = console
        self._clock = clock
        self._began_s = clock()
        self._run_task = self.bars.add_task("episodes", total=1.0, count="", note="")
        self._tasks: dict[str, TaskID] = {}
        self._show()

    def tell(self, message: object) -> None:
        """Update the display by a message of a worker."""
        from scenarios.ipc.messages import Done, EpisodeProgress, Waits

        if isinstance(message, EpisodeProgress) and message.compared is not None:
            self.left.at(message.scenario, self._alone + (1.0 - self._alone) * message.compared)
            self._bar(
                message.scenario,
                message.compared,
                f"{100.0 * message.compared:.0f} %",
                "without the robot",
            )
        elif isinstance(message, EpisodeProgress):
            one = self._scenarios[message.scenario]
            length_m = one.route_line.length_m
            share = max(message.route_s_m / length_m, message.time_s / one.time_limit_s)
            self.left.at(one.id, self._alone * share)
            count = f"{message.route_s_m:.0f}/{length_m:.0f} m"
            note = f"simulated {message.time_s:.0f} s, {message.failures} failures"
            self._bar(one.id, message.route_s_m / length_m, count, note)
        elif isinstance(message, Waits):
            self._console.print(
                f"{message.scenario}: {message.reason}",
                soft_wrap=True,
                highlight=False,
                markup=False,
            )
        elif isinstance(message, Done):
            task = self._tasks.pop(message.scenario, None)
            if task is not None:
                self.bars.remove_task(task)
            self.left.at(message.scenario, 1.0)
            self._finished += 1
            rest = self._time_left()
            words = (
                f"{message.scenario}: {message.status}, {self._finished} of {len(self._scenarios)}"
            )
            self._console.print(
                f"{words}; {rest}" if rest else words, highlight=False, markup=False
            )
        self._show()

    def _bar(self, scenario: str, share: float, count: str, note: str) -> None:
        if scenario not in self._tasks:
            self._tasks[scenario] = self.bars.add_task(
                f"  {scenario}", total=1.0, count="", note=""
            )
        self.bars.update(self._tasks[scenario], completed=share, count=count, note=note)

    def _show(self) -> None:
        count = f"{self._finished}/{len(self._scenarios)}"
        self.bars.update(
            self._run_task, completed=self.left.share, count=count, note=self._time_left()
        )

    def _time_left(self) -> str:
        """Return the time left in words; "" while it is unknown, and at the end."""
        left_s = self.left.seconds(self._clock() - self._began_s)
        return "" if left_s is None or left_s < 0.5 else f"about {duration(left_s)} left"


class EpisodeBars:
    """Reporter (`scenarios.runs.run.Reporter`) that shows notices, stages and episodes."""

    def say(self, words: str) -> None:
        """Print a notice."""
        notice(words)

    def stage(self, words: str) -> AbstractContextManager[Stages]:
        """Show a stage."""
        return doing(words)

    def planned(self, plan: PlannedRun) -> None:
        """Accept the plan."""

    def opening(self, plan: PlannedRun, folder: Path) -> AbstractContextManager[None]:
        """Write no log."""
        return nullcontext()

    @contextmanager
    def running(self, plan: PlannedRun, run: LockedRun) -> Iterator[MessageHandler]:
        """Show the progress of the episodes."""
        board = ProgressDisplay(
            plan.scenarios, {one.id for one in plan.scenarios} - {one.id for one in run.todo}
        )
        with board.bars:
            yield board.tell
