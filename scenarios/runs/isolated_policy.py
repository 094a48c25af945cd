"""Isolated policies: a policy in a supervised process of its own, and its client.

Requests go over a socket, arrays through memory shared with the environment's process only. The
policy's process loads no engine, and has no data of the run but observations. It runs in a sandbox
(`scenarios.ipc.sandbox`), unless its kind is "weak".
"""

from __future__ import annotations

import os
import re
import signal
import sys
from contextlib import ExitStack, suppress
from socket import socket
from typing import Final, cast

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
from cosim.core.errors import MachineError, UsageError
from cosim.core.framing import MessageSocket
from cosim.episode.manifest_checks import check_unprivileged, with_goal
from cosim.episode.policy_caller import LOAD_TIMEOUT_S, NoTimer, Timer
from cosim.policies.load import checked_manifest, load_policy
from cosim.spec.manifest import Manifest
from cosim.spec.options import PolicyHost, PolicyProcess
from cosim.spec.run_config import Isolation
from scenarios.ipc.child_process import ChildProcess
from scenarios.ipc.observation_codec import Arrays, ObservationDecoder
from scenarios.ipc.process_state import ProcessState, end_at_once
from scenarios.ipc.sandbox import KINDS, Sandbox
from scenarios.ipc.shared_memory import SharedMemory, observation_bytes
from scenarios.runs.hosted_policy import HostedCaller, HostedPolicy
from scenarios.runs.policy_view import name_in_sandbox, sandbox_for

_ENTRY_POINT: Final = "scenarios.runs.isolated_policy:serve_without_sandbox"
_ENTRY_POINT_IN_SANDBOX: Final = "scenarios.runs.isolated_policy:serve_in_sandbox"
"""The functions of the policy's process, without and with a sandbox."""
_RUNS: Final[dict[Isolation, PolicyProcess]] = {
    "namespaces": "isolated: namespaces",
    "landlock": "isolated: landlock",
    "weak": "isolated: weak",
}
"""What a row records, by kind."""
_LACKS_A_FILE: Final = re.compile(
    r"Errno (1|2|13)\]|No such file|NO_SUCHFILE|Permission denied|No module named|not exist"
)
"""Words of errors that a file outside of the sandbox may have caused."""
_MAX_BYTES: Final = 4 << 20
"""Size limit of an answer in bytes."""


class _PolicyProcess:
    """Carrier of requests to a child process.

    memory_bytes: bytes for the arrays of an observation.
    sandbox: None for the weak kind.
    """

    can_lose_episodes = False

    def __init__(self, name: str, memory_bytes: int, sandbox: Sandbox | None) -> None:
        self._memory = SharedMemory.new(memory_bytes)
        entry_point = _ENTRY_POINT if sandbox is None else _ENTRY_POINT_IN_SANDBOX
        descriptors = (self._memory.descriptor,)
        self._process = ChildProcess(None, entry_point, "policy", descriptors, _MAX_BYTES, sandbox)
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
            raise self._end_as_fault() from None

    def pack(self, arrays: Arrays) -> dict[str, PackedArray]:
        return self._memory.write_arrays(arrays)

    def exchange(self, request: ResetRequest | ActRequest | EndRequest) -> bytes:
        if isinstance(request, ResetRequest):
            self._process.wake()  # the policy may have stopped its supervisor
        try:
            self._process.wire.send(encode_message(request))
            return self._process.wire.receive()
        except (EOFError, OSError):
            raise self._end_as_fault() from None

    def report_ended(self, request: EndRequest) -> None:
        self.exchange(request)

    def close(self) -> None:
        if self._open:
            self._process.hang_up()
            self._process.kill()
            self._memory.close()
        self._open = False

    def _end_as_fault(self) -> PolicyFault:
        return PolicyFault(f"gave no answer: {self._process.end()}")


class _NoSandbox(Exception):
    """The kernel does not offer a kind of sandbox, and why."""


def isolated_caller(
    name: str,
    timer: Timer | None = None,
    expected: Manifest | None = None,
    host: PolicyHost = PolicyHost(isolated="auto"),  # noqa: B008  a frozen value
    start_s: float = LOAD_TIMEOUT_S,
) -> HostedCaller:
    """Load a policy in a process of its own.

    expected: its manifest in the run, by which shared memory is sized; None if it is not queried.
    host: the kind of its sandbox, and what it may read; "auto" is the first kind that works.
    start_s: timeout of loading in seconds, used without a timer.
    Raises UsageError as `load_policy` does, and for a privileged policy. Raises MachineError if the
    kernel does not offer the sandbox.
    """
    kinds = KINDS if host.isolated == "auto" else (host.isolated,)
    why = []
    for kind in kinds:
        try:
            return _start_isolated(name, timer, expected, host, cast(Isolation, kind), start_s)
        except _NoSandbox as lacking:
            why.append(f"{kind}: {lacking}")
    raise MachineError(
        f"--isolated: this machine offers no sandbox ({'; '.join(why)}). --isolated=weak runs the "
        "policy in another process, which can read your files and end the run"
    )


def sandbox_lacks(kind: Isolation) -> str:
    """Return the step of a sandbox's set-up that fails on this machine, and why; "" if none."""
    try:
        _start_isolated("straight", None, None, PolicyHost(), kind, LOAD_TIMEOUT_S).close()
    except _NoSandbox as lacking:
        return str(lacking)
    return ""


def isolation_of(runs: PolicyProcess) -> Isolation | None:
    """Return the kind of sandbox of a recorded place; None for other places.

    >>> isolation_of("isolated: landlock")
    'landlock'
    """
    return next((kind for kind, words in _RUNS.items() if words == runs), None)


def _start_isolated(
    name: str,
    timer: Timer | None,
    expected: Manifest | None,
    host: PolicyHost,
    kind: Isolation,
    start_s: float,
) -> HostedCaller:
    """Load a policy with one kind of sandbox. Raises _NoSandbox, UsageError."""
    sandbox = None if kind == "weak" else sandbox_for(name, kind, host)
    with ExitStack() as stack, policy_call("loading", timer=timer, passes=(BaseException,)):
        process = _PolicyProcess(name_in_sandbox(name), observation_bytes(expected), sandbox)
        stack.callback(process.close)
        try:
            info = process.info(start_s if timer is None else None)
        except PolicyFault as fault:
            raise UsageError(f"policy '{name}' cannot be loaded: it {fault.words}") from None
        if isinstance(info, Refusal):
            raise _NoSandbox(info.words) if info.why == "sandbox" else UsageError(info.words)
        manifest = with_goal(checked_manifest(name, info.manifest), None)
        check_unprivileged(manifest.name, manifest, "an isolated one", "leave --isolated out")
        stack.pop_all()
    policy = HostedPolicy(manifest, process, host.run)
    return HostedCaller(policy, _RUNS[kind], info.source[:64], timer)


def serve_without_sandbox(
    socket_descriptor: int, call_descriptor: int, memory_descriptor: int
) -> None:
    """Answer requests, without a sandbox.

    call_descriptor: not used, because the environment's process enforces the timeouts.
    """
    os.close(call_descriptor)
    _serve(socket_descriptor, memory_descriptor, in_sandbox=False)


def serve_in_sandbox(socket_descriptor: int, memory_descriptor: int) -> None:
    """Answer requests, in a sandbox."""
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    _serve(socket_descriptor, memory_descriptor, in_sandbox=True)


def _serve(socket_descriptor: int, memory_descriptor: int, *, in_sandbox: bool) -> None:
    """Answer requests until the socket closes. The first message is the policy's name, replied to
    with its info."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    wire = MessageSocket(socket(fileno=socket_descriptor))
    memory = SharedMemory(memory_descriptor, writes=False)
    os.close(memory_descriptor)
    name = wire.receive().decode()
    try:
        caller = load_policy(name, NoTimer())
    except UsageError as error:
        wire.send(encode_message(_with_remedy(Refusal("policy", str(error)), in_sandbox)))
        return
    desk = PolicyDesk(caller.policy, decoder=ObservationDecoder, batch=False)
    info = PolicyInfo("", name, msgspec.to_builtins(caller.manifest), caller.source_hash)
    wire.send(encode_message(info))
    initial_state = ProcessState.now()
    with suppress(EOFError):
        while True:
            request = read_request(wire.receive())
            (reply,) = desk.replies([request], [memory.map])
            if isinstance(request, EndRequest) and ProcessState.now() != initial_state:
                end_at_once()  # without a reply, so that the next episode has a new process
            if isinstance(reply, Refusal):
                reply = _with_remedy(reply, in_sandbox)
            wire.send(encode_message(reply))


def _with_remedy(refusal: Refusal, in_sandbox: bool) -> Refusal:
    """Say how a policy in a sandbox gets the file that it may lack."""
    if not in_sandbox or not _LACKS_A_FILE.search(refusal.words):
        return refusal
    remedy = (
        "; an isolated policy begins in an empty folder and reads only its own: name other files "
        "by --policy-data PATH"
    )
    return msgspec.structs.replace(refusal, words=refusal.words + remedy)
