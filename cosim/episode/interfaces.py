"""Interfaces of policies, engines and cameras to the episode loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from shapely.geometry import MultiPolygon, Polygon

from cosim.core.geometry import Polyline, Pose
from cosim.core.state import Command, Frame, Motion, People, RobotState, Signal, Street, Vehicles
from cosim.spec.camera import Calibration, CameraPicture
from cosim.spec.events import EventQuery, EventReply
from cosim.spec.goal import Goal
from cosim.spec.manifest import Manifest
from cosim.spec.odometry import Odometry
from cosim.spec.robot import Robot
from cosim.spec.sensors import Imu, Scan, Tracks


@dataclass(frozen=True, slots=True)
class Privileged:
    """Simulator state that cameras do not show, for policies that declare `privileged`.

    route_s_m: robot's arc length on the route.
    crossings: id, first and last arc length of each crossing on the route.
    free: positions of the base centre with half the robot's width of clearance, within the walkable
        area and outside barriers.
    waits_m: for each crossing the arc length at which to wait before it, outside the paths of
        turning cars. Empty: directly before each crossing.
    """

    robot: RobotState
    route: Polyline
    route_s_m: float
    people: People
    vehicles: Vehicles
    signals: Mapping[str, Signal]
    crossings: tuple[tuple[str, float, float], ...]
    free: Polygon | MultiPolygon
    waits_m: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Observation:
    """Input of a policy at one moment. Optional fields are set if the manifest requests them.

    tick, time_s: time since the start of the episode.
    rgb: (H, W, 3) uint8, None without a camera.
    v_mps, w_radps: the robot's own speeds, without errors.
    robot: the robot, with its size and limits, constant in an episode.
    privileged: simulator state.
    episode: id of the episode, as in `reset`.
    reset: whether the robot was put elsewhere, at rest, since the last observation, after a
        failure. Older observations are then no history. It is False at the start of an episode.
    goal: goal by the protocol of the manifest or of the run (`cosim.spec.goal`).
    odometry: the robot's estimate of its pose.
    camera: calibration of `rgb`.
    depth: (H, W) float32 metres along the camera's axis.
    labels: (H, W) uint8 ids of `cosim.core.state.LABELS`.
    pictures: pictures of the further cameras by name.
    scan: the last revolution of the lidar.
    imu: reading of the inertial sensor.
    people: tracked people.

    >>> from cosim.spec.robot import COURIER
    >>> now = Observation(tick=5, time_s=0.25, rgb=None, v_mps=0.8, w_radps=0.0, robot=COURIER)
    >>> now.privileged is None
    True
    """

    tick: int
    time_s: float
    rgb: NDArray[np.uint8] | None
    v_mps: float
    w_radps: float
    robot: Robot
    privileged: Privileged | None = None
    episode: str = ""
    reset: bool = False
    goal: Goal | None = None
    odometry: Odometry | None = None
    camera: Calibration | None = None
    depth: NDArray[np.float32] | None = None
    labels: NDArray[np.uint8] | None = None
    pictures: Mapping[str, CameraPicture] = field(default_factory=dict)
    scan: Scan | None = None
    imu: Imu | None = None
    people: Tracks | None = None


class Policy(Protocol):
    """Navigation policy. One object is used for many episodes; `reset` starts each.

    An optional `on_reset()` is called before an `act` whose observation has `reset`: the robot was
    put elsewhere. An exception is recorded as the policy's crash in this episode; it never ends the
    run.

    >>> class Ahead:
    ...     manifest = Manifest("ahead", camera=None)
    ...
    ...     def reset(self, episode_id, seed): ...
    ...
    ...     def act(self, observation):
    ...         return Command(1.0, 0.0)
    """

    @property
    def manifest(self) -> Manifest: ...

    def reset(self, episode_id: str, seed: int) -> None:
        """Start an episode. All random draws must use `seed`.

        Id and seed are derived from the run's seed and the scenario. They reveal neither the
        scenario's name nor its position in the suite.
        """

    def act(self, observation: Observation) -> Command | NDArray[np.floating]:
        """Return a command, or waypoints in the robot's frame.

        Waypoints are (N, 2), x forward and y left in metres, or (N, 4) with cosine and sine of the
        heading there. The manifest's `WaypointRule` selects the followed one.
        """


class BatchPolicy(Policy, Protocol):
    """Policy that can answer for many episodes at once, as in `cosim run --shared-renderer`.

    One object in the renderer's process serves all episodes of the run, several at a time. `reset`
    starts one of them. State of an episode belongs to its id, which every observation contains.

    An optional `ended(episode_id)` is called after the last query of an episode; its exceptions are
    printed and ignored. An optional `on_reset(episode_id)` gets the id. The composition of batches
    is random, so an answer must depend only on its own episode. Without a shared renderer, `act` is
    called.

    A bad answer is the crash of its episode. An exception in `act_batch`, or a wrong number of
    answers, is the crash of all episodes in the batch.

    >>> from cosim.spec.camera import CameraSpec
    >>> class Steady:
    ...     manifest = Manifest("steady", camera=CameraSpec(96, 96))
    ...
    ...     def reset(self, episode_id, seed): ...
    ...
    ...     def act(self, observation):
    ...         return self.act_batch([observation])[0]
    ...
    ...     def act_batch(self, observations):
    ...         pictures = np.stack([one.rgb for one in observations])  # (B, H, W, 3)
    ...         return [Command(1.0, 0.0) for _ in pictures]
    """

    def act_batch(
        self, observations: Sequence[Observation]
    ) -> Sequence[Command | NDArray[np.floating]]:
        """Return the answer of `act` for each observation, in their order."""


class Crowd(Protocol):
    """Everything that moves except the robot."""

    @property
    def street(self) -> Street:
        """Current street."""

    def step(self, robot: RobotState, reply: EventReply) -> Street:
        """Advance one tick, with the robot and the event pedestrians at their current positions."""


class World(Protocol):
    """Physics of the robot."""

    @property
    def footprint_m(self) -> tuple[float, float]:
        """Length and width of the robot in metres."""

    def place(self, pose: Pose) -> RobotState:
        """Put the robot at rest at a pose."""

    def step(self, command: Command, before: Street, after: Street, substeps: int) -> Motion:
        """Advance one tick; people and vehicles move linearly from `before` to `after`."""


class RangeSensor(Protocol):
    """Casts rays from a robot against the collision shapes of the street."""

    def distances(
        self,
        robot: RobotState,
        street: Street,
        height_m: float,
        directions: NDArray[np.float64],
        range_m: float,
    ) -> NDArray[np.float64]:
        """Return the (N,) distances in metres at which rays first hit; inf beyond the range.

        height_m: height of the sensor above the ground under a level robot.
        directions: (3, N) unit vectors in the frame of the robot's trunk.
        """

    def seen_people(
        self, robot: RobotState, street: Street, height_m: float, range_m: float
    ) -> NDArray[np.intp]:
        """Return the rows of people within a range of whom a part is visible from a robot.

        height_m: height of the eye above the ground under a level robot.
        """


class Camera(Protocol):
    """Renders the robot's view."""

    def render(self, robot: RobotState, street: Street) -> Frame: ...


class ViewCamera(Camera, Protocol):
    """Camera that also renders views for humans."""

    def picture(
        self,
        eye_m: ArrayLike,
        target_m: ArrayLike,
        street: Street,
        robot: RobotState | None = None,
        size: tuple[int, int] = (640, 480),
        fov_deg: float = 60.0,
    ) -> Frame:
        """Return a view from (3,) `eye_m` towards (3,) `target_m`, with the robot in it.

        size: width and height in pixels.
        """


class Director(Protocol):
    """Moves the event pedestrians."""

    def react(self, query: EventQuery) -> EventReply: ...
