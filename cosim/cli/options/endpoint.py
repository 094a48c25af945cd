"""Where something is to be found on the network, what guards it, and how long to wait for it."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.terminal.consoles import err
from cosim.core.errors import UsageError
from cosim.spec.connection import Connection, Role, checked_endpoint

DEFAULT = "tcp/127.0.0.1:7447"
DIRECTOR = "tcp/127.0.0.1:7448"
POLICIES_AT = "tcp/127.0.0.1:7449"
EVERY_ADDRESS = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}
"""What stands for all addresses of a machine, and by what it reaches itself."""
LONGEST_WAIT_S = 240.0
"""For a director: an environment process that says nothing for much longer is taken to hang
(`scenarios.execution.pool`)."""

Tls = Annotated[str, typer.Option("--tls", metavar="FOLDER", help="Guard tls/... endpoints: see `cosim certs --help`.")]
Insecure = Annotated[
    bool, typer.Option("--insecure", help="Beyond this machine without TLS: open to all who can reach it, unencrypted.")
]


def listening(role: Role, option: str, endpoint: str, tls: str, insecure: bool) -> Connection:
    """The end that listens at the endpoint of an option. Raises UsageError."""
    return Connection(role=role, listen=checked_endpoint(endpoint, option), tls=tls, insecure=insecure)


def connecting(role: Role, option: str, endpoint: str, tls: str, insecure: bool) -> Connection:
    """The end that connects to the endpoint of an option. Raises UsageError."""
    return Connection(role=role, connect=checked_endpoint(endpoint, option), tls=tls, insecure=insecure)


def ends_of_run(
    live: str | None, director: str | None, policies: Sequence[str], tls: str, insecure: bool
) -> tuple[Connection | None, Connection | None, tuple[Connection, ...]]:
    """Where a run listens, where its director and the servers of its policy are: --tls goes to those that are tls/...
    Raises UsageError."""
    at = {f"--policy-at {end}": end for end in policies}
    given = {name: end for name, end in (("--live", live), ("--director", director)) if end is not None} | at
    if not given and (tls or insecure):
        raise UsageError(f"{'--tls' if tls else '--insecure'} goes with --live, --director or --policy-at")
    guarded = [name for name, end in given.items() if end.startswith("tls/")]
    if tls and not guarded:
        raise UsageError(f"--tls goes with tls/ADDRESS:PORT, not with {', '.join(given.values())}")
    files = {name: tls if name in guarded else "" for name in given}
    return (
        None if live is None else listening("coordinator", "--live", live, files["--live"], insecure),
        None if director is None else connecting("coordinator", "--director", director, files["--director"], insecure),
        tuple(connecting("coordinator", "--policy-at", end, files[name], insecure) for name, end in at.items()),
    )


def reached_by(hub: Connection, role: Role) -> str:
    """The options by which a command in this role reaches a hub from this machine, each after a space."""
    protocol, _, address = hub.listen.partition("/")
    host, _, port = address.rpartition(":")
    if host in EVERY_ADDRESS:
        address = f"{_certified(hub.tls) if hub.tls else EVERY_ADDRESS[host]}:{port}"
    options = ["--connect", f"{protocol}/{address}"]
    if hub.tls:
        options += ["--tls", str(Path(hub.tls).parent / role)]
    elif hub.insecure and not hub.of_this_machine and host not in EVERY_ADDRESS:
        options += ["--insecure"]
    return " " + shlex.join(options)


def _certified(folder: str) -> str:
    """The first name in the certificate of a hub, by which others must reach it."""
    from bridge.security.identity import identity_in

    return identity_in(Path(folder)).hosts[0]


def warned(line: str) -> None:
    """Print what is insecure, or ends soon, on standard error."""
    err.print(line, soft_wrap=True, markup=False, highlight=False)
