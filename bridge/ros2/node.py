"""A ROS 2 node on a Zenoh session: tokens, publishers, subscriptions, and the nodes around it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, Final, NamedTuple

from bridge.ros2.commands import Received
from bridge.ros2.types import to_cdr
from bridge.ros2.wire import (
    DIALECTS,
    Attachment,
    Endpoint,
    Kind,
    Qos,
    full_topic,
    gid_of,
    read_attachment,
    ros_type,
    type_hash,
)
from bridge.session import Session
from cosim.spec.ros2 import MAX_MESSAGE_B, Ros2Dialect, Ros2Distro

NAME: Final = "cosim"
"""Name of the node of a run."""


class Network(NamedTuple):
    """Part of a ROS 2 network: its domain, and the form of its keys."""

    domain: int = 0
    namespace: str = ""
    distro: Ros2Distro = "jazzy"
    dialect: Ros2Dialect = "rmw_zenoh"


class _Publisher(NamedTuple):
    """A declared publisher.

    numbers: a list with its last sequence number.
    """

    key: str
    type: str
    hash: str
    gid: bytes
    numbers: list[int]
    latched: bool


class Ros2Node:
    """A node of a ROS 2 network.

    ordered: Whether messages of all topics and tokens are taken in their order of arrival
        (`Session.listen`). It takes half a millisecond longer for a picture and its answer.
    changed: Notified whenever a message arrives or a token changes.
    tokens_changed_s: Monotonic time of the last change of a token in this network.
    """

    def __init__(
        self, session: Session, network: Network, name: str = NAME, *, ordered: bool = False
    ) -> None:
        self.network = network
        self.name = name
        self._ordered = ordered
        self.changed = threading.Condition()
        self._session = session
        self._dialect = DIALECTS[network.dialect]
        self._publishers: dict[str, _Publisher] = {}
        self._others: dict[bytes, Endpoint] = {}
        self._entities = 0
        self.tokens_changed_s = time.monotonic()
        self._show(Endpoint("NN", network.domain, session.id, name, namespace=self._namespace))
        session.watch_tokens(self._dialect.tokens, self._token, ordered=ordered)

    @property
    def _namespace(self) -> str:
        return self.network.namespace or "/"

    @property
    def others(self) -> list[Endpoint]:
        """Entities of other sessions whose tokens are there, in any domain."""
        with self.changed:
            return list(self._others.values())

    def advertise(self, topic: str, name: str, qos: Qos = Qos()) -> None:  # noqa: B008
        """Declare a publisher of a topic and a type."""
        end = self._endpoint("MP", topic, name, qos)
        key = self._dialect.key(self.network.domain, end.topic, name, end.hash)
        gid = gid_of(self._show(end))
        self._publishers[topic] = _Publisher(key, name, end.hash, gid, [0], qos.latched)
        self._session.advertise(key, latched=qos.depth if qos.latched else 0)

    def publish(self, topic: str, sent: Any) -> None:
        """Publish a message on an advertised topic, without loss."""
        publisher = self._publishers[topic]
        publisher.numbers[0] += 1
        attached = b""
        if self._dialect.attached:
            attached = Attachment(publisher.numbers[0], time.time_ns(), publisher.gid).data
        self._session.publish(publisher.key, to_cdr(sent), attached)

    def has_subscriber(self, topic: str) -> bool:
        """Return whether another node subscribes to an advertised topic."""
        return bool(self._others_at(topic, "MS"))

    def subscribe(
        self, topic: str, names: tuple[str, ...], take: Callable[[Received], None]
    ) -> None:
        """Call `take` with every message of a topic, of any type, in a thread of Zenoh.

        names: Types that are read, for the tokens.
        """
        for name in names:
            self._show(self._endpoint("MS", topic, name, Qos()))
        full = full_topic(self.network.namespace, topic)
        key = self._dialect.key_of_any_type(self.network.domain, full)

        def received(key: str, payload: bytes, attachment: bytes) -> None:
            take(self._read(topic, key, payload, attachment))
            with self.changed:
                self.changed.notify_all()

        self._session.subscribe(key, received, ordered=self._ordered)

    def wait_for(self, holds: Callable[[], object], timeout_s: float) -> bool:
        """Wait until a condition holds; it is tested after each message and change of tokens."""
        with self.changed:
            return bool(self.changed.wait_for(holds, timeout_s))

    def wait_for_tokens(self, timeout_s: float) -> None:
        """Wait until a token of this network changes."""
        before_s = self.tokens_changed_s
        self.wait_for(lambda: self.tokens_changed_s != before_s, timeout_s)

    def publishers_of(self, topic: str) -> dict[bytes, Endpoint]:
        """Return the publishers of a topic in this network by gid."""
        return self._others_at(topic, "MP")

    def subscriptions(self) -> list[tuple[str, Endpoint]]:
        """Return the subscriptions of other nodes to advertised topics, of any type: topic and
        entity."""
        return [
            (topic, end)
            for topic in self._publishers
            for end in self._others_at(topic, "MS").values()
        ]

    def subscriptions_arrived(self) -> bool:
        """Return whether another node subscribes to an advertised topic, and messages reach it.

        A token may arrive before the subscription that it announces. Latched topics are left out:
        their subscribers query the history.
        """
        read = [
            publisher.key
            for topic, publisher in self._publishers.items()
            if not publisher.latched
            and any(
                end.type == publisher.type and end.hash in ("", publisher.hash)
                for end in self._others_at(topic, "MS").values()
            )
        ]
        return bool(read) and all(map(self._session.has_subscriber, read))

    def _others_at(self, topic: str, kind: Kind) -> dict[bytes, Endpoint]:
        full = full_topic(self.network.namespace, topic)
        with self.changed:
            return {
                gid: end
                for gid, end in self._others.items()
                if end.kind == kind and end.topic == full and self._in_network(end)
            }

    def _in_network(self, end: Endpoint) -> bool:
        """Return whether an entity is in this domain, as far as its token names one."""
        return end.domain in (-1, self.network.domain)

    def _endpoint(self, kind: Kind, topic: str, name: str, qos: Qos) -> Endpoint:
        self._entities += 1
        return Endpoint(
            kind,
            self.network.domain,
            self._session.id,
            self.name,
            (0, self._entities),
            self._namespace,
            full_topic(self.network.namespace, topic),
            name,
            type_hash(name, self.network.distro),
            qos.text,
        )

    def _show(self, end: Endpoint) -> str:
        """Declare the token of an entity, and return it."""
        token = self._dialect.token(end)
        self._session.declare_token(token)
        return token

    def _token(self, token: str, alive: bool) -> None:
        end = self._dialect.read_token(token)
        if end is None or end.session == self._session.id:
            return
        with self.changed:
            if alive:
                self._others[gid_of(token)] = end
            else:
                self._others.pop(gid_of(token), None)
            if self._in_network(end):
                self.tokens_changed_s = time.monotonic()
            self.changed.notify_all()

    def _read(self, topic: str, key: str, payload: bytes, attachment: bytes) -> Received:
        """Return a received message with its publisher.

        Without attachments the publisher is known if the topic has a single one.
        """
        there = self.publishers_of(topic)
        sender = b""
        if not self._dialect.attached:
            sender = next(iter(there)) if len(there) == 1 else b""
        elif (attached := read_attachment(attachment)) is not None:
            sender = attached.gid
        by = there[sender].in_words if sender in there else "a node"
        name = hash = ""
        if self._dialect.names_type:
            _, name, hash = key.rsplit("/", 2)
        size_b = len(payload)
        kept = payload if size_b <= MAX_MESSAGE_B else b""
        return Received(kept, ros_type(name), hash, sender, by, size_b)
