"""What environment processes and the shared renderer say to each other, and a run to its renderer;
as MessagePack.

An environment asks for one thing at a time and waits for the reply. Arrays travel as their bytes:
what arrives is equal to the bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.core.state import People, RobotState, Signal, Street, Vehicles, write_protected
from cosim.spec.goal import Goal
from cosim.spec.odometry import Odometry
from cosim.spec.scenario import Scenario
from scenarios.ipc.messages import Hello


class RendererHello(msgspec.Struct, frozen=True, tag=True):
    """A run to its renderer: which policy the pictures are for. number: which renderer of the run
    this is, from 1."""

    hello: Hello
    number: int


class Welcome(msgspec.Struct, frozen=True, tag=True):
    """The renderer to who has connected. number: which of the run it is; renderer: what draws, as
    records name it; size: width, height of the pictures."""

    number: int
    renderer: str
    size: tuple[int, int]


class Enter(msgspec.Struct, frozen=True, tag=True):
    """This scenario is run from now on."""

    scenario: Scenario


class Draw(msgspec.Struct, frozen=True, tag=True):
    """Draw what the robot sees. The picture comes in shared memory
    (`scenarios.ipc.picture_memory`)."""

    robot: RobotState
    street: Street


class Leave(msgspec.Struct, frozen=True, tag=True):
    """It is over. Nothing is replied."""


class Begin(msgspec.Struct, frozen=True, tag=True):
    """Reset the policy for an episode of the scenario that was entered: what it is called, and the
    policy's seed."""

    episode: str
    seed: int


class Knowledge(msgspec.Struct, frozen=True, tag=True):
    """What a privileged policy is told at a moment. free: as WKB, b"" where it is that of the last
    time."""

    robot: RobotState
    route_s_m: float
    people: People
    vehicles: Vehicles
    signals: Mapping[str, Signal]
    crossings: tuple[tuple[str, float, float], ...]
    free: bytes


class Ask(msgspec.Struct, frozen=True, tag=True):
    """Ask the policy. Of the observation what the renderer does not know: it has the picture."""

    tick: int
    v_mps: float
    w_radps: float
    known: Knowledge | None
    reset: bool = False
    goal: Goal | None = None
    odometry: Odometry | None = None


class Fine(msgspec.Struct, frozen=True, tag=True):
    """It is done."""


class Told(msgspec.Struct, frozen=True, tag=True):
    """The policy's command, within the robot's limits; waypoints, index: as in `Planned`, where it
    was one."""

    v_mps: float
    w_radps: float
    waypoints: NDArray[np.float32] | None = None
    index: int = 0


class Refused(msgspec.Struct, frozen=True, tag=True):
    """It cannot be done. by_policy: the policy raised, or its answer is no command."""

    reason: str
    by_policy: bool


Request = Enter | Draw | Leave | Begin | Ask
Reply = Welcome | Fine | Told | Refused


def _in_bytes(value: object) -> object:
    """What MessagePack does not know, in what it does."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, MappingProxyType):
        return dict(value)
    raise NotImplementedError(f"a {type(value).__name__} cannot be sent")


def _array(kind: type, packed: Any) -> Any:
    """A write-protected array."""
    dtype, shape, data = packed
    return write_protected(np.frombuffer(data, dtype).reshape(shape), dtype)


_encode = msgspec.msgpack.Encoder(enc_hook=_in_bytes).encode
decode_request = msgspec.msgpack.Decoder(Request, dec_hook=_array).decode
decode_reply = msgspec.msgpack.Decoder(Reply, dec_hook=_array).decode
decode_renderer_hello = msgspec.msgpack.Decoder(RendererHello).decode


def encode_exchange(message: Request | Reply | RendererHello) -> bytes:
    """The bytes of a message, for its decoder."""
    return _encode(message)
