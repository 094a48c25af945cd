"""Two sessions on this machine that are connected to each other."""

from __future__ import annotations

from bridge.session import Session, open_session
from cosim.spec.connection import Connection


def listening_at(endpoint: str) -> Session:
    """Return a session that listens."""
    return open_session(Connection(role="coordinator", listen=endpoint))


def connected_to(endpoint: str) -> Session:
    """Return a session that connects. Raises EngineError when no session listens there."""
    return open_session(Connection(role="worker", connect=endpoint))
