"""How a session is set: over the endpoints that are named, found by nobody else, with no memory
shared."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from bridge.security.rights import access_of
from cosim.spec.connection import Connection

_ALWAYS: Final[dict[str, object]] = {
    "scouting/multicast/enabled": False,
    "scouting/delay": 0,
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
    "transport/link/tx/lease": 2000,
    "transport/link/tx/queue/size/data": 16,
    "transport/shared_memory/enabled": False,
    "transport/link/rx/max_message_size": 16 << 20,
}
CONNECTS_WITHIN_S: Final = 2.0
"""So long an end that connects tries to; a hub that has just been started is there sooner."""


def settings_alone() -> dict[str, object]:
    """Of a session with nobody else in it, by Zenoh's names of settings."""
    return _ALWAYS | {
        "mode": "peer",
        "listen/endpoints": [],
        "connect/endpoints": [],
        "connect/timeout_ms": 0,
    }


def settings_of(connection: Connection, own: Sequence[str] = ()) -> dict[str, object]:
    """Of one end of a session. own: where else it listens, for processes of its own."""
    settings = _ALWAYS | {
        "mode": "router" if connection.listen else "client",
        "listen/endpoints": [connection.listen, *own] if connection.listen else [],
        "connect/endpoints": [connection.connect] if connection.connect else [],
        "connect/timeout_ms": round(1000 * CONNECTS_WITHIN_S) if connection.connect else 0,
    }
    if connection.tls:
        folder = Path(connection.tls)
        certificate, key = str(folder / "cert.pem"), str(folder / "key.pem")
        settings["transport/link/tls"] = {
            "root_ca_certificate": str(folder / "ca.pem"),
            "listen_certificate": certificate,
            "listen_private_key": key,
            "connect_certificate": certificate,
            "connect_private_key": key,
            "enable_mtls": True,
            "verify_name_on_connect": True,
        }
    return settings | (access_of(connection) if connection.listen else {})
