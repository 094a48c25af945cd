"""Published networks of states: the answers of their repositories, and how they drive.

`published_cases.npz` has the inputs and outputs of the authors' code with the published weights:

- `cadrl`: the notebook ga3c_cadrl_demo.ipynb of mit-acl/cadrl_ros, and five random rows, evaluated
  by TensorFlow 2.15 with the published graph. The notebook's printed action is in the test.
- `sarl`: states and 81 action values of the test case 0 of vita-epfl/CrowdNav.
- `dsrnn`: the first 40 steps of the test case 0 of Shuijing725/CrowdNav_DSRNN, unicycle.
- `td3`: `TD3.get_action` of test_velodyne_td3.py for its first state and random ones.
- `metaurban`: `PPO.predict` of Stable-Baselines3 2.3.2, as eval_ppo.py loads it.
"""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from cosim.core.errors import UsageError
from cosim.core.geometry import Polyline, Pose
from cosim.core.network import softmax
from cosim.core.state import STILL, Command
from cosim.episode.control import clipped
from cosim.episode.interfaces import Observation
from cosim.policies.load import load_policy
from cosim.policies.published import NETWORK_POLICIES
from cosim.policies.published.cadrl import ACTIONS, Cadrl, states
from cosim.policies.published.dsrnn import EMPTY, GOAL_MOST_M, PEOPLE, Dsrnn, Places, arena
from cosim.policies.published.metaurban_ppo import MetaurbanPpo, driven, state
from cosim.policies.published.network_policy import weights_in_words
from cosim.policies.published.sarl import VELOCITIES, Sarl, action_values
from cosim.policies.published.td3_lidar import Td3Lidar, sectors
from cosim.policies.published.tensorflow_file import read_checkpoint
from cosim.spec.goal import PointGoal, RoutePoints, in_robot_frame, route_points_at
from cosim.spec.odometry import Odometry
from cosim.spec.robot import COURIER
from cosim.spec.sensors import Scan, ScanSpec, Tracks

CASES = np.load(Path(__file__).parent / "published_cases.npz")
START = Pose(0.0, 0.0, 0.0)
WEIGHTS = Path(os.environ.get("COSIM_WEIGHTS") or Path(__file__).parents[3] / "shared" / "weights")


@pytest.fixture
def weights(monkeypatch: pytest.MonkeyPatch) -> None:
    """The published files, which are not in this repository."""
    names = [file.name for one in NETWORK_POLICIES.values() for file in one.files]
    if missing := [name for name in names if not (WEIGHTS / name).is_file()]:
        pytest.skip(f"the published files {', '.join(missing)} are not in {WEIGHTS}")
    monkeypatch.setenv("COSIM_WEIGHTS", str(WEIGHTS))


def test_cadrl_answers_as_the_notebook_of_its_authors(weights: None) -> None:
    """Their scene gives their input row, the action that they printed, and the graph's shares."""
    network = Cadrl().network
    here, goal = np.array([2.0, 5.0]), np.array([1.0, -3.0])
    people = np.array([(-1, 2, 1.0, 0.0), (-2, 3, 0.6, 0.6), (-3, 4, 0.2, 0.8)])
    people[:, :2] -= here
    towards = math.hypot(*goal), math.atan2(goal[1], goal[0])
    host, others = states(towards, people, np.array([0.5, 0.4, 0.3]), 0.5, 1.2)
    row = CASES["cadrl.rows"][0]
    assert np.concatenate([[3.0], host, others.ravel()]) == pytest.approx(row[:26], abs=1e-6)
    speed, turn_rad = ACTIONS[int(np.argmax(network.logits(host, others)))]
    assert (1.2 * speed, turn_rad) == pytest.approx((1.2, -0.52359878))
    for row, shares in zip(CASES["cadrl.rows"], CASES["cadrl.shares"], strict=True):
        logits = network.logits(row[1:5], row[5 : 5 + 7 * int(row[0])].reshape(-1, 7))
        assert softmax(logits) == pytest.approx(shares, abs=1e-5)


def test_sarl_values_velocities_as_the_test_case_of_its_authors(weights: None) -> None:
    """The 81 action values of four states, and the chosen velocities, are equal."""
    network = Sarl().network
    for robot, people, values, action in zip(
        *(CASES[f"sarl.{name}"] for name in ("robot", "people", "values", "action")), strict=True
    ):
        in_robot_frame_rows = np.column_stack([people[:, :2] - robot[:2], people[:, 2:4]])
        found = action_values(network, robot[5:7] - robot[:2], in_robot_frame_rows)
        assert found == pytest.approx(values, abs=2e-6)
        assert VELOCITIES[int(np.argmax(found))] == pytest.approx(action, abs=1e-9)


def test_dsrnn_remembers_as_the_test_case_of_its_authors(weights: None) -> None:
    """The changes of 40 steps, each with the memory of the previous one, are equal."""
    network, memory = Dsrnn().network, EMPTY
    for robot, velocity, people, changes in zip(
        *(CASES[f"dsrnn.{name}"] for name in ("robot", "velocity", "people", "changes")),
        strict=True,
    ):
        found, memory = network.changes(robot, velocity, people, memory)
        assert found == pytest.approx(changes, abs=2e-5)


def test_lidar_networks_answer_as_the_code_of_their_authors(weights: None) -> None:
    """The actors of TD3 and of PPO give the published answers."""
    td3, ppo = Td3Lidar().network, MetaurbanPpo().network
    for given, action in zip(CASES["td3.states"], CASES["td3.actions"], strict=True):
        assert td3.answer(given, ())[0] == pytest.approx(action, abs=1e-6)
    for given, action in zip(CASES["metaurban.states"], CASES["metaurban.actions"], strict=True):
        assert np.clip(ppo.answer(given, ())[0], -1, 1) == pytest.approx(action, abs=2e-6)


def tracks(*rows: tuple[float, float, float, float], ids: ArrayLike = ()) -> Tracks:
    array = np.array(rows, np.float32).reshape(-1, 4)
    names = np.array(ids or range(len(rows)), np.int32)
    return Tracks(names, array[:, :2], array[:, 2:])


def scan(spec: ScanSpec, walls: dict[tuple[float, float], float] | None = None) -> Scan:
    """A scan with distances by intervals of bearings in degrees."""
    degrees = np.degrees(spec.angles_rad)
    ranges = np.full(spec.rays, np.inf, np.float32)
    for (low, high), distance in (walls or {}).items():
        ranges[(degrees >= low) & (degrees <= high)] = distance
    return Scan(ranges[None], spec)


def observation_of(
    name: str, pose: Pose = START, side: float = 0.0, people: Tracks | None = None
) -> Observation:
    """An observation in a free street with a goal at (10, side), or a route over it."""
    manifest = NETWORK_POLICIES[name].manifest
    route = Polyline([(0.0, 0.0), (40.0, 4.0 * side)])
    along = manifest.goal == "route_points"
    s_m = float(np.clip(pose.xy @ route.points[-1] / route.length_m, 0.0, route.length_m))
    return Observation(
        tick=0,
        time_s=0.0,
        rgb=None,
        v_mps=0.0,
        w_radps=0.0,
        robot=COURIER,
        goal=RoutePoints(route_points_at(pose, s_m, route))
        if along
        else in_robot_frame(pose, Pose(10.0, side, 0.0)),
        odometry=Odometry(*pose),
        scan=None if manifest.scan is None else scan(manifest.scan),
        people=people or tracks(),
    )


@pytest.mark.parametrize("side", [4.0, -4.0], ids=["left", "right"])
@pytest.mark.parametrize("name", ["cadrl", "dsrnn", "sarl", "metaurban-ppo"])
def test_a_robot_reaches_a_goal_on_either_side(weights: None, name: str, side: float) -> None:
    """It comes within 2 m in a free street, with commands within the limits of its robot."""
    policy = NETWORK_POLICIES[name]()
    pose, last, k = START, STILL, 0
    step_s = 1.0 / policy.manifest.rate_hz
    while math.dist(pose.xy, (10.0, side)) > 2.0:
        assert k * step_s < 20.0
        now = replace(observation_of(name, pose, side), time_s=k * step_s)
        last = policy.act(replace(now, v_mps=last.v_mps, w_radps=last.w_radps))
        assert last == clipped(last, COURIER)
        heading = pose.heading_rad + step_s * last.w_radps
        along = step_s * last.v_mps * np.array([math.cos(heading), math.sin(heading)])
        pose, k = Pose(*(pose.xy + along), heading), k + 1


def test_td3_turns_to_the_side_of_its_goal(weights: None) -> None:
    """Between walls it turns left where the goal is left, and right where it is right."""
    policy = Td3Lidar()
    between = scan(policy.manifest.scan or ScanSpec(), {(-180.0, 180.0): 5.0})

    def turn(y_m: float) -> float:
        policy.reset("street", 0)
        return policy.act(
            replace(observation_of("td3-lidar"), goal=PointGoal(3.0, y_m), scan=between)
        ).w_radps

    assert turn(4.0) > 0.5 and turn(-4.0) < -0.5


@pytest.mark.parametrize("name", ["cadrl", "sarl"])
def test_people_change_the_command(weights: None, name: str) -> None:
    """People change it, and the same observations give the same command again."""
    policy = NETWORK_POLICIES[name]()
    near = tracks((1.5, 0.2, -1.0, 0.0), (2.5, -0.6, 0.0, 0.3))

    def commands(people: Tracks) -> list[Command]:
        policy.reset("street", 0)
        return [
            policy.act(replace(observation_of(name, people=people), time_s=0.1 * i))
            for i in range(3)
        ]

    assert commands(near) == commands(near) != commands(tracks())


@pytest.mark.parametrize("name", [*NETWORK_POLICIES])
def test_missing_files_are_named_with_size_hash_and_source(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same message refuses a file with other content."""
    monkeypatch.setenv("COSIM_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    policy = NETWORK_POLICIES[name]
    first = policy.files[0]
    assert first.facts is not None and first.name in weights_in_words(policy)
    with pytest.raises(UsageError) as caught:
        load_policy(name)
    assert (
        f"policy '{name}': {first.name} is missing, {first.facts.bytes} bytes, SHA-256 "
        f"{first.facts.sha256}: from {first.source}" in str(caught.value)
    )
    for file in policy.files:
        (tmp_path / file.name).parent.mkdir(exist_ok=True)
        (tmp_path / file.name).write_bytes(b"weights")
    with pytest.raises(UsageError, match=rf"7 bytes, .*; expected {first.name} of"):
        load_policy(name)


def test_sectors_are_from_right_to_left() -> None:
    """Each has its least distance, at most 10 m, and returns from behind count in none."""
    spec = ScanSpec(rays=360, range_m=20.0)
    least = sectors(scan(spec, {(-90.0, -82.0): 3.0, (0.0, 4.0): 2.0, (150.0, 179.0): 1.0}))
    assert least.tolist() == [3.0, *(9 * [10.0]), 2.0, *(9 * [10.0])]


def test_the_input_of_metaurban_is_relative_to_the_route() -> None:
    """The robot is 1 m to the left of a route that leads 45 degrees to the right, with a wall to
    the left."""
    spec = ScanSpec(rays=240, range_m=50.0)
    step = math.sqrt(2.0)
    way = np.array([(i * step - 1.0 / step, -i * step - 1.0 / step) for i in range(11)])
    given = state(scan(spec, {(80.0, 100.0): 5.0}), way, -0.4)
    assert given.shape == (271,) and given[:7].tolist() == 7 * [0.0]
    assert given[7:9] == pytest.approx([0.4, (1.0 - 1.0 / 2.25) / 2.0])
    assert given[9:11] == pytest.approx((way[2] * (1, -1) / 30.0 + 1.0) / 2.0)
    assert given[27:31] == pytest.approx([0.4, 0.375, 0.0, 0.0], abs=1e-6)
    assert given[31] == 1.0 and given[31 + 60] == pytest.approx(0.1) and given[31 + 180] == 1.0
    faster = driven(0.5, 1.0, 1.0, COURIER)
    assert faster.v_mps == pytest.approx(1.0 + 0.1 * 3200.0 / 1595.0) and faster.w_radps > 0.0
    assert driven(0.0, -1.0, 0.5, COURIER).v_mps == 0.0


def test_people_keep_their_slots() -> None:
    """A person holds a slot while near, is extrapolated while unseen, then forgotten; a nearer one
    replaces the farthest of five."""
    places, here = Places(), np.zeros(2)
    rows = [(float(i + 2), 0.0, 0.0, 1.0) for i in range(5)]
    assert places.update(tracks(*rows), here, 0.0, 0.0) == [0, 1, 2, 3, 4]
    turned = tracks((1.0, 0.0, 0.0, 0.0), *rows, ids=[9, 0, 1, 2, 3, 4])
    assert places.update(turned, here, math.pi / 2.0, 0.1) == [4]
    found = places.relative(here, here, 0.1)
    assert found[4] == pytest.approx([0.0, 1.0]) and found[0] == pytest.approx([0.0, 2.0])
    assert places.update(tracks(), here, 0.0, 0.6) == []
    assert places.relative(here, here, 0.6)[0] == pytest.approx([-0.5, 2.0])
    places.update(tracks(), here, 0.0, 1.2)
    assert places.held == PEOPLE * [None]
    assert places.relative(here, np.array([1.0, 2.0]), 1.2)[0].tolist() == [16.0, 17.0]


def test_an_arena_lies_between_robot_and_goal() -> None:
    """It is fixed while the robot drives, at most 12 m wide, and moves on near its end."""
    goal = np.array([20.0, 0.0])
    first = arena(None, np.zeros(2), goal)
    assert first.goal.tolist() == [GOAL_MOST_M, 0.0] and first.centre.tolist() == [6.0, 0.0]
    assert arena(first, np.array([7.0, 0.0]), goal) is first
    second = arena(first, np.array([9.0, 0.0]), goal)
    assert second.goal.tolist() == [20.0, 0.0]
    assert arena(second, np.array([19.0, 0.0]), goal) is second
    other = arena(second, np.array([19.0, 0.0]), np.array([19.0, 4.0]))
    assert other.centre.tolist() == [19.0, 2.0]


def varint(number: int) -> bytes:
    low, rest = number & 0x7F, number >> 7
    return bytes([low | 0x80]) + varint(rest) if rest else bytes([low])


def block(*entries: tuple[bytes, bytes]) -> bytes:
    """A block of a table, whose keys share beginnings."""
    data, last = b"", b""
    for key, value in entries:
        pairs = zip(key, last, strict=False)
        shared = next((i for i, (a, b) in enumerate(pairs) if a != b), min(len(key), len(last)))
        data += varint(shared) + varint(len(key) - shared) + varint(len(value))
        data, last = data + key[shared:] + value, key
    return data + (0).to_bytes(4, "little") + (1).to_bytes(4, "little")


def checkpoint(arrays: dict[str, NDArray[np.float32]]) -> tuple[bytes, bytes]:
    """Return index and numbers of a checkpoint, as TensorFlow writes them."""
    entries, numbers = [(b"", b"\x08\x01")], b""
    for name, array in sorted(arrays.items()):
        sides = b"".join(
            b"\x12" + varint(len(varint(side)) + 1) + b"\x08" + varint(side) for side in array.shape
        )
        place = b"\x20" + varint(len(numbers)) + b"\x28" + varint(array.nbytes)
        value = b"\x08\x01\x12" + varint(len(sides)) + sides + place + b"\x35abcd"
        entries.append((name.encode(), value))
        numbers += array.tobytes()
    data = block(*entries)
    trailer = b"\x00" + b"crc "
    top = block((b"z", varint(0) + varint(len(data))))
    handles = varint(0) + varint(0) + varint(len(data) + 5) + varint(len(top))
    footer = handles.ljust(40, b"\x00") + (0xDB4775248B80FB57).to_bytes(8, "little")
    return data + trailer + top + trailer + footer, numbers


def test_a_checkpoint_is_read_without_tensorflow() -> None:
    """Names with shared prefixes, shapes and numbers are read, and damaged files are refused."""
    arrays = {
        "layer/kernel:0": np.arange(600, dtype=np.float32).reshape(3, 200),
        "layer/bias:0": np.ones(200, np.float32),
        "step:0": np.float32(7.0).reshape(()),
    }
    index, numbers = checkpoint(arrays)
    found = read_checkpoint(index, numbers)
    assert found.keys() == arrays.keys()
    assert all((found[name] == array).all() for name, array in arrays.items())
    for wrong, expected in (
        (index[:-1], "it ends otherwise"),
        (index.replace(b"\x00crc ", b"\x01crc "), "compressed index"),
        (b"\xff" * 20 + index[20:], "TensorFlow checkpoint"),
    ):
        with pytest.raises(ValueError, match=expected):
            read_checkpoint(wrong, numbers)
    with pytest.raises(ValueError, match="not in the checkpoint's first data file"):
        read_checkpoint(index, numbers[:-4])
