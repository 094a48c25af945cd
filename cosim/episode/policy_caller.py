"""Calls a policy safely: returns a command or raises PolicyError, nothing else.

The policy gets copies, so it cannot change simulation, record or referee. Its manifest is read
once. Any exception, SystemExit and KeyboardInterrupt included, is a crash of the policy and never
ends the process.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, ClassVar, Literal, Protocol

from numpy.typing import NDArray

from bridge.policy_server import PolicyFault, error_text, policy_call
from cosim.core.clock import Clock
from cosim.core.errors import PolicyError
from cosim.core.geometry import Polyline
from cosim.core.state import Command, Signal, Vehicles
from cosim.episode.control import command_of
from cosim.episode.interfaces import Observation, Policy, Privileged
from cosim.spec.manifest import Manifest
from cosim.spec.options import PolicyProcess

PolicyCall = Literal["loading", "reset", "first act", "act", "on_reset", "ended"]
"""Kinds of calls of a policy. The first act of an episode has a longer timeout than the others."""

LOAD_TIMEOUT_S = 300.0
"""Default timeout in seconds for loading a policy, for a reset and for the first act."""


class Timer(Protocol):
    """Observes the start and end of each call of a policy."""

    def starts(self, doing: PolicyCall, tick: int) -> None: ...

    def stops(self) -> None: ...


class NoTimer:
    """Timer that does nothing."""

    def starts(self, doing: PolicyCall, tick: int) -> None:
        """Do nothing."""

    def stops(self) -> None:
        """Do nothing."""


class PolicyCaller:
    """Wraps a policy; its answers are commands within the robot's limits. It is a Policy itself.

    manifest: manifest of the policy, read once.
    source_hash: hash of the policy's source file, "" if unknown (`cosim.policies.load`).
    runs: process that runs the policy.
    at_once: maximum number of episodes at a time, 0 for any number.
    """

    runs: PolicyProcess = "in-process"
    at_once = 0
    _passes: ClassVar[tuple[type[Exception], ...]] = (PolicyError,)
    """Exceptions of a call that are raised unchanged."""

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
        self._has_answered = False
        self._route: tuple[Polyline, Polyline] | None = None
        self._on_answer: Callable[[object], None] | None = None

    @property
    def policy(self) -> Policy:
        """The wrapped policy."""
        return self._policy

    @property
    def clock(self) -> dict[str, float]:
        """Response times of the last episode for a record's `clock`, if known."""
        return {}

    @property
    def has_exited(self) -> bool:
        """Whether the policy's process has ended, so that the next episode needs a new caller."""
        return False

    def close(self) -> None:
        """Release the policy."""

    @property
    def batches(self) -> bool:
        """Whether the policy can answer for many episodes at once (`BatchPolicy`)."""
        return callable(getattr(self._policy, "act_batch", None))

    @classmethod
    def of(cls, policy: Policy) -> PolicyCaller:
        """Return the caller of a policy: the policy itself if it is one."""
        return policy if isinstance(policy, PolicyCaller) else cls(policy)

    def reset(self, episode_id: str, seed: int) -> None:
        """Start an episode. Raises PolicyError."""
        self._begun = episode_id
        self._has_answered = False
        self._route = None
        with self._guarded("reset", 0):
            self._policy.reset(episode_id, seed)

    def act(self, observation: Observation) -> Command:
        """Return the policy's command. Raises PolicyError for an exception or an invalid answer."""
        own = self._copied_observation(observation)
        if own.reset:
            self._call_on_reset(own.episode, own.tick)
        with self._guarded("act" if self._has_answered else "first act", observation.tick):
            answer = self._policy.act(own)
            if self._on_answer is not None:
                self._on_answer(answer)
            command = command_of(answer, rule=self.manifest.waypoints, robot=own.robot)
        self._has_answered = True
        return command

    def on_answer(self, callback: Callable[[object], None]) -> None:
        """Set a callback for raw answers, before checks and limits."""
        self._on_answer = callback

    def on_reason(self, callback: Callable[[str], None]) -> None:
        """Set a callback for the reasons for which the policy waits. Most policies give none."""

    def ended(self) -> None:
        """End the episode, if one has started, of a policy that can answer for many at once.

        Exceptions are printed.
        """
        if self._begun and self.batches:
            self._call_ended(self._begun)
        self._begun = ""

    def _call_on_reset(self, episode_id: str, tick: int) -> None:
        """Call the policy's `on_reset`, if it has one. Raises PolicyError."""
        if callable(callback := getattr(self._policy, "on_reset", None)):
            with self._guarded("on_reset", tick):
                callback(*([episode_id] if self.batches else []))

    def _call_ended(self, episode_id: str) -> None:
        """Call the policy's `ended`, if it has one; print its exception."""
        try:
            if callable(callback := getattr(self._policy, "ended", None)):
                with self._guarded("ended", 0):
                    callback(episode_id)
        except PolicyError as error:
            traceback.print_exception(error)

    @contextmanager
    def _guarded(self, doing: PolicyCall, tick: int) -> Iterator[None]:
        """Time a call of the policy. Raises PolicyError for any exception."""
        try:
            with policy_call(doing, tick, self._timer, self._passes):
                yield
        except (PolicyFault, PolicyError) as error:
            fault = error if isinstance(error, PolicyFault) else PolicyFault(error_text(error))
            during = call_in_words("on_reset" if fault.during == "on_reset" else doing, tick)
            together = f", for {fault.together} episodes at once" if fault.together > 1 else ""
            words = f"policy '{self.manifest.name}' {fault.words} ({during}{together})"
            raise PolicyError(words) from fault.__cause__ or error

    def _copied_observation(self, observation: Observation) -> Observation:
        """Return the observation as copies, without what the manifest does not request."""
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
            scan=None if observation.scan is None else observation.scan.copied(),
            people=None if observation.people is None else observation.people.copied(),
            privileged=self._copied_privileged(known)
            if known is not None and self.manifest.privileged
            else None,
        )

    def _copied_privileged(self, known: Privileged) -> Privileged:
        """Return a copy of the simulator state; the route is copied once in an episode, `free` is
        immutable."""
        if self._route is None or self._route[0] is not known.route:
            self._route = (known.route, Polyline(known.route.points.copy()))
        robot = known.robot
        vehicles = known.vehicles
        return Privileged(
            robot=replace(robot),
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
            waits_m=known.waits_m,
        )


def _copied(picture: NDArray[Any] | None) -> NDArray[Any] | None:
    return None if picture is None else picture.copy()


def call_in_words(doing: PolicyCall, tick: int) -> str:
    """Return the kind and time of a call as text: "reset", or "act at 3.20 s"."""
    if doing == "on_reset" or doing.endswith("act"):
        return f"{doing.removeprefix('first ')} at {Clock().time_s(tick):.2f} s"
    return doing
