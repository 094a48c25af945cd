"""MessagePack for the messages of the bridge: typed, refused when malformed, never a pickle.
Pure."""

from __future__ import annotations

from typing import TypeVar

import msgspec

from cosim.core.errors import EngineError

_T = TypeVar("_T")

_encoder = msgspec.msgpack.Encoder()


def encode(message: msgspec.Struct | tuple[msgspec.Struct, ...]) -> bytes:
    """A message, or several, as MessagePack, fields by name."""
    return _encoder.encode(message)


def decode(payload: bytes, kind: type[_T]) -> _T:
    """The message of type `kind` in `payload`. Raises EngineError when it is anything else."""
    try:
        return msgspec.msgpack.decode(payload, type=kind)
    except (msgspec.DecodeError, RecursionError, ValueError) as error:
        raise EngineError(f"not a {kind.__name__} message: {error}") from error
