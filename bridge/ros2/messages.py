"""Messages of an observation. Pure functions.

Frames: `map` is `odom` at the start; `odom` -> `base_link` is the odometry; `base_link` is on the
ground below the robot's middle, x forward, y left, z up; optical frames have z ahead and x right.
`TOPICS` has a row for each published topic, in the order in which those of a tick are sent.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bridge.ros2.types import message
from bridge.ros2.wire import Qos
from cosim.core.clock import Clock
from cosim.core.geometry import Floats
from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.spec.camera import Calibration
from cosim.spec.goal import Instruction, PointGoal
from cosim.spec.odometry import Odometry
from cosim.spec.ros2 import ORIGIN_S, PUBLISHED_TOPICS
from cosim.spec.sensors import Imu, Scan

_NS: Final = 1_000_000_000
BASE: Final = "base_link"
ODOM: Final = "odom"
_MAP: Final = "map"
CAMERA: Final = "camera_link"
OPTICAL: Final = "camera_optical_frame"
LIDAR: Final = "lidar_link"
IMU: Final = "imu_link"
_JPEG_QUALITY: Final = 90
"""Quality of compressed pictures, of 100."""
_MIN_RANGE_M: Final = 0.05
"""Smallest range of the lidar in metres."""
_OPTICAL_IN_CAMERA: Final = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Axes of an optical frame in the frame of its camera: z ahead, x right, y down."""
GOAL_MOVED_M: Final = 0.25
"""Distance in metres by which a goal must move in `odom` to be published again."""


def stamp_ns(tick: int, offset_s: float = 0.0) -> int:
    """Return the time of a tick in nanoseconds.

    offset_s: Time of earlier episodes, for a clock that never goes back.

    >>> stamp_ns(3)
    1150000000
    """
    return (ORIGIN_S * 1000 + tick * Clock().tick_ms) * 1_000_000 + round(offset_s * _NS)


def time_of(time_ns: int) -> Any:
    """Return a time as a builtin_interfaces/msg/Time."""
    return message("builtin_interfaces/msg/Time", time_ns // _NS, time_ns % _NS)


def ns_of(time: Any) -> int:
    """Return a builtin_interfaces/msg/Time in nanoseconds."""
    return int(time.sec) * _NS + int(time.nanosec)


def header(time_ns: int, frame: str) -> Any:
    """Return a std_msgs/msg/Header."""
    return message("std_msgs/msg/Header", time_of(time_ns), frame)


def clock(time_ns: int) -> Any:
    """Return the message of /clock."""
    return message("rosgraph_msgs/msg/Clock", time_of(time_ns))


def string(text: str) -> Any:
    """Return a std_msgs/msg/String."""
    return message("std_msgs/msg/String", text)


def _vector(x: float, y: float, z: float) -> Any:
    return message("geometry_msgs/msg/Vector3", float(x), float(y), float(z))


def _point(x: float, y: float, z: float = 0.0) -> Any:
    return message("geometry_msgs/msg/Point", float(x), float(y), float(z))


def _yaw(heading_rad: float) -> Any:
    """Return the quaternion of a heading."""
    half = 0.5 * heading_rad
    return message("geometry_msgs/msg/Quaternion", 0.0, 0.0, math.sin(half), math.cos(half))


def _quaternion(axes: NDArray[np.float64]) -> Any:
    """Return the quaternion of a (3, 3) rotation."""
    trace = float(np.trace(axes))
    if trace > 0.0:
        s = 2.0 * math.sqrt(1.0 + trace)
        x, y, z = (
            (axes[2, 1] - axes[1, 2]) / s,
            (axes[0, 2] - axes[2, 0]) / s,
            (axes[1, 0] - axes[0, 1]) / s,
        )
        w = 0.25 * s
    else:
        i = int(np.argmax(np.diag(axes)))
        j, k = (i + 1) % 3, (i + 2) % 3
        s = 2.0 * math.sqrt(max(1.0 + axes[i, i] - axes[j, j] - axes[k, k], 0.0))
        part = [0.0, 0.0, 0.0]
        part[i], part[j], part[k] = (
            0.25 * s,
            (axes[j, i] + axes[i, j]) / s,
            (axes[k, i] + axes[i, k]) / s,
        )
        x, y, z = part
        w = (axes[k, j] - axes[j, k]) / s
    return message("geometry_msgs/msg/Quaternion", float(x), float(y), float(z), float(w))


def _transform(time_ns: int, frame: str, child: str, at: Any, turn: Any) -> Any:
    return message(
        "geometry_msgs/msg/TransformStamped",
        header(time_ns, frame),
        child,
        message("geometry_msgs/msg/Transform", _vector(*at), turn),
    )


def pose_of(seen: Observation) -> Odometry:
    """Return the estimated pose of the robot in `odom`, the origin without odometry."""
    return seen.odometry or Odometry(0.0, 0.0, 0.0)


def _pose(pose: Odometry) -> Any:
    return message(
        "geometry_msgs/msg/Pose", _point(pose.x_m, pose.y_m), _yaw(pose.heading_rad or 0.0)
    )


def tf(seen: Observation, time_ns: int) -> Any:
    """Return the transform odom -> base_link."""
    pose = pose_of(seen)
    at, turn = (pose.x_m, pose.y_m, 0.0), _yaw(pose.heading_rad or 0.0)
    return message("tf2_msgs/msg/TFMessage", [_transform(time_ns, ODOM, BASE, at, turn)])


def static_tf(seen: Observation, time_ns: int) -> Any:
    """Return the constant transforms: map -> odom, and base_link -> sensors."""
    level = _yaw(0.0)
    frames = [_transform(time_ns, _MAP, ODOM, (0.0, 0.0, 0.0), level)]
    if seen.camera is not None:
        on_robot = seen.camera.on_robot
        camera = on_robot[:3, :3] @ _OPTICAL_IN_CAMERA.T
        frames += [
            _transform(time_ns, BASE, CAMERA, on_robot[:3, 3], _quaternion(camera)),
            _transform(time_ns, CAMERA, OPTICAL, (0.0, 0.0, 0.0), _quaternion(_OPTICAL_IN_CAMERA)),
        ]
    if seen.scan is not None:
        at = (0.0, 0.0, seen.scan.spec.height_m)
        frames.append(_transform(time_ns, BASE, LIDAR, at, level))
    if seen.imu is not None:
        frames.append(_transform(time_ns, BASE, IMU, (0.0, 0.0, 0.0), level))
    return message("tf2_msgs/msg/TFMessage", frames)


def odometry(seen: Observation, time_ns: int) -> Any:
    """Return the message of /odom: the estimated pose, and the robot's own speeds."""
    twist = _twist(seen.v_mps, seen.w_radps)
    unknown = np.zeros(36)
    return message(
        "nav_msgs/msg/Odometry",
        header(time_ns, ODOM),
        BASE,
        message("geometry_msgs/msg/PoseWithCovariance", _pose(pose_of(seen)), unknown),
        message("geometry_msgs/msg/TwistWithCovariance", twist, unknown),
    )


def initial_pose(seen: Observation, time_ns: int) -> Any:
    """Return the estimated pose as a geometry_msgs/msg/PoseWithCovarianceStamped in `map`."""
    pose = message("geometry_msgs/msg/PoseWithCovariance", _pose(pose_of(seen)), np.zeros(36))
    return message("geometry_msgs/msg/PoseWithCovarianceStamped", header(time_ns, _MAP), pose)


def _twist(v_mps: float, w_radps: float) -> Any:
    return message("geometry_msgs/msg/Twist", _vector(v_mps, 0, 0), _vector(0, 0, w_radps))


def stamped_command(command: Command, time_ns: int) -> Any:
    """Return a command as a geometry_msgs/msg/TwistStamped in `base_link`."""
    twist = _twist(command.v_mps, command.w_radps)
    return message("geometry_msgs/msg/TwistStamped", header(time_ns, BASE), twist)


def waypoint_path(points: Floats | NDArray[np.float32], time_ns: int) -> Any:
    """Return waypoints, (N, 2) or (N, 4) in the robot's frame, as a nav_msgs/msg/Path in
    `base_link`."""
    at = header(time_ns, BASE)
    poses = [
        message("geometry_msgs/msg/PoseStamped", at, _pose(Odometry(x, y, 0.0)))
        for x, y in points[:, :2].tolist()
    ]
    return message("nav_msgs/msg/Path", at, poses)


def imu(reading: Imu, time_ns: int) -> Any:
    """Return a sensor_msgs/msg/Imu without an orientation."""
    unknown, none = np.zeros(9), np.array([-1.0] + 8 * [0.0])
    level = _yaw(0.0)
    return message(
        "sensor_msgs/msg/Imu",
        header(time_ns, IMU),
        level,
        none,
        _vector(*reading.gyro_radps),
        unknown,
        _vector(*reading.accel_mps2),
        unknown,
    )


def laser_scan(scan: Scan, time_ns: int) -> Any:
    """Return the first ring of a lidar as a sensor_msgs/msg/LaserScan."""
    spec = scan.spec
    step = 2.0 * math.pi / spec.rays
    return message(
        "sensor_msgs/msg/LaserScan",
        header(time_ns, LIDAR),
        -math.pi,
        -math.pi + (spec.rays - 1) * step,
        step,
        0.0,
        0.0,
        _MIN_RANGE_M,
        spec.range_m,
        np.ascontiguousarray(scan.ranges_m[0], np.float32),
        np.zeros(0, np.float32),
    )


def point_cloud(scan: Scan, time_ns: int) -> Any:
    """Return all rings of a lidar as a sensor_msgs/msg/PointCloud2 of x, y and z in metres, a row
    for each ring. Points without a return are infinite."""
    returned = np.isfinite(scan.ranges_m)
    along = scan.spec.directions.reshape(3, *scan.ranges_m.shape)
    points = np.where(returned, np.where(returned, scan.ranges_m, 0.0) * along, np.inf)
    data = np.moveaxis(points, 0, -1).astype("<f4")
    fields = [
        message("sensor_msgs/msg/PointField", name, 4 * i, 7, 1) for i, name in enumerate("xyz")
    ]
    rings, rays = scan.ranges_m.shape
    return message(
        "sensor_msgs/msg/PointCloud2",
        header(time_ns, LIDAR),
        rings,
        rays,
        fields,
        False,
        12,
        12 * rays,
        data.reshape(-1).view(np.uint8),
        False,
    )


def image(rgb: NDArray[np.uint8], time_ns: int) -> Any:
    """Return a picture, (H, W, 3), as a sensor_msgs/msg/Image in rgb8."""
    high, wide, _ = rgb.shape
    data = np.ascontiguousarray(rgb).reshape(-1)
    return message(
        "sensor_msgs/msg/Image", header(time_ns, OPTICAL), high, wide, "rgb8", 0, 3 * wide, data
    )


def compressed_image(rgb: NDArray[np.uint8], time_ns: int) -> Any:
    """Return a picture, (H, W, 3), as a sensor_msgs/msg/CompressedImage in JPEG."""
    import cv2

    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    _, jpeg = cv2.imencode(".jpg", rgb[..., ::-1], quality)
    return message(
        "sensor_msgs/msg/CompressedImage", header(time_ns, OPTICAL), "jpeg", jpeg.reshape(-1)
    )


def depth_image(depth: NDArray[np.float32], time_ns: int) -> Any:
    """Return depth, (H, W) in metres along the axis, as a sensor_msgs/msg/Image in 32FC1."""
    high, wide = depth.shape
    data = np.ascontiguousarray(depth, "<f4").reshape(-1).view(np.uint8)
    return message(
        "sensor_msgs/msg/Image", header(time_ns, OPTICAL), high, wide, "32FC1", 0, 4 * wide, data
    )


def camera_info(camera: Calibration, size: tuple[int, int], time_ns: int) -> Any:
    """Return the calibration of a camera.

    size: width and height in pixels.
    """
    wide, high = size
    matrix = np.ascontiguousarray(camera.matrix, float)
    whole = message("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    return message(
        "sensor_msgs/msg/CameraInfo",
        header(time_ns, OPTICAL),
        high,
        wide,
        "plumb_bob",
        np.array(camera.distortion, float),
        matrix.reshape(-1),
        np.eye(3).reshape(-1),
        np.column_stack([matrix, np.zeros(3)]).reshape(-1),
        0,
        0,
        whole,
    )


def goal_in_odom(seen: Observation) -> tuple[float, float] | None:
    """Return the point goal in `odom`, in metres; None if the goal is no point."""
    goal = seen.goal
    if not isinstance(goal, PointGoal):
        return None
    pose = pose_of(seen)
    cos, sin = math.cos(pose.heading_rad or 0.0), math.sin(pose.heading_rad or 0.0)
    return pose.x_m + cos * goal.x_m - sin * goal.y_m, pose.y_m + sin * goal.x_m + cos * goal.y_m


def goal_pose(seen: Observation, time_ns: int) -> Any:
    """Return the point goal as a geometry_msgs/msg/PoseStamped in `odom`, towards the goal."""
    at = goal_in_odom(seen)
    assert at is not None
    pose = pose_of(seen)
    towards = math.atan2(at[1] - pose.y_m, at[0] - pose.x_m)
    return message(
        "geometry_msgs/msg/PoseStamped",
        header(time_ns, ODOM),
        message("geometry_msgs/msg/Pose", _point(*at), _yaw(towards)),
    )


def relative_goal(seen: Observation, time_ns: int) -> Any:
    """Return the point goal as a geometry_msgs/msg/PoseStamped in `base_link`; None without one."""
    goal = seen.goal
    if not isinstance(goal, PointGoal):
        return None
    towards = _yaw(math.atan2(goal.y_m, goal.x_m))
    pose = message("geometry_msgs/msg/Pose", _point(goal.x_m, goal.y_m), towards)
    return message("geometry_msgs/msg/PoseStamped", header(time_ns, BASE), pose)


def episode_text(episode: str, seed: int, tick: int = 0, *, reset: bool = False) -> Any:
    """Return the message of /cosim/episode.

    episode: Opaque id.
    seed: For random numbers of the node.
    reset: Whether the robot was put elsewhere in the episode, instead of the episode's start.
    """
    return string(json.dumps({"episode": episode, "seed": seed, "tick": tick, "reset": reset}))


class Topic(NamedTuple):
    """A published topic.

    message: Returns its message of an observation; None if there is none now.
    lazy: Whether it is encoded only for a subscriber.
    """

    name: str
    message: Callable[[Observation, int], Any] | None = None
    qos: Qos = Qos()
    lazy: bool = False

    @property
    def type(self) -> str:
        """Type of its messages."""
        return PUBLISHED_TOPICS[self.name]


_LATCHED: Final = Qos(depth=1, latched=True)


def _picture(make: Callable[[NDArray[np.uint8], int], Any]) -> Callable[[Observation, int], Any]:
    return lambda seen, time_ns: None if seen.rgb is None else make(seen.rgb, time_ns)


def _scan(seen: Observation, time_ns: int) -> Any:
    scan = seen.scan
    return None if scan is None or scan.spec.rings > 1 else laser_scan(scan, time_ns)


def _points(seen: Observation, time_ns: int) -> Any:
    scan = seen.scan
    return None if scan is None or scan.spec.rings == 1 else point_cloud(scan, time_ns)


def _inertial(seen: Observation, time_ns: int) -> Any:
    return None if seen.imu is None else imu(seen.imu, time_ns)


def _depth(seen: Observation, time_ns: int) -> Any:
    return None if seen.depth is None else depth_image(seen.depth, time_ns)


def _info(seen: Observation, time_ns: int) -> Any:
    if seen.camera is None or seen.rgb is None:
        return None
    high, wide, _ = seen.rgb.shape
    return camera_info(seen.camera, (wide, high), time_ns)


CLOCK: Final = "/clock"
EPISODE: Final = "/cosim/episode"
STATIC: Final = "/tf_static"
INITIAL: Final = "/initialpose"
GOAL: Final = "/goal_pose"
INSTRUCTION: Final = "/cosim/instruction"
_ROWS: Final = (
    Topic(CLOCK),
    Topic(EPISODE, qos=_LATCHED),
    Topic(STATIC, qos=_LATCHED),
    Topic(INITIAL),
    Topic(GOAL, qos=_LATCHED),
    Topic(INSTRUCTION, qos=_LATCHED),
    Topic("/cosim/goal", relative_goal),
    Topic("/tf", tf),
    Topic("/odom", odometry),
    Topic("/imu", _inertial),
    Topic("/scan", _scan),
    Topic("/points", _points),
    Topic("/camera/camera_info", _info),
    Topic("/camera/depth", _depth),
    Topic("/camera/image_raw/compressed", _picture(compressed_image), lazy=True),
    Topic("/camera/image_raw", _picture(image)),
)
TOPICS: Final[Mapping[str, Topic]] = MappingProxyType({row.name: row for row in _ROWS})
"""Published topics by name, in the order in which those of a tick are sent."""


class SentGoal(NamedTuple):
    """Goal that was published last: a point in `odom`, or an instruction."""

    point: tuple[float, float] | None = None
    text: str = ""


def new_goal(seen: Observation, sent: SentGoal, time_ns: int) -> tuple[SentGoal, str, Any]:
    """Return the goal of an observation, its topic and its message; the topic is "" if the goal is
    still the one that was sent."""
    if isinstance(seen.goal, Instruction) and seen.goal.text != sent.text:
        return SentGoal(text=seen.goal.text), INSTRUCTION, string(seen.goal.text)
    at = goal_in_odom(seen)
    if at is not None and (sent.point is None or math.dist(at, sent.point) > GOAL_MOVED_M):
        return SentGoal(point=at), GOAL, goal_pose(seen, time_ns)
    return sent, "", None


class EpisodeStream:
    """Messages of an episode, in order: /clock of each tick before stamps of its time.

    elapsed_s: Time of earlier episodes, for a clock that never goes back.
    """

    def __init__(self, episode: str, seed: int, elapsed_s: float = 0.0) -> None:
        self._episode = episode, seed
        self.elapsed_s = elapsed_s
        self._sent = SentGoal()
        self.tick = -1

    def time_ns(self, tick: int) -> int:
        """Return the time of a tick in nanoseconds."""
        return stamp_ns(tick, self.elapsed_s)

    def begun(self) -> Iterator[tuple[str, Any]]:
        """Yield topic and message of the start."""
        yield CLOCK, clock(self.time_ns(0))
        yield EPISODE, episode_text(*self._episode)

    def observed(
        self, seen: Observation, wanted: Callable[[str], bool] = lambda _: True
    ) -> Iterator[tuple[str, Any]]:
        """Yield topic and message of an observation.

        wanted: Whether a topic that is encoded only for a subscriber has one.
        """
        now_ns = self.time_ns(seen.tick)
        for tick in range(max(self.tick + 1, 1), seen.tick + 1):
            yield CLOCK, clock(self.time_ns(tick))
        if self.tick < 0:
            yield STATIC, static_tf(seen, now_ns)
        self.tick = seen.tick
        if seen.reset:
            self._sent = SentGoal()
            yield EPISODE, episode_text(*self._episode, seen.tick, reset=True)
            yield INITIAL, initial_pose(seen, now_ns)
        self._sent, topic, goal = new_goal(seen, self._sent, now_ns)
        if topic:
            yield topic, goal
        for row in TOPICS.values():
            if row.message is None or (row.lazy and not wanted(row.name)):
                continue
            if (sent := row.message(seen, now_ns)) is not None:
                yield row.name, sent
