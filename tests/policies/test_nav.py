"""The policy `nav` on computed scans of circles and walls, and one episode at the end."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cosim.core.geometry import Floats, Pose
from cosim.core.state import PERSON_RADIUS_M, Command
from cosim.episode.interfaces import Observation
from cosim.policies.nav.costmap import CELL_M, Costmap
from cosim.policies.nav.local_plan import local_plan
from cosim.policies.nav.policy import Nav
from cosim.policies.nav.pursuit import pursue
from cosim.policies.nav.route_path import STEP_M, path_to
from cosim.policies.nav.tracking import Tracker
from cosim.spec.goal import PointGoal, RoutePatch, route_patch_at
from cosim.spec.odometry import Odometry
from cosim.spec.robot import COURIER, ROBOTS, Robot
from cosim.spec.sensors import Scan, ScanSpec
from scenarios.episodes.run_episode import run_episode
from scenarios.suites.catalog import load_suite

SPEC = Nav.manifest.scan or ScanSpec()
START = Pose(0.0, 0.0, 0.0)
ROUTE = np.array([(-5.0, 0.0), (12.0, 0.0)])


def scan_at(pose: Pose, circles: Floats) -> Scan:
    """Return a noiseless lidar scan of circles, (N, 3) x, y and radius."""
    angles = SPEC.angles_rad + pose.heading_rad
    unit = np.column_stack([np.cos(angles), np.sin(angles)])
    to = circles[:, :2] - pose.xy
    along = unit @ to.T
    across = (to * to).sum(axis=1) - along**2
    inside = circles[:, 2] ** 2 - across
    hits = np.where((inside > 0.0) & (along > 0.0), along - np.sqrt(np.maximum(inside, 0.0)), 99.0)
    ranges = hits.min(axis=1, initial=99.0)
    ranges[ranges > SPEC.range_m] = np.inf
    return Scan(ranges[None].astype(np.float32), SPEC)


def wall(x_m: float, low_m: float, high_m: float) -> Floats:
    """Return circles in a row across the way."""
    y = np.arange(low_m, high_m, 0.15)
    return np.column_stack([np.full_like(y, x_m), y, np.full_like(y, 0.1)])


def drive(
    robot: Robot, things: Floats, walker: Floats | None = None, until_s: float = 20.0
) -> tuple[list[Pose], float]:
    """Drive a unicycle along ROUTE to its end or until the time is up.

    walker: x, y, vx, vy of a person.
    Returns the poses, and the least distance of the robot's middle to an outline.
    """
    policy, pose, speed, poses, least_m = Nav(), START, Command(0.0, 0.0), [START], math.inf
    policy.reset("e", 0)
    for k in range(round(10 * until_s)):
        circles = things
        if walker is not None:
            at = walker[:2] + 0.1 * k * walker[2:]
            circles = np.vstack([things, [(*at, PERSON_RADIUS_M)]])
        to = np.hypot(*(circles[:, :2] - pose.xy).T) - circles[:, 2]
        least_m = min(least_m, float(to.min(initial=math.inf)))
        now = Observation(
            tick=2 * k,
            time_s=0.1 * k,
            rgb=None,
            v_mps=speed.v_mps,
            w_radps=speed.w_radps,
            robot=robot,
            goal=RoutePatch(route_patch_at(pose, ROUTE)),
            odometry=Odometry(*pose),
            scan=scan_at(pose, circles),
        )
        speed = policy.act(now)
        heading = pose.heading_rad + 0.1 * speed.w_radps
        pose = Pose(
            pose.x_m + 0.1 * speed.v_mps * math.cos(heading),
            pose.y_m + 0.1 * speed.v_mps * math.sin(heading),
            heading,
        )
        poses.append(pose)
        if math.hypot(*(ROUTE[-1] - pose.xy)) < 1.0:
            break
    return poses, least_m


def test_the_path_follows_the_route_of_a_patch_to_its_end() -> None:
    """It turns a corner and ends at the goal, within half a pixel, also from beside the route and
    rotated."""
    route = np.array([(-4.0, 0.0), (3.0, 0.0), (3.0, 2.5)])
    for pose in (START, Pose(-0.5, 0.6, 0.3), Pose(0.2, -0.7, -0.5)):
        path = path_to(RoutePatch(route_patch_at(pose, route)), -pose.heading_rad)
        cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
        in_map = path @ np.array([[cos, sin], [-sin, cos]]) + pose.xy
        off = np.minimum(
            np.where(in_map[:, 0] <= 3.3, np.abs(in_map[:, 1]), np.inf), np.abs(in_map[:, 0] - 3.0)
        )
        assert off.max() < 0.4 and np.hypot(*(in_map[-1] - route[-1])) < 0.6
        assert np.hypot(*np.diff(path, axis=0).T) == pytest.approx(STEP_M, abs=0.08)


def test_a_point_is_approached_straight_and_other_goals_are_refused() -> None:
    """The path ends at a point to the left, and without a goal the error names the protocol."""
    assert path_to(PointGoal(3.0, 4.0), 0.0)[-1] == pytest.approx([3.0, 4.0], abs=STEP_M)
    with pytest.raises(ValueError, match="--goal route_patch"):
        path_to(None, 0.0)


def test_the_costmap_marks_hits_and_clears_seen_space() -> None:
    """Distances hold while the robot drives and turns, and a body that leaves is cleared."""
    costmap, thing = Costmap(), np.array([(3.0, 0.5, 0.3)])
    for k in range(10):
        pose = Pose(0.13 * k, 0.05 * k, 0.1 * k)
        costmap.update(scan_at(pose, thing), pose)
        cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
        probe = np.array([(2.0, 0.5)]) - pose.xy
        found = costmap.distances(probe @ np.array([[cos, -sin], [sin, cos]]))
        assert found[0] == pytest.approx(0.7, abs=1.5 * CELL_M)
    costmap.update(scan_at(pose, np.array([(-6.0, 0.0, 0.3)])), pose)
    assert costmap.distances(np.array([(1.9, 0.0)]))[0] == 2.0


def test_a_plan_passes_an_obstacle_and_ends_before_a_wall() -> None:
    """It takes the gap on the free side; on a closed way it is blocked, and the robot stops before
    the wall."""
    path = path_to(RoutePatch(route_patch_at(START, ROUTE)), 0.0)
    costmap = Costmap()
    costmap.update(scan_at(START, wall(3.0, -0.2, 2.5)), START)
    plan = local_plan(path, costmap, COURIER.width_m / 2, 0.1)
    beside = plan.points[np.argmin(np.abs(plan.points[:, 0] - 3.0))]
    assert not plan.blocked and plan.side == -1 and -1.2 < beside[1] < -0.55
    costmap = Costmap()
    costmap.update(scan_at(START, wall(1.1, -2.5, 2.5)), START)
    plan = local_plan(path, costmap, COURIER.width_m / 2, 0.1)
    assert plan.blocked and plan.free_m < 1.1
    assert pursue(plan, costmap, COURIER, 0.5, 1.5) == Command(0.0, 0.0)


def test_a_track_has_the_walkers_velocity_and_obstacles_have_none() -> None:
    """From a driving and turning robot the velocity is exact to 0.2 m/s, and nothing else moves."""
    tracker = Tracker()
    things = np.array([(4.0, -2.0, 0.3), (2.5, 1.8, 0.2)])
    for k in range(20):
        pose = Pose(0.1 * k, 0.0, 0.02 * k)
        walker = (6.0, -2.0 + 0.12 * k, PERSON_RADIUS_M)
        tracker.update(scan_at(pose, np.vstack([things, [walker]])), pose, 0.1 * k)
    movers = tracker.movers(pose)
    cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    assert movers.velocity == pytest.approx(np.array([(1.2 * sin, 1.2 * cos)]), abs=0.2)
    assert movers.at @ np.array([[cos, sin], [-sin, cos]]) + pose.xy == pytest.approx(
        np.array([walker[:2]]), abs=0.25
    )


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=list(ROBOTS))
def test_any_robot_drives_a_slalom(robot: Robot) -> None:
    """It passes an obstacle on the left and one on the right to the goal without touching either."""
    things = np.vstack([wall(4.0, -0.3, 2.0), wall(8.0, -2.0, 0.3)])
    poses, least_m = drive(robot, things, until_s=40.0)
    assert math.hypot(*(ROUTE[-1] - poses[-1].xy)) < 1.0
    assert least_m > robot.width_m / 2 + 0.03


def test_the_robot_lets_a_crossing_person_pass_and_continues() -> None:
    """It slows down for the person, touches nobody, and reaches the goal."""
    walker = np.array([5.0, -4.0, 0.0, 1.2])
    poses, least_m = drive(COURIER, np.array([(6.0, 5.0, 0.3)]), walker)
    assert least_m > math.hypot(*COURIER.footprint_m) / 2
    assert math.hypot(*(ROUTE[-1] - poses[-1].xy)) < 1.0


def test_a_closed_way_makes_the_robot_wait_and_then_turn_slowly() -> None:
    """It stops before the wall, and never touches it."""
    poses, least_m = drive(COURIER, wall(4.0, -3.0, 3.0), until_s=15.0)
    assert least_m > COURIER.length_m / 2 and max(pose.x_m for pose in poses) < 3.2
    assert max(abs(pose.heading_rad) for pose in poses) > 0.15


@pytest.mark.engine
def test_nav_solves_a_scenario_with_an_obstacle_reproducibly() -> None:
    """With the engine's lidar two runs have equal bits, without a camera or privileged knowledge."""
    (scenario,) = (one for one in load_suite("unit").scenarios if one.id == "straight-001")
    records = [run_episode(scenario, Nav()).record for _ in range(2)]
    assert [one.measures["success"] for one in records] == [1.0, 1.0]
    assert records[0].state_hash == records[1].state_hash
    assert not Nav.manifest.privileged and Nav.manifest.camera is None
