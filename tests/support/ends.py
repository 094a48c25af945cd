"""Two ends of a session on this machine."""

from __future__ import annotations

from bridge.session import Session, open_session
from cosim.spec.connection import Connection


def listening_at(endpoint: str) -> Session:
    """One that listens."""
    return open_session(Connection(role="coordinator", listen=endpoint))


def connected_to(endpoint: str) -> Session:
    """One that connects. Raises EngineError when nobody listens there."""
    return open_session(Connection(role="worker", connect=endpoint))
