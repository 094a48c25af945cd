"""A policy at arm's length: asked through one door, which lets nothing out but a command or a
PolicyError.

What a policy is given are copies of its own: whatever it writes into them, the simulation, the
record and the referee do not see it. What it is, its manifest, is read once. Whatever it raises is
its crash, SystemExit and KeyboardInterrupt included, and never the end of the process.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, ClassVar, Literal, Protocol

from numpy.typing import NDArray

from bridge.policy_server import PolicyFault, policy_call, said_by
from cosim.core.clock import Clock
from cosim.core.errors import PolicyError
from cosim.core.geometry import Polyline
from cosim.core.state import Command, RobotState, Signal, Vehicles
from cosim.episode.control import command_of
from cosim.episode.interfaces import Observation, Policy, Privileged
from cosim.spec.manifest import Manifest
from cosim.spec.options import PolicyRuns

PolicyCall = Literal["loading", "reset", "first act", "act", "on_reset", "ended"]
"""What a policy is busy with. The first answer of an episode may take longer than the others."""

LOADED_WITHIN_S = 300.0
"""A policy may take so long to be loaded, for a reset and for the first answer, unless a run says
otherwise."""


class Timer(Protocol):
    """Is told when a policy is asked and when it has answered."""

    def starts(self, doing: PolicyCall, tick: int) -> None: ...

    def stops(self) -> None: ...


class Untimed:
    """A timer that does not care."""

    def starts(self, doing: PolicyCall, tick: int) -> None:
        """Nothing to start."""

    def stops(self) -> None:
        """Nothing to stop."""


class Driver:
    """A policy that can be asked. It is a Policy itself, and its answers are commands within the
    robot's limits.

    manifest: what the policy is, read once; later changes of `policy.manifest` mean nothing.
    source_hash: of the file it is written in, "" where that is unknown (`cosim.policies.load`).
    runs: where it is asked; at_once: for so many episodes at a time, 0 for any number.
    """

    runs: PolicyRuns = "in-process"
    at_once = 0
    _passes: ClassVar[tuple[type[Exception], ...]] = (PolicyError,)
    """Errors of a call that are not wrapped as raised by the policy."""

    def __init__(
        self,
        policy: Policy,
        manifest: Manifest | None = None,
        source_hash: str = "",
        timer: Timer | None = None,
    ) -> None:
        manifest = policy.manifest if manifest is None else manifest
        self.manifest = replace(manifest, cameras=dict(manifest.cameras))
        self.source_hash = source_hash
        self._policy = policy
        self._timer = timer
        self._begun = ""
        self._answered = False
        self._route: tuple[Polyline, Polyline] | None = None
        self._hears: Callable[[object], None] | None = None

    @property
    def policy(self) -> Policy:
        """What is asked."""
        return self._policy

    @property
    def clock(self) -> dict[str, float]:
        """How long the answers of the last episode took, where that is known: for a record's
        `clock`."""
        return {}

    @property
    def spent(self) -> bool:
        """Whether what answers has come to its end: the next episode needs a driver of its own."""
        return False

    def close(self) -> None:
        """Nothing more is asked of the policy."""

    @property
    def batches(self) -> bool:
        """Whether the policy can answer for many episodes at once (`BatchPolicy`)."""
        return callable(getattr(self._policy, "act_batch", None))

    @classmethod
    def of(cls, policy: Policy) -> Driver:
        """The driver of a policy: itself if it is one."""
        return policy if isinstance(policy, Driver) else cls(policy)

    def reset(self, episode_id: str, seed: int) -> None:
        """Tell the policy that an episode begins. Raises PolicyError for whatever it raises."""
        self._begun = episode_id
        self._answered = False
        self._route = None
        with self._asked("reset", 0):
            self._policy.reset(episode_id, seed)

    def act(self, observation: Observation) -> Command:
        """The policy's command. Raises PolicyError for whatever it raises, and for an answer that
        is no command."""
        own = self._own(observation)
        if own.reset:
            self._tell_reset(own.episode, own.tick)
        with self._asked("act" if self._answered else "first act", observation.tick):
            answer = self._policy.act(own)
            if self._hears is not None:
                self._hears(answer)
            command = command_of(answer, rule=self.manifest.waypoints, robot=own.robot)
        self._answered = True
        return command

    def heard_by(self, hears: Callable[[object], None]) -> None:
        """Tell somebody every answer as it is, before it is looked at and made a command within the
        robot's limits."""
        self._hears = hears

    def ended(self) -> None:
        """Tell a policy for many episodes that nothing more is asked about this one, if it has
        begun. What it raises is printed."""
        if self._begun and self.batches:
            self._tell_ended(self._begun)
        self._begun = ""

    def _tell_reset(self, episode_id: str, tick: int) -> None:
        """Call `on_reset` of a policy that has one. Raises PolicyError for whatever it raises."""
        if callable(told := getattr(self._policy, "on_reset", None)):
            with self._asked("on_reset", tick):
                told(*([episode_id] if self.batches else []))

    def _tell_ended(self, episode_id: str) -> None:
        """Call `ended` of a policy that has one."""
        try:
            if callable(told := getattr(self._policy, "ended", None)):
                with self._asked("ended", 0):
                    told(episode_id)
        except PolicyError as error:
            traceback.print_exception(error)

    @contextmanager
    def _asked(self, doing: PolicyCall, tick: int) -> Iterator[None]:
        """Time a call of the policy. Raises PolicyError for whatever it raises."""
        try:
            with policy_call(doing, tick, self._timer, self._passes):
                yield
        except (PolicyFault, PolicyError) as error:
            fault = error if isinstance(error, PolicyFault) else PolicyFault(said_by(error))
            during = when(doing if fault.during != "on_reset" else "on_reset", tick)
            together = (
                f", asked for {fault.together} episodes together" if fault.together > 1 else ""
            )
            words = f"policy '{self.manifest.name}' {fault.words} ({during}{together})"
            raise PolicyError(words) from fault.__cause__ or error

    def _own(self, observation: Observation) -> Observation:
        """What the policy may know, as copies of its own."""
        known, pictures = observation.privileged, observation.pictures
        return replace(
            observation,
            rgb=_copied(observation.rgb),
            depth=_copied(observation.depth),
            labels=_copied(observation.labels),
            pictures={
                name: replace(
                    one, rgb=one.rgb.copy(), depth=_copied(one.depth), labels=_copied(one.labels)
                )
                for name, one in pictures.items()
            },
            goal=None if observation.goal is None else observation.goal.copied(),
            privileged=self._own_knowledge(known)
            if known is not None and self.manifest.privileged
            else None,
        )

    def _own_knowledge(self, known: Privileged) -> Privileged:
        """Copies of all but `free`, which cannot be written to; of the route one for the whole
        episode."""
        if self._route is None or self._route[0] is not known.route:
            self._route = (known.route, Polyline(known.route.points.copy()))
        robot = known.robot
        vehicles = known.vehicles
        return Privileged(
            robot=RobotState(robot.pose, robot.v_mps, robot.w_radps, robot.z_m, robot.tilt_rad),
            route=self._route[1],
            route_s_m=known.route_s_m,
            people=known.people.copied(),
            vehicles=Vehicles.of(
                vehicles.ids, vehicles.xy, vehicles.heading, vehicles.speed, vehicles.size
            ),
            signals={
                name: Signal(signal.walk, signal.changes_in_s)
                for name, signal in known.signals.items()
            },
            crossings=known.crossings,
            free=known.free,
        )


def _copied(picture: NDArray[Any] | None) -> NDArray[Any] | None:
    return None if picture is None else picture.copy()


def when(doing: PolicyCall, tick: int) -> str:
    """What a policy was doing, in words: "reset", or "act at 3.2 s"."""
    if doing == "on_reset" or doing.endswith("act"):
        return f"{doing.removeprefix('first ')} at {Clock().time_s(tick):.2f} s"
    return doing
