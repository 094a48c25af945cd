"""The pose filter on made-up tracks."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from cosim.core.geometry import Floats, Pose, box_disk_gap, wrap_angle
from cosim.core.state import PERSON_RADIUS_M
from cosim.people.yielding import RobotBody, StandingObstacles
from cosim.spec.events import StandingBody
from sumo_nets.crowd.shown_people import MAX_SPEED_MPS, MAX_TURN_RADPS, PoseFilter

DT_S = 0.05


def east(name: str) -> float:
    """Headings of people who all enter facing along x."""
    return 0.0


def filtered(track: Floats, facing_rad: float = 0.0) -> tuple[Floats, Floats, Floats]:
    """Return what the filter shows of one person on a track (T, 2): (T, 2), (T,), (T,)."""
    poses = PoseFilter(DT_S)
    speed = np.hypot(*np.diff(track, axis=0, prepend=track[:1]).T) / DT_S
    rows = [
        poses.update(("c1",), track[i : i + 1], speed[i : i + 1], lambda _: facing_rad)
        for i in range(len(track))
    ]
    xy, facing, fast = (np.concatenate([row[k] for row in rows]) for k in range(3))
    return xy, facing, fast


def walk(seconds: float, mps: float = 1.4) -> Floats:
    t = np.arange(0.0, seconds, DT_S)
    return np.column_stack([mps * t, np.zeros_like(t)])


def test_an_even_walk_is_unchanged() -> None:
    """A person who walks evenly is shown exactly where it is, at its speed."""
    track = walk(3.0)
    xy, facing, speed = filtered(track)
    np.testing.assert_allclose(xy, track, atol=1e-12)
    np.testing.assert_allclose(facing, 0.0, atol=1e-12)
    np.testing.assert_allclose(speed[1:], 1.4)


def test_a_jump_becomes_a_brisk_walk_that_catches_up() -> None:
    """After a sideways jump of 2 m the shown speed stays below the limit, and the gap closes."""
    track = walk(8.0)
    track[40:, 1] += 2.0
    xy, _, speed = filtered(track)
    assert speed.max() <= MAX_SPEED_MPS + 1e-9
    assert np.hypot(*np.diff(xy, axis=0).T).max() <= MAX_SPEED_MPS * DT_S + 1e-9
    np.testing.assert_allclose(xy[-1], track[-1], atol=1e-9)


def test_the_heading_follows_the_motion_at_a_limited_rate() -> None:
    """A turn on the spot by 90 degrees takes at least half a second."""
    track = walk(3.0)
    corner = np.concatenate([track, track[-1] + walk(3.0)[1:, ::-1]])
    _, facing, _ = filtered(corner)
    turns = [abs(wrap_angle(b - a)) for a, b in itertools.pairwise(facing)]
    assert max(turns) <= MAX_TURN_RADPS * DT_S + 1e-9
    assert facing[-1] == pytest.approx(math.pi / 2, abs=0.01)


def test_a_standing_person_keeps_its_heading() -> None:
    """Small shuffles of a standing person do not turn it."""
    rest = np.zeros((60, 2))
    rest[:, 1] = 0.005 * (np.arange(60) % 2)
    _, facing, _ = filtered(rest, facing_rad=1.0)
    np.testing.assert_allclose(facing, 1.0)


def test_poses_follow_ids_as_people_enter_and_leave() -> None:
    """Each id keeps its own pose whatever its row, and a person who returns is new."""
    poses = PoseFilter(DT_S)
    ab = np.array([[0.0, 0.0], [10.0, 0.0]])
    poses.update(("a", "b"), ab, np.zeros(2), east)
    bc = np.array([[0.0, 0.0], [20.0, 0.0]])
    xy, _, _ = poses.update(("b", "c"), bc, np.zeros(2), east)
    assert xy[0] == pytest.approx([10.0 - MAX_SPEED_MPS * DT_S, 0.0]) and xy[1] == pytest.approx(
        bc[1]
    )
    empty = poses.update((), np.zeros((0, 2)), np.zeros(0), east)
    assert [len(part) for part in empty] == [0, 0, 0]
    xy, _, _ = poses.update(("b",), ab[:1], np.zeros(1), east)
    assert xy[0] == pytest.approx(ab[0])


@pytest.mark.parametrize("aside_m", [0.3, 0.6, 0.8, 1.0], ids=["close", "near", "middle", "apart"])
def test_people_avoid_obstacles_without_walking_into_the_robot(aside_m: float) -> None:
    """A person who passes an obstacle comes no nearer to a robot that drives on the other side."""
    half_m = 0.35, 0.275
    standing = StandingObstacles([StandingBody(0.0, -aside_m, 0.0, 1.0, 0.6, 0.0, -1.0)])
    poses = PoseFilter(DT_S, standing)
    track = walk(3.0, MAX_SPEED_MPS) - [3.0, aside_m - 0.1]
    least_m = math.inf
    for i in range(len(track)):
        robot = Pose(-2.4 + 1.2 * i * DT_S, 0.45, 0.0)
        body = RobotBody(robot, half_m, 1.2)
        xy, _, _ = poses.update(("c1",), track[i : i + 1], np.full(1, MAX_SPEED_MPS), east, body)
        least_m = min(
            least_m,
            float(box_disk_gap(np.array([robot]), *half_m, xy[None])[0, 0]) - PERSON_RADIUS_M,
        )
    assert least_m > 0.05


@pytest.mark.parametrize("robot_y_m", [0.3, 0.45, 0.6])
@pytest.mark.parametrize("aside_m", [-0.4, 0.0, 0.2])
def test_people_pass_a_robot_beside_an_obstacle(robot_y_m: float, aside_m: float) -> None:
    """No person gets stuck between an obstacle at the edge and a robot that stands next to it."""
    half_m = 0.35, 0.275
    standing = StandingObstacles([StandingBody(0.0, -0.7, 0.0, 1.0, 0.6, 0.0, -1.0)])
    poses = PoseFilter(DT_S, standing)
    robot = Pose(0.0, robot_y_m, 0.0)
    least_m = math.inf
    for x_m in np.minimum(np.arange(-4.0, 12.0, 1.3 * DT_S), 4.0).tolist():
        at = np.array([[x_m, aside_m]])
        xy, _, _ = poses.update(("c1",), at, np.full(1, 1.3), east, RobotBody(robot, half_m))
        gap_m = float(box_disk_gap(np.array([robot]), *half_m, xy[None])[0, 0]) - PERSON_RADIUS_M
        least_m = min(least_m, gap_m)
    assert least_m > 0.05
    assert xy[0] == pytest.approx([4.0, aside_m], abs=0.1)
