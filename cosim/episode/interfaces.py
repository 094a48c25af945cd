"""What the loop needs of the engines and of a policy: protocols of a few methods each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as filled
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


@dataclass(frozen=True, slots=True)
class Privileged:
    """What the simulator knows and a camera does not; given only to policies that declare it.

    route_s_m: the robot's arc length on the route. crossings: for each crossing of the route its id
    and the arc lengths at which the route enters and leaves it. free: where the base centre may be
    with half the robot's width to spare: the walkable area minus barriers, eroded.
    """

    robot: RobotState
    route: Polyline
    route_s_m: float
    people: People
    vehicles: Vehicles
    signals: Mapping[str, Signal]
    crossings: tuple[tuple[str, float, float], ...]
    free: Polygon | MultiPolygon


@dataclass(frozen=True, slots=True)
class Observation:
    """What a policy gets. rgb: (H, W, 3) uint8 or None without a camera; v_mps, w_radps: its own
    speeds, without error.

    Where the manifest asks for them: depth (H, W) float32, metres along the camera's axis; labels
    (H, W) uint8 of `cosim.core.state.LABELS`; camera: how `rgb` was taken; pictures: of the further
    cameras, by name; odometry: where the robot takes itself to be; goal: by the protocol of the
    manifest or of the run (`cosim.spec.goal`).

    tick, time_s: since the start of the episode; robot: which one it drives, the same from reset to
    the end: its size, its pace, its limits; privileged: only for a manifest that declares it;
    episode: of which one it is, as `reset` was told: a name that tells nothing. reset: since the
    last observation the robot was put back on its way after a failure, elsewhere and at rest, so
    that what was seen before is no history of this; not at the start of an episode, which
    `Policy.reset` tells.

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
    pictures: Mapping[str, CameraPicture] = filled(default_factory=dict)


class Policy(Protocol):
    """A navigation policy. One object lives through many episodes; `reset` comes before each.

    `on_reset()`, if it has one, is called before the `act` whose observation says `reset`: the
    robot was put elsewhere. Whatever it raises is its own crash, recorded with the episode; it
    never ends the run.

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
        """A new episode begins. Anything random must come from `seed`. Both are drawn from the seed
        of the run and the scenario, and tell neither its name nor its place in the suite."""

    def act(self, observation: Observation) -> Command | NDArray[np.floating]:
        """A command, or waypoints in the robot's frame: (N, 2), x forward and y left, or (N, 4)
        with the cosine and the sine of the heading there; the manifest's `WaypointRule` says which
        is followed, and how."""


class BatchPolicy(Policy, Protocol):
    """A policy that can answer for many episodes at once; `cosim run --shared-renderer` asks it so.

    One object, in the renderer's process, lives through all episodes of the run, of which several
    are under way at any time. `reset` begins one of them; what the policy remembers of an episode
    it keeps under its id, which every observation carries. `ended(episode_id)`, if it has one, is
    called when nothing more will be asked about an episode, however that ended; what it raises is
    printed and changes nothing. Its `on_reset(episode_id)` is told of which. Who is asked together
    is a matter of time and chance: an answer must depend on nothing but its own episode. Without a
    shared renderer it is a policy like any other, asked by `act`.

    A bad answer is the crash of its episode; whatever `act_batch` raises, also a number of answers
    that is not that of the observations, is the crash of all that it was asked for.

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
        """For each observation, in their order, what `act` would answer."""


class Crowd(Protocol):
    """Everything that moves but the robot."""

    @property
    def street(self) -> Street:
        """The street now."""

    def step(self, robot: RobotState, reply: EventReply) -> Street:
        """One tick on, with the robot and the event pedestrians where they are now."""


class World(Protocol):
    """The physics of the robot."""

    @property
    def footprint_m(self) -> tuple[float, float]:
        """Length and width of the robot."""

    def place(self, pose: Pose) -> RobotState:
        """Put the robot at rest at a pose."""

    def step(self, command: Command, before: Street, after: Street, substeps: int) -> Motion:
        """One tick of physics; people and vehicles move evenly from `before` to `after`."""


class Camera(Protocol):
    """Draws what the robot sees."""

    def render(self, robot: RobotState, street: Street) -> Frame: ...


class Eyes(Camera, Protocol):
    """A camera that also draws for humans."""

    def picture(
        self,
        eye_m: ArrayLike,
        target_m: ArrayLike,
        street: Street,
        robot: RobotState | None = None,
        size: tuple[int, int] = (640, 480),
        fov_deg: float = 60.0,
    ) -> Frame:
        """A view from (3,) `eye_m` towards (3,) `target_m`, with the robot in it; size: width,
        height."""


class Director(Protocol):
    """Moves the event pedestrians."""

    def react(self, query: EventQuery) -> EventReply: ...
