"""A policy at arm's length: asked through one door, which lets nothing out but a command or a
PolicyError.

What a policy is given are copies of its own: whatever it writes into them, the simulation, the
record and the referee do not see it. What it is, its manifest, is read once. Whatever it raises is
its crash, SystemExit and KeyboardInterrupt included, and never the end of the process.
"""

from __future__ import annotations

import os
import signal
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Protocol, cast

from numpy.typing import NDArray

from cosim.core.clock import Clock
from cosim.core.errors import PolicyError
from cosim.core.geometry import Polyline
from cosim.core.state import Command, RobotState, Signal, Vehicles
from cosim.episode.control import command_of
from cosim.episode.interfaces import BatchPolicy, Observation, Policy, Privileged
from cosim.spec.goal import own_goal
from cosim.spec.manifest import Manifest
from cosim.spec.policy_host import PolicyRuns

PolicyCall = Literal["loading", "reset", "first act", "act", "on_reset", "ended"]
"""What a policy is busy with. The first answer of an episode may take longer than the others."""

_OWN_PACKAGES = frozenset({"cosim", "scenarios", "sumo_nets", "physics", "bridge"})
_STDLIB = Path(traceback.__file__).parent
LOADED_WITHIN_S = 300.0
"""A policy may take so long to be loaded, for a reset and for the first answer, unless a run says
otherwise."""
MOST_SAID = 500
"""Of what a policy says when it raises, so many characters are kept."""


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
        self._timer: Timer = Untimed() if timer is None else timer
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
        """The policy at work: timed, and whatever it raises is a PolicyError."""
        process = os.getpid()
        self._timer.starts(doing, tick)
        try:
            yield
        except BaseException as error:
            if (
                isinstance(error, KeyboardInterrupt)
                and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN
            ):
                # somebody pressed Ctrl-C; where that is ignored only a policy can have raised it
                raise
            raise PolicyError(
                f"policy '{self.manifest.name}' {told_of(error)} ({when(doing, tick)})"
            ) from error
        finally:
            if os.getpid() != process:
                os._exit(
                    1
                )  # a child that the policy has forked: the episode goes on in its parent alone
            self._timer.stops()

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
            goal=own_goal(observation.goal),
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


class BatchDriver:
    """A `BatchPolicy` that can be asked for several episodes at once. What goes wrong with one
    answer is that episode's crash; whatever the policy raises is the crash of all that it was asked
    for."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self.manifest = driver.manifest
        self._policy = cast(BatchPolicy, driver._policy)
        self._answered: set[str] = set()

    def reset(self, episode_id: str, seed: int) -> None:
        """Tell the policy that another episode begins. Raises PolicyError for whatever it
        raises."""
        self._answered.discard(episode_id)
        with self._driver._asked("reset", 0):
            self._policy.reset(episode_id, seed)

    def ended(self, episode_id: str) -> None:
        """Tell the policy that nothing more is asked about an episode. What it raises is
        printed."""
        self._answered.discard(episode_id)
        self._driver._tell_ended(episode_id)

    def act_batch(self, observations: Sequence[Observation]) -> list[Command | PolicyError]:
        """The policy's command for each observation, or what is wrong with it. The observations
        become the policy's own."""
        crashes = [self._told_reset(one) for one in observations]
        asked = [one for one, crash in zip(observations, crashes, strict=True) if crash is None]
        answers = iter(self._answers(asked) if asked else ())
        return [next(answers) if crash is None else crash for crash in crashes]

    def _told_reset(self, seen: Observation) -> PolicyError | None:
        """Tell the policy of a reset, where there was one; its crash if it raises."""
        try:
            if seen.reset:
                self._driver._tell_reset(seen.episode, seen.tick)
        except PolicyError as error:
            return error
        return None

    def _answers(self, observations: Sequence[Observation]) -> list[Command | PolicyError]:
        began = all(observation.episode in self._answered for observation in observations)
        doing: PolicyCall = "act" if began else "first act"
        last = max(observation.tick for observation in observations)
        try:
            with self._driver._asked(doing, last):
                answers = _as_many(self._policy.act_batch(tuple(observations)), len(observations))
        except PolicyError as error:
            told = told_of(error.__cause__ or error)
            return [self._crash(told, doing, one, len(observations)) for one in observations]
        self._answered |= {observation.episode for observation in observations}
        return [
            self._command(answer, doing, one)
            for answer, one in zip(answers, observations, strict=True)
        ]

    def _command(
        self, answer: object, doing: PolicyCall, seen: Observation
    ) -> Command | PolicyError:
        try:
            with self._driver._asked(doing, seen.tick):
                return command_of(answer, rule=self._driver.manifest.waypoints, robot=seen.robot)
        except PolicyError as error:
            return error

    def _crash(self, told: str, doing: PolicyCall, seen: Observation, among: int) -> PolicyError:
        together = f", asked for {among} episodes together" if among > 1 else ""
        return PolicyError(
            f"policy '{self._driver.manifest.name}' {told} ({when(doing, seen.tick)}{together})"
        )


def _copied(picture: NDArray[Any] | None) -> NDArray[Any] | None:
    return None if picture is None else picture.copy()


def _as_many(answers: Sequence[object], count: int) -> list[object]:
    """The answers of a batch. Raises PolicyError unless there is one for each observation."""
    if not hasattr(answers, "__len__") or not hasattr(answers, "__getitem__"):
        raise PolicyError(
            f"answered a {type(answers).__name__}: a batch is answered with a sequence"
        )
    if len(answers) != count:
        raise PolicyError(f"gave {len(answers)} answers to {count} observations")
    return [answers[i] for i in range(count)]


def when(doing: PolicyCall, tick: int) -> str:
    """What a policy was doing, in words: "reset", or "act at 3.2 s"."""
    if doing == "on_reset" or doing.endswith("act"):
        return f"{doing.removeprefix('first ')} at {Clock().time_s(tick):.2f} s"
    return doing


def told_of(error: BaseException) -> str:
    """What is said of an error that came out of a policy."""
    said = said_by(error)
    if isinstance(error, PolicyError):  # of this project: about its answer
        return said
    where = line_of(error)
    return f"raised {type(error).__name__}{f': {said}' if said else ''}{f' in {where}' if where else ''}"


def line_of(error: BaseException) -> str:
    """Name the file and line of the user's code that an error came from, as "mine.py:12"; "" if
    there is none.

    Code of this project, of Python and of installed packages is not the user's.
    """
    found = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        file = Path(frame.f_code.co_filename)
        installed = (
            "site-packages" in file.parts
            or file.is_relative_to(_STDLIB)
            or file.name.startswith("<")
        )
        if (
            not installed
            and frame.f_globals.get("__name__", "").partition(".")[0] not in _OWN_PACKAGES
        ):
            found = f"{file.name}:{line}"
    return found


def said_by(error: BaseException) -> str:
    """The message of an error, as text that can be stored and shown in a line or a few, however odd
    it is."""
    try:
        text = str(error)
    except BaseException:  # noqa: BLE001  even the message of an error can raise
        return "(its message cannot be read)"
    text = text.encode("utf-8", "replace").decode()
    text = "".join(c if c.isprintable() or c == "\n" else "?" for c in text)
    return text if len(text) <= MOST_SAID else f"{text[:MOST_SAID]} ... ({len(text)} characters)"
