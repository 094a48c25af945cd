"""Observations of a policy in real episodes: picture goals, further cameras, and no secrets."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from cosim.core.errors import RunError
from cosim.core.state import Command, People, RobotState, Street
from cosim.episode.interfaces import Observation
from cosim.episode.policy_caller import PolicyCaller
from cosim.results.run_folder import read_spec
from cosim.spec.camera import CameraSpec
from cosim.spec.goal import ImageGoal, PointGoal
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import Scenario, Suite
from cosim.spec.sensors import ScanSpec
from physics.cameras.view import robot_shot
from scenarios.episodes.episode import Episode
from scenarios.runs.run import run
from scenarios.tools.verify.doctor import small_scenario
from scenarios.tools.viewing.drawn_route import way_in_picture
from tests.support.reachable import leaks

pytestmark = pytest.mark.engine

SPEC = CameraSpec(64, 48, depth=True, labels=True)
ALL = Manifest(
    "all",
    camera=SPEC,
    goal="image",
    odometry="wheel",
    scan=ScanSpec(rays=90),
    imu="noisy",
    people="seen",
    cameras={"left": CameraSpec(48, 32, mount="left")},
)
SEED = EpisodeOptions(seed=11)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    """Return a second of a long way in a small city."""
    return msgspec.structs.replace(small_scenario(), time_limit_s=1.0)


class Ahead:
    """Drives straight ahead, and stores its observations."""

    def __init__(self, manifest: Manifest) -> None:
        self.manifest = manifest
        self.seen: list[Observation] = []

    def reset(self, episode_id: str, seed: int) -> None:
        """Keeps no state."""

    def act(self, observation: Observation) -> Command:
        self.seen.append(observation)
        return Command(1.0, 0.0)


def test_an_observation_holds_no_secret_and_a_goal_picture_has_no_people(
    scenario: Scenario,
) -> None:
    """An unprivileged observation with everything that can be requested reaches no value of the
    simulator alone, and its goal picture shows the place without people."""
    policy = Ahead(ALL)
    driver = PolicyCaller(policy)
    with Episode(scenario, ALL, SEED) as episode, episode.eyes(SPEC) as camera:
        first = seen = episode.reset()
        while not episode.over:
            now = episode.moment
            seen = episode.advance(driver.act(seen))
        assert len(now.street.people) > 5
        for one in (first, seen, *policy.seen):
            assert leaks(one, scenario, episode.moment) == [] == leaks(one, scenario, now)
        place = scenario.route_line.at(20.0)
        z_m, _, _ = episode._open.engines.world.surface.lean(place, seen.robot.drive.span_m)  # type: ignore[attr-defined]
        robot = RobotState(place, z_m=z_m)
        ahead = place.xy + 3.0 * np.array([np.cos(place.heading_rad), np.sin(place.heading_rad)])
        person = People.of(("a",), [ahead], [0.0], [0.0], ("stand",))
        empty, met = (
            camera.render(robot, Street(0, people)).rgb
            for people in (People.of((), [], [], [], ()), person)
        )
    assert isinstance(first.goal, ImageGoal) and np.array_equal(first.goal.rgb, empty)
    assert (first.goal.rgb != met).any(axis=-1).mean() > 0.02
    assert first.depth is not None and first.depth.shape == (48, 64) and first.labels is not None
    assert 1.0 < float(np.median(first.depth)) < 160.0 and len(np.unique(first.labels)) > 2
    assert first.pictures["left"].rgb.shape == (32, 48, 3) and first.pictures["left"].depth is None
    assert seen.odometry is not None and 0.1 < seen.odometry.x_m < 1.0


def test_goals_are_drawn_from_the_runs_seed_and_change_nothing_in_the_street(
    scenario: Scenario,
) -> None:
    """The same seed gives the same goals, and another seed others. The option overrides the
    manifest and is recorded; state hashes and pictures equal those of an episode without goals."""
    records = []
    pictures = []
    points = []
    for goal, seed in (
        ("none", 1),
        ("random_point", 1),
        ("random_point", 1),
        ("random_point", 2),
        ("image", 1),
    ):
        options = EpisodeOptions(seed=seed, goal=goal)  # type: ignore[arg-type]
        with Episode(
            scenario, Manifest("seeing", camera=CameraSpec(48, 32), goal="final_point"), options
        ) as episode:
            seen = [episode.reset()]
            while not episode.over:
                seen.append(episode.advance(Command(1.0, 0.0)))
            records.append(episode.result()[0])
        pictures.append([one.rgb.tobytes() for one in seen if one.rgb is not None])
        points.append(
            [(one.goal.x_m, one.goal.y_m) for one in seen if isinstance(one.goal, PointGoal)]
        )
    assert [record.manifest.goal for record in records] == ["none", *["random_point"] * 3, "image"]
    assert len({record.state_hash for record in records}) == 1
    assert pictures[0] == pictures[1] == pictures[4]
    assert points[0] == points[4] == [] and points[1] == points[2] and points[1][0] != points[3][0]


def test_a_run_cannot_be_resumed_with_other_goals(scenario: Scenario, tmp_path: Path) -> None:
    """Rows and run.json have the goal protocol, and resuming with another one is refused with both
    names."""
    suite = Suite(name="one", version="1", scenarios=(scenario,))
    policy = Ahead(Manifest("ahead", camera=None, odometry="gps"))
    given = EpisodeOptions(seed=2, goal="route_point")
    table = run(suite, policy, out=tmp_path / "run", options=given)
    assert table[["goal_protocol", "odometry", "privileged"]].to_numpy().tolist() == [
        ["route_point", "gps", False]
    ]
    assert (
        all(isinstance(one.goal, PointGoal) and one.odometry is not None for one in policy.seen)
        and policy.seen
    )
    spec = read_spec(tmp_path / "run")
    assert (spec.manifest.goal, spec.manifest.odometry) == ("route_point", "gps")
    for goal, named in (
        ("final_point", "and this command has final_point"),
        (None, "and this command has none"),
    ):
        other = EpisodeOptions(seed=2, goal=goal)  # type: ignore[arg-type]
        with pytest.raises(
            RunError, match=f"is of another run: its goal_protocol is route_point, {named}"
        ):
            run(suite, policy, out=tmp_path / "run", resume=True, options=other)
    assert len(run(suite, policy, out=tmp_path / "run", resume=True, options=given)) == 1


def test_the_calibration_is_that_of_the_picture(scenario: Scenario) -> None:
    """Every ground pixel before the robot maps to level ground by depth and matrix, and a point of
    the ground is drawn where the calibration projects it."""
    with Episode(scenario, ALL, SEED) as episode:
        seen = episode.reset()
        z_m = episode.moment.robot.z_m
        # type: ignore[attr-defined]
        surface = episode._open.engines.world.surface
        robot = episode.moment.robot
        lean = np.array(surface.lean(scenario.start_pose, seen.robot.drive.span_m)[1:])
        shot = robot_shot(surface, seen.robot, SPEC, robot)
    assert seen.camera is not None and seen.depth is not None and seen.labels is not None
    assert np.abs(lean).max() < 0.01, "a start on a slope tells nothing here"
    rows, columns = np.nonzero((seen.labels == 2) & (seen.depth < 8.0))
    rays = np.linalg.inv(seen.camera.matrix) @ np.stack([columns, rows, np.ones_like(rows)])
    points = seen.camera.on_robot @ np.vstack(
        [rays * seen.depth[rows, columns], np.ones_like(rows)]
    )
    assert len(rows) > 50 and abs(z_m) < 1.0
    assert np.abs(np.median(points[2])) < 0.03 and np.percentile(np.abs(points[2]), 90) < 0.06
    cos, sin = np.cos(robot.pose.heading_rad), np.sin(robot.pose.heading_rad)
    ground_points = points[:2].T @ [[cos, sin], [-sin, cos]] + robot.pose.xy
    drawn = way_in_picture(
        shot, SPEC.lens, np.column_stack([ground_points, surface.heights(ground_points)])
    ).points
    off_px = np.hypot(*(drawn - np.column_stack([columns, rows]) - 0.5).T)
    assert np.median(off_px) < 0.3 and np.percentile(off_px, 90) < 1.0
