"""Conversion of observations to a graph's inputs: history, pictures, goals, and memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from cosim.episode.interfaces import Observation
from cosim.policies.onnx.feeding import Feeder
from cosim.policies.onnx.graph import TensorPort
from cosim.policies.onnx.inputs import GraphInput
from cosim.spec.goal import Goal, ImageGoal, Instruction, PointGoal, RoutePatch
from cosim.spec.odometry import Odometry
from cosim.spec.robot import COURIER
from cosim.spec.sensors import Imu, Scan, ScanSpec, Tracks

SEEN = Observation(tick=0, time_s=0.0, rgb=None, v_mps=1.2, w_radps=-0.3, robot=COURIER)
SCAN = Scan(np.array([[1.0, 2.0, 3.0, 4.0, np.inf, 6.0, 7.0, 30.0]], np.float32), ScanSpec(rays=8))
TRACKS = Tracks(
    np.array([4, 2], np.int32),
    np.array([[3.0, 4.0], [6.0, -1.0]], np.float32),
    np.array([[0.5, 0.0], [-1.0, 0.25]], np.float32),
)
SENSED = replace(SEEN, scan=SCAN, imu=Imu((0.1, 0.2, 0.3), (1.0, 2.0, 9.8)), people=TRACKS)
SMALL = {"what": "picture", "size": [4, 2], "layout": "TCHW"}


def feeder(
    shape: Sequence[int | None], dtype: Any = np.float32, seed: int = 0, **inputs: dict[str, Any]
) -> Feeder:
    """A feeder of inputs as in a manifest, all of one shape."""
    made = msgspec.convert(inputs, dict[str, GraphInput])
    return Feeder(
        made, {name: TensorPort(name, np.dtype(dtype), tuple(shape)) for name in made}, seed
    )


def grey_picture(value: int) -> NDArray[np.uint8]:
    """A picture of one grey."""
    return np.full((8, 16, 3), value, np.uint8)


def first_pixels(feeding: Feeder, *levels: int) -> list[float]:
    """Return the first pixels of the last query's frames, after pictures of these greys."""
    for one in levels:
        tensor = feeding.feed(replace(SEEN, rgb=grey_picture(one)))["obs"]
    return [round(float(number) * 255) for number in tensor[:, 0, 0, 0]]


def test_history_is_the_last_frames_padded_with_the_first() -> None:
    """Order, stride and zero padding follow the manifest, and history restarts after a reset."""
    feeding = feeder((3, 3, 2, 4), obs={**SMALL, "frames": 3})
    assert first_pixels(feeding, 1) == [1, 1, 1]
    assert first_pixels(feeding, 2) == [1, 1, 2]
    assert first_pixels(feeding, 3, 4, 5) == [3, 4, 5]
    feeding.clear()
    assert first_pixels(feeding, 6) == [6, 6, 6]
    newest = feeder(
        (3, 3, 2, 4),
        obs={**SMALL, "frames": 3, "every": 2, "order": "newest_first", "before": "zeros"},
    )
    assert first_pixels(newest, 1, 2, 3, 4) == [4, 2, 0]
    assert first_pixels(newest, 5) == [5, 3, 1]


COLOURED = np.zeros((8, 16, 3), np.uint8)
COLOURED[:, :8] = 255, 0, 0
COLOURED[:, 8:] = 0, 0, 51
PICTURES: dict[str, tuple[dict[str, Any], tuple[int, ...], tuple[int, ...], float]] = {
    "red-left": ({"layout": "NCHW"}, (1, 3, 2, 4), (0, 0, 0, 0), 1.0),
    "bgr-is-turned-round": ({"layout": "NCHW", "colour": "bgr"}, (1, 3, 2, 4), (0, 2, 0, 0), 1.0),
    "channels-last": ({"layout": "NHWC"}, (1, 2, 4, 3), (0, 0, 3, 2), 0.2),
    "stacked": ({"layout": "N(TC)HW", "frames": 2}, (1, 6, 2, 4), (0, 3, 1, 1), 1.0),
    "channels-before-frames": ({"layout": "N(CT)HW", "frames": 2}, (1, 6, 2, 4), (0, 1, 1, 1), 1.0),
    "grey": ({"layout": "NCHW", "colour": "grey"}, (1, 1, 2, 4), (0, 0, 0, 0), 76 / 255),
    "grey-without-an-axis": ({"layout": "NHW", "colour": "grey"}, (1, 2, 4), (0, 1, 0), 76 / 255),
    "as-it-is": ({"layout": "NHWC", "scale": 1}, (1, 2, 4, 3), (0, 0, 3, 2), 51.0),
    "normal": (
        {"layout": "NCHW", "mean": [0.5, 0, 0], "std": [0.25, 1, 1]},
        (1, 3, 2, 4),
        (0, 0, 0, 0),
        2.0,
    ),
    "right-half": ({"layout": "NCHW", "crop": [0.5, 0, 1, 1]}, (1, 3, 2, 4), (0, 2, 0, 0), 0.2),
    "middle": ({"layout": "NCHW", "size": [2, 2], "fit": "crop"}, (1, 3, 2, 2), (0, 0, 0, 0), 1.0),
    "border-above": (
        {"layout": "NCHW", "size": [4, 4], "fit": "letterbox"},
        (1, 3, 4, 4),
        (0, 0, 0, 0),
        114 / 255,
    ),
    "border-below": (
        {"layout": "NCHW", "size": [4, 4], "fit": "corner"},
        (1, 3, 4, 4),
        (0, 0, 3, 0),
        114 / 255,
    ),
    "yuv": (
        {"layout": "NCHW", "colour": "yuv420", "size": [8, 4], "scale": 1},
        (1, 6, 2, 4),
        (0, 5, 0, 0),
        240.0,
    ),
}


@pytest.mark.parametrize("name", PICTURES)
def test_a_picture_becomes_the_declared_tensor(name: str) -> None:
    """A pixel of a picture that is red at the left and dark blue at the right is at its declared
    place."""
    fields, shape, pixel, value = PICTURES[name]
    tensor = feeder(shape, obs=SMALL | fields).feed(replace(SEEN, rgb=COLOURED))["obs"]
    assert tensor.shape == shape and tensor.dtype == np.float32 and tensor.flags.c_contiguous
    assert tensor[pixel] == pytest.approx(value, abs=0.005)


def test_pictures_stay_bytes_for_a_graph_of_bytes() -> None:
    """With scale 1 they are unchanged."""
    feeding = feeder(
        (None, 8, 16, 3), np.uint8, obs={**SMALL, "size": [16, 8], "layout": "NHWC", "scale": 1}
    )
    np.testing.assert_array_equal(feeding.feed(replace(SEEN, rgb=COLOURED))["obs"], COLOURED[None])


AHEAD_LEFT = PointGoal(3.0, 4.0)
VECTORS: dict[str, tuple[dict[str, Any], Goal | None, list[float]]] = {
    "point": ({"what": "goal_point", "unit_m": 10}, AHEAD_LEFT, [0.3, 0.4]),
    "right-handed": ({"what": "goal_point", "values": ["-y", "x"]}, AHEAD_LEFT, [-4.0, 3.0]),
    "polar": (
        {"what": "goal_point", "values": ["distance", "cos", "sin"], "unit_m": 20},
        AHEAD_LEFT,
        [0.25, 0.6, 0.8],
    ),
    "not-beyond": (
        {"what": "goal_point", "values": ["x", "distance"], "most_m": 2.5},
        AHEAD_LEFT,
        [1.5, 2.5],
    ),
    "normal-point": ({"what": "goal_point", "mean": [1, 2], "std": [2, 4]}, AHEAD_LEFT, [1.0, 0.5]),
    "no-point": ({"what": "goal_point", "mean": [1, 2], "missing": [7, 8]}, None, [7.0, 8.0]),
    "bearing": (
        {"what": "goal_point", "values": ["bearing"]},
        PointGoal(0.0, -1.0),
        [-math.pi / 2],
    ),
    "speeds": ({"what": "speeds", "values": ["v", "w", "-w"]}, None, [1.2, -0.3, 0.3]),
    "left-instruction": (
        {"what": "command"},
        Instruction("Follow the sidewalk. In 5 m, turn left."),
        [-1.0],
    ),
    "left-not-yet": (
        {"what": "command"},
        Instruction("Follow the sidewalk. In 10 m, turn left."),
        [0.0],
    ),
    "right-due": ({"what": "command"}, Instruction("Bear right."), [1.0]),
    "crosswalk": ({"what": "command"}, Instruction("Cross the street at the crosswalk."), [0.0]),
    "right-of-point": (
        {"what": "command", "right": [0, 0, 1], "left": [1, 0, 0], "straight": [0, 1, 0]},
        PointGoal(1.0, -1.0),
        [0.0, 0.0, 1.0],
    ),
    "mask-without": ({"what": "mask", "given": 0, "missing": 1}, AHEAD_LEFT, [1.0]),
    "constant": ({"what": "constant", "value": [1, 2, 3]}, None, [1.0, 2.0, 3.0]),
    "joined": (
        {"what": "joined", "parts": [{"what": "goal_point"}, {"what": "speeds"}]},
        AHEAD_LEFT,
        [3.0, 4.0, 1.2, -0.3],
    ),
}


@pytest.mark.parametrize("name", VECTORS)
def test_numbers_are_given_as_declared(name: str) -> None:
    """A robot at 1.2 m/s that turns right at 0.3 rad/s has this goal."""
    fields, goal, wanted = VECTORS[name]
    tensor = feeder((None, len(wanted)), one=fields).feed(replace(SEEN, goal=goal))["one"]
    np.testing.assert_allclose(tensor, [wanted], atol=1e-6)


SENSORS: dict[str, tuple[dict[str, Any], list[float]]] = {
    "scan": ({"what": "scan", "unit_m": 10}, [0.1, 0.2, 0.3, 0.4, 2.0, 0.6, 0.7, 2.0]),
    "sectors": (
        {"what": "scan", "sectors": 4, "clockwise": True, "most_m": 5},
        [5.0, 5.0, 3.0, 1.0],
    ),
    "imu": ({"what": "imu", "values": ["gyro_z", "accel_x"]}, [0.3, 1.0]),
    "people": (
        {"what": "people", "rows": 3, "values": ["distance", "-vy", "present"], "absent": -1},
        [5.0, 0.0, 1.0, math.hypot(6.0, 1.0), -0.25, 1.0, -1.0, -1.0, -1.0],
    ),
    "joined": (
        {
            "what": "joined",
            "parts": [{"what": "speeds"}, {"what": "people", "rows": 1, "values": ["x"]}],
        },
        [1.2, -0.3, 3.0],
    ),
}


@pytest.mark.parametrize("name", SENSORS)
def test_sensors_are_given_as_declared(name: str) -> None:
    """The sensors are a scan with a missing and a too far return, two tracked people, and an
    inertial reading."""
    fields, wanted = SENSORS[name]
    tensor = feeder((None, len(wanted)), one=fields).feed(SENSED)["one"]
    np.testing.assert_allclose(tensor, [wanted], atol=1e-6)


def test_a_mask_marks_whether_another_input_has_its_goal() -> None:
    """An image goal is given to a graph that takes pictures, and another goal is not."""
    goal = {"what": "goal_picture", "size": [4, 2], "layout": "NCHW", "missing": 0}
    ports = {
        "goal": TensorPort("goal", np.dtype(np.float32), (1, 3, 2, 4)),
        "mask": TensorPort("mask", np.dtype(np.int64), (1,)),
    }
    feeding = Feeder(
        msgspec.convert({"goal": goal, "mask": {"what": "mask"}}, dict[str, GraphInput]), ports, 0
    )
    assert feeding.feed(replace(SEEN, goal=ImageGoal(grey_picture(255))))["mask"].tolist() == [0]
    without = feeding.feed(replace(SEEN, goal=AHEAD_LEFT))
    assert without["mask"].tolist() == [1] and not without["goal"].any()


def test_a_route_patch_has_the_declared_numbers() -> None:
    """Cells on the route and next to it have the declared values, frame by frame."""
    patch = np.zeros((80, 80), np.uint8)
    patch[:40, 40] = 255
    fields = {"what": "route_patch", "frames": 2, "on": 2, "off": -1, "layout": "NTHW"}
    tensor = feeder((1, 2, 80, 80), one=fields).feed(replace(SEEN, goal=RoutePatch(patch)))["one"]
    assert (
        tensor[0, 1, 0, 40] == tensor[0, 0, 39, 40] == 2
        and tensor[0, 1, 41, 40] == tensor[0, 1, 0, 0] == -1
    )


def test_past_positions_are_relative_to_the_robots_pose() -> None:
    """After 2 m ahead, a left turn and 1 m, the start is 1 m behind and 2 m to the left."""
    feeding = feeder((1, 3, 2), one={"what": "past_positions", "frames": 3, "before": "zeros"})
    for place in ((0.0, 0.0, 0.0), (2.0, 0.0, math.pi / 2), (2.0, 1.0, math.pi / 2)):
        seen = feeding.feed(replace(SEEN, odometry=Odometry(*place)))["one"]
    np.testing.assert_allclose(seen[0], [[-1, 2], [-1, 0], [0, 0]], atol=1e-6)
    feeding.clear()
    again = feeding.feed(replace(SEEN, odometry=Odometry(9.0, 9.0, 0.0)))["one"]
    np.testing.assert_array_equal(again, np.zeros((1, 3, 2)))


def test_a_graphs_memory_is_fed_back_until_a_reset() -> None:
    """It is the output of the previous answer, or the last rows of it."""
    feeding = feeder((1, 2), one={"what": "state", "output": "memory", "begin": 0.5})
    assert feeding.feed(SEEN)["one"].tolist() == [[0.5, 0.5]]
    feeding.remember({"memory": np.array([[1.0, 2.0]])})
    assert feeding.feed(SEEN)["one"].tolist() == [[1.0, 2.0]]
    feeding.clear()
    assert feeding.feed(SEEN)["one"].tolist() == [[0.5, 0.5]]
    rows = feeder((1, 3, 2), one={"what": "state", "output": "memory", "append": True})
    for number in (1.0, 2.0):
        rows.remember({"memory": np.array([[number, -number]])})
    assert rows.feed(SEEN)["one"].tolist() == [[[0, 0], [1, -1], [2, -2]]]


def test_noise_comes_from_the_seed_of_the_episode() -> None:
    """It is drawn for every answer, and repeats with the seed."""
    first, same, other = (feeder((1, 8), seed=seed, one={"what": "noise"}) for seed in (3, 3, 4))
    drawn = [one.feed(SEEN)["one"] for one in (first, first, same, other)]
    assert (
        (drawn[0] == drawn[2]).all()
        and not (drawn[0] == drawn[1]).any()
        and not (drawn[0] == drawn[3]).any()
    )
