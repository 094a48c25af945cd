"""Log of the commands of an episode, in memory that survives the environment process.

Each command is written before it is simulated. If the process dies, hangs or reports an engine
error, the run has the commands simulated again without the policy (fault attribution).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final, NamedTuple

from cosim.core.state import Command
from scenarios.ipc.shared_memory import HEAD_BYTES, SharedMemory

_PROGRESS: Final = struct.Struct("qqq")
"""Layout of the progress: simulated ticks, number of commands, whether the episode is over."""
_PROGRESS_AT: Final = 32
"""Byte of the header at which the progress begins, after the pending call."""
_COMMAND: Final = struct.Struct("qqdd")
"""Layout of a command: tick of its observation, delay in ticks, speed in m/s, yaw rate in rad/s."""
MAX_COMMANDS: Final = 1 << 20
"""Maximum number of commands of an episode, 14.5 hours at 20 Hz. Unused memory takes no space."""
LOG_BYTES: Final = MAX_COMMANDS * _COMMAND.size
"""Size of the memory of a log in bytes."""


class TimedCommand(NamedTuple):
    """A command for the observation of `tick`, which takes effect `delay` ticks later."""

    tick: int
    delay: int
    command: Command


class Driven(NamedTuple):
    """What was driven of an episode.

    ticks: number of simulated ticks.
    over: whether nothing more was simulated.
    commands: bytes of the log.
    """

    ticks: int = 0
    over: bool = False
    commands: bytes = b""


class CommandLog:
    """Writer of the log, in the shared memory of an environment process."""

    def __init__(self, memory: SharedMemory) -> None:
        self._map = memory.map
        self._room = (len(self._map) - HEAD_BYTES) // _COMMAND.size
        self._count = self._ticks = 0

    def begins(self) -> None:
        """Start the log of an episode."""
        self._count = self._ticks = 0
        self._note()

    def commanded(self, command: TimedCommand) -> None:
        """Add a command. The number of commands is written last, so that each is complete."""
        if self._count < self._room:
            at = HEAD_BYTES + self._count * _COMMAND.size
            speeds = command.command.v_mps, command.command.w_radps
            _COMMAND.pack_into(self._map, at, command.tick, command.delay, *speeds)
        self._count += 1
        self._note()

    def simulated(self, ticks: int, *, over: bool) -> None:
        """Note the number of simulated ticks, and whether the episode is over."""
        self._ticks = ticks
        self._note(over=over)

    def ends(self) -> None:
        """Note that nothing more is simulated."""
        self._note(over=True)

    def _note(self, *, over: bool = False) -> None:
        _PROGRESS.pack_into(self._map, _PROGRESS_AT, self._ticks, self._count, over)


def progress_of(memory: SharedMemory) -> tuple[int, bool]:
    """Return the number of simulated ticks, and whether the episode is over."""
    ticks, _, over = _PROGRESS.unpack_from(memory.map, _PROGRESS_AT)
    return ticks, bool(over)


def driven_of(memory: SharedMemory) -> Driven | None:
    """Return what was driven of the episode of a process; None if the log was full or damaged."""
    ticks, count, over = _PROGRESS.unpack_from(memory.map, _PROGRESS_AT)
    end = HEAD_BYTES + count * _COMMAND.size
    if not 0 <= count <= MAX_COMMANDS or end > len(memory.map) or ticks < 0:
        return None
    return Driven(ticks, bool(over), bytes(memory.map[HEAD_BYTES:end]))


def commands_of(log: bytes) -> Iterator[TimedCommand]:
    """Yield the commands of a log."""
    for tick, delay, v_mps, w_radps in _COMMAND.iter_unpack(log):
        yield TimedCommand(tick, delay, Command(v_mps, w_radps))
