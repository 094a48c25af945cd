"""Management of a run's shared renderer: started, replaced when it fails, ended with the run.

The run holds the socket that environments connect to, so that the address remains valid when a
renderer is replaced. An environment that connects meanwhile waits for the next one.
"""

from __future__ import annotations

import secrets
import select
import socket
import time
from pathlib import Path
from types import TracebackType
from typing import Final, NamedTuple, Self

import msgspec

from cosim.core.errors import MachineError, UsageError
from cosim.episode.policy_caller import PolicyCaller
from cosim.spec.options import CameraName, RendererAddress
from cosim.spec.run_config import Appearance
from scenarios.ipc.child_process import ChildProcess, Watchdog
from scenarios.ipc.messages import Hello, encode_message

RENDERERS: Final = 3
"""Number of renderers that may fail in a row without an episode that ends in between."""
_SILENCE_S: Final = 120.0
"""Timeout in seconds of a renderer's heartbeats while no policy call is pending."""
_ENDING_S: Final = 5.0
"""Longest time in seconds between an environment's notice of a renderer's end and the run's."""
_ENTRY_POINT: Final = "scenarios.runs.renderer:serve_pictures"
"""The function of the renderer's process."""


class RendererEnd(NamedTuple):
    """The end of a renderer, in words.

    unanswered_s: timeout of the policy call in seconds, if the renderer was killed for it.
    """

    words: str
    unanswered_s: float | None = None


class SharedRenderer:
    """The shared renderer of a run. Use it in a `with` block.

    logs: folder for the output of renderers.
    hello: introduces the policy of the run.
    asks: whether the renderer also queries the policy.
    appearance: of scanned places.
    at: its address for environments.
    """

    def __init__(
        self, logs: Path, hello: Hello, *, asks: bool, appearance: Appearance = "splats"
    ) -> None:
        self._logs = logs
        address = f"cosim-renderer-{secrets.token_hex(8)}"
        self.at = RendererAddress(address=address, asks=asks, appearance=appearance)
        self._hello = msgspec.structs.replace(hello, renderer=self.at)
        self._listening = socket.socket(socket.AF_UNIX)
        self._watchdog: Watchdog | None = None
        self._ends: list[RendererEnd] = []
        self._failures_in_a_row = 0

    def __enter__(self) -> Self:
        self._listening.bind(f"\0{self.at.address}")
        self._listening.listen(socket.SOMAXCONN)
        self.check()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._watchdog is not None:
            self._watchdog.process.hang_up()
            self._watchdog.process.kill()
            self._watchdog = None
        self._listening.close()

    def check(self) -> None:
        """Check the renderer, and replace it if it has ended or hangs. Raises UsageError if it
        cannot load the policy, MachineError if none can be started."""
        if self._watchdog is None:
            self._start()
            return
        end = self._watchdog.poll(lambda message: None)
        if end is None:
            return
        if (
            end.allowed_s is not None
            and end.pending_call is not None
            and end.pending_call.kind == "loading"
        ):
            raise UsageError(
                f"policy '{self._hello.manifest.name}' gave no answer for {end.allowed_s:g} s "
                "while it was loaded in the renderer process: give a longer --start-timeout"
            )
        self._replace(
            self._watchdog,
            RendererEnd(end.words, end.allowed_s),
            blames_policy=end.pending_call is not None,
        )

    def end_of(self, number: int) -> RendererEnd | None:
        """Return the end of the renderer with this number; None if it still runs, and only an
        environment has lost it.

        number: from 1; 0 for an environment that never had a reply.
        """
        if number == 0:
            return RendererEnd("the renderer process could not be reached")
        deadline_s = time.monotonic() + _ENDING_S
        while (
            number > len(self._ends)
            and self._watchdog is not None
            and time.monotonic() < deadline_s
        ):
            select.select([self._watchdog.process.wire], [], [], 0.1)
            self.check()
        return self._ends[number - 1] if number <= len(self._ends) else None

    def episode_ended(self) -> None:
        """Reset the count of failed renderers."""
        self._failures_in_a_row = 0

    def _start(self) -> None:
        log = self._logs / f"renderer-{len(self._ends)}.log"
        process = ChildProcess(log, _ENTRY_POINT, "renderer", (self._listening.fileno(),))
        at = msgspec.structs.replace(self.at, number=len(self._ends) + 1)
        process.send(encode_message(msgspec.structs.replace(self._hello, renderer=at)))
        self._watchdog = Watchdog(process, self._hello.patience, _SILENCE_S)

    def _replace(self, watchdog: Watchdog, end: RendererEnd, *, blames_policy: bool) -> None:
        """Start another renderer. Raises UsageError or MachineError after too many failures in a
        row."""
        self._ends.append(end)
        if watchdog.ready and blames_policy:  # counted as a failed attempt of its episodes
            self._start()
            return
        self._failures_in_a_row += 1
        if self._failures_in_a_row >= RENDERERS:
            words = (
                f"{end.words}, {RENDERERS} times, and no episode ended in between: see "
                f"{watchdog.process.log}"
            )
            if blames_policy:
                raise UsageError(f"policy '{self._hello.policy}' cannot be loaded: {words}")
            raise MachineError(
                f"{words}, and `cosim doctor`; without --shared-renderer each environment "
                f"draws for itself"
            )
        self._start()


def check_shared(caller: PolicyCaller, camera: CameraName) -> None:
    """Check that a run can have a shared renderer. camera: of the run. Raises UsageError."""
    manifest = caller.manifest
    if manifest.camera is None and not caller.batches:
        raise UsageError(
            f"policy '{manifest.name}' has no camera and no method 'act_batch': leave "
            "--shared-renderer out, there is nothing to share"
        )
    if manifest.cameras or (manifest.camera is not None and manifest.camera.depth):
        raise UsageError(
            f"policy '{manifest.name}' asks for "
            f"{'further cameras' if manifest.cameras else 'depth'}, which a shared "
            "renderer does not give: leave --shared-renderer out"
        )
    if manifest.camera is not None and camera != "gl":
        raise UsageError(
            f"--shared-renderer draws by OpenGL, not by the {camera} camera: use --camera gl "
            "(`cosim doctor` says whether it works here), or leave --shared-renderer out"
        )
