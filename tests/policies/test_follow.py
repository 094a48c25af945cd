"""`follow`: its graph from published weights, people and ground in pictures, and the arcs that it
takes."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cosim.core.errors import UsageError
from cosim.core.state import STILL, Command
from cosim.episode.manifest_checks import calibration_of
from cosim.policies.follow.espnetv2 import street_graph
from cosim.policies.follow.networks import (
    ESPNET_GRAPH,
    ESPNET_WEIGHTS,
    YOLOX_NANO,
    weights_in_words,
)
from cosim.policies.follow.policy import (
    ARC_LENGTH_M,
    GROUND_CELL_M,
    Ground,
    WaitForPeople,
    best_arc,
    command_along,
    decode_boxes,
    turn_aside,
    walkable_pixels,
)
from cosim.policies.load import load_policy
from cosim.policies.onnx.graph import Graph
from cosim.policies.onnx.policy import example_observation
from cosim.policies.onnx.torch_file import read_torch_file
from cosim.spec.camera import CameraSpec
from cosim.spec.robot import COURIER, ROBOTS, Robot
from tests.support.follow_weights import WEIGHTS, make_weights
from tests.support.graphs import tiny_graph

PICTURES = Path(__file__).parent / "pictures"
CAMERA = calibration_of(CameraSpec(512, 288, 60.0), COURIER)
GROUND = Ground(CAMERA, (512, 288))
OPEN = np.ones((80, 80), np.bool_)
NOBODY = np.zeros((0, 2))


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with both graphs, one of them built by this test."""
    return make_weights(tmp_path_factory.mktemp("weights"))


def picture(name: str) -> NDArray[np.uint8]:
    return np.ascontiguousarray(cv2.imread(str(PICTURES / f"{name}.jpg"))[..., ::-1])


def test_every_array_of_the_file_is_used_by_the_graph(weights: Path) -> None:
    """A NetworkFile with an additional, a missing or a renamed array is refused."""
    arrays = read_torch_file((WEIGHTS / ESPNET_WEIGHTS.name).read_bytes())
    with pytest.raises(ValueError, match="holds 'more', and 0 more, of which there is no place"):
        street_graph({**arrays, "more": np.zeros(1)})
    name = "base_net.level4.6.spp_dw.3.conv.weight"
    with pytest.raises(ValueError, match=f"has no '{name}'"):
        street_graph({key: array for key, array in arrays.items() if key != name})


def test_espnetv2_sees_a_sidewalk_between_two_verges(weights: Path) -> None:
    """In pictures of our street pavement is walkable, grass and houses are not, and mirrored
    pictures give mirrored masks."""
    network = Graph(weights / ESPNET_GRAPH.name)
    street = picture("front_left")
    walkable = walkable_pixels(street, network)
    assert walkable[110:, 140:190].mean() > 0.9, "the pavement before the robot"
    assert walkable[95:118, 2:25].mean() < 0.1, "grass"
    mirrored = walkable_pixels(np.ascontiguousarray(street[:, ::-1]), network)
    assert (walkable[60:] == mirrored[60:, ::-1]).mean() > 0.95


def test_follow_turns_back_to_the_sidewalk_and_a_mirrored_street_mirrors_its_turn(
    weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot without a goal that has turned 30 degrees away turns back, mirrored to the other
    side."""
    monkeypatch.setenv("COSIM_WEIGHTS", str(weights))
    driver = load_policy("follow")
    assert len(driver.source_hash) == 16 and str(weights) in weights_in_words()
    policy = driver.policy
    seen = replace(example_observation(policy.manifest), goal=None, camera=CAMERA)

    def turn(street: NDArray[np.uint8]) -> float:
        policy.reset("street", 0)
        answer = policy.act(replace(seen, rgb=np.ascontiguousarray(street)))
        assert isinstance(answer, Command)
        return answer.w_radps

    for turned, sign in (("left", -1.0), ("right", 1.0)):
        street = picture(f"front_{turned}")
        assert sign * turn(street) > 0.1 and sign * turn(street[:, ::-1]) < -0.1


def test_follow_without_its_weights_says_how_they_are_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message has the command, its input file and the source; another file of the name is
    refused."""
    monkeypatch.setenv("COSIM_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    with pytest.raises(
        UsageError,
        match=r"missing: from `python -m cosim.policies.follow.espnetv2 .*\.pth`.*EdgeNets",
    ):
        load_policy("follow")
    assert weights_in_words() == f"weights missing ({ESPNET_GRAPH.name}, {YOLOX_NANO.name})"
    (tmp_path / ESPNET_GRAPH.name).write_bytes(b"\x3a\x00")
    (tmp_path / YOLOX_NANO.name).write_bytes(b"\x3a\x00")
    with pytest.raises(UsageError, match=r"policy 'follow': .*city_512x256\.onnx: "):
        load_policy("follow")
    (tmp_path / ESPNET_GRAPH.name).write_bytes(tiny_graph())
    with pytest.raises(
        UsageError, match=r"city_512x256\.onnx: cannot be run by onnxruntime: .*picture"
    ):
        load_policy("follow")


def test_a_file_that_is_not_the_weights_is_refused_in_one_line(tmp_path: Path) -> None:
    """The line has its size and hash and the required ones, and nothing is written."""
    (tmp_path / "w.pth").write_bytes(b"not weights")
    command = [
        sys.executable,
        "-m",
        "cosim.policies.follow.espnetv2",
        tmp_path / "w.pth",
        "-o",
        tmp_path / "out",
    ]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 1 and result.stderr.count("\n") == 1
    assert "w.pth: 11 bytes, BLAKE2b" in result.stderr and "1107690 bytes" in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_file_of_weights_cannot_run_code() -> None:
    """A pickle with anything but tensors is refused, and so is a file that is no pickle."""
    begin = pickle.dumps(0x1950A86A20F9469CFC6C) + pickle.dumps(1001) + pickle.dumps({})
    with pytest.raises(ValueError, match=r"holds a \w+\.system: weights alone are read"):
        read_torch_file(begin + pickle.dumps(os.system))
    for data in (b"", b"PK\x03\x04", pickle.dumps(7), begin):
        with pytest.raises(ValueError, match="no PyTorch file of weights"):
            read_torch_file(data)


def test_boxes_are_decoded_from_the_networks_answer() -> None:
    """A planted answer in the grid of 16 pixels, and its duplicate next to it, become one box in
    picture pixels."""
    answer = np.zeros((3549, 85), np.float32)
    row = 52 * 52 + 10 * 26 + 5  # of the second grid, the row 10 and the column 5
    answer[row, :6] = 0.5, 0.25, np.log(2.0), np.log(4.0), 0.9, 0.9
    answer[row + 1, :6] = -0.5, 0.25, np.log(2.0), np.log(4.0), 0.9, 0.6
    answer[7, :6] = 0.0, 0.0, 0.0, 0.0, 0.9, 0.2
    (box,) = decode_boxes(answer, scale=416 / 512)
    middle = np.array([5.5, 10.25]) * 16
    size = np.array([32.0, 64.0])
    assert np.allclose(
        box, np.concatenate([middle - size / 2, middle + size / 2]) * 512 / 416, atol=0.01
    )


def test_feet_are_located_on_the_ground() -> None:
    """The lower edge of a box locates a person 4 m ahead and 1 m left; a box above the horizon is
    left out."""
    x, y, depth = CAMERA.matrix @ (np.linalg.inv(CAMERA.on_robot) @ [4.0, 1.0, 0.0, 1.0])[:3]
    u, v = x / depth, y / depth
    feet = GROUND.ground_positions(
        np.array([[u - 10, v - 60, u + 10, v], [200.0, 10.0, 220.0, 60.0]])
    )
    assert np.allclose(feet, [[4.0, 1.0]], atol=0.01)


def test_unwalkable_pixels_block_the_ground_they_show() -> None:
    """A picture with an unwalkable left half blocks the cells to the left, as far as the camera
    sees them."""
    walkable = np.ones((128, 256), np.bool_)
    walkable[:, :128] = False
    free = GROUND.free(walkable)
    assert free[:, :40].all() and not free[20:, 41:50].any() and free[:5].all()


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_arcs_keep_to_the_middle_and_lead_to_the_goal(robot: Robot) -> None:
    """They lead straight on open ground, to the goal's side, and away from a wall, with mirrored
    results."""
    assert best_arc(OPEN, NOBODY, robot, None).curvature == pytest.approx(0.0, abs=1e-9)
    assert command_along(best_arc(OPEN, NOBODY, robot, None), robot).v_mps == pytest.approx(
        0.8 * robot.cruise_mps
    )
    assert (
        best_arc(OPEN, NOBODY, robot, 0.5).curvature
        > 0.1
        > -0.1
        > best_arc(OPEN, NOBODY, robot, -0.5).curvature
    )
    wall = OPEN.copy()
    wall[:, 46:] = False  # from 0.6 m to the left
    away = best_arc(wall, NOBODY, robot, None)
    back = best_arc(wall[:, ::-1], NOBODY, robot, None)
    assert away.curvature < -0.01 and away.free_m == ARC_LENGTH_M
    assert back.curvature == pytest.approx(-away.curvature)


def test_follow_passes_a_person_with_room_and_stops_without() -> None:
    """The policy passes a person on open ground and stops before one in a lane of 1.4 m."""
    person = np.array([[2.5, 0.0]])
    round_him = best_arc(OPEN, person, COURIER, None)
    assert abs(round_him.curvature) > 0.1 and round_him.free_m == ARC_LENGTH_M
    lane = np.zeros((80, 80), np.bool_)
    lane[:, 33:47] = True
    assert command_along(best_arc(lane, person, COURIER, None), COURIER).v_mps > 0.0
    assert command_along(best_arc(lane, person - [1.0, 0.0], COURIER, None), COURIER) == STILL
    assert command_along(best_arc(lane, NOBODY, COURIER, None), COURIER).v_mps == pytest.approx(1.2)


def test_follow_turns_on_the_spot_to_the_freer_side() -> None:
    """It turns left where more of the left is free."""
    half = OPEN.copy()
    half[round(1.0 / GROUND_CELL_M) :, :40] = False
    assert turn_aside(half, COURIER).w_radps > 0.0 > turn_aside(half[:, ::-1], COURIER).w_radps


def test_follow_waits_four_seconds_for_a_near_person_and_then_passes() -> None:
    """The policy waits four seconds for a person near it, even if the detector misses a frame, and
    then passes."""
    near = np.array([[2.0, 0.3]])
    far = np.array([[4.0, 0.0], [2.0, 1.5]])
    waiting = WaitForPeople()
    assert not waiting.stands(0.0, far) and not waiting.stands(0.2, NOBODY)
    seen = [
        waiting.stands(t, NOBODY if t == 2.8 else near)
        for t in (1.0, 1.9, 2.6, 2.8, 3.2, 4.1, 4.9, 5.0)
    ]
    assert seen == [True, True, True, False, True, True, True, False]
    assert not waiting.stands(5.4, near) and waiting.stands(7.0, near)
