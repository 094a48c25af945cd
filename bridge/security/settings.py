"""Zenoh settings of a session: explicit endpoints and, on a hub, access rights by role.

No discovery and no shared memory. Everything that no right allows is denied. Only the run itself,
which uses a private socket (`Session.inside`), publishes positions, and only the hub assigns
episodes. Without certificates (TCP of this machine, or --insecure) every client has the rights of
all roles allowed at the hub.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from cosim.spec.connection import Connection, Role
from cosim.spec.ros2 import COMMAND_TOPICS, PUBLISHED_TOPICS

_ENV = "cosim/*/env/*"


class _Rights(NamedTuple):
    """Rights of a role, as key expressions.

    words: Description for users.
    queries: Keys it may query.
    subscribes: Keys it may subscribe to.
    serves: Keys on which it may declare queryables.
    tokens: Keys of its liveliness tokens.
    publishes: Keys on which it may publish.
    sees_tokens: Keys of the liveliness tokens that it may see.
    """

    words: str
    queries: tuple[str, ...] = ()
    subscribes: tuple[str, ...] = ()
    serves: tuple[str, ...] = ()
    tokens: tuple[str, ...] = ()
    publishes: tuple[str, ...] = ()
    sees_tokens: tuple[str, ...] = ()


def _ros2_keys(topics: Iterable[str]) -> tuple[str, ...]:
    """Return the keys of ROS 2 topics: of rmw_zenoh in any domain and namespace, and of
    zenoh-bridge-ros2dds in a namespace of at most one name."""
    forms = ("*/**{}/*/*", "*{}")
    bare = tuple(topic.removeprefix("/") for topic in topics)
    return (*(form.format(topic) for topic in topics for form in forms), *bare)


_ROS2_PUBLISHED = _ros2_keys(PUBLISHED_TOPICS)
_ROS2_COMMANDS = _ros2_keys(COMMAND_TOPICS)
_ROS2_HISTORY = tuple(f"{key}/@adv/**" for key in _ROS2_PUBLISHED)
_ROS2_TOKENS = ("@ros2_lv/**", "@/*/@ros2_lv/**")
_EVERYTHING = ("**", *_ROS2_TOKENS, "**/@adv/**")
"""All keys; wildcards do not match a chunk that begins with @."""

RIGHTS: Final[dict[Role, _Rights]] = {
    "coordinator": _Rights(
        "query policies and directors", queries=("cosim/*/policy/**", f"{_ENV}/director")
    ),
    "director": _Rights("nothing elsewhere"),
    "worker": _Rights(
        "take episodes and report their results, query policies and directors",
        queries=(
            "cosim/*/status",
            "cosim/*/jobs/*",
            "cosim/*/nets/*",
            "cosim/*/policy/**",
            f"{_ENV}/director",
        ),
        tokens=("cosim/*/workers/*",),
    ),
    "policy": _Rights("answer as a policy", serves=("cosim/*/policy/**",)),
    "viewer": _Rights(
        "watch",
        queries=("cosim/*/status", *(f"{_ENV}/{key}" for key in ("status", "log", "camera"))),
        subscribes=tuple(
            f"{_ENV}/{key}" for key in ("clock", "robot", "crowd", "signals", "events")
        ),
    ),
    "injector": _Rights("inject pedestrians", queries=(f"{_ENV}/inject", f"{_ENV}/status")),
    "ros2": _Rights(
        "see sensors and drive, as a ROS 2 node",
        queries=(*_ROS2_PUBLISHED, *_ROS2_HISTORY),
        subscribes=(*_ROS2_PUBLISHED, *_ROS2_HISTORY),
        tokens=(*_ROS2_TOKENS, *_ROS2_HISTORY),
        publishes=_ROS2_COMMANDS,
        sees_tokens=(*_ROS2_TOKENS, *_ROS2_HISTORY),
    ),
}
"""Rights by role."""
_ADMITTED: Final[dict[Role, tuple[Role, ...]]] = {
    "coordinator": ("worker", "policy", "viewer", "injector", "coordinator"),
    "director": ("worker", "coordinator"),
    "policy": ("worker", "coordinator", "policy"),
}
"""Roles allowed at each hub."""
_MAX_MESSAGE_B: Final = {
    64 << 10: (f"{_ENV}/inject", "cosim/*/jobs/claim"),
    1 << 20: (f"{_ENV}/director",),
    1 << 10: (
        "cosim/*/status",
        "cosim/*/nets/*",
        *(f"{_ENV}/{key}" for key in ("status", "log", "camera")),
    ),
}
"""Size limit in bytes by key; larger messages are dropped. Others have the session's limit.

Those of ROS 2 nodes reach the environment process, which reports what is too large."""
_ALL: Final = (
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "declare_queryable",
    "reply",
    "liveliness_token",
    "declare_liveliness_subscriber",
    "liveliness_query",
)
"""All types of messages in Zenoh's access control."""


def access_settings(connection: Connection) -> dict[str, object]:
    """Return Zenoh's settings for the access rights and size limits of a hub.

    Empty for a Unix socket, which is protected by file permissions.
    """
    if connection.listen.startswith("unixsock-stream/"):
        return {}
    guests = connection.guests or _ADMITTED[connection.role]
    rules = [_rule("inside", flow, _ALL, _EVERYTHING) for flow in ("ingress", "egress")]
    subjects: list[dict[str, object]] = [{"id": "inside", "link_protocols": ["unixsock-stream"]}]
    policies: list[dict[str, object]] = [
        {"rules": ["inside ingress", "inside egress"], "subjects": ["inside"]}
    ]
    if not connection.tls:
        subjects.append({"id": "anybody", "link_protocols": ["tcp"]})
    for role in guests:
        theirs = _rules(role)
        rules += theirs
        if connection.tls:
            subjects.append({"id": role, "cert_common_names": [role], "link_protocols": ["tls"]})
        policies.append(
            {
                "rules": [rule["id"] for rule in theirs],
                "subjects": [role if connection.tls else "anybody"],
            }
        )
    limits = [
        {
            "id": f"{size_b} bytes",
            "flows": ["ingress"],
            "link_protocols": ["tcp", "tls"],
            "messages": ["put", "query"],
            "key_exprs": list(keys),
            "size_limit": size_b,
        }
        for size_b, keys in _MAX_MESSAGE_B.items()
    ]
    control = {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }
    return {"access_control": control, "low_pass_filter": limits}


def _rules(role: Role) -> list[dict[str, object]]:
    """Return the access rules of a role, for messages into and out of the hub."""
    may = RIGHTS[role]
    rules = [
        _rule(f"{role} sends queries", "ingress", ("query",), may.queries),
        _rule(f"{role} gets replies", "egress", ("declare_queryable", "reply"), may.queries),
        _rule(f"{role} subscribes", "ingress", ("declare_subscriber",), may.subscribes),
        _rule(f"{role} gets messages", "egress", ("put",), may.subscribes),
        _rule(f"{role} serves", "ingress", ("declare_queryable", "reply"), may.serves),
        _rule(f"{role} gets queries", "egress", ("query",), may.serves),
        _rule(f"{role} declares tokens", "ingress", ("liveliness_token",), may.tokens),
        _rule(f"{role} publishes", "ingress", ("put",), may.publishes),
        _rule(f"{role} gets subscribers", "egress", ("declare_subscriber",), may.publishes),
        _rule(
            f"{role} subscribes to tokens",
            "ingress",
            ("declare_liveliness_subscriber", "liveliness_query"),
            may.sees_tokens,
        ),
        _rule(f"{role} gets tokens", "egress", ("liveliness_token", "reply"), may.sees_tokens),
    ]
    return [rule for rule in rules if rule["key_exprs"]]


def _rule(
    name: str, flow: str, messages: tuple[str, ...], keys: tuple[str, ...]
) -> dict[str, object]:
    named = f"{name} {flow}" if name == "inside" else name
    return {
        "id": named,
        "flows": [flow],
        "permission": "allow",
        "messages": list(messages),
        "key_exprs": list(keys),
    }


_ALWAYS: Final[dict[str, object]] = {
    "scouting/multicast/enabled": False,
    "scouting/delay": 0,
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
    "transport/link/tx/lease": 2000,
    "transport/link/tx/queue/size/data": 16,
    "timestamping/enabled": True,
    "transport/shared_memory/enabled": False,
    "transport/link/rx/max_message_size": 16 << 20,
}
"""Settings of every session."""
CONNECTS_WITHIN_S: Final = 2.0
"""Timeout in seconds to connect; a hub that was just started needs less."""


def local_settings() -> dict[str, object]:
    """Return the settings of a session without endpoints."""
    return _ALWAYS | {
        "mode": "peer",
        "listen/endpoints": [],
        "connect/endpoints": [],
        "connect/timeout_ms": 0,
    }


def session_settings(connection: Connection, own: Sequence[str] = ()) -> dict[str, object]:
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
    return settings | (access_settings(connection) if connection.listen else {})
