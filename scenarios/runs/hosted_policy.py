"""Asking a policy that is not in this process: the same questions and answers, whatever carries
them.

Nothing that comes back is believed: an answer must be signed with the question's run, episode,
attempt and step, and becomes a command by the same checks as that of a policy in this process.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any, Protocol

import numpy as np

from bridge.policy_server import Answer, AskAct, AskEnded, AskReset, Begun, PackedArray, Refusal
from cosim.core.errors import MachineError, PolicyError, PolicyServerLost
from cosim.core.state import Command
from cosim.episode.control import check_numbers
from cosim.episode.interfaces import Observation
from cosim.episode.policy_caller import MOST_SAID, Driver, PolicyCall, Timer
from cosim.spec.manifest import Manifest
from cosim.spec.policy_host import PolicyRuns
from scenarios.runs.observation_codec import arrays_of, told_about, told_goal

PolicyQuestion = AskReset | AskAct | AskEnded


class QuestionCarrier(Protocol):
    """Brings questions to where a policy is."""

    def lay(self, arrays: dict[str, np.ndarray[Any, Any]]) -> dict[str, PackedArray]:
        """Arrays of the next question, as they are told of in it."""

    def ask(self, question: PolicyQuestion) -> Begun | Answer | Refusal:
        """The reply to a question. Raises PolicyError where none will come, PolicyServerLost where
        that is no fault of the answer."""

    def close(self) -> None:
        """Nothing more is asked."""


class HostedPolicy:
    """A policy elsewhere, as one that can be asked here. run: signs what is asked. took_ms: each
    answer of the episode. lost: whether nobody was there any more when an episode had ended."""

    def __init__(self, manifest: Manifest, carrier: QuestionCarrier, run: str) -> None:
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
        self._reply(AskReset(*self._sign, seed))

    def act(self, seen: Observation) -> Command | np.ndarray[Any, Any]:
        began_s = time.perf_counter()
        self._step += 1
        goal, goal_arrays = told_goal(seen.goal)
        arrays = arrays_of(seen) | goal_arrays
        odometry = (
            None if (told := seen.odometry) is None else (told.x_m, told.y_m, told.heading_rad)
        )
        answer = self._reply(
            AskAct(
                *self._sign,
                self._step,
                seen.tick,
                seen.time_s,
                seen.v_mps,
                seen.w_radps,
                seen.reset,
                goal,
                odometry,
                self._carrier.lay(arrays),
                told_about(seen) if self._step == 0 else None,
            )
        )
        assert isinstance(answer, Answer)
        self.took_ms.append(1000.0 * (time.perf_counter() - began_s))
        return (
            Command(answer.v_mps, answer.w_radps)
            if answer.waypoints is None
            else _array(answer.waypoints)
        )

    def tell_ended(self) -> None:
        """Nothing more is asked about the episode. Whatever goes wrong with that changes
        nothing."""
        try:
            self._carrier.ask(AskEnded(*self._sign))
        except (PolicyError, PolicyServerLost):
            self.lost = True

    def close(self) -> None:
        self._carrier.close()

    def _reply(self, question: AskReset | AskAct) -> Begun | Answer:
        reply = self._carrier.ask(question)
        if isinstance(reply, Refusal):
            raise PolicyError(reply.words[: 2 * MOST_SAID])
        wanted = Begun if isinstance(question, AskReset) else Answer
        step = reply.step if isinstance(reply, Answer) else -1
        if not isinstance(reply, wanted) or reply.signature != self._sign or step != self._step:
            told = f"answered step {step} of '{reply.episode}' when it was asked step {self._step}"
            raise PolicyError(told + ", in another attempt" * (step == self._step))
        return reply


class HostedDriver(Driver):
    """The driver of a policy elsewhere. What comes of it is checked as ever; that its server is
    lost, or the machine lacks something, is not its crash."""

    def __init__(
        self, policy: HostedPolicy, runs: PolicyRuns, source_hash: str, timer: Timer | None = None
    ) -> None:
        super().__init__(policy, policy.manifest, source_hash, timer)
        self._hosted = policy
        self.runs = runs

    @property
    def clock(self) -> dict[str, float]:
        if not self._hosted.took_ms:
            return {}
        median, most = np.quantile(self._hosted.took_ms, [0.5, 0.95])
        return {"answer_median_ms": float(median), "answer_p95_ms": float(most)}

    def ended(self) -> None:
        if self._begun:
            # What is elsewhere is waited for a moment only, by itself.
            with self._asked("ended", 0) if self.runs == "isolated" else nullcontext():
                self._hosted.tell_ended()
        self._begun = ""

    @property
    def spent(self) -> bool:
        return self.runs == "isolated" and self._hosted.lost

    def close(self) -> None:
        self._hosted.close()

    def _own(self, observation: Observation) -> Observation:
        return observation  # what is sent is a copy

    @contextmanager
    def _asked(self, doing: PolicyCall, tick: int) -> Iterator[None]:
        try:
            with super()._asked(doing, tick):
                yield
        except PolicyError as error:
            if isinstance(
                error.__cause__, MachineError | PolicyServerLost
            ):  # no words of the policy's become these
                raise error.__cause__ from None
            raise


def _array(told: PackedArray) -> np.ndarray[Any, Any]:
    """Waypoints. Raises PolicyError where they are none."""
    try:
        kind = np.dtype(told.dtype)
        if kind.kind not in "biufc" or any(side < 0 for side in told.shape) or told.at >= 0:
            raise ValueError(f"an array of {told.dtype} {told.shape}")
        check_numbers(told.shape)
        return np.frombuffer(told.data, kind).reshape(told.shape)
    except (TypeError, ValueError, OverflowError) as error:
        raise PolicyError(f"answered waypoints that cannot be read: {error}"[:MOST_SAID]) from None
