"""`cosim status`: how a run goes, and how its workers are."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Group
from rich.live import Live
from rich.table import Column, Table
from rich.text import Text

from cosim.cli.options.endpoint import Insecure, Tls, connecting, warned
from cosim.cli.options.panels import MANY
from cosim.cli.terminal.consoles import out
from cosim.cli.terminal.fitted import parts_of_table
from cosim.core.errors import INTERRUPTED, EngineError, RunError, UsageError
from cosim.core.telling import duration

if TYPE_CHECKING:
    from scenarios.many.roll import RunStatus, Under

status_app = typer.Typer()

_EVERY_S = 1.0
_STALE_S = 10.0
"""A coordinator writes its status every two seconds."""
_STILL_S = 30.0
"""An episode that has not come on for so long is told of."""
_COLOURS = {"working": "green", "idle": "", "silent": "yellow", "lost": "red", "left": "dim", "turned away": "red"}


@status_app.command(
    "status",
    rich_help_panel=MANY,
    epilog="Examples:  \n`cosim status runs/mine`  \n`cosim status --connect tcp/127.0.0.1:7447`",
)
def status_command(
    folder: Annotated[Path | None, typer.Argument(metavar="RUN", help="A run folder.")] = None,
    connect: Annotated[
        str | None, typer.Option(metavar="ENDPOINT", help="Ask the coordinator that listens there instead.")
    ] = None,
    tls: Tls = "",
    insecure: Insecure = False,
) -> None:
    """Show how a run goes: progress, rate, time left, and each worker's health; live in a terminal, until Ctrl-C or the
    end of the run, once elsewhere."""
    if (folder is None) == (connect is None):
        raise UsageError("name a run folder, or the coordinator's address with --connect")
    if folder is not None:
        _show(lambda: _of_folder(folder))
        return
    from bridge import keys
    from bridge.session import open_session

    connection = connecting("viewer", "--connect", str(connect), tls, insecure)
    with open_session(connection, warned) as session:
        _show(lambda: _asked(session.answers(keys.EVERY_RUN, timeout_s=5.0), str(connect)))


def _asked(answers: dict[str, bytes], where: str) -> tuple[RunStatus, str]:
    """Raises EngineError when no run is coordinated there."""
    from scenarios.many.roll import status_in

    if not answers:
        raise EngineError(f"no run is coordinated at {where}: is `cosim coordinator` started, and the address right?")
    return status_in(next(iter(answers.values()))), ""


def _of_folder(folder: Path) -> tuple[RunStatus, str]:
    """The status of a run, and a remark on whoever runs it. Raises UsageError when the folder holds no run."""
    from cosim.records.run_folder import read_rows, read_spec, refuse_in_use
    from scenarios.many.roll import STATUS_FILE, RunStatus, status_in

    spec = read_spec(folder)
    try:
        refuse_in_use(folder)
        runs = False
    except RunError:
        runs = True
    finished, total = len(read_rows(folder)), len(spec.scenarios)
    path = folder / STATUS_FILE
    if runs and path.exists():
        told = status_in(path.read_bytes())
        late_s = time.time() - told.at_s
        if told.finished <= finished or late_s < _STALE_S:
            return told, f"Its coordinator has said nothing for {duration(late_s)}." if late_s > _STALE_S else ""
    bare = RunStatus(suite=spec.suite, policy=spec.policy, folder=str(folder), total=total, finished=finished)
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
    words = f"{told.suite}, policy {told.policy}: {told.finished} of {told.total} episodes"
    if told.per_hour is not None and told.left_s is not None:
        words += f", {told.per_hour:.0f} an hour, about {duration(told.left_s)} left"
    if told.lost:
        words += f"; {told.lost} lost with their workers and run again"
    if told.odd:
        words += f"; {told.odd} messages refused"
    parts: list[Text | Table] = [Text(words)]
    if told.workers:
        heads = ("worker", "state", "heard", "done", "episode")
        table = Table(*(Column(head, no_wrap=head != "episode", justify="left") for head in heads), box=None)
        for one in told.workers:
            silent = duration(one.silent_s) if one.silent_s > 0.5 else "now"
            told_of = "\n".join(_under(under) for under in one.under_way) or one.why
            table.add_row(one.name, Text(one.state, style=_COLOURS[one.state]), silent, str(one.done), told_of)
        parts += parts_of_table(out, table, words=[4])
    elif told.finished < told.total and not remark:
        parts.append(Text("No worker is there: start some with `cosim worker`."))
    parts += [Text(line, style="bold red") for line in told.conflicts]
    if remark:
        parts.append(Text(remark))
    return Group(*parts)


def _under(under: Under) -> str:
    words = f"{under.scenario} at {under.time_s:.0f} s, {under.share:.0%}"
    if under.waits:
        return f"{words}, {under.waits}"
    return words if under.still_s < _STILL_S else f"{words}, no progress for {duration(under.still_s)}"
