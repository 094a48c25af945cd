"""Types, keys, tokens and attachments of ROS 2, against rosbags and the examples of rmw_zenoh's
design document; bytes against their decoded values."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from bridge.ros2 import messages, types
from bridge.ros2.commands import (
    PATH,
    TWIST,
    TWIST_STAMPED,
    Fault,
    Inbox,
    Received,
    Remarks,
    judged,
    plan_points,
)
from bridge.ros2.wire import (
    DIALECTS,
    Attachment,
    Endpoint,
    Qos,
    gid_of,
    read_attachment,
    read_rmw_token,
    rmw_key,
    rmw_token,
    type_hash,
)
from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.episode.manifest_checks import calibration_of
from cosim.spec.camera import CameraSpec
from cosim.spec.goal import Instruction, PointGoal
from cosim.spec.odometry import Odometry
from cosim.spec.robot import COURIER
from cosim.spec.ros2 import CMD_VEL, COMMAND_TOPICS, MAX_MESSAGE_B, PLAN, PUBLISHED_TOPICS, Ros2Wait
from cosim.spec.sensors import Imu, Scan, ScanSpec
from tests.conftest import ROOT

CHATTER = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
TALKER = (
    "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/"
    f"std_msgs::msg::dds_::String_/{CHATTER}/::,7:,:,:,,"
)
LISTENER = "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
SPEC = CameraSpec(64, 40, depth=True)
RGB = np.arange(40 * 64 * 3, dtype=np.uint8).reshape(40, 64, 3)
DEPTH = np.linspace(0.5, 30.0, 40 * 64, dtype=np.float32).reshape(40, 64)
NOW_NS = messages.stamp_ns(20)


def observation_with(**more: Any) -> Observation:
    """An observation with every sensor that ROS 2 is sent."""
    lidar = ScanSpec(rays=8)
    values: dict[str, Any] = {
        "rgb": RGB,
        "depth": DEPTH,
        "camera": calibration_of(SPEC, COURIER),
        "goal": PointGoal(10.0, 2.0),
        "odometry": Odometry(3.0, -1.0, 0.5),
        "scan": Scan(np.array([[1, 2, np.inf, 4, 5, 6, 7, 8]], np.float32), lidar),
        "imu": Imu((0.0, 0.1, 0.2), (0.3, 0.0, 9.81)),
    }
    return Observation(20, 1.0, v_mps=0.5, w_radps=-0.25, robot=COURIER, **(values | more))


@pytest.mark.parametrize("store", [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_KILTED])
def test_type_hashes_are_those_of_the_definitions(store: Stores) -> None:
    """Each stored hash equals that of rosbags for the distribution's definition, and every topic
    has one."""
    definitions = get_typestore(store)
    assert {name: definitions.hash_rihs01(name) for name in types.HASHES} == dict(types.HASHES)
    used = {
        *PUBLISHED_TOPICS.values(),
        *(name for names in COMMAND_TOPICS.values() for name in names),
    }
    assert used == set(types.HASHES)


def test_keys_tokens_and_gids_are_those_of_the_design_document() -> None:
    """Its examples are read and written back to the letter; QoS texts, key, gid and attachment have
    the documented form."""
    for token in (TALKER, LISTENER):
        end = read_rmw_token(token)
        assert end is not None and rmw_token(end) == token and end.domain == 2
    assert rmw_key(0, "/chatter", "std_msgs/msg/String", CHATTER) == (
        f"0/chatter/std_msgs::msg::dds_::String_/{CHATTER}"
    )
    assert (Qos().text, Qos(1, latched=True).text) == ("::,10:,:,:,,", ":1:,1:,:,:,,")
    gid = gid_of(TALKER)
    data = Attachment(7, 1_700_000_000_000_000_000, gid).data
    assert len(data) == 33 and data[:8] == b"\x07" + bytes(7) and data[16] == 16
    assert data[17:] == gid and read_attachment(data) == Attachment(7, 17 * 10**17, gid)
    assert read_attachment(data[:-1]) is None and read_rmw_token("@ros2_lv/x") is None
    assert type_hash("std_msgs/msg/String", "humble") == "TypeHashNotSupported"


def test_a_namespace_is_mangled_in_tokens() -> None:
    """In both dialects, slashes of namespaces and topics become % and are read back."""
    end = Endpoint(
        "MS", 3, "ab12", "driver", (1, 4), "/env/a", "/env/a/scan",
        "sensor_msgs/msg/LaserScan", types.HASHES["sensor_msgs/msg/LaserScan"],
    )  # fmt: off
    token = rmw_token(end)
    assert "/%env%a/driver/%env%a%scan/" in token and read_rmw_token(token) == end
    bridge = DIALECTS["ros2dds"]
    assert bridge.key(3, end.topic, end.type, end.hash) == "env/a/scan"
    assert bridge.token(end) == "@/ab12/@ros2_lv/MS/env§a§scan/sensor_msgs§msg§LaserScan/:1:0:0,10"
    read = bridge.read_token(bridge.token(end))
    assert read is not None and (read.topic, read.type) == (end.topic, end.type)


def test_each_message_is_decoded_to_what_was_observed() -> None:
    """All topics of an observation survive CDR with values, frames and stamps, as the same bytes
    each time."""
    observation = observation_with()
    sent = {
        row.name: row.message(observation, NOW_NS)
        for row in messages.TOPICS.values()
        if row.message
    }
    assert sent.pop("/points") is None
    sent["/goal_pose"] = messages.goal_pose(observation, NOW_NS)
    sent["/tf_static"] = messages.static_tf(observation, NOW_NS)
    sent["/initialpose"] = messages.initial_pose(observation, NOW_NS)
    back = {}
    for name, message in sent.items():
        data = types.to_cdr(message)
        assert data[:4] == b"\0\1\0\0" and data == types.to_cdr(message)
        back[name] = types.from_cdr(data, PUBLISHED_TOPICS[name])
        assert (
            not hasattr(back[name], "header") or messages.ns_of(back[name].header.stamp) == NOW_NS
        )
    image = back["/camera/image_raw"]
    assert (image.height, image.width, image.encoding, image.step) == (40, 64, "rgb8", 192)
    assert (image.data.reshape(40, 64, 3) == RGB).all()
    assert (back["/camera/depth"].data.view("<f4").reshape(40, 64) == DEPTH).all()
    info = back["/camera/camera_info"]
    assert observation.camera is not None
    assert (info.k.reshape(3, 3) == observation.camera.matrix).all() and info.p[3] == 0.0
    pose = back["/odom"].pose.pose
    assert (pose.position.x, pose.position.y) == (3.0, -1.0)
    scan = back["/scan"]
    assert (scan.ranges == observation.scan.ranges_m[0]).all()  # type: ignore[union-attr]
    assert math.isclose(scan.angle_max, math.pi - scan.angle_increment, rel_tol=1e-6)
    assert back["/imu"].linear_acceleration.z == 9.81
    goal = back["/goal_pose"].pose.position
    away = math.hypot(goal.x - 3.0, goal.y + 1.0)
    assert (
        math.isclose(away, math.hypot(10.0, 2.0)) and back["/goal_pose"].header.frame_id == "odom"
    )


def test_optical_frames_look_ahead() -> None:
    """The chain base_link -> camera_link -> optical frame equals the calibration of the picture,
    and camera_link has x ahead."""
    observation = observation_with()
    frames = {
        frame.child_frame_id: frame for frame in messages.static_tf(observation, NOW_NS).transforms
    }
    assert list(frames) == ["odom", messages.CAMERA, messages.OPTICAL, messages.LIDAR, messages.IMU]
    camera, optical = (
        _matrix(frames[name].transform) for name in (messages.CAMERA, messages.OPTICAL)
    )
    assert observation.camera is not None
    assert np.allclose(camera @ optical, observation.camera.on_robot)
    assert camera[0, 0] > 0.9 and abs(camera[1, 0]) < 1e-9


def _matrix(transform: Any) -> np.ndarray[Any, Any]:
    at, turn = transform.translation, transform.rotation
    x, y, z, w = turn.x, turn.y, turn.z, turn.w
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = at.x, at.y, at.z
    return matrix


def test_a_cloud_of_rings_has_the_points_of_the_scan() -> None:
    """Points are the distances along the rays; rays without a return are infinite."""
    spec = ScanSpec(rays=16, rings=3, elevation_deg=(-10.0, 10.0))
    ranges = np.full((3, 16), 5.0, np.float32)
    ranges[1, 4] = np.inf
    cloud = messages.point_cloud(Scan(ranges, spec), NOW_NS)
    points = types.from_cdr(types.to_cdr(cloud), "sensor_msgs/msg/PointCloud2")
    xyz = points.data.view("<f4").reshape(3, 16, 3)
    assert np.isinf(xyz[1, 4]).all() and np.allclose(np.linalg.norm(xyz[0], axis=-1), 5.0)
    assert xyz[2, 8, 0] > 4.9 and xyz[2, 8, 2] > 0.8 and abs(xyz[2, 8, 1]) < 1e-6


def test_a_goal_is_sent_when_it_changes() -> None:
    """A point is sent again after it has moved in odom, and an instruction when its text differs."""
    sent, topic, _ = messages.new_goal(observation_with(), messages.SentGoal(), NOW_NS)
    assert topic == "/goal_pose"
    assert messages.new_goal(observation_with(goal=PointGoal(10.1, 2.0)), sent, NOW_NS)[1] == ""
    assert (
        messages.new_goal(observation_with(goal=PointGoal(12.0, 2.0)), sent, NOW_NS)[1]
        == "/goal_pose"
    )
    sent_instruction, topic, message = messages.new_goal(
        observation_with(goal=Instruction("Go.")), sent, NOW_NS
    )
    assert (topic, message.data) == ("/cosim/instruction", "Go.")
    assert (
        messages.new_goal(observation_with(goal=Instruction("Go.")), sent_instruction, NOW_NS)[1]
        == ""
    )


def twist(v_mps: float, w_radps: float, stamp_ns: int | None = None) -> Received:
    """A command; with a stamp it is a TwistStamped."""
    vector = [
        types.message("geometry_msgs/msg/Vector3", *xyz)
        for xyz in ((v_mps, 0.0, 0.0), (0.0, 0.0, w_radps))
    ]
    sent = types.message(TWIST, *vector)
    if stamp_ns is not None:
        sent = types.message(TWIST_STAMPED, messages.header(stamp_ns, "base_link"), sent)
    name = sent.__msgtype__
    data = types.to_cdr(sent)
    return Received(data, name, types.HASHES[name], bytes(16), "/a", len(data))


def verdict(message: Received, wait: Ros2Wait = "next", distro: str = "jazzy") -> Any:
    return judged(
        message,
        wait,
        NOW_NS,
        type_hash(message.type, distro) if message.type in types.HASHES else "",
        attached=True,
    )


def test_a_command_is_taken_by_the_rule_of_its_stamp() -> None:
    """Twist and TwistStamped drive; `stamped` takes the stamp of the tick alone, and skips older
    ones."""
    assert verdict(twist(1.0, 0.5)).command == Command(1.0, 0.5)
    for stamp_ns in (NOW_NS, NOW_NS - 10**9, 0):
        assert verdict(twist(1.0, 0.5, stamp_ns)).command == Command(1.0, 0.5)
    assert verdict(twist(1.0, 0.5, NOW_NS), "stamped").command == Command(1.0, 0.5)
    early = verdict(twist(1.0, 0.5, NOW_NS - 1), "stamped")
    assert early.command is None and early.fault is None


def test_an_invalid_command_is_described_and_never_driven() -> None:
    """NaN, excess length, another type or hash, a wall clock, no attachment and malformed bytes are
    reported with node and remedy."""
    good = twist(1.0, 0.5)
    faults = {
        "both must be finite": verdict(twist(math.nan, 0.0)),
        "at most 1048576": verdict(good._replace(payload=b"", size_b=MAX_MESSAGE_B + 1)),
        "as std_msgs/msg/String": verdict(good._replace(type="std_msgs/msg/String")),
        "another definition": verdict(good._replace(hash="RIHS01_" + 64 * "0")),
        "--ros2-distro humble": verdict(good._replace(hash=types.NO_HASH)),
        "not of Humble": verdict(good, distro="humble"),
        "use_sim_time": verdict(twist(1.0, 0.0, 1_790_000_000 * 10**9)),
        "ahead of /clock": verdict(twist(1.0, 0.0, NOW_NS + 1)),
        "without the attachment": verdict(good._replace(sender=b"")),
        "not a geometry_msgs/msg/Twist": verdict(good._replace(payload=good.payload[:20])),
        "has no stamp": verdict(good, "stamped"),
    }
    for words, found in faults.items():
        assert found.command is None and words in found.fault.words, found
        assert found.fault.topic == CMD_VEL and found.fault.words.startswith("/a ")


def test_a_plan_is_turned_into_the_robots_frame() -> None:
    """Points of a path in odom become metres ahead and left, 32 at most; other frames, empty and
    malformed paths are refused."""
    turn = types.message("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)

    def path(frame: str, points: list[tuple[float, float]]) -> bytes:
        header = messages.header(NOW_NS, frame)
        poses = [
            types.message(
                "geometry_msgs/msg/PoseStamped",
                header,
                types.message(
                    "geometry_msgs/msg/Pose",
                    types.message("geometry_msgs/msg/Point", *xy, 0.0),
                    turn,
                ),
            )
            for xy in points
        ]
        return types.to_cdr(types.message("nav_msgs/msg/Path", header, poses))

    def points(payload: bytes, **more: Any) -> Any:
        got = Received(payload, PATH, types.HASHES[PATH], bytes(16), "/a", len(payload))
        pose = Odometry(1.0, 1.0, math.pi / 2)
        return plan_points(got._replace(**more), pose, types.HASHES[PATH], attached=True)

    good = path("odom", [(1.0, 3.0), (0.0, 3.0)])
    assert np.allclose(points(good), [(2.0, 0.0), (2.0, 1.0)])
    assert len(points(path("map", [(float(i), 0.0) for i in range(400)]))) == 32
    faults = {
        "in the frame 'camera'": points(path("camera", [(1.0, 1.0)])),
        "without poses": points(path("odom", [])),
        "not a nav_msgs/msg/Path": points(b"\0\1\0\0x"),
        "not finite": points(path("odom", [(math.nan, 1.0)])),
        "at most 1048576": points(b"", size_b=MAX_MESSAGE_B + 1),
        "as std_msgs/msg/String": points(good, type="std_msgs/msg/String"),
    }
    for words, fault in faults.items():
        assert isinstance(fault, Fault) and fault.topic == PLAN and words in fault.words, fault


def test_an_inbox_is_bounded_in_messages_and_bytes() -> None:
    """A full inbox drops the newest message, or the oldest one for the rule `rate`."""
    for newest, numbers in ((False, [0, 1, 2]), (True, [7, 8, 9])):
        for inbox in (Inbox(newest=newest, most=3), Inbox(newest=newest, max_b=300)):
            for number in range(10):
                inbox.put(Received(bytes([number]) * 100))
            assert len(inbox) == 3
            first = inbox.take()
            assert first is not None
            taken = [first, *inbox.take_all()]
            assert [got.payload[0] for got in taken] == numbers and inbox.take() is None


def test_remarks_are_counted_by_topic_and_kind() -> None:
    """A kind of fault is new once in an episode, whatever its words; repeats are counted."""
    remarks = Remarks()
    first = [remarks.add(Fault(CMD_VEL, "number", f"linear.x {x}")) for x in range(3)]
    assert first == [True, False, False]
    assert remarks.add(Fault(PLAN, "number", "a plan"))
    assert remarks.words == ["linear.x 0 (3 messages)", "a plan"]
    assert remarks.ended() == ["3 messages in the episode: linear.x 0"]
    assert remarks.words == [] and remarks.add(Fault(CMD_VEL, "number", "again"))


def test_the_page_names_each_topic_and_its_type() -> None:
    """The table of topics in docs/ros2.md lists those that are sent and read, with their types."""
    page = (ROOT / "docs" / "ros2.md").read_text()
    rows = [
        line.split("|")[1:3] for line in page.splitlines() if line.startswith(("| `/", "| in: `/"))
    ]
    topics = {name for row in rows for name in re.findall(r"`([^`]+)`", row[0])}
    assert topics == {*PUBLISHED_TOPICS, *COMMAND_TOPICS}
    named = {name for row in rows for name in re.findall(r"`([^`]+)`", row[1])}
    assert named == set(types.HASHES)
