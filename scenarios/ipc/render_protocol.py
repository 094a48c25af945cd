"""Messages between environment processes and the shared renderer, as MessagePack.

An environment sends one request at a time and waits for the reply. In addition to these it sends
the requests to a policy (`bridge.policy_server`), which are answered as everywhere else.
"""

from __future__ import annotations

import msgspec

from bridge.policy_server import AskAct, AskEnded, AskReset, PackedArray, PolicyReply, Refusal
from cosim.core.state import RobotState, Street
from cosim.spec.scenario import Scenario
from scenarios.ipc.observation_codec import decode_extra, encode_extra


class Enter(msgspec.Struct, frozen=True, tag="enter"):
    """The environment runs this scenario from now on; None: it runs none, which is not replied
    to."""

    scenario: Scenario | None


class Draw(msgspec.Struct, frozen=True, tag="draw"):
    """Draw what the robot sees."""

    robot: RobotState
    street: Street


class Rendered(msgspec.Struct, frozen=True, tag="rendered"):
    """The reply to Enter and Draw.

    number: which renderer of the run this is, from 1. renderer: what draws, as records name it.
    arrays: the picture, in the memory shared with the environment.
    """

    number: int
    renderer: str
    arrays: dict[str, PackedArray] = {}


Request = Enter | Draw | AskReset | AskAct | AskEnded
Reply = Rendered | PolicyReply

_encode = msgspec.msgpack.Encoder(enc_hook=encode_extra).encode
decode_request = msgspec.msgpack.Decoder(Request, dec_hook=decode_extra).decode
decode_rendered = msgspec.msgpack.Decoder(Rendered | Refusal).decode


def encode_exchange(message: Request | Reply) -> bytes:
    """Encode a message for its decoder."""
    return _encode(message)
