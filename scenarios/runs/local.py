"""Runs episodes in environment processes of this machine: a transport."""

from __future__ import annotations

from multiprocessing.connection import wait
from pathlib import Path

from scenarios.ipc.child_process import KeptProcess
from scenarios.ipc.messages import Hello
from scenarios.runs.environment_slot import EnvironmentSlot, start_environment


class LocalProcesses:
    """Runs up to `jobs` environment processes; each writes a file of its own in the folder
    `logs`."""

    def __init__(self, logs: Path, jobs: int = 1) -> None:
        self._logs = logs
        self._jobs = jobs
        self._started = 0
        self._slots: list[EnvironmentSlot] = []

    def room(self, busy: int) -> int:
        return self._jobs - busy

    def unsolicited(self) -> tuple[()]:
        return ()

    def start(self, hello: Hello) -> EnvironmentSlot:
        def start_next() -> KeptProcess:
            number = self._started
            self._started = self._started + 1
            return start_environment(self._logs / f"worker-{number}.log", hello)

        slot = EnvironmentSlot(start_next, hello)
        self._slots.append(slot)
        return slot

    def wait(self, timeout_s: float) -> None:
        descriptors = [slot.descriptor for slot in self._slots]
        wait([one for one in descriptors if one is not None], timeout_s)
