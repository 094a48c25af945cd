"""Isolated policies: a policy in a supervised process of its own, and its client.

Requests go over a socket, arrays through memory shared with the environment's process only. The
policy's process loads no engine, and has no data of the run but observations.
"""

from __future__ import annotations

import os
import signal
from contextlib import ExitStack, suppress
from socket import socket
from typing import Final

import msgspec

from bridge.policy_server import (
    UNREADABLE,
    ActRequest,
    EndRequest,
    PackedArray,
    PolicyDesk,
    PolicyFault,
    PolicyInfo,
    Refusal,
    ResetRequest,
    decode_info,
    encode_message,
    policy_call,
    read_request,
)
from cosim.core.errors import UsageError
from cosim.core.framing import MessageSocket
from cosim.episode.manifest_checks import with_goal
from cosim.episode.policy_caller import LOAD_TIMEOUT_S, NoTimer, Timer
from cosim.policies.load import checked_manifest, load_policy
from cosim.spec.manifest import Manifest
from scenarios.ipc.child_process import ChildProcess
from scenarios.ipc.observation_codec import Arrays, ObservationDecoder
from scenarios.ipc.shared_memory import SharedMemory, room_for
from scenarios.ipc.surroundings import Surroundings, end_at_once
from scenarios.runs.hosted_policy import HostedDriver, HostedPolicy

_SERVES: Final = "scenarios.runs.isolated_policy:serve_alone"
"""The function of the policy's process."""
_MOST_BYTES: Final = 4 << 20
"""Size limit of an answer in bytes."""


class _PolicyProcess:
    """Carrier of requests to a child process. room: bytes for the arrays of an observation."""

    loses = False

    def __init__(self, name: str, room: int) -> None:
        self._memory = SharedMemory.new(room)
        self._process = ChildProcess(
            None, _SERVES, "policy", (self._memory.descriptor,), _MOST_BYTES
        )
        self._process.send(name.encode())
        self._open = True

    def info(self, within_s: float | None) -> PolicyInfo | Refusal:
        """Return the first message of the process. Raises PolicyFault."""
        try:
            info: PolicyInfo | Refusal = decode_info(self._process.wire.receive(within_s))
            return info
        except TimeoutError:
            words = f"gave no answer for {within_s:g} s: --start-timeout gives it longer"
            raise PolicyFault(words) from None
        except UNREADABLE as error:
            raise PolicyFault(f"sent what is no answer: {error}") from None
        except (EOFError, OSError):
            raise self._dead() from None

    def lay(self, arrays: Arrays) -> dict[str, PackedArray]:
        return self._memory.lay(arrays)

    def ask(self, question: ResetRequest | ActRequest | EndRequest) -> bytes:
        if isinstance(question, ResetRequest):
            self._process.wake()  # the policy may have stopped its supervisor
        try:
            self._process.wire.send(encode_message(question))
            return self._process.wire.receive()
        except (EOFError, OSError):
            raise self._dead() from None

    def report_ended(self, question: EndRequest) -> None:
        self.ask(question)

    def close(self) -> None:
        if self._open:
            self._process.hang_up()
            self._process.kill()
            self._memory.close()
        self._open = False

    def _dead(self) -> PolicyFault:
        return PolicyFault(f"gave no answer: {self._process.end()}")


def isolated_driver(
    name: str,
    timer: Timer | None = None,
    expected: Manifest | None = None,
    run: str = "",
    start_s: float = LOAD_TIMEOUT_S,
) -> HostedDriver:
    """Load a policy in a process of its own.

    expected: its manifest in the run, by which shared memory is sized; None if it is not queried.
    start_s: timeout of loading in seconds, used without a timer.
    Raises UsageError as `load_policy` does, and for a privileged policy.
    """
    with ExitStack() as stack, policy_call("loading", timer=timer, passes=(BaseException,)):
        process = _PolicyProcess(name, room_for(expected))
        stack.callback(process.close)
        try:
            info = process.info(start_s if timer is None else None)
        except PolicyFault as fault:
            raise UsageError(f"policy '{name}' cannot be loaded: it {fault.words}") from None
        if isinstance(info, Refusal):
            raise UsageError(info.words)
        manifest = with_goal(checked_manifest(name, info.manifest), None)
        if manifest.privileged:
            raise UsageError(
                f"policy '{manifest.name}' is told what the simulator knows (privileged), and an "
                "isolated one sees only observations: leave --isolated out"
            )
        stack.pop_all()
    return HostedDriver(HostedPolicy(manifest, process, run), "isolated", info.source[:64], timer)


def serve_alone(socket_descriptor: int, call_descriptor: int, memory_descriptor: int) -> None:
    """Answer requests until the socket closes. The first message is the policy's name, replied to
    with its info.

    call_descriptor: not used, because the environment's process enforces the timeouts.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.close(call_descriptor)
    wire = MessageSocket(socket(fileno=socket_descriptor))
    memory = SharedMemory(memory_descriptor, writes=False)
    os.close(memory_descriptor)
    name = wire.receive().decode()
    try:
        driver = load_policy(name, NoTimer())
    except UsageError as error:
        wire.send(encode_message(Refusal("policy", str(error))))
        return
    desk = PolicyDesk(driver.policy, decoder=ObservationDecoder, batch=False)
    info = PolicyInfo("", name, msgspec.to_builtins(driver.manifest), driver.source_hash)
    wire.send(encode_message(info))
    surroundings = Surroundings.now()
    with suppress(EOFError):
        while True:
            request = read_request(wire.receive())
            (reply,) = desk.replies([request], [memory.map])
            if isinstance(request, EndRequest) and Surroundings.now() != surroundings:
                end_at_once()  # without a reply, so that the next episode has a new process
            wire.send(encode_message(reply))
