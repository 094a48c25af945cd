"""Zenoh without any code of this project, as another program uses it."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import zenoh


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def plain_zenoh(
    endpoint: str, certs: Path | None, role: str, wait_ms: int = 60_000
) -> Iterator[zenoh.Session]:
    """Open a client, with a role's certificate if there is one. Raises ZError without a link."""
    settings: dict[str, Any] = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": wait_ms,
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }
    if certs is not None:
        settings["transport/link/tls"] = {
            "root_ca_certificate": f"{certs}/ca.pem",
            "verify_name_on_connect": True,
        }
        if (certs / role).exists():
            settings["transport/link/tls"] |= {
                "connect_certificate": f"{certs}/{role}/cert.pem",
                "connect_private_key": f"{certs}/{role}/key.pem",
                "enable_mtls": True,
            }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield session
