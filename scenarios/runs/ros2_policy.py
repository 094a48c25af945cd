"""A policy that is a ROS 2 node: publishes observations, and waits for a command.

Time stands still while the node computes. The rule of `Ros2Settings.wait` decides which command
answers an observation:

next        the first one that arrives after the observation was sent
stamped     the first TwistStamped with the stamp of the observation
rate        the newest one, at most one for each observation; without one the last command holds
            for a while

A message that is not understood never drives the robot. Each kind of fault is reported once in an
episode. Nor do two publishers drive together: their episode crashes.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Mapping
from logging import WARNING
from typing import Any, ClassVar, Final, NamedTuple, cast

import numpy as np

from bridge.policy_server import PolicyFault
from bridge.ros2 import messages
from bridge.ros2.commands import (
    COMMAND_TYPES,
    PATH,
    Fault,
    Inbox,
    Received,
    Remarks,
    fault_of_form,
    judged,
    plan_points,
)
from bridge.ros2.messages import TOPICS
from bridge.ros2.node import Network, Ros2Node
from bridge.ros2.types import message_store
from bridge.ros2.wire import DIALECTS, Endpoint, full_topic, gid_of, type_hash
from bridge.session import Session, open_session
from cosim.core.clock import Clock
from cosim.core.errors import EngineError, MachineError, PolicyError, UsageError
from cosim.core.log_event import log_event
from cosim.core.progress import ignore
from cosim.core.state import STILL, Command, WaypointCommand
from cosim.episode.interfaces import Observation
from cosim.episode.policy_caller import PolicyCaller, Timer
from cosim.policies.load import checked_manifest
from cosim.spec.options import PolicyHost, PolicyProcess
from cosim.spec.ros2 import CMD_VEL, COMMAND_TOPICS, PLAN, ROS2_SCHEME, Ros2Settings
from scenarios.runs.ros2_diagnosis import diagnosis, two_publishers, unreadable

JOINED_S: Final = 1.0
"""Time without new publishers and subscriptions after which all nodes count as started."""
SETTLED_S: Final = 10.0
"""Time in seconds after which nodes count as started even if publishers still come and go."""
SETTLE_S: Final = 0.3
"""Time in seconds for nodes to notice that /clock was set back."""
GONE_S: Final = 3.0
"""Time in seconds without a publisher of /cmd_vel after which the node counts as lost."""
HINT_S: Final = 5.0
"""Time in seconds after which the run reports why it waits."""
HOLD_S: Final = 0.5
"""Simulated time in seconds for which the rule `rate` repeats a command."""
_SILENT_PERIODS: Final = 2.0
"""Periods of the policy, in seconds of the machine, that the rule `rate` waits for a command."""
_LOOK_S: Final = 0.25
"""Longest time in seconds between two looks at the nodes around."""
_LEAVING_S: Final = 0.5
"""Time in seconds for the token of a publisher to disappear after another one took its place."""
_elapsed_s: Final[dict[int, float]] = {}
"""Time in seconds of all episodes of this process, by domain, for a monotonic /clock."""
_EARLY_S: Final = 1.0
"""Time in seconds before the run's timeout at which the policy reports why it has no command."""


class _Controller(NamedTuple):
    """The publisher of an episode's commands. by: its node in words."""

    gid: bytes
    by: str


class Ros2Policy:
    """Policy that is a ROS 2 node, reached over a Zenoh session that the first episode opens.

    took_ms: Time of each answer of the episode.
    on_reason: Called with the reasons for which the policy waits.
    """

    def __init__(self, name: str, settings: Ros2Settings) -> None:
        self.on_reason: Callable[[str], None] = ignore
        self.settings = settings
        self.manifest = settings.manifest(name)
        self.took_ms: list[float] = []
        self._session: Session | None = None
        self._node: Ros2Node | None = None
        self._inbox = Inbox(newest=settings.wait == "rate")
        self._absent_s: float | None = None
        self._plan: Received | None = None
        self._remarks = Remarks()
        self._hints: set[str] = set()
        self._sent: set[str] = set()
        self._controller: _Controller | None = None
        self._present: Mapping[bytes, Endpoint] = {}
        self._stream: messages.EpisodeStream | None = None
        self._last: tuple[Command, int] | None = None
        self._waits_s = 0.0

    def reset(self, episode_id: str, seed: int) -> None:
        """Wait for a node that publishes /cmd_vel, and announce the episode to it."""
        node = self._joined()
        monotonic = self.settings.clock == "monotonic"
        elapsed_s = _elapsed_s.get(self.settings.domain, 0.0) if monotonic else 0.0
        self._stream = messages.EpisodeStream(episode_id, seed, elapsed_s)
        self._controller = None
        self._last = self._absent_s = None
        self._hints.clear()
        self._sent.clear()
        self.took_ms = []
        self._report_repeated()
        self._await_controller(node)
        self._present = self._command_publishers(node)
        for topic, sent in self._stream.begun():
            self._publish(node, topic, sent)
        time.sleep(SETTLE_S)
        self._inbox.take_all()
        self._plan = None

    def act(self, seen: Observation) -> Command:
        """Publish an observation and return the command that answers it."""
        began_s = time.perf_counter()
        node, stream = self._joined(), self._stream
        assert stream is not None, "reset comes first"
        first = stream.tick < 0
        _elapsed_s[self.settings.domain] = stream.elapsed_s + Clock().time_s(seen.tick + 1)
        if self.settings.wait != "rate":
            self._refuse_another(node, self._inbox.take_all())
        for topic, sent in stream.observed(seen, node.has_subscriber):
            self._publish(node, topic, sent)
        now_ns = stream.time_ns(seen.tick)
        if first:
            self._waits_s = time.monotonic()
        if self.settings.wait == "rate":
            command = self._held(node, seen.tick, now_ns)
        else:
            command = self._next(node, now_ns, first)
        self.took_ms.append(1000.0 * (time.perf_counter() - began_s))
        return self._with_plan(command, seen)

    def close(self) -> None:
        """Remove the node from the network."""
        self._report_repeated()
        if self._session is not None:
            self._session.close()
        self._session = self._node = None

    def _joined(self) -> Ros2Node:
        """Return the node, which joins the network at the first call."""
        if self._node is None:
            settings = self.settings
            session = open_session(settings.connection)
            network = Network(
                settings.domain, settings.namespace, settings.distro, settings.dialect
            )
            try:
                node = Ros2Node(session, network)
                for topic in TOPICS.values():
                    node.advertise(topic.name, topic.type, topic.qos)
                node.subscribe(CMD_VEL, COMMAND_TYPES, self._inbox.put)
                node.subscribe(PLAN, (PATH,), self._take_plan)
            except BaseException:
                session.close()
                raise
            self._session, self._node = session, node
        return self._node

    def _publish(self, node: Ros2Node, topic: str, sent: Any) -> None:
        node.publish(topic, sent)
        self._sent.add(topic)

    def _take_plan(self, got: Received) -> None:
        """Hold a plan until the next answer; one that is too long does not replace another."""
        if (fault := self._fault_of_form(got, PLAN)) is None:
            self._plan = got
        else:
            self._remark(fault)

    def _next(self, node: Ros2Node, now_ns: int, first: bool) -> Command:
        """Wait for the command that answers the observation. Raises PolicyFault without one."""
        began_s = time.monotonic()
        allowed_s = self._allowed_s(first)
        while True:
            if (left_s := began_s + allowed_s - time.monotonic()) <= 0.0:
                raise self._no_command(node, allowed_s)
            self._hint(node, allowed_s - left_s, "a command", self._nothing_came)
            node.wait_for(lambda: len(self._inbox), min(left_s, _LOOK_S))
            while (got := self._inbox.take()) is not None:
                if (command := self._accepted(node, got, now_ns)) is not None:
                    return command
            self._refuse_gone(node)

    def _held(self, node: Ros2Node, at_tick: int, now_ns: int) -> Command:
        """Return the newest command if one comes within two periods, else the last one while it
        holds. Raises PolicyFault."""
        until_s = time.monotonic() + _SILENT_PERIODS / self.settings.rate_hz
        while (left_s := until_s - time.monotonic()) > 0.0:
            node.wait_for(lambda: len(self._inbox), left_s)
            if (command := self._newest(node, now_ns)) is not None:
                self._last = command, at_tick
                self._waits_s, self._absent_s = time.monotonic(), None
                return command
        self._refuse_gone(node)
        allowed_s = self._allowed_s(self._last is None)
        if time.monotonic() - self._waits_s > allowed_s:
            raise self._no_command(node, allowed_s)
        self._hint(node, time.monotonic() - self._waits_s, "a command", self._nothing_came)
        command, tick = self._last or (STILL, at_tick)
        return command if Clock().time_s(at_tick - tick) <= HOLD_S else STILL

    def _newest(self, node: Ros2Node, now_ns: int) -> Command | None:
        """Take all messages that have come, and return the newest command."""
        newest = None
        for got in self._inbox.take_all():
            newest = self._accepted(node, got, now_ns) or newest
        return newest

    def _refuse_gone(self, node: Ros2Node) -> None:
        """Raise PolicyFault if no node has published /cmd_vel for a while."""
        now_s = time.monotonic()
        if there := self._command_publishers(node):
            self._absent_s = None
            self._refuse_replaced(there)
        elif self._absent_s is None:
            self._absent_s = now_s
        elif now_s - self._absent_s > GONE_S:
            name = "the node" if self._controller is None else self._controller.by
            raise PolicyFault(f"is gone: {name} published {CMD_VEL}, and has left")

    def _refuse_replaced(self, there: Mapping[bytes, Endpoint]) -> None:
        """Raise PolicyFault if other publishers have taken the place of those of the episode: they
        lack the observation.

        there: Publishers by gid.
        """
        if self._present and not self._present.keys() & there.keys():
            by = next(iter(self._present.values())).in_words
            names = [end.in_words for end in there.values()]
            raise PolicyFault(self._replaced(by, by if by in names else names[0]))

    def _allowed_s(self, first: bool) -> float:
        """Return the timeout of an answer, before that of the run."""
        whole_s = self.settings.start_s if first else self.settings.answer_s
        return max(whole_s - _EARLY_S, 0.5 * whole_s)

    @property
    def _attached(self) -> bool:
        """Whether messages have an attachment with the gid of their publisher."""
        return DIALECTS[self.settings.dialect].attached

    def _wanted_hash(self, name: str, topic: str) -> str:
        """Return the hash of a type that is read on a topic, else ""."""
        return type_hash(name, self.settings.distro) if name in COMMAND_TOPICS[topic] else ""

    def _fault_of_form(self, got: Received, topic: str) -> Fault | None:
        wanted_hash = self._wanted_hash(got.type, topic)
        return fault_of_form(got, topic, wanted_hash, attached=self._attached)

    def _accepted(self, node: Ros2Node, got: Received, now_ns: int) -> Command | None:
        """Return the command of a message; None, with a remark, if it is refused."""
        wanted_hash = self._wanted_hash(got.type, CMD_VEL)
        found = judged(got, self.settings.wait, now_ns, wanted_hash, attached=self._attached)
        if found.fault is not None:
            self._remark(found.fault)
        if found.command is not None:
            self._refuse_another(node, [got])
            if self._controller is None and got.sender:
                self._controller = _Controller(got.sender, got.by)
                there = self._command_publishers(node)
                self._present = {gid: end for gid, end in there.items() if gid == got.sender}
        return found.command

    def _refuse_another(self, node: Ros2Node, received: Iterable[Received]) -> None:
        """Raise PolicyFault if a message is not of the publisher of the episode's commands.

        Without attachments it is also raised if several publishers are there.
        """
        for got in received:
            if got.type and got.type not in COMMAND_TYPES:
                continue
            if not got.sender:
                there = list(node.publishers_of(CMD_VEL).values())
                if not self._attached and len(there) > 1:
                    raise PolicyFault(self._several(node, there))
            elif self._controller is not None and got.sender != self._controller.gid:
                raise PolicyFault(self._another(node, got))

    def _several(self, node: Ros2Node, there: list[Endpoint]) -> str:
        """Return what is wrong with a command of one of several publishers."""
        controller = self._controller
        if controller is not None and self._has_left(node, controller.gid):
            new = [end for end in there if end.in_words != controller.by] or there
            return self._replaced(controller.by, new[0].in_words)
        return f"is {two_publishers(there[0], there[1])}"

    def _has_left(self, node: Ros2Node, gid: bytes) -> bool:
        """Return whether the token of a publisher is gone, or disappears now."""
        node.wait_for(lambda: gid not in node.publishers_of(CMD_VEL), _LEAVING_S)
        return gid not in node.publishers_of(CMD_VEL)

    def _replaced(self, by: str, other: str) -> str:
        """Return what is wrong with a publisher that has taken the place of another."""
        assert self._stream is not None
        at_s = Clock().time_s(self._stream.tick)
        what = (
            f"{by} left and came back at {at_s:.2f} s"
            if by == other
            else f"{by} published {CMD_VEL} and has left, and {other} publishes it now"
        )
        return f"is gone: {what}. An episode has one publisher: restart a node between runs"

    def _another(self, node: Ros2Node, got: Received) -> str:
        """Return what is wrong with a command of another publisher: the first one has left, or
        there are two."""
        assert self._controller is not None
        gid, by = self._controller
        if self._has_left(node, gid):
            return self._replaced(by, got.by)
        there = node.publishers_of(CMD_VEL)
        if got.sender in there:
            return f"is {two_publishers(there[gid], there[got.sender])}"
        return (
            f"is two publishers of {CMD_VEL}, {by} and {got.by}: stop one, or mix their commands "
            "in a node of your own"
        )

    def _with_plan(self, command: Command, seen: Observation) -> Command:
        """Return a command with the points of the latest plan, for the record."""
        got, self._plan = self._plan, None
        if got is None:
            return command
        wanted_hash = self._wanted_hash(got.type, PLAN)
        points = plan_points(got, messages.pose_of(seen), wanted_hash, attached=self._attached)
        if isinstance(points, Fault):
            self._remark(points)
            return command
        return WaypointCommand(command.v_mps, command.w_radps, points.astype(np.float32), 0)

    def _remark(self, fault: Fault) -> None:
        """Count a fault, and report it if it is the first of its kind in the episode."""
        if self._remarks.add(fault):
            _report(fault.words)

    def _report_repeated(self) -> None:
        """Report the numbers of the last episode's faults, and forget them."""
        for words in self._remarks.ended():
            _report(words)

    def _await_controller(self, node: Ros2Node) -> None:
        """Wait until one node publishes /cmd_vel and subscriptions have arrived.

        Nodes count as started if no further entity comes for a second. After ten, subscriptions are
        no longer waited for: a controller may read other topics. Raises PolicyFault.
        """
        began_s = time.monotonic()
        allowed_s = self._allowed_s(True)

        def ready() -> bool:
            now_s = time.monotonic()
            several = len(node.publishers_of(CMD_VEL)) > 1
            if not self._command_publishers(node) or (several and not self._attached):
                return False
            if now_s - began_s > SETTLED_S:
                return True
            reads = self.settings.wait == "rate" or node.subscriptions_arrived()
            return reads and now_s - node.tokens_changed_s > JOINED_S

        while not ready():  # outside the node's lock, which receiving threads need
            there = list(node.publishers_of(CMD_VEL).values())
            waited_s = time.monotonic() - began_s
            if len(there) > 1 and not self._attached and waited_s > min(SETTLED_S, allowed_s):
                raise PolicyFault(f"is {two_publishers(there[0], there[1])}")
            if waited_s > allowed_s:
                why = self._diagnosis(node, self._remarks.words) or "nodes still come and go"
                raise PolicyFault(f"is missing after {allowed_s:.0f} s: {why}")
            self._hint(node, waited_s, "a node")
            node.wait_for_tokens(_LOOK_S)
        if len(there := list(self._command_publishers(node).values())) > 1:
            words = f"there are {two_publishers(there[0], there[1])}"
            self._remark(Fault(CMD_VEL, "publishers", words))
            self.on_reason(words)

    def _command_publishers(self, node: Ros2Node) -> dict[bytes, Endpoint]:
        """Return the publishers of /cmd_vel with a type that is read, by gid."""
        there = node.publishers_of(CMD_VEL)
        distro = self.settings.distro
        return {gid: end for gid, end in there.items() if not unreadable(end, distro)}

    def _no_command(self, node: Ros2Node, allowed_s: float) -> PolicyFault:
        """Return the error that no command came in time."""
        why = self._diagnosis(node, self._remarks.words) or self._nothing_came
        return PolicyFault(f"gave no command for {allowed_s:.0f} s: {why}")

    @property
    def _nothing_came(self) -> str:
        """Why there is no command if nothing is wrong with the nodes around."""
        if self.settings.wait == "stamped":
            return "no command came with the stamp of the observation"
        return f"no message came on {full_topic(self.settings.namespace, CMD_VEL)}"

    def _diagnosis(self, node: Ros2Node, faults: Iterable[str]) -> str:
        return diagnosis(node, self.settings, faults, self._sent)

    def _hint(self, node: Ros2Node, waited_s: float, waits_for: str, otherwise: str = "") -> None:
        """Report why the run waits, once it has waited for a while, and each reason once.

        otherwise: Reason if nothing is wrong with the nodes around.
        """
        if waited_s < HINT_S:
            return
        words = self._diagnosis(node, self._remarks.kinds) or otherwise
        if words and words not in self._hints:
            self._hints.add(words)
            self.on_reason(f"waits for {waits_for}: {words}")


def _report(words: str) -> None:
    """Print a line about refused messages, and log it."""
    print(f"ros2: {words}", file=sys.stderr, flush=True)
    log_event("ros2 message refused", WARNING, why=words)


class Ros2Caller(PolicyCaller):
    """Caller of a policy that is a ROS 2 node."""

    _passes: ClassVar[tuple[type[Exception], ...]] = (PolicyError, EngineError, MachineError)

    def __init__(self, policy: Ros2Policy, timer: Timer | None = None) -> None:
        super().__init__(policy, policy.manifest, timer=timer)
        self._ros2 = policy
        self.runs = cast(PolicyProcess, f"ros2, {policy.settings.wait}")

    @property
    def clock(self) -> dict[str, float]:
        if not self._ros2.took_ms:
            return {}
        median, most = np.quantile(self._ros2.took_ms, [0.5, 0.95])
        return {"answer_median_ms": float(median), "answer_p95_ms": float(most)}

    def on_reason(self, callback: Callable[[str], None]) -> None:
        self._ros2.on_reason = callback

    def close(self) -> None:
        self._ros2.close()

    def _own(self, observation: Observation) -> Observation:
        return observation  # the messages are copies


def ros2_caller(name: str, host: PolicyHost, timer: Timer | None = None) -> Ros2Caller:
    """Return the caller of policy `ros2:` or `ros2:NAME`, which joins the network in an episode.

    Raises UsageError for invalid settings, MachineError without the extra [ros2].
    """
    if host.ros2 is None:
        raise UsageError(
            f"policy '{name}' has no settings here: use `cosim run` or `cosim scenario run`, or in "
            "Python PolicyHost(ros2=Ros2Settings(...))"
        )
    message_store()
    gid_of("")  # raises without xxhash
    called = name.removeprefix(ROS2_SCHEME) or "ros2"
    policy = Ros2Policy(called, host.ros2)
    checked_manifest(name, _builtins(policy))
    return Ros2Caller(policy, timer)


def _builtins(policy: Ros2Policy) -> Any:
    import msgspec

    return msgspec.to_builtins(policy.manifest)
