"""A graph on trial: loaded and asked in a child process, with limits of time and memory.

A graph may hold a loop without end, or ask for more memory than there is. Neither can be
interrupted, but a process of its own can be ended. What the trial answers has the bits of the same
graph in this process.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final, Self

import msgspec
import numpy as np

from cosim.core.child_process import ForkedChild
from cosim.core.errors import UsageError
from cosim.core.framing import Wire
from cosim.policies.onnx.graph import Graph, Tensor, TensorPort, import_runtime

ROOM_BYTES: Final = 4 << 30
"""So much memory a graph may use for its answers, and TIMES its files."""
_TIMES: Final = 8
_MOST_ANSWER_BYTES: Final = 512 << 20

_Packed = tuple[str, tuple[int, ...], bytes]
_Port = tuple[str, str, tuple[int | None, ...]]


class _Ports(msgspec.Struct, tag=True):
    """A graph was loaded."""

    inputs: list[_Port]
    outputs: list[_Port]


class _Ask(msgspec.Struct):
    """A question to it."""

    tensors: dict[str, _Packed]
    names: list[str]


class _Told(msgspec.Struct, tag=True):
    """The answer."""

    tensors: dict[str, _Packed]


class _Raised(msgspec.Struct, tag=True):
    """What was raised instead. refused: it cannot be loaded."""

    words: str
    refused: bool = False


class TrialGraph:
    """A graph in a child process. Use as a context manager. Raises UsageError as `Graph` does, and
    where loading and all answers take more than `within_s` seconds together, or end the child.
    size: bytes of the graph's files."""

    def __init__(self, path: Path, size: int, within_s: float) -> None:
        import_runtime()
        self.path = path
        self._within_s = within_s
        self._until_s = time.monotonic() + within_s
        self._child = ForkedChild(partial(_serve, path), ROOM_BYTES + _TIMES * size)
        try:
            ports = self._reply()
            assert isinstance(ports, _Ports)
        except BaseException:
            self._child.close()
            raise
        self.inputs: Mapping[str, TensorPort] = {one[0]: _port(one) for one in ports.inputs}
        self.outputs: Mapping[str, TensorPort] = {one[0]: _port(one) for one in ports.outputs}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._child.close()

    def ask(self, tensors: Mapping[str, Tensor], names: Sequence[str]) -> dict[str, Tensor]:
        """The outputs of these names. What the runtime raises is raised as a RuntimeError with its
        words."""
        packed = {name: _packed(array) for name, array in tensors.items()}
        try:
            self._child.wire.send(msgspec.msgpack.encode(_Ask(packed, list(names))))
        except OSError:
            raise self._dead() from None
        told = self._reply()
        assert isinstance(told, _Told)
        return {name: _unpacked(told.tensors[name]) for name in names}

    def _reply(self) -> _Ports | _Told:
        try:
            message = self._child.wire.receive(max(self._until_s - time.monotonic(), 0.0))
        except TimeoutError:
            raise UsageError(
                f"{self.path}: gives no answer within {self._within_s:g} s, to be loaded and "
                f"to answer: it may hold a "
                "loop without end. One that is only slow needs more time: --start-timeout"
            ) from None
        except (EOFError, OSError):
            raise self._dead() from None
        reply = msgspec.msgpack.decode(message, type=_Ports | _Told | _Raised)
        if isinstance(reply, _Raised):
            raise UsageError(reply.words) if reply.refused else RuntimeError(reply.words)
        return reply

    def _dead(self) -> UsageError:
        return UsageError(
            f"{self.path}: ends onnxruntime: the process that ran it {self._child.ended()}; "
            f"export it anew"
        )


def _serve(path: Path, wire: Wire) -> None:
    """In the child: load the graph, then answer until the wire closes."""
    try:
        graph = Graph(path)
    except UsageError as error:
        wire.send(msgspec.msgpack.encode(_Raised(_with_room(str(error)), refused=True)))
        return
    ports = (
        [(one.name, one.dtype.str, one.shape) for one in held.values()]
        for held in (graph.inputs, graph.outputs)
    )
    wire.send(msgspec.msgpack.encode(_Ports(*ports)))
    while True:
        asked = msgspec.msgpack.decode(wire.receive(), type=_Ask)
        try:
            told = graph.ask(
                {name: _unpacked(one) for name, one in asked.tensors.items()}, asked.names
            )
            if (size := sum(array.nbytes for array in told.values())) > _MOST_ANSWER_BYTES:
                raise ValueError(
                    f"the outputs hold {size} bytes; at most {_MOST_ANSWER_BYTES} are taken"
                )
            reply: _Told | _Raised = _Told({name: _packed(array) for name, array in told.items()})
        except Exception as error:  # noqa: BLE001  whatever the runtime raises
            reply = _Raised(_with_room(str(error) or type(error).__name__))
        wire.send(msgspec.msgpack.encode(reply))


def _with_room(words: str) -> str:
    """The words of an error; where memory was lacking, with how much there was."""
    lacks = any(part in words.lower() for part in ("alloc", "memory"))
    return (
        f"{words} (a graph may use {ROOM_BYTES >> 30} GiB and {_TIMES} times its size)"
        if lacks
        else words
    )


def _port(told: _Port) -> TensorPort:
    name, dtype, shape = told
    return TensorPort(name, np.dtype(dtype), shape)


def _packed(array: Tensor) -> _Packed:
    return array.dtype.str, array.shape, array.tobytes()


def _unpacked(told: _Packed) -> Tensor:
    dtype, shape, data = told
    return np.frombuffer(data, dtype).reshape(shape)
