"""A running episode on the network: it takes injections, answers for its state, and tells what happens.

Keys, below `cosim/<run>/env/<episode>/`: `inject`, `status`, `log` and `camera` are asked (queryables); `clock`,
`robot`, `crowd`, `signals` and `events` are told every tick (JSON). Who comes late asks for the log.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import msgspec

from bridge.session import Session
from cosim.core.errors import EngineError, SpecError
from cosim.spec.injection import Ack, Injection

LARGEST_B: Final = 64 * 1024
"""Longer injections are refused unread."""
_JSON_BEGINS: Final = b"{[ \t\r\n"

Offer = Callable[[Injection], Ack]


def serve_injections(session: Session, key: str, offer: Offer) -> None:
    """Take injections in as JSON or MessagePack, and answer in the same. Whatever is wrong becomes a refusal."""

    def answer(payload: bytes) -> bytes:
        return _encoded(answer_to(payload, offer), as_json=payload[:1] in _JSON_BEGINS)

    session.serve(key, answer)


def answer_to(payload: bytes, offer: Offer) -> Ack:
    """What becomes of a message."""
    if len(payload) > LARGEST_B:
        return Ack(id="", status="refused", reason=f"{len(payload)} bytes: a message has at most {LARGEST_B}")
    try:
        decode = msgspec.json.decode if payload[:1] in _JSON_BEGINS else msgspec.msgpack.decode
        return offer(decode(payload, type=Injection))
    except (msgspec.DecodeError, RecursionError, ValueError, SpecError) as error:
        unknown = f". Valid choices: {', '.join(Injection.__struct_fields__)}" if "unknown field" in str(error) else ""
        return Ack(id="", status="refused", reason=f"{error}{unknown}")


def _encoded(ack: Ack, *, as_json: bool) -> bytes:
    return msgspec.json.encode(ack) if as_json else msgspec.msgpack.encode(ack)


def send_injection(session: Session, key: str, injection: bytes, timeout_s: float = 5.0) -> Ack:
    """Send an injection (JSON) and wait for its acknowledgement.

    Raises SpecError for one that is too long, EngineError when nobody answers, or something else.
    """
    if len(injection) > LARGEST_B:
        raise SpecError(f"{len(injection)} bytes: an injection has at most {LARGEST_B}")
    try:
        return msgspec.json.decode(session.ask(key, injection, timeout_s=timeout_s), type=Ack)
    except TimeoutError as error:
        raise EngineError(f"{error}: the episode has ended, or is too busy; what it did is in its log") from error
    except msgspec.DecodeError as error:
        raise EngineError(f"'{key}' answered something that is no acknowledgement: {error}") from error
