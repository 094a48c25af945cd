"""Where something is to be found on the network, and how long to wait for it."""

from __future__ import annotations

import re

from cosim.core.errors import UsageError

DEFAULT = "tcp/127.0.0.1:7447"
DIRECTOR = "tcp/127.0.0.1:7448"
LONGEST_WAIT_S = 240.0
"""For a director: an environment process that says nothing for much longer is taken to hang
(`scenarios.execution.pool`)."""


def checked_endpoint(endpoint: str, option: str) -> str:
    """An endpoint of an option, as zenoh writes it. Raises UsageError."""
    like = DEFAULT if option in ("--live", "--connect") else DIRECTOR
    over_ip = re.fullmatch(r"(?:tcp|tls|udp|quic)/[^/]+:(\d{1,5})(?:[?#].*)?", endpoint)
    if not (over_ip and 1 <= int(over_ip.group(1)) <= 65535) and not re.fullmatch(r"unixsock-stream/.+", endpoint):
        raise UsageError(f"{option} '{endpoint}': write it as PROTOCOL/ADDRESS:PORT, like {like}")
    return endpoint
