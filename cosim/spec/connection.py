"""Endpoint of a network session: role, address and security.

An endpoint is limited to its own machine, protected by TLS, or explicitly insecure. This is checked
here, before anything is opened.
"""

from __future__ import annotations

import re
from ipaddress import ip_address
from typing import Final, Literal

import msgspec

from cosim.core.errors import UsageError

Role = Literal["coordinator", "director", "policy", "worker", "viewer", "injector", "ros2"]
"""Role of an end of a session, for its rights (`bridge.security.settings`)."""
HUBS: Final[tuple[Role, ...]] = ("coordinator", "director", "policy")
"""Roles that listen; the others connect."""

_IP_ENDPOINT: Final = re.compile(r"(tcp|tls)/([^/?#]+):(\d{1,5})")
_SOCKET_ENDPOINT: Final = re.compile(r"(unixsock-stream)/([^?#]+)")


class Connection(msgspec.Struct, frozen=True, kw_only=True):
    """Endpoint that listens or connects.

    role: role of this end, and the role in its certificate.
    listen, connect: exactly one of both, as PROTOCOL/ADDRESS:PORT (tcp or tls) or
        unixsock-stream/PATH.
    tls: folder with `ca.pem`, `cert.pem` and `key.pem` (`cosim certs`).
    insecure: allow other machines without TLS.
    guests: roles allowed at a listening end, () for those of its own role
        (`bridge.security.settings`). Raises UsageError.

    >>> Connection(role="worker", connect="tls/hub.lan:7447", tls="certs/worker").endpoint
    'tls/hub.lan:7447'
    """

    role: Role
    listen: str = ""
    connect: str = ""
    tls: str = ""
    insecure: bool = False
    guests: tuple[Role, ...] = ()

    def __post_init__(self) -> None:
        if bool(self.listen) == bool(self.connect):
            raise UsageError("one end of a session listens or connects: name one endpoint")
        if self.listen and self.role not in HUBS:
            raise UsageError(
                f"the role {self.role} connects and does not listen. Roles that listen: "
                f"{', '.join(HUBS)}."
            )
        protocol, address = _parts(checked_endpoint(self.endpoint, "endpoint"))
        if self.tls and self.insecure:
            raise UsageError("--tls guards and --insecure does not: choose one")
        if self.tls and protocol != "tls":
            raise UsageError(f"--tls goes with tls/ADDRESS:PORT, not with {self.endpoint}")
        if protocol == "tls" and not self.tls:
            raise UsageError(
                f"{self.endpoint} needs --tls FOLDER, which holds ca.pem, cert.pem and key.pem of "
                f"the role {self.role}: `cosim certs` makes them"
            )
        if not (self.tls or self.insecure or self.is_local):
            raise UsageError(
                f"{self.endpoint} is beyond this machine and unguarded: {self._risk}. Use "
                f"tls/{address} with --tls FOLDER (`cosim certs` makes it), or say --insecure"
            )

    @property
    def endpoint(self) -> str:
        """Address that it listens on or connects to."""
        return self.listen or self.connect

    def seen_by(self, other: Connection) -> Connection:
        """Return the connection that `other` needs to the same address, with its own role and
        certificates."""
        return msgspec.structs.replace(self, role=other.role, tls=other.tls if self.tls else "")

    @property
    def is_local(self) -> bool:
        """Whether the endpoint is reachable only on this machine."""
        protocol, address = _parts(self.endpoint)
        return protocol == "unixsock-stream" or _is_loopback(address.rpartition(":")[0].strip("[]"))

    @property
    def warning(self) -> str:
        """Consequence of --insecure in one line; "" if nothing is insecure."""
        return "" if not self.insecure or self.is_local else f"--insecure: {self._risk}."

    @property
    def _risk(self) -> str:
        if self.connect:
            return f"anyone between here and {self.connect} may read and change all that is sent"
        if self.guests == ("ros2",):
            return f"anyone who can reach {self.listen} may see the sensors and drive the robot"
        may = {
            "coordinator": "watch, inject pedestrians, take episodes and report their results, and "
            "answer as a policy",
            "director": "query it",
            "policy": "query it and see its observations",
        }
        return f"anyone who can reach {self.listen} may {may[self.role]}, and read all that is sent"


def listening(role: Role, option: str, endpoint: str, tls: str, insecure: bool) -> Connection:
    """Return the connection that listens on an option's endpoint. Raises UsageError."""
    return Connection(
        role=role, listen=checked_endpoint(endpoint, option), tls=tls, insecure=insecure
    )


def connecting(role: Role, option: str, endpoint: str, tls: str, insecure: bool) -> Connection:
    """Return the connection to an option's endpoint. Raises UsageError."""
    return Connection(
        role=role, connect=checked_endpoint(endpoint, option), tls=tls, insecure=insecure
    )


def checked_endpoint(endpoint: str, option: str) -> str:
    """Return the endpoint of an option. Raises UsageError if it is malformed."""
    found = _IP_ENDPOINT.fullmatch(endpoint)
    if not (found and 1 <= int(found[3]) <= 65535) and not _SOCKET_ENDPOINT.fullmatch(endpoint):
        like = "tcp/127.0.0.1:7447, tls/HOST:7447 or unixsock-stream/PATH"
        raise UsageError(f"{option} '{endpoint}': write it as PROTOCOL/ADDRESS:PORT, like {like}")
    return endpoint


def _parts(endpoint: str) -> tuple[str, str]:
    """Split an endpoint into protocol and address."""
    protocol, _, rest = endpoint.partition("/")
    return protocol, rest


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False
