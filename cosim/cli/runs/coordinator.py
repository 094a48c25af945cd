"""`cosim coordinator`, `cosim worker`: a run by many machines."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from signal import SIGINT
from typing import Annotated, Any

import typer

from cosim.cli.options.endpoint import DEFAULT, Insecure, Tls, connecting, listening, warned
from cosim.cli.options.panels import MANY
from cosim.cli.options.taking import taking
from cosim.cli.runs.run import carry_out, told_if_not_begun
from cosim.cli.terminal.consoles import err
from cosim.cli.terminal.logs import LogJson, LogLevel, logged
from cosim.core.errors import INTERRUPTED, UsageError
from cosim.core.journal import happened

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
    epilog="Examples:  \n`cosim coordinator reactive --policy orca --out runs/mine`, and on the same machine "
    "`cosim worker --jobs 2`  \n"
    "`cosim coordinator reactive --policy orca --out runs/mine --resume`, after it was stopped or killed  \n"
    "`cosim coordinator reactive --policy orca --seed 7 --shard 1/2 --out runs/1`: see `cosim merge`  \n"
    "`cosim coordinator reactive --policy my.py:Mine --listen tls/0.0.0.0:7447 --tls certs/coordinator`",
)
@taking(carry_out, without=("carrier", "jobs", "director_wait", "tls", "insecure"), hidden=_OF_ONE_MACHINE)
def coordinator_command(
    listen: Annotated[str, typer.Option(metavar="ENDPOINT", help="Where workers find it.")] = DEFAULT,
    tls: Tls = "",
    insecure: Insecure = False,
    **asked: Any,
) -> None:
    """Run a suite by workers that come and go (`cosim worker`): with the options of `cosim run`, and the same results.

    It waits for workers as long as there is something to do. Killed at any moment, and begun again with --resume, it
    goes on where it was, and so do they. `cosim status` tells how it goes.
    """
    from bridge.session import notices_of, open_session
    from scenarios.many.workers import workers_of_run

    for name, why in _OF_ONE_MACHINE.items():
        if asked[name]:
            raise UsageError(f"--{name.replace('_', '-')} is of one machine ({why}): leave it out, or use `cosim run`")
    at = asked["policy_at"] or ()
    files = tls if any(one.startswith("tls/") for one in at) else ""
    ours = tls if listen.startswith("tls/") or not files else ""
    connection = listening("coordinator", "--listen", listen, ours, insecure)
    notices_of(connection)

    @contextmanager
    def carrier() -> Iterator[Any]:
        with open_session(connection, warned) as session:
            _say(f"Workers find it by: cosim worker --connect {listen.replace('0.0.0.0', 'THIS-MACHINE')}")
            yield partial(workers_of_run, session, resumed=bool(asked["resume"]))

    with told_if_not_begun(asked["folder"]):
        carry_out(**asked, tls=files, insecure=insecure and bool(at), carrier=carrier())


@coordinator_app.command(
    "worker",
    rich_help_panel=MANY,
    epilog="Examples:  \n`cosim worker --jobs 2`  \n`cosim worker --connect tls/hub.lan:7447 --tls certs/worker --jobs "
    "16 --once`  \nExit codes: 0 told to end by SIGTERM, its episodes handed back, or the run is over (--once); 2 the "
    "run needs another installation, or its policy cannot be loaded here; 3 this machine lacks something, or no run "
    "was heard of for 10 minutes (--once); 130 Ctrl-C",
)
def worker_command(
    connect: Annotated[str, typer.Option(metavar="ENDPOINT", help="Where the coordinator listens.")] = DEFAULT,
    jobs: Annotated[int, typer.Option(min=1, max=1024, help="Environment processes.")] = 1,
    once: Annotated[bool, typer.Option("--once", help="End when a run is over; else wait for the next one.")] = False,
    tls: Tls = "",
    insecure: Insecure = False,
    logs: Annotated[
        Path | None, typer.Option(help="Keep here what its processes print; else the run alone keeps it.")
    ] = None,
    log_level: LogLevel = "",
    log_json: LogJson = None,
) -> None:
    """Run episodes for a coordinator (`cosim coordinator`), on this machine or another one.

    It needs no folder of the run's: scenarios, options and the policy's name come from there. The policy itself must be
    importable here, and be the same. It may come and go at any time.
    """
    from scenarios.many.supervisor import work

    connection = connecting("worker", "--connect", connect, tls, insecure)
    with logged(log_level, log_json):
        ended_by = work(connection, jobs, _say, once=once, logs=logs)
    if ended_by == SIGINT:
        raise typer.Exit(INTERRUPTED)


def _say(words: str) -> None:
    happened("said", words=words)
    err.print(words, soft_wrap=True, highlight=False, markup=False)
