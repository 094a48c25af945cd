"""Settings of `--policy ros2:`, a policy that is a ROS 2 node reached over Zenoh."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, Literal

import msgspec

from cosim.core.errors import UsageError
from cosim.spec.connection import Connection

if TYPE_CHECKING:  # slow to import, and the command line's options are made with this module
    from cosim.spec.camera import CameraSpec
    from cosim.spec.manifest import Manifest
    from cosim.spec.sensors import ScanSpec

Ros2Wait = Literal["next", "stamped", "rate"]
"""Rules that decide which command answers an observation."""
Ros2Dialect = Literal["rmw_zenoh", "ros2dds"]
"""Wire formats: that of rmw_zenoh, and that of zenoh-bridge-ros2dds."""
Ros2Distro = Literal["humble", "jazzy", "kilted"]
"""Distributions of nodes. Humble has no type hashes; the hashes of the others are equal."""
Ros2Clock = Literal["restart", "monotonic"]
"""Behaviour of /clock at a new episode: back to its start, or further on."""
Ros2Odometry = Literal["exact", "wheel"]
"""Kinds of odometry with a heading, which /odom needs."""
Ros2Imu = Literal["none", "exact", "noisy"]
"""Kinds of inertial sensor."""

ROS2_SCHEME: Final = "ros2:"
"""Name of the policy that is a ROS 2 node; a name for tables may follow."""
ROS2_LISTEN: Final = "tcp/127.0.0.1:7447"
"""Default endpoint for nodes: where those of rmw_zenoh look for a router."""
LARGEST_DOMAIN: Final = 232
"""Largest ROS_DOMAIN_ID."""
ORIGIN_S: Final = 1
"""Time of /clock at the start of an episode in seconds: ROS reads 0 as no time."""
PUBLISHED_TOPICS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "/clock": "rosgraph_msgs/msg/Clock",
        "/cosim/episode": "std_msgs/msg/String",
        "/tf_static": "tf2_msgs/msg/TFMessage",
        "/initialpose": "geometry_msgs/msg/PoseWithCovarianceStamped",
        "/goal_pose": "geometry_msgs/msg/PoseStamped",
        "/cosim/instruction": "std_msgs/msg/String",
        "/cosim/goal": "geometry_msgs/msg/PoseStamped",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/odom": "nav_msgs/msg/Odometry",
        "/imu": "sensor_msgs/msg/Imu",
        "/scan": "sensor_msgs/msg/LaserScan",
        "/points": "sensor_msgs/msg/PointCloud2",
        "/camera/camera_info": "sensor_msgs/msg/CameraInfo",
        "/camera/depth": "sensor_msgs/msg/Image",
        "/camera/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
        "/camera/image_raw": "sensor_msgs/msg/Image",
    }
)
"""Type of each published topic, in the order in which those of a tick are sent."""
TOPIC_OPTIONS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "/cosim/instruction": "--goal instruction",
        "/cosim/goal": "--goal with a point",
        "/goal_pose": "--goal with a point",
        "/imu": "--ros2-imu",
        "/scan": "--ros2-scan with one ring",
        "/points": "--ros2-scan with several rings",
        "/camera/camera_info": "--ros2-camera",
        "/camera/depth": "--ros2-depth",
        "/camera/image_raw/compressed": "--ros2-camera",
        "/camera/image_raw": "--ros2-camera",
    }
)
"""Options of a run on which it depends whether a topic has messages."""
CMD_VEL: Final = "/cmd_vel"
PLAN: Final = "/plan"
COMMAND_TOPICS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        CMD_VEL: ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"),
        PLAN: ("nav_msgs/msg/Path",),
    }
)
"""Types of each topic that is read."""
MAX_MESSAGE_B: Final = 1 << 20
"""Largest message in bytes that is read: a plan of 10,000 poses fits."""
_CAMERA: Final = re.compile(r"(\d{1,4})x(\d{1,4})(?:@(\d{1,3}(?:\.\d+)?))?")
_SCAN: Final = re.compile(r"(\d{1,5})(?:x(\d{1,3}))?(?:@(\d{1,3}(?:\.\d+)?))?")


class Ros2Settings(msgspec.Struct, frozen=True, kw_only=True):
    """Settings of a policy that is a ROS 2 node.

    connection: Where nodes connect, or the router to connect to.
    domain: ROS domain of the first environment process; the next ones use the following domains.
    namespace: Prefix of all topics, "" or "/NAME".
    wait: Rule that decides which command answers an observation.
    rate_hz: Rate at which the policy acts and sensors are published.
    camera: Size and vertical field of view in degrees of the front camera, as "512x288@75";
        "none" for no camera.
    depth: Whether the camera also has depth.
    scan: Rays, rings and range of the lidar, as "360", "360@20" or "1024x16@50"; "none" for no
        lidar.
    answer_s, start_s: Timeouts in seconds of an answer, and of the first one.
    hub: Endpoint of the hub in messages, if `connection` is a private one to it.

    Raises UsageError.

    >>> Ros2Settings(connection=Connection(role="coordinator", listen=ROS2_LISTEN)).wait
    'next'
    """

    connection: Connection
    domain: int = 0
    namespace: str = ""
    wait: Ros2Wait = "next"
    distro: Ros2Distro = "jazzy"
    clock: Ros2Clock = "restart"
    dialect: Ros2Dialect = "rmw_zenoh"
    rate_hz: float = 10.0
    camera: str = "512x288"
    depth: bool = False
    scan: str = "none"
    imu: Ros2Imu = "none"
    odometry: Ros2Odometry = "wheel"
    answer_s: float = 60.0
    start_s: float = 300.0
    hub: str = ""

    def __post_init__(self) -> None:
        if not 0 <= self.domain <= LARGEST_DOMAIN:
            raise UsageError(
                f"--ros2-domain {self.domain}: domains, one for each job, are from 0 to "
                f"{LARGEST_DOMAIN}"
            )
        if not (math.isfinite(self.rate_hz) and self.rate_hz > 0.0):
            raise UsageError(f"--ros2-rate {self.rate_hz}: give a positive rate in Hz")
        camera_called(self.camera, "--ros2-camera", depth=self.depth)
        _scan(self.scan)
        parts = self.namespace.split("/")[1:]
        named = all(re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", part) for part in parts)
        if self.namespace and not (self.namespace.startswith("/") and named):
            raise UsageError(
                f"--ros2-namespace '{self.namespace}': use / and names of letters, digits and _, "
                f"like /robot1"
            )
        if self.dialect == "ros2dds" and len(parts) > 1:
            raise UsageError(
                f"--ros2-namespace '{self.namespace}': with --ros2-dialect ros2dds it has one name"
            )

    def manifest(self, name: str) -> Manifest:
        """Return the manifest of the policy: the sensors that are published."""
        from cosim.spec.manifest import Manifest, WaypointRule

        return Manifest(
            name,
            rate_hz=self.rate_hz,
            camera=camera_called(self.camera, "--ros2-camera", depth=self.depth),
            waypoints=WaypointRule(index=0),
            goal="route_point",
            goals=("none", "route_point", "final_point", "random_point", "instruction"),
            odometry=self.odometry,
            scan=_scan(self.scan),
            imu=self.imu,
        )

    @property
    def where(self) -> str:
        """Endpoint at which nodes and the run meet."""
        return self.hub or self.connection.endpoint

    def of_job(self, number: int) -> Ros2Settings:
        """Return the settings of an environment process, with a domain of its own."""
        return msgspec.structs.replace(self, domain=self.domain + number)


def camera_called(text: str, option: str, *, depth: bool = False) -> CameraSpec | None:
    """Return the front camera of an option's value. Raises UsageError."""
    from cosim.spec.camera import CameraSpec

    if text == "none":
        if depth:
            raise UsageError(f"--ros2-depth needs a camera: leave out {option} none")
        return None
    if not (found := _CAMERA.fullmatch(text)):
        raise UsageError(f"{option} '{text}': write it as 512x288, 512x288@75 or none")
    return CameraSpec(int(found[1]), int(found[2]), float(found[3] or 75.0), depth=depth)


def _scan(text: str) -> ScanSpec | None:
    """Return the lidar of an option's value. Raises UsageError, SpecError."""
    from cosim.spec.sensors import ScanSpec

    if text == "none":
        return None
    if not (found := _SCAN.fullmatch(text)) or int(found[1]) == 0 or found[2] == "0":
        raise UsageError(f"--ros2-scan '{text}': write it as 360, 360@20, 1024x16@50 or none")
    rings = int(found[2] or 1)
    return ScanSpec(
        rays=int(found[1]),
        rings=rings,
        range_m=float(found[3] or 20.0),
        elevation_deg=(0.0, 0.0) if rings == 1 else (-15.0, 15.0),
    )
