"""The commands `cosim certs`, `direct`, `inject`, `listen` and `serve`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import nullcontext, suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Annotated, cast, get_args

import typer

from cosim.cli import tables
from cosim.cli.console import err, notice, out, say
from cosim.cli.options import DEFAULT, DIRECTOR, MANY, POLICIES_AT, STEP_IN, Insecure, Tls
from cosim.cli.progress import doing
from cosim.core.errors import (
    INTERRUPTED,
    WRONG_USE,
    AccessError,
    CosimError,
    EngineError,
    UsageError,
    unknown,
)
from cosim.spec.connection import Connection, Role, connecting, listening

if TYPE_CHECKING:
    from bridge.session import Session


certs_app = typer.Typer(
    no_args_is_help=True, help="Make, renew and show the certificates of --tls."
)
_Hosts = Annotated[
    list[str] | None,
    typer.Option(
        "--host",
        metavar="NAME",
        help="A host name or address of this endpoint; repeatable.",
    ),
]
_Days = Annotated[int, typer.Option(min=1, max=3650, help="How long it is valid.")]


@certs_app.command(
    epilog="Example, then copy each role's folder to where it is needed:  \n"
    "`cosim certs init certs --host hub.lan --host 10.0.0.7`  \n`cosim certs role certs worker`"
)
def init(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="A new folder.")],
    host: _Hosts = None,
    days: _Days = 365,
) -> None:
    """Make a private authority, and the certificate of a coordinator for each --host."""
    from bridge.security.authority import make_authority

    make_authority(folder, host or ["localhost", "127.0.0.1"], days)
    _print_certificate(folder / "coordinator")
    words = f"Keep {folder / 'ca.key'} to yourself: it can make every role."
    say(words)


@certs_app.command(
    epilog="Examples:  \n`cosim certs role certs viewer`  \n`cosim certs role certs policy --host "
    "gpu.lan`  \n`cosim certs role certs worker --renew`"
)
def role(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="What `cosim certs init` made.")],
    name: Annotated[str, typer.Argument(metavar="ROLE", help=", ".join(get_args(Role)) + ".")],
    host: _Hosts = None,
    days: _Days = 365,
    renew: Annotated[bool, typer.Option("--renew", help="Replace the one that is there.")] = False,
) -> None:
    """Issue the certificate of a role. A director needs --host, a policy if its server listens."""
    from bridge.security.authority import issue

    if name not in get_args(Role):
        raise unknown("role", name, get_args(Role))
    _print_certificate(issue(folder, cast(Role, name), host or [], days, renew=renew))


@certs_app.command(
    "show", epilog="Examples:  \n`cosim certs show certs`  \n`cosim certs show certs/worker`"
)
def show_certificates(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="An authority's folder, or a role's.")
    ],
) -> None:
    """Show role, host names, rights and end of validity of the certificates in a folder."""
    from bridge.security.identity import identity_in, time_left
    from bridge.security.settings import RIGHTS

    places = (folder, *(folder / name for name in get_args(Role)))
    found = [path for path in places if (path / "cert.pem").exists()]
    if not found:
        raise AccessError(f"{folder} holds no certificate: `cosim certs init` makes one")
    rows = []
    for path in found:
        identity = identity_in(path)
        may = RIGHTS[identity.role].words
        hosts = ", ".join(identity.hosts)
        rows.append((path.name, identity.role, hosts, may, time_left(identity)))
    columns = [*tables.names("folder"), *tables.labels("role")]
    columns += [*tables.words("reached by", "may"), *tables.labels("valid until")]
    tables.show(out, columns, rows)


def _print_certificate(place: Path) -> None:
    from bridge.security.identity import identity_in, time_left

    identity = identity_in(place)
    names = f", reached by {', '.join(identity.hosts)}" if identity.hosts else ""
    words = f"{place}: role {identity.role}{names}, valid until {time_left(identity)}"
    say(words)


direct_app = typer.Typer()
WAKE_S = 0.5
"""Longest sleep of a waiting command. A signal that arrives just before a sleep is handled after
it."""


@direct_app.command(
    rich_help_panel=STEP_IN,
    epilog="Example, in two terminals:  \n`cosim direct --listen tcp/127.0.0.1:7448`  \n"
    "`cosim run reactive --event frontal --policy orca --director tcp/127.0.0.1:7448`",
)
def direct(
    listen: Annotated[str, typer.Option(help="The endpoint for runs.")] = DIRECTOR,
    tls: Tls = "",
    insecure: Insecure = False,
) -> None:
    """Direct the event pedestrians of runs that were started with --director, until stopped.

    It is stateless. If it is killed and started again during an episode, the episode waits and
    reaches the same state hash. A run with other source code is refused.
    """
    from bridge.session import open_session
    from scenarios.episodes.director import behaviour_version, serve_all_directors

    with open_session(listening("director", "--listen", listen, tls, insecure), notice) as session:
        serve_all_directors(session)
        print(
            f"directing at {listen}, behaviours {behaviour_version()}; stop with Ctrl-C", flush=True
        )
        try:
            while True:
                time.sleep(WAKE_S)
        except KeyboardInterrupt:
            raise typer.Exit(INTERRUPTED) from None


live_app = typer.Typer()
SEARCH_S = 1.0
PAUSE_S = 0.5

Connect = Annotated[str, typer.Option(help="The endpoint that the run was given as --live.")]
Env = Annotated[
    str | None, typer.Option(help="The episode as RUN/EPISODE; required if several run.")
]
Wait = Annotated[
    float,
    typer.Option(
        min=0.0,
        max=1e6,
        help="Seconds to wait until the episode is live; default: no wait.",
    ),
]


@live_app.command(
    rich_help_panel=STEP_IN,
    epilog="Examples:  \n"
    '`cosim inject \'{"id": "carl", "path": [{"ahead": 15, "left": 1}]}\'`  \n'
    '`cosim inject \'{"id": "dora", "path": [{"ahead": 15}, {"ahead": 3}]}\'`  \n'
    "`cosim inject @pedestrian.json --wait 60`",
)
def inject(
    message: Annotated[
        str, typer.Argument(help="The pedestrian as JSON, @FILE, or - for standard input.")
    ],
    connect: Connect = DEFAULT,
    env: Env = None,
    wait: Wait = 0.0,
    tls: Tls = "",
    insecure: Insecure = False,
) -> None:
    """Inject a pedestrian into a running episode. Prints the tick at which it enters, and where.
    Exit code 2: refused.

    It appears at the first point of its `path`, walks along it, stays at the end for `stay_s` (30)
    seconds, and leaves. A point is `[x, y]` on the map, or `{"ahead": 15, "left": 1}` from the
    robot as it is at that tick, in metres. Negative values mean behind it and to its right. Further
    fields: `speed_mps`, `heading_rad`, `doing`, `age`.
    """
    from bridge.live import send_injection as send

    payload = _payload(message)
    session, below = _live_episode(
        connecting("injector", "--connect", connect, tls, insecure), env, wait
    )
    with session:
        ack = send(session, f"{below}/inject", payload)
    if ack.status == "refused":
        notice(f"refused: {ack.reason}")
        raise typer.Exit(WRONG_USE)
    where = "" if ack.x_m is None else f", at [{ack.x_m:.1f}, {ack.y_m:.1f}]"
    out.print(
        f"'{ack.id}' enters at tick {ack.tick}, {ack.time_s:.2f} s{where}",
        markup=False,
        highlight=False,
    )


@live_app.command(
    rich_help_panel=STEP_IN,
    epilog="Examples:  \n`cosim listen robot --seconds 5`  \n`cosim listen events --wait 60`",
)
def listen(
    topic: Annotated[
        str, typer.Argument(help="clock, robot, crowd, signals or events.")
    ] = "events",
    connect: Connect = DEFAULT,
    env: Env = None,
    wait: Wait = 0.0,
    tls: Tls = "",
    insecure: Insecure = False,
    seconds: Annotated[
        float | None, typer.Option(min=0.0, max=1e6, help="How long; by default until stopped.")
    ] = None,
) -> None:
    """Print messages of a running episode, a line of JSON each. `events` begins with past ones."""
    topics = ("clock", "robot", "crowd", "signals", "events")
    if topic not in topics:
        raise unknown("topic", topic, topics)
    session, below = _live_episode(
        connecting("viewer", "--connect", connect, tls, insecure), env, wait
    )
    with session:
        if topic == "events":
            try:
                print(session.query(f"{below}/log", b"", timeout_s=5.0).decode(), flush=True)
            except TimeoutError as error:
                raise EngineError(f"{error}: the episode has ended, or is too busy") from error
        received: SimpleQueue[bytes] = SimpleQueue()
        session.subscribe(f"{below}/{topic}", lambda _, payload, __: received.put(payload))
        ends_at = time.monotonic() + (seconds if seconds is not None else 1e9)
        try:
            while (left_s := ends_at - time.monotonic()) > 0.0:
                with suppress(Empty):
                    print(received.get(timeout=left_s).decode(), flush=True)
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


def _live_episode(connection: Connection, env: str | None, wait_s: float) -> tuple[Session, str]:
    """Return an open session, and the key prefix of the requested episode.

    Searches for `wait_s` seconds. Raises EngineError if no episode is live then, UsageError if only
    others are, or if several are and `env` is None.
    """
    found = _live_episode_now(connection, env, notice)
    connect = connection.connect
    if isinstance(found, tuple):
        return found
    began = time.monotonic()
    with (
        doing(f"waiting up to {wait_s:g} s for {env or 'an episode'} at {connect}")
        if wait_s
        else nullcontext()
    ):
        while isinstance(found, CosimError):
            left_s = began + wait_s - time.monotonic()
            if left_s <= 0.0:
                remedy = f"waited {wait_s:g} s" if wait_s else "--wait 60 waits until it is there"
                raise type(found)(f"{found} ({remedy})")
            time.sleep(min(PAUSE_S, left_s))
            found = _live_episode_now(connection, env)
    err.print(
        f"{_episode_name(found[1])} is on the air after {time.monotonic() - began:.0f} s.",
        highlight=False,
    )
    return found


def _live_episode_now(
    connection: Connection, env: str | None, warn: Callable[[str], None] = lambda _: None
) -> tuple[Session, str] | CosimError:
    """Return a session and the key prefix of the episode, or the error while there is none.

    Raises UsageError if waiting cannot help.
    """
    from bridge import keys
    from bridge.session import open_session

    connect = connection.connect
    try:
        session = open_session(connection, warn)
    except EngineError:
        return EngineError(
            f"no run is on the air at {connect}: start one with `cosim run ... --live {connect}`"
        )
    statuses = session.query_all(keys.EVERY_STATUS, timeout_s=SEARCH_S)
    names = {
        _episode_name(below): below
        for below in sorted(key.removesuffix("/status") for key in statuses)
    }
    if env in names or (env is None and len(names) == 1):
        return session, names[env or next(iter(names))]
    session.close()
    if env is not None and names:
        return unknown("running episode", env, names)
    if names:
        raise UsageError(f"several episodes are running: choose one with --env: {', '.join(names)}")
    return EngineError(
        f"a run is at {connect}, but none of its episodes is on the air: a new one takes "
        f"some seconds"
    )


def _episode_name(below: str) -> str:
    """Return RUN/EPISODE of a key prefix."""
    return "/".join(below.split("/")[1::2])


serve_app = typer.Typer()


@serve_app.command(
    "serve",
    rich_help_panel=MANY,
    epilog="Examples, each with a run in another terminal:  \n`cosim serve my.py:Mine --name "
    "mine`, `cosim run reactive --policy zenoh:mine --policy-at tcp/127.0.0.1:7449`  \n`cosim "
    "serve my.py:Mine --name mine --listen tls/0.0.0.0:7449 --tls certs/policy`  \n`cosim serve "
    "my.py:Mine --name mine --connect tcp/127.0.0.1:7449`: a further one, where another listens",
)
def serve_command(
    policy: Annotated[str, typer.Argument(help="Your own, as my.py:Class, or a baseline.")],
    name: Annotated[
        str, typer.Option(help="Its name in --policy zenoh:NAME; default: the manifest's.")
    ] = "",
    listen: Annotated[
        str, typer.Option(metavar="ENDPOINT", help="The endpoint for runs.")
    ] = POLICIES_AT,
    connect: Annotated[
        str,
        typer.Option(
            metavar="ENDPOINT",
            help="Instead: the endpoint of another server, next to which runs find it.",
        ),
    ] = "",
    jpeg: Annotated[
        bool, typer.Option("--jpeg", help="Get pictures as JPEG, which is recorded in every row.")
    ] = False,
    tls: Tls = "",
    insecure: Insecure = False,
) -> None:
    """Serve a policy to runs in other processes, until stopped.

    A policy with act_batch is queried for all waiting episodes together; any other gets an object
    per episode. Several servers of one name share the episodes; those of a killed server are run
    again. Where cosim cannot be installed, copy bridge/policy_server.py and call its `serve`.
    """
    from bridge import keys
    from bridge.policy_server import serve
    from bridge.session import open_session
    from cosim.episode.interfaces import Policy
    from cosim.episode.manifest_checks import check_unprivileged
    from cosim.episode.policy_caller import NoTimer
    from cosim.policies.load import load_policy
    from scenarios.ipc.observation_codec import ObservationDecoder

    first = load_policy(policy)
    check_unprivileged(policy, first.manifest, "a remote one")
    spare = [first.policy]

    def another() -> Policy:
        return spare.pop() if spare else load_policy(policy, NoTimer()).policy

    if connect:
        connection = connecting("policy", "--connect", connect, tls, insecure)
    else:
        connection = listening("policy", "--listen", listen, tls, insecure)
    with open_session(connection, notice) as session:
        serve(
            first.policy if first.batches else another,
            name=keys.name(name) if name else keys.chunk(first.manifest.name),
            listen=connection.listen,
            connect=connection.connect,
            jpeg=jpeg,
            manifest=first.manifest,
            source=first.source_hash,
            decoder=ObservationDecoder,
            session=session.zenoh_session,
        )
    raise typer.Exit(INTERRUPTED)
