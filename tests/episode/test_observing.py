"""Observations: what the manifest requests, drawn from a seed, and nothing that only the simulator
knows."""

from __future__ import annotations

import dataclasses
import weakref
from collections.abc import Callable
from typing import cast, get_args

import numpy as np
import pytest

from cosim.core.geometry import Pose
from cosim.core.state import STILL, Frame, Motion, People, RobotState, Street
from cosim.episode.interfaces import Observation, Privileged
from cosim.episode.loop import Moment, Step
from cosim.episode.observer import Observer
from cosim.spec.camera import CameraSpec
from cosim.spec.events import Event, EventReply
from cosim.spec.goal import GoalProtocol, ImageGoal, PointGoal
from cosim.spec.manifest import Manifest
from cosim.spec.odometry import Odometry, OdometryKind
from cosim.spec.robot import COURIER
from cosim.spec.scenario import City, Scenario
from tests.support.reachable import leaks

SCENARIO = Scenario(
    id="frontal-017",
    suite="reactive",
    place=City(seed=1, size_m=500.0),
    seed=5,
    start=(101.3, 57.7, 0.4),
    goal=(141.8, 90.2),
    route=((101.3, 57.7), (120.6, 70.9), (141.8, 90.2)),
    events=(
        Event(
            id="e1",
            kind="frontal",
            x_m=120.25,
            y_m=70.65,
            heading_rad=0.4,
            route_s_m=22.9,
            half_width_m=2.1,
        ),
    ),
)
PEOPLE = People.of(
    ("c17", "e1"), [[110.2, 60.1], [121.7, 71.3]], [0.1, 0.2], [1.1, 1.2], ("walk", "walk")
)


HERE = Pose(107.9, 62.3, 0.61)


def moment(tick: int = 20, pose: Pose = HERE) -> Moment:
    return Moment(
        tick,
        RobotState(pose, 1.1, 0.05),
        Street(tick, PEOPLE),
        SCENARIO.route_line.project(*pose[:2])[0],
    )


class CountingCamera:
    """A camera that draws people as one brighter pixel each."""

    def __init__(self, spec: CameraSpec) -> None:
        self.spec = spec

    def render(self, robot: RobotState, street: Street) -> Frame:
        rgb = np.full((self.spec.height, self.spec.width, 3), 7 + len(street.people), np.uint8)
        return Frame(rgb, np.zeros(rgb.shape[:2], np.uint8), np.ones(rgb.shape[:2], np.float32))


def no_knowledge(now: Moment) -> Privileged:
    raise AssertionError("what the simulator knows was asked for")


def observed(
    manifest: Manifest,
    now: Moment | None = None,
    seed: int = 3,
    known: Callable[[Moment], Privileged] = no_knowledge,
) -> Observation:
    """Return what a policy observes in a street with two people."""
    eye = None if manifest.camera is None else CountingCamera(manifest.camera)
    observer = observing(manifest, seed, known)
    return observer.observed(now or moment(), 1.0, eye, was_reset=False)[0]


def observing(
    manifest: Manifest, seed: int = 3, known: Callable[[Moment], Privileged] = no_knowledge
) -> Observer:
    eye = None if manifest.camera is None else CountingCamera(manifest.camera)
    further = {name: CountingCamera(spec) for name, spec in manifest.cameras.items()}

    def look(pose: Pose) -> np.ndarray:
        assert eye is not None
        return eye.render(RobotState(pose), Street(0)).rgb

    return Observer(SCENARIO, manifest, seed, known, further, look)


def test_a_default_manifest_gets_only_the_basic_observation() -> None:
    """It has speeds, time and robot, but no picture, goal, odometry, calibration, depth, labels or
    knowledge."""
    seen = observed(Manifest("blind", camera=None))
    goal_and_odometry = {
        f.name for f in dataclasses.fields(seen) if getattr(seen, f.name) not in (None, {}, False)
    }
    assert goal_and_odometry == {"tick", "time_s", "v_mps", "w_radps", "robot", "episode"}


def test_each_requested_sensor_is_given() -> None:
    """Cameras get the depth and labels that they request, and image goals lack the people of the
    picture."""
    spec = CameraSpec(8, 6, depth=True)
    manifest = Manifest(
        "all",
        camera=spec,
        goal="image",
        odometry="exact",
        cameras={"left": CameraSpec(4, 4, labels=True)},
    )
    seen = observed(manifest)
    assert (
        seen.rgb is not None
        and seen.rgb.max() == 9
        and seen.depth is not None
        and seen.labels is None
    )
    assert (
        isinstance(seen.goal, ImageGoal)
        and seen.goal.rgb.max() == 7
        and seen.goal.rgb.shape == (6, 8, 3)
    )
    left = seen.pictures["left"]
    assert left.rgb.shape == (4, 4, 3) and left.depth is None and left.labels is not None
    assert (
        left.camera.matrix[0, 2] == 1.5
        and seen.camera is not None
        and seen.camera.matrix[0, 2] == 3.5
    )
    assert seen.odometry is not None and seen.odometry.x_m > 5.0


@pytest.mark.parametrize("protocol", get_args(GoalProtocol))
@pytest.mark.parametrize("odometry", get_args(OdometryKind))
def test_an_observation_gives_no_access_to_privileged_values(
    protocol: GoalProtocol, odometry: OdometryKind
) -> None:
    """No attribute, container, closure, weak reference or array base of any goal protocol leads to
    simulator values."""
    cameras = {"left": CameraSpec(4, 4, mount="left", depth=True, labels=True)}
    spec = CameraSpec(8, 6, depth=True, labels=True)
    seen = observed(Manifest("all", camera=spec, goal=protocol, odometry=odometry, cameras=cameras))
    assert leaks(seen, SCENARIO, moment()) == []


def _planted(seen: Observation, what: str) -> object:
    """An observation that leaks."""
    now = moment()
    people = PEOPLE
    plants: dict[str, object] = {
        "attribute": people,
        "array": people.xy[1],
        "view": np.hstack([people.xy, people.xy])[:, 1:2][:0],
        "container": [{"x": (1, {"deep": SCENARIO.route_line})}],
        "closure": lambda: now.robot,
        "default": lambda at=now.robot.pose: at,
        "method": SCENARIO.driven_by,
        "weak": weakref.ref(SCENARIO.route_line),
        "objects": np.array([SCENARIO], dtype=object),
        "number": now.route_s_m,
        "name": "frontal-017",
        "key": {"c17": 0},
    }
    return dataclasses.replace(seen, goal=cast(PointGoal, plants[what]))


PLANTS = [
    "attribute",
    "array",
    "view",
    "container",
    "closure",
    "default",
    "method",
    "weak",
    "objects",
    "number",
]
PLANTS += ["name", "key"]


@pytest.mark.parametrize("what", PLANTS)
def test_the_sweep_finds_every_kind_of_leak(what: str) -> None:
    """Each planted way to pass a privileged value on is found."""
    assert leaks(_planted(observed(Manifest("blind", camera=None)), what), SCENARIO, moment())


def test_privileged_policies_get_the_simulators_knowledge() -> None:
    """They get it in addition to their goal."""
    moments: list[Moment] = []
    nothing = cast(Privileged, object())

    def known(now: Moment) -> Privileged:
        moments.append(now)
        return nothing

    seen = observed(
        Manifest("knows", camera=None, privileged=True, goal="final_point"), known=known
    )
    assert seen.privileged is nothing and len(moments) == 1 and isinstance(seen.goal, PointGoal)


def test_goals_and_errors_are_drawn_independently_from_the_runs_seed() -> None:
    """Goals and errors repeat with the seed and differ with another, and odometry changes no goal."""

    def goal_and_odometry(
        seed: int, odometry: OdometryKind = "gps"
    ) -> tuple[object, Odometry | None]:
        seen = observed(
            Manifest("mine", camera=None, goal="random_point", odometry=odometry), seed=seed
        )
        return seen.goal, seen.odometry

    assert goal_and_odometry(3) == goal_and_odometry(3)
    assert (
        goal_and_odometry(3)[0] != goal_and_odometry(4)[0]
        and goal_and_odometry(3)[1] != goal_and_odometry(4)[1]
    )
    assert goal_and_odometry(3, "wheel")[0] == goal_and_odometry(3)[0]


def drove(before: Pose, after: Pose) -> Step:
    motion = Motion(RobotState(after), np.zeros((10, 3)))
    reply = EventReply(episode="", tick=0, actors=(), states=())
    return Step(0, RobotState(before), Street(0), 0.0, None, STILL, reply, motion, Street(0), 0.0)


def test_a_reset_gives_another_random_point_and_is_not_counted_by_the_wheels() -> None:
    """After 2 m of driving and a reset by 6 m the wheels count 2 m, and the point is 5 to 20 m
    ahead."""
    observer = observing(Manifest("mine", camera=None, goal="random_point", odometry="wheel"))
    start, ahead, back = (Pose(101.3 + d, 57.7, 0.0) for d in (0.0, 2.0, -4.0))
    first = observer.observed(moment(0, start), 0.0, None, was_reset=False)[0].goal
    observer.moved(drove(start, ahead), is_reset=False)
    unchanged = observer.observed(moment(5, ahead), 0.25, None, was_reset=False)[0].goal
    observer.moved(drove(ahead, ahead), is_reset=True)
    seen = observer.observed(moment(6, back), 0.3, None, was_reset=True)[0]
    assert (
        isinstance(first, PointGoal)
        and isinstance(unchanged, PointGoal)
        and isinstance(seen.goal, PointGoal)
    )
    assert (unchanged.x_m, unchanged.y_m) == pytest.approx((first.x_m - 2.0, first.y_m))
    assert 5.0 <= seen.goal.x_m <= 20.0 and abs(seen.goal.x_m - (first.x_m + 4.0)) > 1e-6
    assert (
        seen.odometry is not None
        and seen.odometry.x_m == pytest.approx(2.0, abs=0.5)
        and seen.reset
    )


def test_the_robot_description_is_that_of_the_table() -> None:
    """Size, limits and mounts are the same value in every episode."""
    assert observed(Manifest("blind", camera=None)).robot is COURIER
