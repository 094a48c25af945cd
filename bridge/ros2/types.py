"""ROS 2 message types that the bridge uses, with their type hashes.

The hashes (RIHS01) are those of Iron and later distributions; a test computes them again. Encoding
needs the package `rosbags`, of the extra [ros2].
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from cosim.core.errors import MachineError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

NO_HASH: Final = "TypeHashNotSupported"
"""Type hash in the keys of Humble, which has none."""
HASHES: Final[Mapping[str, str]] = MappingProxyType(
    {
        name: f"RIHS01_{digits}"
        for name, digits in {
            "geometry_msgs/msg/PoseStamped": (
                "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8"
            ),
            "geometry_msgs/msg/PoseWithCovarianceStamped": (
                "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e"
            ),
            "geometry_msgs/msg/Twist": (
                "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a"
            ),
            "geometry_msgs/msg/TwistStamped": (
                "5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64"
            ),
            "nav_msgs/msg/Odometry": (
                "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"
            ),
            "nav_msgs/msg/Path": (
                "1957a5bb3cee5da65c4e52e52b65a93df227efce4c20f8458b36e73066ca334b"
            ),
            "rosgraph_msgs/msg/Clock": (
                "692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564"
            ),
            "sensor_msgs/msg/CameraInfo": (
                "b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275"
            ),
            "sensor_msgs/msg/CompressedImage": (
                "15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a"
            ),
            "sensor_msgs/msg/Image": (
                "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"
            ),
            "sensor_msgs/msg/Imu": (
                "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b"
            ),
            "sensor_msgs/msg/LaserScan": (
                "64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828"
            ),
            "sensor_msgs/msg/PointCloud2": (
                "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"
            ),
            "std_msgs/msg/String": (
                "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
            ),
            "tf2_msgs/msg/TFMessage": (
                "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
            ),
        }.items()
    }
)
"""Type hash by the name of the type."""


@cache
def message_store() -> Typestore:
    """Return the message definitions. Raises MachineError without the extra [ros2]."""
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise missing_extra() from error
    return get_typestore(Stores.ROS2_KILTED)


def missing_extra() -> MachineError:
    """Return the error for a missing extra [ros2]."""
    return MachineError(
        "ROS 2 messages need rosbags and xxhash, of the extra [ros2]: pip install -e '.[ros2]' in "
        "the folder of the source, or pip install rosbags xxhash"
    )


def message(name: str, *fields: Any) -> Any:
    """Return a message from its fields, in the order of its definition.

    >>> message("std_msgs/msg/String", "left").data
    'left'
    """
    return message_store().types[name](*fields)


def to_cdr(sent: Any) -> bytes:
    """Return a message as CDR: little-endian XCDR1 with its header. Padding is zero."""
    return bytes(message_store().serialize_cdr(sent, sent.__msgtype__))


def from_cdr(payload: bytes, name: str) -> Any:
    """Return the message in CDR bytes. Raises ValueError if they are not of the type."""
    try:
        return message_store().deserialize_cdr(payload, name)
    except Exception as error:  # a malformed message raises whatever its bytes lead to
        raise ValueError(f"not a {name}: {type(error).__name__}: {error}") from error
