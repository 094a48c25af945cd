"""Options of an episode that are not part of its scenario, from the command line to the worker."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final, Literal

import msgspec

from cosim.core.errors import UsageError, unknown
from cosim.spec.connection import Connection
from cosim.spec.demo_options import DemoOptions
from cosim.spec.episode_id import check_seed
from cosim.spec.goal import GoalProtocol, goal_called
from cosim.spec.injection import Injected, LiveAddress
from cosim.spec.ros2 import Ros2Settings
from cosim.spec.run_config import (
    MAX_LATENCY_MS,
    POLICY_MEMORY_GB,
    Appearance,
    CameraChoice,
    Isolation,
    RunConfig,
)
from cosim.spec.scenario import Scenario
from cosim.spec.weather import WEATHERS

ONNX_GAIT: Final = "onnx:"
"""Beginning of the name of a gait that is an ONNX file."""

PolicyProcess = Literal[
    "in-process",
    "isolated: namespaces",
    "isolated: landlock",
    "isolated: weak",
    "isolated",
    "remote",
    "remote, jpeg",
    "ros2, next",
    "ros2, stamped",
    "ros2, rate",
]
"""Process that runs a policy: the simulator's, an isolated one on the same machine with the kind of
its sandbox, a server over Zenoh, or a ROS 2 node with its waiting rule. "isolated" is the weak
kind, in older records. "remote, jpeg" means that its pictures may have been sent as JPEG."""


class PolicyHost(msgspec.Struct, frozen=True, kw_only=True):
    """Location of a run's policy.

    isolated: run it in a process of its own, in a sandbox of this kind.
    data: paths that an isolated policy may read, in addition to its own folder.
    memory_gb: limit of the memory of each of its processes.
    hidden: folders of this machine that it may not read, even in its own folder.
    servers: connections to the servers of a remote policy.
    ros2: settings of a policy that is a ROS 2 node.
    run: name of the run, part of each query's key so that runs are not confused.

    >>> PolicyHost(isolated="auto").servers
    ()
    """

    isolated: Isolation = "no"
    data: tuple[str, ...] = ()
    memory_gb: float = POLICY_MEMORY_GB
    hidden: tuple[str, ...] = ()
    servers: tuple[Connection, ...] = ()
    ros2: Ros2Settings | None = None
    run: str = ""

    def of_job(self, number: int) -> PolicyHost:
        """Return the host of an environment process, by its number from 0."""
        if self.ros2 is None:
            return self
        return msgspec.structs.replace(self, ros2=self.ros2.of_job(number))

    def seen_by(self, worker: Connection) -> PolicyHost:
        """Return the host as a worker with this connection to the run reaches it."""
        return msgspec.structs.replace(
            self, servers=tuple(one.seen_by(worker) for one in self.servers)
        )


CameraName = Literal["gl", "bullet", "bullet-egl"]
"""Renderers of a policy's pictures."""


class DirectorAddress(msgspec.Struct, frozen=True, kw_only=True):
    """Address of a director in another process.

    connection: connection to it.
    run: name of the run in keys.
    wait_s: timeout of its replies; then the episode is invalid.
    """

    connection: Connection
    run: str
    wait_s: float


class RendererAddress(msgspec.Struct, frozen=True, kw_only=True):
    """Address of a run's shared renderer.

    address: socket on which it listens.
    asks: whether it hosts the policy and queries it in batches (`act_batch`).
    number: number of the renderer in the run, from 1; only the renderer uses it.
    appearance: of scanned places.
    """

    address: str
    asks: bool
    number: int = 0
    appearance: Appearance = "splats"


MIN_PACE = 0.1
"""Minimum pace in multiples of real time. A slower one would look like a hanging engine."""
MAX_PACE = 100.0
"""Maximum pace in multiples of real time."""


class EpisodeOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options of an episode. Only robot, weather, gait, latency and collecting noise affect what
    happens in the street.

    seed: seed of the run, for policy ids and seeds (`cosim.spec.episode_id`) and the order of
        episodes. If it is None, a run draws one, and a single Episode uses 0.
    robot: robot in place of the scenario's (`cosim.spec.robot`).
    weather: weather in place of the scenario's (`cosim.spec.weather`).
    gait: gait of a robot with legs in place of its own (`physics.dynamics.legs.gait_file`). Its
        path is recorded as an absolute one.
    goal: goal protocol in place of the manifest's (`cosim.spec.goal`).
    own_camera: allow a camera that the robot does not have (`cosim.episode.manifest_checks`). It
        marks the record as nonstandard.
    camera: renderer of the pictures.
    appearance: of scanned places in pictures.
    frames_every_s: interval of saved camera frames in seconds, 0 for none.
    live: address at which the episode is live.
    pace: maximum speed in multiples of real time; 0 for no limit.
    director: address of an event director in another process.
    counterfactual: compare with the same street without the robot.
    injections: injected pedestrians of the episode that this one replays.
    latency_ms: delay from an observation to its command's effect, rounded up to ticks of 50 ms
        (`cosim.episode.command_delay`).
    real_time: use the policy's measured response time as the latency, without queries in the
        meantime. Such an episode can be replayed from its record, but not repeated from its seed.
    collecting: record a demonstration of the policy as an expert. Raises UsageError.

    >>> EpisodeOptions(camera="bullet", frames_every_s=1.0).camera
    'bullet'
    """

    seed: int | None = None
    robot: str = ""
    weather: str = ""
    gait: str = ""
    goal: GoalProtocol | None = None
    own_camera: bool = False
    camera: CameraChoice = "auto"
    appearance: Appearance = "splats"
    frames_every_s: float = 0.0
    live: LiveAddress | None = None
    pace: float = 0.0
    director: DirectorAddress | None = None
    counterfactual: bool = False
    injections: tuple[Injected, ...] = ()
    latency_ms: float = 0.0
    real_time: bool = False
    collecting: DemoOptions | None = None

    @classmethod
    def from_config(cls, config: RunConfig) -> EpisodeOptions:
        """Return the options that a run's config requests. Raises UsageError."""
        return cls(
            seed=config.seed,
            robot=config.robot,
            weather=config.weather,
            gait=absolute_gait(config.gait),
            own_camera=config.own_camera,
            goal=goal_called(config.goal) if config.goal else None,
            camera=config.camera,
            appearance=config.appearance,
            frames_every_s=config.frames,
            counterfactual=config.counterfactual,
            real_time=config.real_time,
            pace=config.pace,
        )

    def __post_init__(self) -> None:
        check_seed(self.seed)
        if self.weather and self.weather not in WEATHERS:
            raise unknown("weather", self.weather, WEATHERS)
        if not (math.isfinite(self.latency_ms) and 0.0 <= self.latency_ms <= MAX_LATENCY_MS):
            raise UsageError(
                f"latency_ms must be from 0 to {MAX_LATENCY_MS:g} ms, not {self.latency_ms:g}"
            )
        if self.pace and not MIN_PACE <= self.pace <= MAX_PACE:
            raise UsageError(
                f"pace must be from {MIN_PACE:g} to {MAX_PACE:g} times real time, or 0 for as "
                f"fast as possible, not {self.pace:g}"
            )
        if self.real_time and self.latency_ms:
            raise UsageError("real_time measures the latency of every answer: leave latency_ms out")

    def apply_to(self, scenario: Scenario) -> Scenario:
        """Return a scenario with the robot and the weather of these options. Raises UsageError,
        SpecError."""
        return scenario.driven_by(self.robot).in_weather(self.weather)


def absolute_gait(gait: str) -> str:
    """Return a gait's name with an absolute path, which is valid in any working folder.

    >>> absolute_gait("onnx:/gaits/walk.onnx")
    'onnx:/gaits/walk.onnx'
    """
    if not gait.startswith(ONNX_GAIT):
        return gait
    return f"{ONNX_GAIT}{Path(gait.removeprefix(ONNX_GAIT)).expanduser().absolute()}"
