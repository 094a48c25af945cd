"""Watches a process that runs a policy, and kills it when it hangs."""

from __future__ import annotations

import time
from functools import partial
from typing import NamedTuple

from cosim.core.errors import MachineError, UsageError
from scenarios.ipc.child_process import KeptProcess
from scenarios.ipc.deadlines import Patience, Question
from scenarios.ipc.messages import Message, MessageHandler, Ready, Unable


class ProcessEnd(NamedTuple):
    """The end of a process, in words.

    question: the policy call that was pending.
    in_engine: whether compiled code has ended it or hangs, while no policy call was pending.
    hung: whether it was killed because it sent nothing.
    allowed_s: the seconds that the policy had for its answer, if it was killed because there was
    none.
    """

    words: str
    question: Question | None = None
    in_engine: bool = False
    hung: bool = False
    allowed_s: float | None = None


class Watchdog:
    """Watches one process.

    silence_s: seconds without a message after which it hangs, unless a policy call is pending.
    ready: whether it has loaded the engines and the policy.
    heard_s: monotonic clock of its last sign of life.
    """

    def __init__(self, process: KeptProcess, patience: Patience, silence_s: float) -> None:
        self.process = process
        self.ready = False
        self.heard_s = time.monotonic()
        self._patience = patience
        self._silence_s = silence_s

    def poll(self, hear: MessageHandler, *, idle: bool = False) -> ProcessEnd | None:
        """Pass on its messages. Returns its end, if it has ended or was killed because it hangs.

        An `idle` process may be silent. Raises UsageError if it cannot load the policy,
        MachineError if the machine lacks something."""
        if not self.process.listen(partial(self._take, hear)):
            words = self.process.end()
            return ProcessEnd(words, self.process.question, self.process.in_engine)
        question = self.process.question
        now_s = time.monotonic()
        if idle:
            return None
        if question is None:
            if now_s - self.heard_s <= self._silence_s:
                return None
            self.process.kill()
            words = f"the {self.process.called} process showed no sign of life"
            return ProcessEnd(words, in_engine=True, hung=True)
        self.heard_s = now_s
        if not question.overdue(self._patience):
            return None
        self.process.kill()
        words = f"the {self.process.called} process was ended"
        return ProcessEnd(words, question, allowed_s=self._patience.of(question.doing))

    def _take(self, hear: MessageHandler, message: Message) -> None:
        self.heard_s = time.monotonic()
        if isinstance(message, Unable):
            raise_unable(message)
        if isinstance(message, Ready):
            self.ready = True
        else:
            hear(message)


def raise_unable(message: Unable) -> None:
    """Raise UsageError if the policy cannot be loaded, MachineError if the machine lacks
    something."""
    raise UsageError(message.reason) if message.blames_policy else MachineError(message.reason)
