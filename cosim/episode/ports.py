"""What the loop needs of the engines and of a policy: protocols of a few methods each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as filled
from typing import Literal, Protocol, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from shapely.geometry import MultiPolygon, Polygon

from cosim.core.errors import SpecError
from cosim.core.geometry import Polyline, Pose
from cosim.core.state import Command, Frame, Motion, People, RobotState, Signal, Street, Vehicles
from cosim.spec.events import EventQuery, EventReply
from cosim.spec.goal import Goal, GoalProtocol
from cosim.spec.odometry import Odometry, OdometryKind
from cosim.spec.picture import Calibration, CameraPicture
from cosim.spec.robot import Mount, Robot


@dataclass(frozen=True, slots=True)
class Lens:
    """What a camera's optics and sensor do to a picture; the default does nothing.

    k1, k2: radial terms of Brown's distortion, in units of the focal length; k1 < 0 is a barrel.
    shutter_s: time the shutter is open, the source of motion blur; readout_s: from the first row to the last, the
    source of a rolling shutter's skew. full_well_e: electrons of a white pixel, 0 for a sensor without noise;
    read_noise_e: electrons of noise in the dark. auto_exposure_ev: stops by which metering on the picture itself may
    brighten or darken it. vignette: 0 (none) to 1 (the natural fall of light, cos^4 of the angle off the axis).
    """

    k1: float = 0.0
    k2: float = 0.0
    shutter_s: float = 0.0
    readout_s: float = 0.0
    full_well_e: float = 0.0
    read_noise_e: float = 0.0
    auto_exposure_ev: float = 0.0
    vignette: float = 0.0

    def __post_init__(self) -> None:
        ranges = {
            "k1": (-0.5, 0.5), "k2": (-0.5, 0.5), "shutter_s": (0.0, 0.1), "readout_s": (0.0, 0.1),
            "full_well_e": (0.0, 1e6), "read_noise_e": (0.0, 1000.0), "auto_exposure_ev": (0.0, 4.0),
            "vignette": (0.0, 1.0),
        }  # fmt: skip
        for field, (low, high) in ranges.items():
            if not low <= getattr(self, field) <= high:
                raise SpecError(f"lens {field} must be in [{low:g}, {high:g}], not {getattr(self, field)}")
        if self.read_noise_e and not self.full_well_e:
            raise SpecError("lens read_noise_e needs full_well_e, the electrons of a white pixel (10000 is usual)")


@dataclass(frozen=True, slots=True)
class CameraSpec:
    """A policy's camera: size in pixels, vertical field of view in degrees, and where it sits.

    mount: the name of one of the robot's mounts, which every robot has elsewhere and whose limits hold for size, field
    of view and rate. A place of one's own, or what is beyond the limits, needs `EpisodeOptions.own_camera`.
    crop: (x0, y0, x1, y1) in pixels of the whole picture: the policy gets its columns x0 to x1 and rows y0 to y1 alone,
    from the upper left corner, without x1 and y1. depth, labels: whether the policy gets these of each picture, too.
    Raises SpecError where the crop is no part of the picture.

    >>> CameraSpec(width=512, height=288, fov_deg=60.0, crop=(0, 88, 512, 288)).size
    (512, 200)
    """

    width: int = 96
    height: int = 96
    fov_deg: float = 75.0
    mount: str | Mount = "front"
    lens: Lens = Lens()
    crop: tuple[int, int, int, int] | None = None
    depth: bool = False
    labels: bool = False

    def __post_init__(self) -> None:
        if self.crop is None:
            return
        object.__setattr__(self, "crop", tuple(self.crop))
        x0, y0, x1, y1 = self.crop if len(self.crop) == 4 else (0, 0, 0, 0)
        if not (0 <= x0 < x1 <= self.width and 0 <= y0 < y1 <= self.height):
            raise SpecError(
                f"camera crop must be (x0, y0, x1, y1) within {self.width} x {self.height} pixels, x0 < x1 and "
                f"y0 < y1, not {self.crop}"
            )

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of what the policy gets."""
        x0, y0, x1, y1 = self.crop or (0, 0, self.width, self.height)
        return x1 - x0, y1 - y0

    @property
    def in_words(self) -> str:
        """As tables tell it."""
        own = "own mount" if isinstance(self.mount, Mount) else self.mount
        crop = "" if self.crop is None else ", crop " + " ".join(map(str, self.crop))
        more = ", lens" * (self.lens != Lens()) + ", depth" * self.depth + ", labels" * self.labels
        return f"{own}, {self.width} x {self.height} px, {self.fov_deg:g} deg{crop}{more}"

    def on(self, robot: Robot) -> Mount:
        """Where it sits on a robot. Raises UsageError, listing the robot's mounts, if it has none of that name."""
        return robot.mount(self.mount) if isinstance(self.mount, str) else self.mount


@dataclass(frozen=True, slots=True)
class Privileged:
    """What the simulator knows and a camera does not; given only to policies that declare it.

    route_s_m: the robot's arc length on the route. crossings: for each crossing of the route its id and the arc
    lengths at which the route enters and leaves it. free: where the base centre may be with half the robot's width
    to spare: the walkable area minus barriers, eroded.
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
    """What a policy gets. rgb: (H, W, 3) uint8 or None without a camera; v_mps, w_radps: its own speeds, without error.

    Where the manifest asks for them: depth (H, W) float32, metres along the camera's axis; labels (H, W) uint8 of
    `cosim.core.state.LABELS`; camera: how `rgb` was taken; pictures: of the further cameras, by name; odometry: where
    the robot takes itself to be; goal: by the protocol of the manifest or of the run (`cosim.spec.goal`).

    tick, time_s: since the start of the episode; robot: which one it drives, the same from reset to the end: its size,
    its pace, its limits; privileged: only for a manifest that declares it; episode: of which one it is, as `reset` was
    told: a name that tells nothing. reset: since the last observation the robot was put back on its way after a
    failure, elsewhere and at rest, so that what was seen before is no history of this; not at the start of an episode,
    which `Policy.reset` tells.

    >>> from cosim.spec.robot import COURIER
    >>> Observation(tick=5, time_s=0.25, rgb=None, v_mps=0.8, w_radps=0.0, robot=COURIER).privileged is None
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


HowFollowed = Literal["shipped", "atan2"]


@dataclass(frozen=True, slots=True)
class WaypointRule:
    """How a policy's waypoints become a command. The defaults are how GNM, ViNT and NoMaD drive their robots.

    index: which waypoint is followed, from 0: the third of an answer. unit_m: metres in one unit of x and y. dt_s: the
    time in which it is to be reached. rule: "shipped", v = x / dt and w = arctan(y / x) / dt, so that a waypoint behind
    the robot turns it by less than a quarter; or "atan2", w = atan2(y, x) / dt, which turns it round. Both take a
    waypoint at the robot's own place by its heading, if it has one (`cosim.episode.control`). Raises SpecError.

    >>> WaypointRule(index=0, dt_s=0.2).in_words
    'waypoint 0, units of 1 m, in 0.2 s, shipped'
    """

    index: int = 2
    unit_m: float = 1.0
    dt_s: float = 0.25
    rule: HowFollowed = "shipped"

    def __post_init__(self) -> None:
        if isinstance(self.index, bool) or not isinstance(self.index, int) or self.index < 0:
            raise SpecError(f"waypoints index must be a whole number from 0, not {self.index!r}")
        for field in ("unit_m", "dt_s"):
            value = getattr(self, field)
            if not (math.isfinite(value) and value > 0.0):
                raise SpecError(f"waypoints {field} must be a positive number, not {value}")
        if self.rule not in get_args(HowFollowed):
            raise SpecError(f"waypoints rule must be one of {', '.join(get_args(HowFollowed))}, not {self.rule!r}")

    @property
    def in_words(self) -> str:
        """As tables tell it."""
        return f"waypoint {self.index}, units of {self.unit_m:g} m, in {self.dt_s:g} s, {self.rule}"


@dataclass(frozen=True, slots=True)
class Manifest:
    """What a policy says of itself. rate_hz: how often it acts; waypoints: how those that it answers are followed.

    camera: what it sees by, None for a blind one; cameras: further ones, by names of its own; goal: what it is told of
    where to go (`cosim.spec.goal.GOALS`), unless the run says otherwise; odometry: what its sensors tell of where it is
    (`cosim.spec.odometry.ODOMETRY`); privileged: whether it is told what a camera does not show; goals: those that it
    can do with, () for any: a run that gives others is refused. Raises nothing itself: an episode refuses what cannot
    be, such as a rate of which a period is no whole number of ticks.

    >>> Manifest("mine", rate_hz=5.0, camera=CameraSpec(width=512, height=288)).camera.height
    288
    """

    name: str
    version: str = "1"
    rate_hz: float = 4.0
    camera: CameraSpec | None = CameraSpec()
    privileged: bool = False
    waypoints: WaypointRule = WaypointRule()
    goal: GoalProtocol = "none"
    odometry: OdometryKind = "none"
    cameras: Mapping[str, CameraSpec] = filled(default_factory=dict)
    goals: tuple[GoalProtocol, ...] = ()


class Policy(Protocol):
    """A navigation policy. One object lives through many episodes; `reset` comes before each.

    `on_reset()`, if it has one, is called before the `act` whose observation says `reset`: the robot was put elsewhere.
    Whatever it raises is its own crash, recorded with the episode; it never ends the run.

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
        """A new episode begins. Anything random must come from `seed`. Both are drawn from the seed of the run and the
        scenario, and tell neither its name nor its place in the suite."""

    def act(self, observation: Observation) -> Command | NDArray[np.floating]:
        """A command, or waypoints in the robot's frame: (N, 2), x forward and y left, or (N, 4) with the cosine and the
        sine of the heading there; the manifest's `WaypointRule` says which is followed, and how."""


class BatchPolicy(Policy, Protocol):
    """A policy that can answer for many episodes at once; `cosim run --shared-renderer` asks it so.

    One object, in the renderer's process, lives through all episodes of the run, of which several are under way at any
    time. `reset` begins one of them; what the policy remembers of an episode it keeps under its id, which every
    observation carries. `ended(episode_id)`, if it has one, is called when nothing more will be asked about an episode,
    however that ended; what it raises is printed and changes nothing. Its `on_reset(episode_id)` is told of which. Who
    is asked together is a matter of time and chance: an answer must depend on nothing but its own episode. Without a
    shared renderer it is a policy like any other, asked by `act`.

    A bad answer is the crash of its episode; whatever `act_batch` raises, also a number of answers that is not that of
    the observations, is the crash of all that it was asked for.

    >>> class Steady:
    ...     manifest = Manifest("steady", camera=CameraSpec(96, 96))
    ...
    ...     def reset(self, episode_id, seed): ...
    ...
    ...     def act(self, observation):
    ...         return self.act_batch([observation])[0]
    ...
    ...     def act_batch(self, observations):
    ...         pictures = np.stack([observation.rgb for observation in observations])  # (B, H, W, 3)
    ...         return [Command(1.0, 0.0) for _ in pictures]
    """

    def act_batch(self, observations: Sequence[Observation]) -> Sequence[Command | NDArray[np.floating]]:
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
        """A view from (3,) `eye_m` towards (3,) `target_m`, with the robot in it; size: width, height."""


class Director(Protocol):
    """Moves the event pedestrians."""

    def react(self, query: EventQuery) -> EventReply: ...
