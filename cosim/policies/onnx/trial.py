"""Run a graph in a child process with limits of time and memory.

A graph may loop for ever or allocate too much memory. Neither can be interrupted, but a child
process can be killed. The outputs are bit-identical to those in this process.
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
from cosim.core.framing import MessageSocket
from cosim.policies.onnx.graph import Graph, Tensor, TensorPort, import_runtime

ROOM_BYTES: Final = 4 << 30
"""Memory in bytes that a graph may use in addition to _TIMES the size of its files."""
_TIMES: Final = 8
"""Memory that a graph may use, as a multiple of the size of its files."""
_MAX_ANSWER_BYTES: Final = 512 << 20
"""Largest size of all outputs in bytes."""

_Packed = tuple[str, tuple[int, ...], bytes]
_Port = tuple[str, str, tuple[int | None, ...]]


class _Ports(msgspec.Struct, tag=True):
    """Reply: the graph was loaded."""

    inputs: list[_Port]
    outputs: list[_Port]


class _Request(msgspec.Struct):
    """Request to run the graph."""

    tensors: dict[str, _Packed]
    names: list[str]


class _Outputs(msgspec.Struct, tag=True):
    """Reply: the outputs."""

    tensors: dict[str, _Packed]


class _Raised(msgspec.Struct, tag=True):
    """Reply: an error.

    refused: The graph cannot be loaded.
    """

    words: str
    refused: bool = False


class TrialGraph:
    """Graph in a child process. Use as a context manager.

    Raises UsageError as `Graph` does, if all calls together exceed `within_s` seconds, or the child
    ends.

    size: Size of the bundle's files in bytes.
    within_s: Timeout in seconds.
    """

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

    def run(self, tensors: Mapping[str, Tensor], names: Sequence[str]) -> dict[str, Tensor]:
        """Run the graph and return the named outputs.

        Raises RuntimeError with the runtime's message.
        """
        packed = {name: _packed(array) for name, array in tensors.items()}
        try:
            self._child.wire.send(msgspec.msgpack.encode(_Request(packed, list(names))))
        except OSError:
            raise self._dead() from None
        reply = self._reply()
        assert isinstance(reply, _Outputs)
        return {name: _unpacked(reply.tensors[name]) for name in names}

    def _reply(self) -> _Ports | _Outputs:
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
        reply = msgspec.msgpack.decode(message, type=_Ports | _Outputs | _Raised)
        if isinstance(reply, _Raised):
            raise UsageError(reply.words) if reply.refused else RuntimeError(reply.words)
        return reply

    def _dead(self) -> UsageError:
        return UsageError(
            f"{self.path}: ends onnxruntime: the process that ran it {self._child.ended()}; "
            f"export it again"
        )


def _serve(path: Path, wire: MessageSocket) -> None:
    """Load the graph and answer requests until the wire closes, in the child."""
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
        request = msgspec.msgpack.decode(wire.receive(), type=_Request)
        try:
            outputs = graph.run(
                {name: _unpacked(one) for name, one in request.tensors.items()}, request.names
            )
            if (size := sum(array.nbytes for array in outputs.values())) > _MAX_ANSWER_BYTES:
                raise ValueError(
                    f"the outputs hold {size} bytes; at most {_MAX_ANSWER_BYTES} are taken"
                )
            reply: _Outputs | _Raised = _Outputs(
                {name: _packed(array) for name, array in outputs.items()}
            )
        except Exception as error:  # noqa: BLE001  whatever the runtime raises
            reply = _Raised(_with_room(str(error) or type(error).__name__))
        wire.send(msgspec.msgpack.encode(reply))


def _with_room(words: str) -> str:
    """Return an error's message, with the memory limit if memory was exhausted."""
    lacks = any(part in words.lower() for part in ("alloc", "memory"))
    return (
        f"{words} (a graph may use {ROOM_BYTES >> 30} GiB and {_TIMES} times its size)"
        if lacks
        else words
    )


def _port(port: _Port) -> TensorPort:
    name, dtype, shape = port
    return TensorPort(name, np.dtype(dtype), shape)


def _packed(array: Tensor) -> _Packed:
    return array.dtype.str, array.shape, array.tobytes()


def _unpacked(packed: _Packed) -> Tensor:
    dtype, shape, data = packed
    return np.frombuffer(data, dtype).reshape(shape)
