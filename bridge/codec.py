"""Encode and decode messages of the bridge as MessagePack with type checks."""

from __future__ import annotations

from typing import TypeVar

import msgspec

from cosim.core.errors import EngineError

_T = TypeVar("_T")

_encoder = msgspec.msgpack.Encoder()


def encode(message: msgspec.Struct | tuple[msgspec.Struct, ...]) -> bytes:
    """Encode a message, or a tuple of messages, with field names."""
    return _encoder.encode(message)


def decode(payload: bytes, kind: type[_T]) -> _T:
    """Decode a message of type `kind`. Raises EngineError if invalid."""
    try:
        return msgspec.msgpack.decode(payload, type=kind)
    except (msgspec.DecodeError, RecursionError, ValueError) as error:
        raise EngineError(f"not a {kind.__name__} message: {error}") from error
