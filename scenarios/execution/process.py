"""One environment process as the run sees it: started, spoken with, ended with everything it has started."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from multiprocessing import Pipe
from pathlib import Path
from typing import Final

from cosim.core.errors import unwritable
from scenarios.execution.asked import Asked, Question
from scenarios.execution.messages import Hello, Job, Message, decode_message, encode_message

ENDING_S: Final = 10.0
"""What a process is left to end by itself, and then its shepherd to clear up."""
_CODE: Final = (
    "import sys; sys.path[:] = {path!r}; from scenarios.execution.shepherd import keep_worker; "
    "keep_worker({pipe}, {asked}, {run})"
)


class Process:
    """A shepherd and its worker (`scenarios.execution.shepherd`). asked: what its policy is asked right now;
    question: what it was asked when it ended."""

    def __init__(self, log: Path) -> None:
        self.log, self.asked = log, Asked.new()
        self.question: Question | None = None
        self.pipe, theirs = Pipe()
        given = (theirs.fileno(), self.asked.descriptor)
        path = [str(Path(entry).absolute()) for entry in sys.path]
        code = _CODE.format(path=path, pipe=given[0], asked=given[1], run=os.getpid())
        try:
            with log.open("ab") as printed:
                self._child = subprocess.Popen(
                    [sys.executable, "-P", "-c", code],
                    stdin=subprocess.DEVNULL,
                    stdout=printed,
                    stderr=printed,
                    pass_fds=given,
                    start_new_session=True,
                )
        except OSError as error:
            raise unwritable(log, error) from error
        finally:
            theirs.close()

    def send(self, message: Hello | Job) -> None:
        """Say something. A process that died while it was idle does not hear it: its `messages` tell."""
        try:
            self.pipe.send_bytes(encode_message(message))
        except (BrokenPipeError, ConnectionResetError):
            return

    def messages(self) -> Iterator[Message | None]:
        """What the process has said since; None at last if it says no more."""
        try:
            while self.pipe.poll():
                yield decode_message(self.pipe.recv_bytes())
        except (EOFError, ConnectionResetError):
            yield None

    def hang_up(self) -> None:
        """Close the pipe: an idle process ends then."""
        self.pipe.close()

    def kill(self, *, wait: bool = True) -> None:
        """End it by force, with all its children."""
        self._child.send_signal(signal.SIGTERM)
        if wait:
            self.end()

    def end(self) -> str:
        """Wait until it has ended, by force if need be. Returns how it ended, in words."""
        self.pipe.close()
        code = self._code(ENDING_S)
        if code is None:
            self._child.send_signal(signal.SIGTERM)
            if self._code(2 * ENDING_S) is None:
                self._child.kill()
                self._child.wait()
        self.question = self.asked.question
        self.asked.close()
        during = f" in the policy's {self.question.when}" if self.question is not None else ""
        return f"the environment process {_in_words(code)}{during}"

    def _code(self, wait_s: float) -> int | None:
        """Its exit code; None if it has not ended in time."""
        try:
            return self._child.wait(wait_s)
        except subprocess.TimeoutExpired:
            return None


def _in_words(code: int | None) -> str:
    if code is None:
        return "closed its pipe to the run"
    if code < 0:
        return f"was killed by {signal.Signals(-code).name}"
    return f"ended with exit code {code}"
