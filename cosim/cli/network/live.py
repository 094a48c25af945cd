"""The command line beside running episodes: `cosim inject`, `cosim listen`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import nullcontext, suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.cli.options.endpoint import DEFAULT, Insecure, Tls, connecting, warned
from cosim.cli.options.panels import STEP_IN
from cosim.cli.terminal.consoles import err, out
from cosim.cli.terminal.progress import doing
from cosim.core.errors import INTERRUPTED, WRONG_USE, CosimError, EngineError, UsageError, unknown
from cosim.spec.connection import Connection

if TYPE_CHECKING:
    from bridge.session import Session


live_app = typer.Typer()
SEARCH_S = 1.0
PAUSE_S = 0.5

Connect = Annotated[str, typer.Option(help="The endpoint that the run was given as --live.")]
Env = Annotated[str | None, typer.Option(help="Which episode, as RUN/EPISODE; needed when several run.")]
Wait = Annotated[
    float, typer.Option(min=0.0, max=1e6, help="Seconds to wait until it is on the air; by default it must be by now.")
]


@live_app.command(
    rich_help_panel=STEP_IN,
    epilog="Examples:  \n"
    '`cosim inject \'{"id": "carl", "path": [{"ahead": 15, "left": 1}]}\'`  \n'
    '`cosim inject \'{"id": "dora", "path": [{"ahead": 15}, {"ahead": 3}]}\'`  \n'
    "`cosim inject @pedestrian.json --wait 60`",
)
def inject(
    message: Annotated[str, typer.Argument(help="The pedestrian as JSON, @FILE, or - for standard input.")],
    connect: Connect = DEFAULT,
    env: Env = None,
    wait: Wait = 0.0,
    tls: Tls = "",
    insecure: Insecure = False,
) -> None:
    """Inject a pedestrian into a running episode. Prints the tick at which it enters, and where. Exit code 2: refused.

    It appears at the first point of its `path`, walks along it, stays at the end for `stay_s` (30) seconds, and leaves.
    A point is `[x, y]` on the map, or `{"ahead": 15, "left": 1}` from the robot as it is at that tick, in metres.
    Negative values mean behind it and to its right. Further fields: `speed_mps`, `heading_rad`, `doing`, `age`.
    """
    from bridge.live import send_injection as send

    payload = _payload(message)
    session, below = _found(connecting("injector", "--connect", connect, tls, insecure), env, wait)
    with session:
        ack = send(session, f"{below}/inject", payload)
    if ack.status == "refused":
        err.print(f"refused: {ack.reason}", soft_wrap=True, markup=False, highlight=False)
        raise typer.Exit(WRONG_USE)
    where = "" if ack.x_m is None else f", at [{ack.x_m:.1f}, {ack.y_m:.1f}]"
    out.print(f"'{ack.id}' enters at tick {ack.tick}, {ack.time_s:.2f} s{where}", markup=False, highlight=False)


@live_app.command(
    rich_help_panel=STEP_IN, epilog="Examples:  \n`cosim listen robot --seconds 5`  \n`cosim listen events --wait 60`"
)
def listen(
    topic: Annotated[str, typer.Argument(help="clock, robot, crowd, signals or events.")] = "events",
    connect: Connect = DEFAULT,
    env: Env = None,
    wait: Wait = 0.0,
    tls: Tls = "",
    insecure: Insecure = False,
    seconds: Annotated[float | None, typer.Option(min=0.0, max=1e6, help="How long; by default until stopped.")] = None,
) -> None:
    """Print what a running episode tells: a line of JSON each time. For `events` what happened before comes first."""
    topics = ("clock", "robot", "crowd", "signals", "events")
    if topic not in topics:
        raise unknown("topic", topic, topics)
    session, below = _found(connecting("viewer", "--connect", connect, tls, insecure), env, wait)
    with session:
        if topic == "events":
            try:
                print(session.ask(f"{below}/log", b"", timeout_s=5.0).decode(), flush=True)
            except TimeoutError as error:
                raise EngineError(f"{error}: the episode has ended, or is too busy") from error
        heard: SimpleQueue[bytes] = SimpleQueue()
        session.listen(f"{below}/{topic}", lambda _, payload: heard.put(payload))
        ends_at = time.monotonic() + (seconds if seconds is not None else 1e9)
        try:
            while (left_s := ends_at - time.monotonic()) > 0.0:
                with suppress(Empty):
                    print(heard.get(timeout=left_s).decode(), flush=True)
        except KeyboardInterrupt:
            raise typer.Exit(INTERRUPTED) from None


def _payload(message: str) -> bytes:
    if message == "-":
        return sys.stdin.buffer.read()
    if message.startswith("@"):
        try:
            return Path(message[1:]).read_bytes()
        except OSError as error:
            raise UsageError(f"{message[1:]}: cannot be read: {error.strerror}") from error
    return message.encode()


def _found(connection: Connection, env: str | None, wait_s: float) -> tuple[Session, str]:
    """A session, to be closed, and what the keys of the episode that is meant begin with.

    Looks for it until `wait_s` seconds are over, and says so. Raises EngineError when nothing is on the air then,
    UsageError when only others are, or when several are and none is named.
    """
    meant, connect = _meant(connection, env, warned), connection.connect
    if isinstance(meant, tuple):
        return meant
    began = time.monotonic()
    with doing(f"waiting up to {wait_s:g} s for {env or 'an episode'} at {connect}") if wait_s else nullcontext():
        while isinstance(meant, CosimError):
            left_s = began + wait_s - time.monotonic()
            if left_s <= 0.0:
                remedy = f"waited {wait_s:g} s" if wait_s else "--wait 60 waits until it is there"
                raise type(meant)(f"{meant} ({remedy})")
            time.sleep(min(PAUSE_S, left_s))
            meant = _meant(connection, env)
    err.print(f"{_name(meant[1])} is on the air after {time.monotonic() - began:.0f} s.", highlight=False)
    return meant


def _meant(
    connection: Connection, env: str | None, say: Callable[[str], None] = lambda _: None
) -> tuple[Session, str] | CosimError:
    """An open session and the episode, or why there is none yet. Raises UsageError where waiting changes nothing."""
    from bridge import keys
    from bridge.session import open_session

    connect = connection.connect
    try:
        session = open_session(connection, say)
    except EngineError:
        return EngineError(f"no run is on the air at {connect}: start one with `cosim run ... --live {connect}`")
    statuses = session.answers(keys.EVERY_STATUS, timeout_s=SEARCH_S)
    names = {_name(below): below for below in sorted(key.removesuffix("/status") for key in statuses)}
    if env in names or (env is None and len(names) == 1):
        return session, names[env or next(iter(names))]
    session.close()
    if env is not None and names:
        return unknown("running episode", env, names)
    if names:
        raise UsageError(f"several episodes are running: choose one with --env: {', '.join(names)}")
    return EngineError(f"a run is at {connect}, but none of its episodes is on the air: a new one takes some seconds")


def _name(below: str) -> str:
    """RUN/EPISODE, by what its keys begin with."""
    return "/".join(below.split("/")[1::2])
