"""Environment slot on a node of a Ray cluster, as a Ray actor.

The actor loads no engine: the environment process of its slot does, as in a run on one machine.
"""

from __future__ import annotations

import socket
import threading
from contextlib import ExitStack
from functools import partial
from multiprocessing.connection import wait
from typing import Final, NamedTuple

from cosim.core.errors import CosimError, UsageError
from cosim.core.files import temp_folder
from cosim.spec.scenario import CityMap, Place
from scenarios.ipc.faults import AttemptFailure
from scenarios.ipc.messages import Message, Unable, decode_hello, decode_job, encode_message
from scenarios.runs.environment_slot import EnvironmentSlot, new_output, start_environment
from scenarios.runs.protocol import Installed, installed_here

_LAST_PRINTED: Final = 1 << 20
"""Number of bytes that are sent of the output of a process."""


class NodeFound(NamedTuple):
    """The host name and the installed versions of a node."""

    host: str
    installed: Installed


class SlotReport(NamedTuple):
    """The messages of an environment process since the last report, the failure of its job, and its
    output."""

    said: tuple[bytes, ...]
    failure: AttemptFailure | None
    printed: bytes


class EnvironmentActor:
    """Runs jobs in one environment slot. `report` may be called at the same time as another
    method."""

    def __init__(self) -> None:
        self._folder = ExitStack()
        self._log = self._folder.enter_context(temp_folder("cosim-ray-")) / "process.log"
        self._log_sent = 0
        self._turn = threading.Lock()
        self._slot: EnvironmentSlot | None = None
        self._unable: Unable | None = None

    def found(self) -> NodeFound:
        """Return where the actor runs."""
        return NodeFound(socket.gethostname(), installed_here())

    def begin(self, hello: bytes) -> None:
        """Introduce the policy of the run."""
        with self._turn:
            introduced = decode_hello(hello)
            self._slot = EnvironmentSlot(partial(start_environment, self._log), introduced)

    def give(self, job: bytes, where: Place, digest: str, packed: bytes | None) -> None:
        """Run a job. `packed` is its map, which is stored on this node if it is missing."""
        try:
            if packed is not None:
                # Imported only where needed: it loads the importer of maps.
                from scenarios.runs.net_transfer import MapDownload, is_missing

                if isinstance(where, CityMap) and is_missing(where):
                    MapDownload(where, digest).keep(packed)
            with self._turn:
                assert self._slot is not None
                self._slot.give(decode_job(job))
        except CosimError as error:
            self._unable = Unable(str(error), blames_policy=False)

    def report(self, timeout_s: float) -> SlotReport:
        """Wait for messages of the environment process, and return them."""
        slot = self._slot
        descriptor = None if slot is None else slot.descriptor
        wait([] if descriptor is None else [descriptor], timeout_s)
        said: list[Message] = []
        failure = None
        with self._turn:
            if self._unable is not None:
                said.append(self._unable)
            elif slot is not None:
                try:
                    failure = slot.poll(said.append)
                except CosimError as error:
                    self._unable = Unable(str(error), blames_policy=isinstance(error, UsageError))
                    said.append(self._unable)
        return SlotReport(tuple(encode_message(one) for one in said), failure, self._printed())

    def close(self) -> bytes:
        """End the process; return the rest of its output."""
        with self._turn:
            if self._slot is not None:
                self._slot.stop()
                self._slot.end()
            printed = self._printed()
            self._folder.close()
            return printed

    def _printed(self) -> bytes:
        """Return the output of the process since the last report."""
        printed, self._log_sent = new_output(self._log, self._log_sent, _LAST_PRINTED)
        return printed
