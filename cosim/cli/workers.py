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
from cosim.cli.generated_options import ConfiguredCommand, Fields, configured
from cosim.cli.options import DEFAULT, MANY, Insecure, Tls
from cosim.core.errors import INTERRUPTED, EngineError, RunError, UsageError
from cosim.core.log_event import log_event
from cosim.core.units import duration
from cosim.spec.connection import connecting, listening
from cosim.spec.run_config import RunConfig

if TYPE_CHECKING:
    from scenarios.runs.status import RunningEpisode, RunStatus


coordinator_app = typer.Typer()

_LOCAL_ONLY = {
    "shared_renderer": "workers draw for themselves",
    "live": "episodes run on other machines",
    "pace": "it is for live injection, and episodes run on other machines",
    "director": "workers use their own",
    "real_time": "answers are timed on an idle machine",
}
"""Options of `cosim run` that a coordinator refuses, with the reason."""


@coordinator_app.command(
    "coordinator",
    cls=ConfiguredCommand,
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
            hidden=_LOCAL_ONLY,
            panels=True,
        ),
    ],
    listen: Annotated[
        str, typer.Option(metavar="ENDPOINT", help="Where workers find it.")
    ] = DEFAULT,
    tls: Tls = "",
    insecure: Insecure = False,
) -> None:
    """Run a suite on workers (`cosim worker`), with the options and results of `cosim run`.

    Workers may connect and disconnect at any time. A coordinator that was killed continues with
    --resume, and so do its workers. `cosim status` shows the progress.
    """
    from bridge.session import connection_warnings, open_session
    from cosim.cli.run_display import run_in_terminal
    from scenarios.runs.zenoh_transport import workers_of_run

    for name, why in _LOCAL_ONLY.items():
        if getattr(config, name):
            raise UsageError(
                f"--{name.replace('_', '-')} is of one machine ({why}): leave it out, or use "
                f"`cosim run`"
            )
    files = tls if any(one.startswith("tls/") for one in config.policy_at) else ""
    ours = tls if listen.startswith("tls/") or not files else ""
    connection = listening("coordinator", "--listen", listen, ours, insecure)
    connection_warnings(connection)

    @contextmanager
    def workers() -> Iterator[Any]:
        with open_session(connection, notice) as session:
            _log_and_print(
                f"Workers find it by: cosim worker --connect "
                f"{listen.replace('0.0.0.0', 'THIS-MACHINE')}"
            )
            yield partial(workers_of_run, session, resumed=config.resume)

    run_in_terminal(
        replace(config, tls=files, insecure=insecure and bool(config.policy_at)), workers()
    )


@coordinator_app.command(
    "worker",
    rich_help_panel=MANY,
    epilog="Examples:  \n`cosim worker --jobs 2`  \n`cosim worker --connect tls/hub.lan:7447 "
    "--tls certs/worker --jobs 16 --once`  \nExit codes: 0 ended by SIGTERM, its episodes "
    "handed back, or the run is over (--once); 2 the run needs another installation, or its "
    "policy cannot be loaded here; 3 this machine lacks something, or no run was found for 10 "
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
        typer.Option(help="Folder for the output of its processes; default: none."),
    ] = None,
    log_level: LogLevel = "",
    log_json: LogJson = None,
) -> None:
    """Run episodes for a coordinator (`cosim coordinator`), on this machine or another one.

    The coordinator sends scenarios, options and the policy's name. The same policy must be
    importable here. A worker may connect and disconnect at any time.
    """
    from scenarios.runs.zenoh_worker import work

    connection = connecting("worker", "--connect", connect, tls, insecure)
    with logged(log_level, log_json):
        ended_by = work(connection, jobs, _log_and_print, once=once, logs=logs)
    if ended_by == SIGINT:
        raise typer.Exit(INTERRUPTED)


def _log_and_print(words: str, _share: float | None = None, /) -> None:
    log_event("said", words=words)
    notice(words)


status_app = typer.Typer()

_EVERY_S = 1.0
_STALE_S = 10.0
"""Seconds after which a status file is outdated; coordinators write it every 2 s."""
_STILL_S = 30.0
"""Seconds without progress after which an episode is reported."""
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
    """Show progress, rate, time left and each worker's health, live in a terminal.

    A terminal shows it until Ctrl-C or the end of the run. Elsewhere it is printed once.
    """
    if (folder is None) == (connect is None):
        raise UsageError("name a run folder, or the coordinator's address with --connect")
    if folder is not None:
        _show_status(lambda: _status_of_folder(folder))
        return
    from bridge import keys
    from bridge.session import open_session

    connection = connecting("viewer", "--connect", str(connect), tls, insecure)
    with open_session(connection, notice) as session:
        _show_status(
            lambda: _status_of_answers(
                session.query_all(keys.EVERY_RUN, timeout_s=5.0), str(connect)
            )
        )


def _status_of_answers(answers: dict[str, bytes], where: str) -> tuple[RunStatus, str]:
    """Return the status of a coordinated run. Raises EngineError if there is none."""
    from scenarios.runs.status import decode_status

    if not answers:
        raise EngineError(
            f"no run is coordinated at {where}: is `cosim coordinator` started, and the "
            f"address right?"
        )
    return decode_status(next(iter(answers.values()))), ""


def _status_of_folder(folder: Path) -> tuple[RunStatus, str]:
    """Return the status of a run folder, and a remark on its coordinator.

    Raises UsageError if the folder has no run.
    """
    from cosim.results.run_folder import check_not_in_use, read_records, read_spec
    from scenarios.runs.status import STATUS_FILE, RunStatus, decode_status

    spec = read_spec(folder)
    try:
        check_not_in_use(folder)
        runs = False
    except RunError:
        runs = True
    finished = len(read_records(folder))
    total = len(spec.scenarios)
    path = folder / STATUS_FILE
    if runs and path.exists():
        status = decode_status(path.read_bytes())
        late_s = time.time() - status.at_s
        if status.finished <= finished or late_s < _STALE_S:
            return (
                status,
                f"Its coordinator has sent nothing for {duration(late_s)}."
                if late_s > _STALE_S
                else "",
            )
    bare = RunStatus(
        suite=spec.suite, policy=spec.policy, folder=str(folder), total=total, finished=finished
    )
    if runs:
        return bare, "Run by processes of this machine, or just begun."
    return bare, "" if finished == total else "Not running: continue with its command and --resume."


def _show_status(look: Callable[[], tuple[RunStatus, str]]) -> None:
    """Show a status, once or live in a terminal."""
    status, remark = look()
    if not out.is_terminal:
        out.print(_picture(status, remark), soft_wrap=True)
        return
    try:
        with Live(_picture(status, remark), console=out, auto_refresh=False) as live:
            while status.finished < status.total and not remark.startswith("Not running"):
                time.sleep(_EVERY_S)
                try:
                    status, remark = look()
                except EngineError:
                    remark = "Its coordinator does not answer."
                live.update(_picture(status, remark), refresh=True)
    except KeyboardInterrupt:
        raise typer.Exit(INTERRUPTED) from None


def _picture(status: RunStatus, remark: str) -> Group:
    summary = (
        f"{status.suite}, policy {status.policy}: {status.finished} of {status.total} episodes"
    )
    if status.per_hour is not None and status.left_s is not None:
        summary += f", {status.per_hour:.0f} an hour, about {duration(status.left_s)} left"
    if status.lost:
        summary += f"; {status.lost} lost with their workers and run again"
    if status.refused:
        summary += f"; {status.refused} messages refused"
    parts: list[RenderableType] = [Text(summary)]
    if status.workers:
        columns = [*tables.names("worker"), *tables.labels("state", "heard")]
        columns += [*tables.figures("done"), *tables.words("episode")]
        rows = []
        for one in status.workers:
            state = one.state_at(status.at_s)
            silent_s = status.at_s - one.heard_at_s
            silent = duration(silent_s) if silent_s > 0.5 else "now"
            under_way = "\n".join(_episode(each, status.at_s) for each in one.episodes.values())
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
    elif status.finished < status.total and not remark:
        parts.append(Text("No worker is connected: start some with `cosim worker`."))
    parts += [Text(line, style="bold red") for line in status.conflicts]
    if remark:
        parts.append(Text(remark))
    return Group(*parts)


def _episode(episode: RunningEpisode, at_s: float) -> str:
    words = f"{episode.scenario} at {episode.time_s:.0f} s, {episode.share:.0%}"
    if episode.waits:
        return f"{words}, {episode.waits}"
    still_s = at_s - episode.moved_at_s
    return words if still_s < _STILL_S else f"{words}, no progress for {duration(still_s)}"
