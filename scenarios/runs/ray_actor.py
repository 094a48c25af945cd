"""On a node of a Ray cluster: an environment process, kept by a Ray actor.

What Ray gives to each node is this actor. It loads no engine: the process beside it does, which is
the same as in a run on one machine, and what takes that down or hangs in it is told by the actor as
it is found by a run on one machine.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from multiprocessing.connection import wait
from pathlib import Path
from typing import NamedTuple

from cosim.core.errors import CosimError
from cosim.core.files import temp_folder
from cosim.spec.scenario import CityMap, Place
from scenarios.ipc.child_process import WORKER, KeptProcess
from scenarios.ipc.messages import Message, Unable, encode_message
from scenarios.runs.protocol import Asks, Installed, installed_here


class NodeFound(NamedTuple):
    """Where an actor is, and what is installed there."""

    host: str
    installed: Installed


class Heard(NamedTuple):
    """What a process has said since, whether it has ended, and what its policy is asked."""

    said: tuple[bytes, ...]
    ended: bool
    asks: Asks | None


class ProcessEnd(NamedTuple):
    """How a process ended, in words, and what it printed."""

    words: str
    in_engine: bool
    asks: Asks | None
    printed: bytes


class EnvironmentActor:
    """One environment process. Its methods are called by the run, `hear` beside the others."""

    def __init__(self) -> None:
        self._folder = ExitStack()
        logs = self._folder.enter_context(temp_folder("cosim-ray-"))
        self._process = KeptProcess(logs / "process.log", WORKER, "environment")
        self._turn = threading.Lock()
        self._open = True
        self._trouble: list[Message] = []

    def found(self) -> NodeFound:
        """What is here."""
        return NodeFound(socket.gethostname(), installed_here())

    def send(self, message: bytes) -> None:
        """Hand the process a message as the run made it: its Hello."""
        with self._turn:
            self._process.send(message)

    def give(self, message: bytes, where: Place, digest: str, parts: Sequence[bytes]) -> None:
        """Hand the process a job. parts: of the map that it takes place on, where that is not made
        anew here."""
        try:
            if parts:
                from scenarios.runs.net_transfer import Fetched, lacks  # with the importer of maps

                if isinstance(where, CityMap) and lacks(where):
                    fetched = Fetched(where, digest)
                    for part in parts:
                        fetched.take(part)
        except CosimError as error:
            self._trouble.append(Unable(str(error), blames_policy=False))
        self.send(message)

    def hear(self, timeout_s: float) -> Heard:
        """What it has said since the last time; waits for something."""
        if self._open:
            wait([self._process.wire.fileno()], timeout_s)
        with self._turn:
            said = self._trouble
            self._trouble = []
            goes_on = self._open and self._process.listen(said.append)
            return Heard(tuple(encode_message(one) for one in said), not goes_on, self._asks())

    def hang_up(self) -> None:
        """It gets no more jobs."""
        with self._turn:
            if self._open:
                self._process.hang_up()

    def end(self) -> ProcessEnd:
        """Wait until it has ended, by force if need be."""
        with self._turn:
            self._open = False
            words = self._process.end()
            printed = Path(self._process.log).read_bytes()
            self._folder.close()
            return ProcessEnd(words, self._process.in_engine, self._asks(), printed)

    def _asks(self) -> Asks | None:
        question = self._process.question
        if question is None:
            return None
        return Asks(question.doing, question.tick, max(time.monotonic() - question.since_s, 0.0))
