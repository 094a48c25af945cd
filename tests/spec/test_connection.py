"""Allowed endpoints of a session, and the refusals of others."""

from __future__ import annotations

import msgspec
import pytest

from cosim.core.errors import UsageError
from cosim.spec.connection import Connection, Role

LOOPBACK = (
    "tcp/127.0.0.1:7447",
    "tcp/127.8.0.1:1",
    "tcp/localhost:7447",
    "tcp/[::1]:7447",
    "unixsock-stream//tmp/a.sock",
)
BEYOND = (
    "tcp/0.0.0.0:7447",
    "tcp/[::]:7447",
    "tcp/10.0.0.7:7447",
    "tcp/hub.lan:7447",
    "tcp/localhost.evil.org:7447",
)


@pytest.mark.parametrize("endpoint", LOOPBACK)
def test_local_endpoints_need_no_security(endpoint: str) -> None:
    """Loopback and Unix sockets are opened without a warning."""
    assert Connection(role="coordinator", listen=endpoint).warning == ""
    assert Connection(role="viewer", connect=endpoint, insecure=True).warning == ""


@pytest.mark.parametrize("endpoint", BEYOND)
def test_remote_endpoints_need_tls_or_insecure(endpoint: str) -> None:
    """Without either the refusal has both remedies, and --insecure explains itself in one line."""
    with pytest.raises(UsageError, match="may watch, inject") as refused:
        Connection(role="coordinator", listen=endpoint)
    assert f"Use tls/{endpoint[4:]} with --tls FOLDER" in str(
        refused.value
    ) and "--insecure" in str(refused.value)
    with pytest.raises(UsageError, match="anyone between here and"):
        Connection(role="worker", connect=endpoint)
    warning = Connection(role="coordinator", listen=endpoint, insecure=True).warning
    assert warning.startswith("--insecure: anyone who can reach") and "\n" not in warning
    assert (
        Connection(
            role="coordinator", listen=endpoint.replace("tcp", "tls"), tls="certs/coordinator"
        ).warning
        == ""
    )


def test_contradictory_options_are_refused() -> None:
    """They include TLS without files, files without TLS, both TLS and insecure, two endpoints, and
    none."""
    cases: list[tuple[str, dict[str, object]]] = [
        ("needs --tls FOLDER, which holds ca.pem", {"listen": "tls/0.0.0.0:7447"}),
        ("--tls goes with tls/ADDRESS:PORT", {"listen": "tcp/127.0.0.1:7447", "tls": "certs"}),
        ("choose one", {"listen": "tls/0.0.0.0:7447", "tls": "certs", "insecure": True}),
        ("name one endpoint", {}),
        ("name one endpoint", {"listen": "tcp/127.0.0.1:7447", "connect": "tcp/127.0.0.1:7447"}),
        (
            "the role worker connects and does not listen",
            {"listen": "tcp/127.0.0.1:7447", "role": "worker"},
        ),
        ("write it as PROTOCOL/ADDRESS", {"listen": "7447"}),
        ("write it as PROTOCOL/ADDRESS", {"listen": "udp/127.0.0.1:7447"}),
        (
            "write it as PROTOCOL/ADDRESS",
            {"listen": "tls/h:7447#verify_name_on_connect=false", "tls": "certs"},
        ),
        ("write it as PROTOCOL/ADDRESS", {"listen": "tcp/127.0.0.1:70000"}),
    ]
    for words, given in cases:
        with pytest.raises(UsageError, match=words):
            Connection(**{"role": "coordinator", **given})  # type: ignore[arg-type]


def test_a_connection_survives_encoding() -> None:
    """A connection is equal after MessagePack, and is checked again when decoded."""
    role: Role = "worker"
    connection = Connection(role=role, connect="tls/hub.lan:7447", tls="certs/worker")
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(connection), type=Connection) == connection
    there = Connection(role="coordinator", connect="tls/gpu.lan:7449", tls="certs/coordinator")
    assert there.seen_by(connection) == Connection(
        role="worker", connect="tls/gpu.lan:7449", tls="certs/worker"
    )
    with pytest.raises(UsageError, match="needs --tls FOLDER"):
        there.seen_by(Connection(role="worker", connect="tcp/127.0.0.1:7447"))
    bad = msgspec.msgpack.encode({"role": role, "connect": "tcp/hub.lan:7447"})
    with pytest.raises(UsageError, match="unguarded"):
        msgspec.msgpack.decode(bad, type=Connection)
