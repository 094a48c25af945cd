"""Zenoh settings of a session: explicit endpoints, no discovery, no shared memory."""

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
"""Settings of every session."""
CONNECTS_WITHIN_S: Final = 2.0
"""Timeout in seconds to connect; a hub that was just started needs less."""


def settings_alone() -> dict[str, object]:
    """Return the settings of a session without endpoints."""
    return _ALWAYS | {
        "mode": "peer",
        "listen/endpoints": [],
        "connect/endpoints": [],
        "connect/timeout_ms": 0,
    }


def settings_of(connection: Connection, own: Sequence[str] = ()) -> dict[str, object]:
    """Return the settings of one end of a session.

    own: Further endpoints to listen at, for processes of this run.
    """
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
