"""Injection of pedestrians into a running episode over the network.

Keys below `cosim/<run>/env/<episode>/`: `inject`, `status`, `log` and `camera` are queryables;
`clock`, `robot`, `crowd`, `signals` and `events` are published every tick (JSON). Late subscribers
query the log.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final, get_args, get_type_hints

import msgspec

from bridge.session import Session
from cosim.core.errors import EngineError, SpecError
from cosim.spec.injection import POINT_FORMS, Ack, InjectionRequest

MAX_MESSAGE_B: Final = 64 * 1024
"""Largest injection in bytes."""
_ACK_TIMEOUT_S: Final = 5.0
"""Timeout of an acknowledgement in seconds."""
_MAX_SHOWN: Final = 60
"""Longest invalid value in an error message in characters."""
_JSON_BEGINS: Final = b"{[ \t\r\n"
"""First bytes of a JSON message."""
_PLACE: Final = re.compile(r"at `\$([^`]*)`")
"""Path of the invalid value in an error of msgspec."""
_STEP: Final = re.compile(r"\.(\w+)|\[(\d+)\]")
"""Field or index in such a path."""
_OF_PATH: Final = re.compile(r"path\b|`(ahead|left)`")
"""Errors about the path of an injection."""

Offer = Callable[[InjectionRequest], Ack]


def serve_injections(session: Session, key: str, offer: Offer) -> None:
    """Answer injections, in JSON or MessagePack like the request. Errors become refusals."""

    def answer(payload: bytes) -> bytes:
        return _encoded(answer_injection(payload, offer), as_json=payload[:1] in _JSON_BEGINS)

    session.serve(key, answer)


def answer_injection(payload: bytes, offer: Offer) -> Ack:
    """Return the acknowledgement of a message."""
    if len(payload) > MAX_MESSAGE_B:
        return Ack(
            id="",
            status="refused",
            reason=f"{len(payload)} bytes: a message has at most {MAX_MESSAGE_B}",
        )
    try:
        return offer(_decoder(payload)(payload, type=InjectionRequest))
    except (msgspec.DecodeError, RecursionError, ValueError, SpecError) as error:
        fault = str(error)
        return Ack(
            id="", status="refused", reason=f"{fault}{_found(payload, fault)}{_choices(fault)}"
        )


def _found(payload: bytes, error: str) -> str:
    """Return the value at the path of an error; "" if unknown or already shown."""
    place = _PLACE.search(error)
    if place is None or not error.startswith("Expected") or ", got " in error:
        return ""
    with suppress(msgspec.DecodeError, RecursionError, LookupError, TypeError, ValueError):
        value = _decoder(payload)(payload)
        for field, index in _STEP.findall(place[1]):
            value = value[field] if field else value[int(index)]
        return f", found {repr(value)[:_MAX_SHOWN]}"
    return ""


def _choices(error: str) -> str:
    """Return the valid choices for the field of an error; "" if there are none."""
    if "unknown field" in error and "$.path" not in error:
        valid: tuple[str, ...] = InjectionRequest.__struct_fields__
    elif error.startswith("Invalid enum") and (place := _PLACE.search(error)) is not None:
        valid = get_args(get_type_hints(InjectionRequest).get(place[1].removeprefix("."), None))
    else:
        valid = ()
    words = f". Valid choices: {', '.join(valid)}" if valid else ""
    return words + (f"; {POINT_FORMS}" if _OF_PATH.search(error) else "")


def _decoder(payload: bytes) -> Callable[..., Any]:
    return msgspec.json.decode if payload[:1] in _JSON_BEGINS else msgspec.msgpack.decode


def _encoded(ack: Ack, *, as_json: bool) -> bytes:
    return msgspec.json.encode(ack) if as_json else msgspec.msgpack.encode(ack)


def send_injection(session: Session, key: str, injection: bytes) -> Ack:
    """Send an injection (JSON) and wait for its acknowledgement.

    Raises SpecError if it is too long, EngineError on timeout or an invalid reply.
    """
    if len(injection) > MAX_MESSAGE_B:
        raise SpecError(f"{len(injection)} bytes: an injection has at most {MAX_MESSAGE_B}")
    try:
        return msgspec.json.decode(
            session.query(key, injection, timeout_s=_ACK_TIMEOUT_S), type=Ack
        )
    except TimeoutError as error:
        raise EngineError(
            f"{error}: the episode has ended, or is too busy; what it did is in its log"
        ) from error
    except msgspec.DecodeError as error:
        raise EngineError(
            f"'{key}' answered something that is no acknowledgement: {error}"
        ) from error
