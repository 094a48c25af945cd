"""Wire format of rmw_zenoh and of zenoh-bridge-ros2dds: keys, liveliness tokens, attachments.

Pure functions without a session. `DIALECTS` has a row for each of the two formats.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final, Literal, NamedTuple

from bridge.ros2.types import HASHES, NO_HASH, missing_extra
from cosim.spec.ros2 import Ros2Dialect

Kind = Literal["NN", "MP", "MS", "SS", "SC"]
"""Kinds of entities: node, publisher, subscription, service, client."""

ADMIN: Final = "@ros2_lv"
"""First chunk of the liveliness tokens of rmw_zenoh; wildcards do not match it."""
_ATTACHMENT: Final = struct.Struct("<qqB16s")
_GID_BYTES: Final = 16
_SECTION: Final = "§"


class Qos(NamedTuple):
    """Quality of service, always reliable.

    latched: transient local durability.
    """

    depth: int = 10
    latched: bool = False

    @property
    def text(self) -> str:
        """Text in a token; defaults are empty.

        >>> Qos().text, Qos(depth=1, latched=True).text
        ('::,10:,:,:,,', ':1:,1:,:,:,,')
        """
        return f":{'1' if self.latched else ''}:,{self.depth}:,:,:,,"


class Endpoint(NamedTuple):
    """A node, publisher or subscription, as its token states it.

    domain: of the network, -1 if the dialect has none.
    session: id of the Zenoh session.
    numbers: of the node and of the entity in its session.
    topic: fully qualified name, with its first slash.
    type: name, as "sensor_msgs/msg/Image".
    """

    kind: Kind
    domain: int
    session: str
    node: str = ""
    numbers: tuple[int, int] = (0, 0)
    namespace: str = "/"
    topic: str = ""
    type: str = ""
    hash: str = ""
    qos: str = Qos().text

    @property
    def in_words(self) -> str:
        """Node for messages, as "/robot/driver" or "a node of session 1a2b"."""
        if not self.node:
            return f"a node of session {self.session[:8]}"
        return f"{self.namespace.rstrip('/')}/{self.node}"


def dds_type(name: str) -> str:
    """Return the DDS name of a type.

    >>> dds_type("sensor_msgs/msg/Image")
    'sensor_msgs::msg::dds_::Image_'
    """
    package, kind, short = name.split("/")
    return f"{package}::{kind}::dds_::{short}_"


def ros_type(name: str) -> str:
    """Return the ROS name of a DDS type; the same text if it is none.

    >>> ros_type("sensor_msgs::msg::dds_::Image_")
    'sensor_msgs/msg/Image'
    """
    parts = name.split("::")
    if len(parts) != 4 or parts[2] != "dds_":
        return name
    return f"{parts[0]}/{parts[1]}/{parts[3].removesuffix('_')}"


def type_hash(name: str, distro: str) -> str:
    """Return the hash of a type in the keys of a distribution."""
    return NO_HASH if distro == "humble" else HASHES[name]


def rmw_key(domain: int, topic: str, name: str, hash: str) -> str:
    """Return the key of a topic.

    >>> rmw_key(0, "/camera/image_raw", "sensor_msgs/msg/Image", "RIHS01_d3")
    '0/camera/image_raw/sensor_msgs::msg::dds_::Image_/RIHS01_d3'
    """
    return f"{domain}/{topic.strip('/')}/{dds_type(name)}/{hash}"


def rmw_key_of_any_type(domain: int, topic: str) -> str:
    """Return the key expression of a topic with any type and hash.

    >>> rmw_key_of_any_type(0, "/cmd_vel")
    '0/cmd_vel/*/*'
    """
    return f"{domain}/{topic.strip('/')}/*/*"


def rmw_token(end: Endpoint) -> str:
    """Return the liveliness token of a node, publisher or subscription."""
    node, entity = end.numbers
    namespace = "%" if end.namespace == "/" else end.namespace.replace("/", "%")
    head = f"{ADMIN}/{end.domain}/{end.session}/{node}/{entity}/{end.kind}/%/{namespace}/{end.node}"
    if end.kind == "NN":
        return head
    return f"{head}/{end.topic.replace('/', '%')}/{dds_type(end.type)}/{end.hash}/{end.qos}"


def read_rmw_token(token: str) -> Endpoint | None:
    """Return the entity of a token; None if it is none."""
    chunks = token.split("/")
    if len(chunks) not in (9, 13) or chunks[0] != ADMIN:
        return None
    _, domain, session, node, entity, kind, _, namespace, name, *rest = chunks
    if not (domain.isdecimal() and node.isdecimal() and entity.isdecimal()):
        return None
    topic, type_name, hash, qos = rest or ("", "", "", "")
    return Endpoint(
        kind,  # type: ignore[arg-type]
        int(domain),
        session,
        name,
        (int(node), int(entity)),
        "/" if namespace == "%" else namespace.replace("%", "/"),
        topic.replace("%", "/"),
        ros_type(type_name),
        hash,
        qos,
    )


def dds_bridge_key(domain: int, topic: str, name: str, hash: str) -> str:
    """Return the key of a topic for the bridge: its name without the first slash."""
    return topic.strip("/")


def dds_bridge_key_of_any_type(domain: int, topic: str) -> str:
    """Return the key of a topic for the bridge, which names no type."""
    return topic.strip("/")


def dds_bridge_token(end: Endpoint) -> str:
    """Return the liveliness token of an endpoint for the bridge; a node has that of a session."""
    head = f"@/{end.session}/{ADMIN}"
    if end.kind == "NN":
        return head
    parts = end.topic.strip("/"), end.type
    topic, name = (part.replace("/", _SECTION) for part in parts)
    return f"{head}/{end.kind}/{topic}/{name}/{_bridge_qos(end.qos)}"


def _bridge_qos(text: str) -> str:
    """Return the bridge's text of a quality of service: DDS kinds, 1 for reliable and latched."""
    reliability, durability, history, *_ = text.split(":")
    depth = history.partition(",")[2]
    return f":{0 if reliability else 1}:{1 if durability else 0}:0,{depth}"


def read_dds_bridge_token(token: str) -> Endpoint | None:
    """Return the endpoint of a token of the bridge; None if it is none."""
    chunks = token.split("/")
    if len(chunks) < 6 or chunks[0] != "@" or chunks[2] != ADMIN:
        return None
    topic, name = (part.replace(_SECTION, "/") for part in chunks[4:6])
    return Endpoint(chunks[3], -1, chunks[1], topic=f"/{topic}", type=name)  # type: ignore[arg-type]


class DialectRow(NamedTuple):
    """A wire format.

    key: returns the key of a topic from domain, topic, type and hash.
    key_of_any_type: returns the key expression of a topic from its domain and name.
    token, read_token: write and read liveliness tokens.
    tokens: key expression of all tokens.
    attached: whether messages have an attachment with the publisher's gid.
    names_type: whether keys name type and hash.
    """

    key: Callable[[int, str, str, str], str]
    key_of_any_type: Callable[[int, str], str]
    token: Callable[[Endpoint], str]
    read_token: Callable[[str], Endpoint | None]
    tokens: str
    attached: bool
    names_type: bool


DIALECTS: Final[Mapping[Ros2Dialect, DialectRow]] = MappingProxyType(
    {
        "rmw_zenoh": DialectRow(
            rmw_key,
            rmw_key_of_any_type,
            rmw_token,
            read_rmw_token,
            f"{ADMIN}/**",
            attached=True,
            names_type=True,
        ),
        "ros2dds": DialectRow(
            dds_bridge_key,
            dds_bridge_key_of_any_type,
            dds_bridge_token,
            read_dds_bridge_token,
            f"@/*/{ADMIN}/**",
            attached=False,
            names_type=False,
        ),
    }
)
"""Wire formats by name."""


def gid_of(token: str) -> bytes:
    """Return the 16-byte gid of a publisher from its token. Raises MachineError without xxhash."""
    try:
        import xxhash
    except ImportError as error:
        raise missing_extra() from error
    return xxhash.xxh3_128(token.encode()).intdigest().to_bytes(_GID_BYTES, "little")


class Attachment(NamedTuple):
    """Metadata of a message.

    number: sequence number from 1
    time_ns: since 1970.
    """

    number: int
    time_ns: int
    gid: bytes

    @property
    def data(self) -> bytes:
        """The 33 bytes of the attachment.

        >>> Attachment(1, 0, bytes(16)).data[16]
        16
        """
        return _ATTACHMENT.pack(self.number, self.time_ns, _GID_BYTES, self.gid)


def read_attachment(data: bytes) -> Attachment | None:
    """Return the attachment of a message; None if the bytes are none."""
    if len(data) != _ATTACHMENT.size or data[16] != _GID_BYTES:
        return None
    number, time_ns, _, gid = _ATTACHMENT.unpack(data)
    return Attachment(number, time_ns, gid)


def full_topic(namespace: str, topic: str) -> str:
    """Return a topic in a namespace; "" is the root.

    >>> full_topic("", "/scan"), full_topic("/env3", "/scan")
    ('/scan', '/env3/scan')
    """
    return f"{namespace.rstrip('/')}/{topic.strip('/')}"
