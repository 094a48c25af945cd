"""Client of a policy in another process, independent of how requests are carried.

An answer must be signed with the run, episode, attempt and step of the request. It becomes a
command by the same checks as that of a policy in this process.
"""

from __future__ import annotations

import secrets
import time
from contextlib import nullcontext
from typing import Any, ClassVar, Protocol

import numpy as np

from bridge.policy_server import (
    LONGEST_MESSAGE,
    UNREADABLE,
    ActReply,
    ActRequest,
    EndRequest,
    EpisodeReply,
    PackedArray,
    PolicyFault,
    PolicyReply,
    Refusal,
    ResetRequest,
    decode_reply,
)
from cosim.core.errors import EngineError, MachineError, PolicyError, PolicyServerLost
from cosim.core.state import Command, WaypointCommand
from cosim.episode.control import check_numbers
from cosim.episode.interfaces import Observation
from cosim.episode.policy_caller import PolicyCaller, Timer
from cosim.spec.manifest import Manifest
from cosim.spec.options import PolicyProcess
from scenarios.ipc.observation_codec import Arrays, encode_constants, encode_observation


class PolicyServerBusy(PolicyServerLost):
    """Another episode has taken the server."""


class RequestCarrier(Protocol):
    """Carrier of requests to a policy.

    can_lose_episodes: whether the policy's side can lose an episode.
    """

    @property
    def can_lose_episodes(self) -> bool: ...

    def pack(self, arrays: Arrays) -> dict[str, PackedArray]:
        """Pack the arrays of the next request."""

    def exchange(self, request: ResetRequest | ActRequest) -> bytes:
        """Return the reply to a request.

        Raises PolicyFault if none will come, an EngineError if that is not the policy's fault.
        """

    def report_ended(self, request: EndRequest) -> None:
        """Report the end of an episode. Raises the same errors."""

    def close(self) -> None:
        """Release everything."""


class HostedPolicy:
    """A policy in another process, with the interface of one in this process.

    run: signs the requests.
    took_ms: time of each answer of the episode.
    lost: whether the policy was lost when an episode had ended.
    """

    def __init__(self, manifest: Manifest, carrier: RequestCarrier, run: str) -> None:
        self.manifest = manifest
        self._carrier = carrier
        self._run = run
        self._sign = run, "", ""
        self._step = -1
        self.took_ms: list[float] = []
        self.lost = False

    def reset(self, episode_id: str, seed: int) -> None:
        self._sign = self._run, episode_id, secrets.token_hex(8)
        self._step = -1
        self.took_ms = []
        self._reply(ResetRequest(*self._sign, seed))

    def act(self, seen: Observation) -> Command | np.ndarray[Any, Any]:
        began_s = time.perf_counter()
        self._step += 1
        fields, arrays = encode_observation(seen)
        about = encode_constants(seen) if self._step == 0 else None
        locations = self._carrier.pack(arrays)
        answer = self._reply(
            ActRequest(*self._sign, self._step, **fields, arrays=locations, about=about)
        )
        assert isinstance(answer, ActReply)
        self.took_ms.append(1000.0 * (time.perf_counter() - began_s))
        if answer.waypoints is None:
            return Command(answer.v_mps, answer.w_radps)
        waypoints = _array(answer.waypoints)
        if not answer.planned:
            return waypoints
        return WaypointCommand(
            answer.v_mps, answer.w_radps, waypoints, self.manifest.waypoints.index
        )

    def report_ended(self) -> None:
        """Report the end of the episode. Errors are ignored."""
        try:
            self._carrier.report_ended(EndRequest(*self._sign))
        except (PolicyFault, EngineError):
            self.lost = True

    def close(self) -> None:
        self._carrier.close()

    def _reply(self, request: ResetRequest | ActRequest) -> EpisodeReply | ActReply:
        """Return the reply to a request. Raises PolicyFault for errors of the policy,
        PolicyServerLost for a lost episode."""
        payload = self._carrier.exchange(request)
        try:
            reply: PolicyReply = decode_reply(payload)
        except UNREADABLE as error:
            raise PolicyFault(f"sent what is no answer: {error}"[:LONGEST_MESSAGE]) from None
        if isinstance(reply, Refusal):
            fault = PolicyFault(reply.words, reply.during, reply.together)
            if not self._carrier.can_lose_episodes or reply.why not in ("unknown", "busy"):
                raise fault
            lost = PolicyServerBusy if reply.why == "busy" else PolicyServerLost
            raise lost(f"the server of policy '{self.manifest.name}': {fault.words}")
        wanted = EpisodeReply if isinstance(request, ResetRequest) else ActReply
        step = reply.step if isinstance(reply, ActReply) else -1
        if not isinstance(reply, wanted) or reply.signature != self._sign or step != self._step:
            said = f"answered step {step} of '{reply.episode}' instead of step {self._step}"
            raise PolicyFault(said + ", in another attempt" * (step == self._step))
        return reply


class HostedCaller(PolicyCaller):
    """Caller of a policy in another process, with the same checks of its answers.

    A lost server or renderer, or a machine that lacks something, is not the policy's fault.
    """

    _passes: ClassVar[tuple[type[Exception], ...]] = (PolicyError, EngineError, MachineError)

    def __init__(
        self,
        policy: HostedPolicy,
        runs: PolicyProcess,
        source_hash: str,
        timer: Timer | None = None,
    ) -> None:
        super().__init__(policy, policy.manifest, source_hash, timer)
        self._hosted = policy
        self.runs = runs

    @property
    def clock(self) -> dict[str, float]:
        if not self._hosted.took_ms or self.runs == "in-process":
            return {}
        median, most = np.quantile(self._hosted.took_ms, [0.5, 0.95])
        return {"answer_median_ms": float(median), "answer_p95_ms": float(most)}

    def ended(self) -> None:
        if self._begun:
            # A server has a second to reply; an isolated policy is timed like any call.
            with self._guarded("ended", 0) if self._isolated else nullcontext():
                self._hosted.report_ended()
        self._begun = ""

    @property
    def has_exited(self) -> bool:
        return self._isolated and self._hosted.lost

    def close(self) -> None:
        self._hosted.close()

    @property
    def _isolated(self) -> bool:
        return self.runs.startswith("isolated")

    def _own(self, observation: Observation) -> Observation:
        return observation  # the message is a copy


def _array(sent: PackedArray) -> np.ndarray[Any, Any]:
    """Return the waypoints of an answer. Raises PolicyFault or PolicyError if they are invalid."""
    try:
        kind = np.dtype(sent.dtype)
        if kind.kind not in "biufc" or any(side < 0 for side in sent.shape) or sent.at >= 0:
            raise ValueError(f"an array of {sent.dtype} {sent.shape}")
        check_numbers(sent.shape)
        return np.frombuffer(sent.data, kind).reshape(sent.shape)
    except (TypeError, ValueError, OverflowError) as error:
        raise PolicyFault(
            f"answered waypoints that cannot be read: {error}"[:LONGEST_MESSAGE]
        ) from None
