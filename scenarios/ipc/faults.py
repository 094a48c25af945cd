"""Rules for failed attempts at an episode: retry, or record as crashed or invalid.

After the last attempt, the commands of the episode are simulated again without the policy
(`scenarios.runs.environment_slot`). If the simulator fails at the same tick, the episode is
invalid; otherwise the policy is the cause, and the episode is crashed.

policy_ended: the process ended by itself during a call of the policy.
process_ended: the process ended, and the policy is the cause or may be.
engine_failed: the simulator failed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal, NamedTuple

from cosim.core.errors import CosimError, DirectorLost, EngineError, PolicyError, PolicyServerLost
from cosim.results.record import Status

Fault = Literal[
    "policy_timeout",
    "policy_ended",
    "process_ended",
    "engine_failed",
    "damaged_result",
    "machine_lost",
    "handed_back",
    "worker_unable",
]


class Rule(NamedTuple):
    """The consequence of a fault. The episode is recorded with `status` after `attempts`, never if
    that is None."""

    attempts: int | None
    status: Status


RULES: Final[Mapping[Fault, Rule]] = {
    "policy_timeout": Rule(1, "crashed"),
    "policy_ended": Rule(1, "crashed"),
    "damaged_result": Rule(1, "crashed"),
    "process_ended": Rule(2, "crashed"),
    "engine_failed": Rule(2, "invalid"),
    "machine_lost": Rule(8, "crashed"),
    "handed_back": Rule(None, "invalid"),
    "worker_unable": Rule(None, "invalid"),
}
"""Rule of each fault. A lost machine has more attempts, because its loss says little about the
episode."""


class AttemptFailure(NamedTuple):
    """A failed attempt at an episode.

    why: the reason in words.
    found: result of the replay without the policy in words, "" without a replay.
    driven: bytes of the record of what was driven, from a replay.
    """

    fault: Fault
    why: str = ""
    found: str = ""
    driven: bytes = b""


def verdict_on(error: Exception) -> tuple[Status, bool]:
    """Return the status of an episode that ended with an error, and whether it is worth another
    attempt."""
    status: Status = "crashed" if isinstance(error, PolicyError | PolicyServerLost) else "invalid"
    may_pass = isinstance(error, EngineError) or not isinstance(error, CosimError)
    return status, may_pass and not isinstance(error, DirectorLost)


def failure_of_result(status: Status, why: str) -> AttemptFailure:
    """Return the failure of an episode that its process reports as worth another attempt."""
    return AttemptFailure("engine_failed" if status == "invalid" else "process_ended", why)
