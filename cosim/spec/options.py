"""How an episode is run, beyond what its scenario says: one value from the command line to the
worker."""

from __future__ import annotations

import math
from typing import Literal

import msgspec

from cosim.core.errors import UsageError
from cosim.spec.connection import Connection
from cosim.spec.demo_options import Collecting
from cosim.spec.episode_id import check_seed
from cosim.spec.goal import GoalProtocol, goal_called
from cosim.spec.injection import Injected, Live
from cosim.spec.run_config import MOST_LATENCY_MS, CameraChoice, RunConfig

PolicyRuns = Literal["in-process", "isolated", "remote", "remote, jpeg"]
"""Where a policy ran: in the simulator's process, which it can reach into; in one of its own on the
same machine; or behind Zenoh, where its pictures may have been sent as JPEG."""


class PolicyHost(msgspec.Struct, frozen=True, kw_only=True):
    """Where the policy of a run is. isolated: in a process of its own. servers: where those of a
    remote one are found; run: signs what they are asked, so that none mistakes one run for another.

    >>> PolicyHost(isolated=True).servers
    ()
    """

    isolated: bool = False
    servers: tuple[Connection, ...] = ()
    run: str = ""

    def seen_by(self, worker: Connection) -> PolicyHost:
        """As a worker on another machine reaches it, who has this connection to the run."""
        return msgspec.structs.replace(
            self, servers=tuple(one.seen_by(worker) for one in self.servers)
        )


CameraName = Literal["gl", "bullet", "bullet-egl"]


class Outside(msgspec.Struct, frozen=True, kw_only=True):
    """A director in a process of its own. connection: to it; run: the run's name in the keys;
    wait_s: how long an episode waits for it before it is recorded as crashed."""

    connection: Connection
    run: str
    wait_s: float


class RendererAt(msgspec.Struct, frozen=True, kw_only=True):
    """The shared renderer of a run. address: where it listens; asks: whether the policy is there
    and asked there, for all episodes together (`act_batch`). number: for the renderer, which of the
    run it is, from 1."""

    address: str
    asks: bool
    number: int = 0


LEAST_PACE = 0.1
MOST_PACE = 100.0
"""Times real time: the range of a pace. Slower ones would look like an engine that hangs."""


class EpisodeOptions(msgspec.Struct, frozen=True, kw_only=True):
    """How an episode is run. But for robot, latency and the noise of collecting, options change
    what is seen and kept, never what happens in the street.

    seed: of the run: what a policy is told in place of the scenario's name and seed is drawn from
    it (`cosim.spec.episode_id`), and the order of a run's episodes. None: a run draws one, an
    Episode by itself takes 0. robot: which drives (`cosim.spec.robot`), in place of the scenario's
    own. goal: what the policy is told of where to go (`cosim.spec.goal`), in place of what its
    manifest says. own_camera: the policy may see by a camera that the robot does not have
    (`cosim.episode.manifest_checks`), which marks the record as nonstandard. camera: what draws
    pictures. frames_every_s: keep a camera frame every so many seconds, 0 for none. live: where it
    is on the air meanwhile. pace: the simulation waits for the wall clock, to run at most so many
    times faster than real time; 0: it never waits. director: where its event pedestrians are
    decided, if in another process. counterfactual: compare it with its street without the robot.
    injections: pedestrians that were injected into the episode that this one replays. latency_ms:
    each command takes effect so much later than the observation that it answers, rounded up to
    ticks of 50 ms (`cosim.episode.command_delay`). real_time: in place of that, the time that the
    policy takes for an answer on this machine is that answer's latency, and it is not asked again
    before: what comes out is replayed from its record, and not made again from its seed.
    collecting: the policy is an expert, of whose drive a demonstration is kept. Raises UsageError.

    >>> EpisodeOptions(camera="bullet", frames_every_s=1.0).camera
    'bullet'
    """

    seed: int | None = None
    robot: str = ""
    goal: GoalProtocol | None = None
    own_camera: bool = False
    camera: CameraChoice = "auto"
    frames_every_s: float = 0.0
    live: Live | None = None
    pace: float = 0.0
    director: Outside | None = None
    counterfactual: bool = False
    injections: tuple[Injected, ...] = ()
    latency_ms: float = 0.0
    real_time: bool = False
    collecting: Collecting | None = None

    @classmethod
    def asked(cls, config: RunConfig) -> EpisodeOptions:
        """The options that the config of a run asks for. Raises UsageError."""
        return cls(
            seed=config.seed,
            robot=config.robot,
            own_camera=config.own_camera,
            goal=goal_called(config.goal) if config.goal else None,
            camera=config.camera,
            frames_every_s=config.frames,
            counterfactual=config.counterfactual,
            real_time=config.real_time,
            pace=config.pace,
        )

    def __post_init__(self) -> None:
        check_seed(self.seed)
        if not (math.isfinite(self.latency_ms) and 0.0 <= self.latency_ms <= MOST_LATENCY_MS):
            raise UsageError(
                f"latency_ms must be from 0 to {MOST_LATENCY_MS:g} ms, not {self.latency_ms:g}"
            )
        if self.pace and not LEAST_PACE <= self.pace <= MOST_PACE:
            raise UsageError(
                f"pace must be from {LEAST_PACE:g} to {MOST_PACE:g} times real time, or 0 for as "
                f"fast as possible, not {self.pace:g}"
            )
        if self.real_time and self.latency_ms:
            raise UsageError("real_time measures the latency of every answer: leave latency_ms out")
