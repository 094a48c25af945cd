"""Show a run in a terminal: its plan, progress and results."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from cosim.cli.console import err, logged, notice, out
from cosim.cli.options import NO_OPENGL, check_rerun, connect_options, write_rerun
from cosim.cli.run_progress import EpisodeBars, ProgressDisplay
from cosim.cli.run_table import kinds_of, print_by_kind, print_next_commands, print_table
from cosim.core.errors import INTERRUPTED, SOME_CRASHED
from cosim.results.run_folder import read_records
from cosim.results.throughput import Throughput, ThroughputTimer
from cosim.spec.connection import Connection
from cosim.spec.episode_id import episode_id_of
from cosim.spec.run_config import RunConfig

if TYPE_CHECKING:
    from pandas import DataFrame

    from scenarios.ipc.messages import MessageHandler
    from scenarios.runs.planning import PlannedRun
    from scenarios.runs.run import WorkerConnection
    from scenarios.runs.transport import LockedRun

_MAX_CRASHED = 5
"""Largest number of crashed episodes that are named when a run is resumed."""
_EXAMPLE_PEDESTRIAN = '{"id": "eve", "path": [{"ahead": 15, "left": 1}]}'


def run_in_terminal(config: RunConfig, workers: WorkerConnection | None = None) -> None:
    """Run a config in this terminal, and exit with the code of its results.

    workers: connection to workers on other machines; None for this machine.
    """
    terminal = Terminal(config, runs_here=workers is None and not config.on)
    with _noticed_if_not_begun(config.out):
        from scenarios.runs.run import execute_run

        table = execute_run(config, reporter=terminal, workers=workers)
    _print_end(terminal, table)


class Terminal(EpisodeBars):
    """Reporter that shows a run in this terminal.

    runs_here: whether its episodes run in processes of this machine.
    plan, folder: set when the run opens.
    figures: throughput, set when it ends.
    """

    plan: PlannedRun
    folder: Path
    figures: Throughput | None = None

    def __init__(self, config: RunConfig, *, runs_here: bool) -> None:
        self._config = config
        self._runs_here = runs_here
        self._counts: dict[str, int] = {}

    def planned(self, plan: PlannedRun) -> None:
        """Check that a requested recording is possible, and print if OpenGL is missing."""
        sees = plan.caller.manifest.camera is not None
        if sees and self._config.camera == "auto" and plan.options.camera == "bullet":
            err.print(NO_OPENGL)
        check_rerun(self._config.rerun, len(plan.scenarios))

    @contextmanager
    def opening(self, plan: PlannedRun, folder: Path) -> Iterator[None]:
        """Log the run."""
        self.plan = plan
        self.folder = folder
        with logged(self._config.log_level, self._config.log_json) as counts:
            self._counts = counts
            yield

    @contextmanager
    def running(self, plan: PlannedRun, run: LockedRun) -> Iterator[MessageHandler]:
        """Show the progress of episodes and, after Ctrl-C, the command that continues."""
        from scenarios.runs.eta import recording_durations

        config = self._config
        self._print_beginning(plan, run)
        done = {one.id for one in plan.scenarios} - {one.id for one in run.todo}
        board = ProgressDisplay(
            plan.scenarios, done, compared=config.counterfactual, pace=config.pace
        )
        going = ThroughputTimer(run.folder.path, [one.id for one in run.todo], self._counts)
        try:
            with ExitStack() as stack:
                stack.callback(going.end)
                if self._runs_here:
                    stack.enter_context(
                        recording_durations(run.folder, run.todo, config.jobs or 1, config.pace)
                    )
                stack.enter_context(board.bars)
                yield board.tell
        except KeyboardInterrupt:
            self._print_how_to_continue(plan, len(run.folder.finished_ids()))
            raise typer.Exit(INTERRUPTED) from None
        self.figures = going.figures

    def _print_beginning(self, plan: PlannedRun, run: LockedRun) -> None:
        from scenarios.runs.eta import announcement

        config = self._config
        seed = plan.options.seed
        err.print(
            f"Seed {seed}: the episode ids and seeds that the policy gets are drawn from it.",
            highlight=False,
        )
        for note in run.folder.notes:
            notice(note)
        if done := len(run.scenarios) - len(run.todo):
            err.print(f"{done} of {len(run.scenarios)} episodes are finished already.")
            _print_crashed(run)
        if run.todo and self._runs_here:
            jobs = config.jobs or 1
            words = announcement(
                run.todo,
                plan.policy,
                plan.spec.setup.renderer,
                jobs,
                config.counterfactual,
                config.pace,
            )
            err.print(words, soft_wrap=not err.is_terminal, highlight=False, markup=False)
        if config.ends.live is not None and run.todo:
            _print_live_commands(
                config.ends.live, run, several=(config.jobs or 1) > 1, paced=config.pace > 0.0
            )

    def _print_how_to_continue(self, plan: PlannedRun, finished: int) -> None:
        again = shlex.join(word for word in sys.argv[1:] if word != "--resume")
        again += "" if self._config.out else f" --out {shlex.quote(str(self.folder))}"
        err.print(
            f"Stopped. {finished} of {len(plan.scenarios)} episodes are finished and stored in "
            f"{self.folder}."
        )
        err.print(f"Continue with: cosim {again} --resume", soft_wrap=True)


def _print_crashed(run: LockedRun) -> None:
    """Print how to run the crashed episodes of a resumed run again, if there are any."""
    records = read_records(run.folder.path)
    crashed = sorted(one.scenario.id for one in records if one.status == "crashed")
    if crashed:
        chosen = " ".join(f"--scenario {name}" for name in crashed[:_MAX_CRASHED])
        more = " ..." if len(crashed) > _MAX_CRASHED else ""
        notice(
            f"{len(crashed)} of them crashed, which is a result: --resume does not repeat them. To "
            f"run them again, begin another run with {chosen}{more} and another --out."
        )


def _print_live_commands(hub: Connection, run: LockedRun, *, several: bool, paced: bool) -> None:
    """Print the commands that listen to a live run and inject pedestrians.

    several: whether episodes run in parallel; then the commands name the first one.
    paced: whether the run is limited to real time.
    """
    from bridge import keys

    first = min(run.todo, key=partial(episode_id_of, run.folder.spec.setup.seed))
    env = f" --env {keys.chunk(run.folder.path.name)}/{keys.chunk(first.id)}" if several else ""
    notice(f"On the air at {hub.listen}. From another terminal:")
    notice(f"  cosim listen events{connect_options(hub, 'viewer')}{env} --wait 60")
    notice(
        f"  cosim inject '{_EXAMPLE_PEDESTRIAN}'{connect_options(hub, 'injector')}{env} --wait 60"
    )
    if not paced:
        notice(
            "It runs as fast as it can. --pace 1 holds it to real time, so that there is "
            "time to step in."
        )


def _print_end(terminal: Terminal, table: DataFrame) -> None:
    """Print the results of a run. Raises Exit if an episode is not scored."""
    plan = terminal.plan
    folder = terminal.folder
    print_table(out, table, len(plan.selected), folder)
    print_by_kind(out, table, kinds_of(folder))
    if terminal.figures is not None:
        err.print(terminal.figures.in_words, soft_wrap=True, highlight=False)
    out.print(f"Run folder: {folder}", soft_wrap=True)
    print_next_commands(err, folder, table)
    if plan.shard is not None:
        err.print(
            f"Shard {plan.shard.in_words} of the run: `cosim merge` makes one of all.",
            highlight=False,
        )
    if lacking := [one.id for one in plan.scenarios if one.id not in set(table["scenario"])]:
        notice(f"No record of {', '.join(lacking)}: run it again with --resume.")
    if lacking or table["ended"].isna().any():
        raise typer.Exit(SOME_CRASHED)
    write_rerun(folder, [one.id for one in plan.scenarios], plan.config.rerun)


@contextmanager
def _noticed_if_not_begun(folder: Path | None) -> Iterator[None]:
    """Print that there is nothing to resume if Ctrl-C ends a run before its folder is written."""
    try:
        yield
    except KeyboardInterrupt:
        if folder is not None and not (folder / "run.json").exists():
            remedy = "Give the same command again, without --resume."
            notice(f"Stopped before the run began: {folder} holds nothing. {remedy}")
        raise
