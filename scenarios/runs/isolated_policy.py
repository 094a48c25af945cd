"""A policy in a process of its own, kept by a shepherd of its own: questions over a socket,
pictures in memory that it shares with the environment's process alone."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from bridge.policy_server import (
    UNREADABLE,
    Answer,
    Begun,
    PackedArray,
    PolicyInfo,
    Refusal,
    decode_answered,
    encode_asked,
)
from cosim.core.errors import PolicyError, UsageError
from cosim.episode.manifest_checks import with_goal
from cosim.episode.policy_caller import LOADED_WITHIN_S, Timer, Untimed
from cosim.policies.load import checked_manifest
from cosim.spec.manifest import Manifest
from scenarios.ipc.child_process import KeptProcess
from scenarios.ipc.shared_arrays import ObservationMemory, room_for
from scenarios.runs.hosted_policy import HostedDriver, HostedPolicy, PolicyQuestion

_SERVES: Final = "scenarios.runs.isolated_child:serve_alone"
_MOST_BYTES: Final = 4 << 20
"""Of an answer."""


class _PolicyProcess:
    """Carries to a process of this machine. room: bytes for the arrays of an observation."""

    def __init__(self, name: str, room: int) -> None:
        self._memory = ObservationMemory(room)
        self._process = KeptProcess(
            None, _SERVES, "policy", (self._memory.descriptor,), _MOST_BYTES
        )
        self._process.send(name.encode())
        self._open = True

    def lay(self, arrays: dict[str, np.ndarray[Any, Any]]) -> dict[str, PackedArray]:
        return self._memory.lay(arrays)

    def ask(self, question: PolicyQuestion) -> Begun | Answer | Refusal:
        try:
            self._process.wire.send(encode_asked(question))
        except OSError:
            raise self._dead() from None
        reply = self.received()
        if isinstance(reply, PolicyInfo):
            raise PolicyError("gave an answer that nobody had asked for")
        return reply

    def received(self, within_s: float | None = None) -> PolicyInfo | Begun | Answer | Refusal:
        try:
            reply: PolicyInfo | Begun | Answer | Refusal = decode_answered(
                self._process.wire.receive(within_s)
            )
            return reply
        except TimeoutError:
            raise PolicyError(
                f"gave no answer for {within_s:g} s: --start-timeout gives it longer"
            ) from None
        except UNREADABLE as error:
            raise PolicyError(f"sent what is no answer: {error}") from None
        except (EOFError, OSError):
            raise self._dead() from None

    def close(self) -> None:
        if self._open:
            self._process.hang_up()
            self._process.kill()
            self._memory.close()
        self._open = False

    def _dead(self) -> PolicyError:
        return PolicyError(f"gave no answer: {self._process.end()}")


def isolated_driver(
    name: str,
    timer: Timer | None = None,
    expected: Manifest | None = None,
    run: str = "",
    start_s: float = LOADED_WITHIN_S,
) -> HostedDriver:
    """A policy by its name, in a process of its own. expected: its manifest as the run knows it,
    with which it is to be asked; without, nothing is. start_s: without a timer it may take so long
    to be loaded. Raises UsageError as `load_policy` does, and for one that is told what only the
    simulator knows."""
    watched: Timer = Untimed() if timer is None else timer
    watched.starts("loading", 0)
    process = _PolicyProcess(name, room_for(expected))
    try:
        info = process.received(start_s if timer is None else None)
        if isinstance(info, Refusal):
            raise UsageError(info.words)
        if not isinstance(info, PolicyInfo):
            raise UsageError(
                f"policy '{name}' cannot be loaded in a process of its own: it says "
                f"something else first"
            )
        manifest = with_goal(checked_manifest(name, info.manifest), None)
        if manifest.privileged:
            raise UsageError(
                f"policy '{manifest.name}' is told what the simulator knows (privileged), and an "
                "isolated one sees only observations: leave --isolated out"
            )
        policy = HostedPolicy(manifest, process, run)
        return HostedDriver(policy, "isolated", info.source[:64], timer)
    except PolicyError as error:
        process.close()
        raise UsageError(f"policy '{name}' cannot be loaded: it {error}") from None
    except BaseException:
        process.close()
        raise
    finally:
        watched.stops()
