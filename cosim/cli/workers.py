"""The commands `cosim coordinator`, `cosim worker` and `cosim status`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from signal import SIGINT
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Group, RenderableType
from rich.live import Live
from rich.text import Text

from cosim.cli import tables
from cosim.cli.console import LogJson, LogLevel, logged, notice, out
from cosim.cli.generated_options import Fields, configured
from cosim.cli.options import DEFAULT, MANY, Insecure, Tls
from cosim.core.errors import INTERRUPTED, EngineError, RunError, UsageError
from cosim.core.log_event import happened
from cosim.core.units import duration
from cosim.spec.connection import connecting, listening
from cosim.spec.run_config import RunConfig

if TYPE_CHECKING:
    from scenarios.runs.status import RunningEpisode, RunStatus


coordinator_app = typer.Typer()

_OF_ONE_MACHINE = {
    "shared_renderer": "workers draw for themselves",
    "live": "episodes run elsewhere",
    "pace": "it is there to step in, and episodes run elsewhere",
    "director": "workers ask their own",
    "real_time": "answers are timed where nothing else runs",
}
"""Options of `cosim run` that are refused here, and why."""


@coordinator_app.command(
    "coordinator",
    rich_help_panel=MANY,
    epilog="Examples:  \n`cosim coordinator reactive --policy orca --out runs/mine`, and on the "
    "same machine `cosim worker --jobs 2`  \n`cosim coordinator reactive --policy orca --out "
    "runs/mine --resume`, after it was stopped or killed  \n`cosim coordinator reactive --policy "
    "orca --seed 7 --shard 1/2 --out runs/1`: see `cosim merge`  \n`cosim coordinator reactive "
    "--policy my.py:Mine --listen tls/0.0.0.0:7447 --tls certs/coordinator`",
)
@configured
def coordinator_command(
    config: Annotated[
        RunConfig,
        Fields(
            without=("jobs", "on", "director_wait", "tls", "insecure"),
            hidden=_OF_ONE_MACHINE,
            panels=True,
        ),
    ],
    listen: Annotated[
        str, typer.Option(metavar="ENDPOINT", help="Where workers find it.")
    ] = DEFAULT,
    tls: Tls = "",
    insecure: Insecure = False,
) -> None:
    """Run a suite by workers that come and go (`cosim worker`): with the options of `cosim run`,
    and the same results.

    It waits for workers as long as there is something to do. Killed at any moment, and begun again
    with --resume, it goes on where it was, and so do they. `cosim status` tells how it goes.
    """
    from bridge.session import notices_of, open_session
    from cosim.cli.run_display import run_in_terminal
    from scenarios.runs.zenoh_transport import workers_of_run

    for name, why in _OF_ONE_MACHINE.items():
        if getattr(config, name):
            raise UsageError(
                f"--{name.replace('_', '-')} is of one machine ({why}): leave it out, or use "
                f"`cosim run`"
            )
    files = tls if any(one.startswith("tls/") for one in config.policy_at) else ""
    ours = tls if listen.startswith("tls/") or not files else ""
    connection = listening("coordinator", "--listen", listen, ours, insecure)
    notices_of(connection)

    @contextmanager
    def carrier() -> Iterator[Any]:
        with open_session(connection, notice) as session:
            _say(
                f"Workers find it by: cosim worker --connect "
                f"{listen.replace('0.0.0.0', 'THIS-MACHINE')}"
            )
            yield partial(workers_of_run, session, resumed=config.resume)

    run_in_terminal(
        replace(config, tls=files, insecure=insecure and bool(config.policy_at)), carrier()
    )


@coordinator_app.command(
    "worker",
    rich_help_panel=MANY,
    epilog="Examples:  \n`cosim worker --jobs 2`  \n`cosim worker --connect tls/hub.lan:7447 "
    "--tls certs/worker --jobs 16 --once`  \nExit codes: 0 told to end by SIGTERM, its episodes "
    "handed back, or the run is over (--once); 2 the run needs another installation, or its "
    "policy cannot be loaded here; 3 this machine lacks something, or no run was heard of for 10 "
    "minutes (--once); 130 Ctrl-C",
)
def worker_command(
    connect: Annotated[
        str, typer.Option(metavar="ENDPOINT", help="Where the coordinator listens.")
    ] = DEFAULT,
    jobs: Annotated[int, typer.Option(min=1, max=1024, help="Environment processes.")] = 1,
    once: Annotated[
        bool, typer.Option("--once", help="End when a run is over; else wait for the next one.")
    ] = False,
    tls: Tls = "",
    insecure: Insecure = False,
    logs: Annotated[
        Path | None,
        typer.Option(help="Keep here what its processes print; else the run alone keeps it."),
    ] = None,
    log_level: LogLevel = "",
    log_json: LogJson = None,
) -> None:
    """Run episodes for a coordinator (`cosim coordinator`), on this machine or another one.

    It needs no folder of the run's: scenarios, options and the policy's name come from there. The
    policy itself must be importable here, and be the same. It may come and go at any time.
    """
    from scenarios.runs.zenoh_worker import work

    connection = connecting("worker", "--connect", connect, tls, insecure)
    with logged(log_level, log_json):
        ended_by = work(connection, jobs, _say, once=once, logs=logs)
    if ended_by == SIGINT:
        raise typer.Exit(INTERRUPTED)


def _say(words: str, _share: float | None = None, /) -> None:
    happened("said", words=words)
    notice(words)


status_app = typer.Typer()

_EVERY_S = 1.0
_STALE_S = 10.0
"""A coordinator writes its status every two seconds."""
_STILL_S = 30.0
"""An episode that has not come on for so long is told of."""
_COLOURS = {
    "working": "green",
    "idle": "",
    "silent": "yellow",
    "lost": "red",
    "left": "dim",
    "turned away": "red",
}


@status_app.command(
    "status",
    rich_help_panel=MANY,
    epilog="Examples:  \n`cosim status runs/mine`  \n`cosim status --connect tcp/127.0.0.1:7447`",
)
def status_command(
    folder: Annotated[Path | None, typer.Argument(metavar="RUN", help="A run folder.")] = None,
    connect: Annotated[
        str | None,
        typer.Option(metavar="ENDPOINT", help="Ask the coordinator that listens there instead."),
    ] = None,
    tls: Tls = "",
    insecure: Insecure = False,
) -> None:
    """Show how a run goes: progress, rate, time left, and each worker's health; live in a terminal,
    until Ctrl-C or the end of the run, once elsewhere."""
    if (folder is None) == (connect is None):
        raise UsageError("name a run folder, or the coordinator's address with --connect")
    if folder is not None:
        _show(lambda: _of_folder(folder))
        return
    from bridge import keys
    from bridge.session import open_session

    connection = connecting("viewer", "--connect", str(connect), tls, insecure)
    with open_session(connection, notice) as session:
        _show(lambda: _asked(session.answers(keys.EVERY_RUN, timeout_s=5.0), str(connect)))


def _asked(answers: dict[str, bytes], where: str) -> tuple[RunStatus, str]:
    """Raises EngineError when no run is coordinated there."""
    from scenarios.runs.status import decode_status

    if not answers:
        raise EngineError(
            f"no run is coordinated at {where}: is `cosim coordinator` started, and the "
            f"address right?"
        )
    return decode_status(next(iter(answers.values()))), ""


def _of_folder(folder: Path) -> tuple[RunStatus, str]:
    """The status of a run, and a remark on whoever runs it. Raises UsageError when the folder holds
    no run."""
    from cosim.results.run_folder import read_records, read_spec, refuse_in_use
    from scenarios.runs.status import STATUS_FILE, RunStatus, decode_status

    spec = read_spec(folder)
    try:
        refuse_in_use(folder)
        runs = False
    except RunError:
        runs = True
    finished = len(read_records(folder))
    total = len(spec.scenarios)
    path = folder / STATUS_FILE
    if runs and path.exists():
        told = decode_status(path.read_bytes())
        late_s = time.time() - told.at_s
        if told.finished <= finished or late_s < _STALE_S:
            return (
                told,
                f"Its coordinator has said nothing for {duration(late_s)}."
                if late_s > _STALE_S
                else "",
            )
    bare = RunStatus(
        suite=spec.suite, policy=spec.policy, folder=str(folder), total=total, finished=finished
    )
    if runs:
        return bare, "Run by processes of this machine, or just begun."
    return bare, "" if finished == total else "Nobody runs it: go on with its command and --resume."


def _show(look: Callable[[], tuple[RunStatus, str]]) -> None:
    """Once, or again and again where that can be seen."""
    told, remark = look()
    if not out.is_terminal:
        out.print(_picture(told, remark), soft_wrap=True)
        return
    try:
        with Live(_picture(told, remark), console=out, auto_refresh=False) as live:
            while told.finished < told.total and not remark.startswith("Nobody"):
                time.sleep(_EVERY_S)
                try:
                    told, remark = look()
                except EngineError:
                    remark = "Its coordinator does not answer."
                live.update(_picture(told, remark), refresh=True)
    except KeyboardInterrupt:
        raise typer.Exit(INTERRUPTED) from None


def _picture(told: RunStatus, remark: str) -> Group:
    said = f"{told.suite}, policy {told.policy}: {told.finished} of {told.total} episodes"
    if told.per_hour is not None and told.left_s is not None:
        said += f", {told.per_hour:.0f} an hour, about {duration(told.left_s)} left"
    if told.lost:
        said += f"; {told.lost} lost with their workers and run again"
    if told.refused:
        said += f"; {told.refused} messages refused"
    parts: list[RenderableType] = [Text(said)]
    if told.workers:
        columns = [*tables.names("worker"), *tables.labels("state", "heard")]
        columns += [*tables.figures("done"), *tables.words("episode")]
        rows = []
        for one in told.workers:
            state = one.state_at(told.at_s)
            silent_s = told.at_s - one.heard_at_s
            silent = duration(silent_s) if silent_s > 0.5 else "now"
            under_way = "\n".join(_episode(each, told.at_s) for each in one.episodes.values())
            rows.append(
                (
                    one.name,
                    Text(state, style=_COLOURS[state]),
                    silent,
                    str(one.done),
                    under_way or one.why,
                )
            )
        parts += tables.fitted(out, columns, rows)
    elif told.finished < told.total and not remark:
        parts.append(Text("No worker is there: start some with `cosim worker`."))
    parts += [Text(line, style="bold red") for line in told.conflicts]
    if remark:
        parts.append(Text(remark))
    return Group(*parts)


def _episode(episode: RunningEpisode, at_s: float) -> str:
    words = f"{episode.scenario} at {episode.time_s:.0f} s, {episode.share:.0%}"
    if episode.waits:
        return f"{words}, {episode.waits}"
    still_s = at_s - episode.moved_at_s
    return words if still_s < _STILL_S else f"{words}, no progress for {duration(still_s)}"
