"""Messages between environment processes and the shared renderer, as MessagePack.

An environment sends one request at a time and waits for the reply. The requests to a policy are
those of `bridge.policy_server`.
"""

from __future__ import annotations

import msgspec

from bridge.policy_server import (
    ActRequest,
    EndRequest,
    PackedArray,
    PolicyReply,
    Refusal,
    ResetRequest,
)
from cosim.core.state import RobotState, Street
from cosim.spec.scenario import Scenario
from scenarios.ipc.observation_codec import decode_extra, encode_extra


class Enter(msgspec.Struct, frozen=True, tag="enter"):
    """Reports the scenario of an environment; None, without a reply, if it runs none."""

    scenario: Scenario | None


class Draw(msgspec.Struct, frozen=True, tag="draw"):
    """Requests the picture of the robot's camera."""

    robot: RobotState
    street: Street


class Rendered(msgspec.Struct, frozen=True, tag="rendered"):
    """Replies to Enter and Draw.

    number: number of the renderer in the run, from 1.
    renderer: its name in records.
    arrays: the picture, in the memory shared with the environment.
    """

    number: int
    renderer: str
    arrays: dict[str, PackedArray] = {}


Request = Enter | Draw | ResetRequest | ActRequest | EndRequest
Reply = Rendered | PolicyReply

_encode = msgspec.msgpack.Encoder(enc_hook=encode_extra).encode
decode_request = msgspec.msgpack.Decoder(Request, dec_hook=decode_extra).decode
decode_rendered = msgspec.msgpack.Decoder(Rendered | Refusal).decode


def encode_exchange(message: Request | Reply) -> bytes:
    """Encode a message for its decoder."""
    return _encode(message)
