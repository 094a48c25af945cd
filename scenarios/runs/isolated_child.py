"""The process of an isolated policy: loads the policy and answers requests over a socket.

No engine is imported, and nothing of the run is in its memory but observations.
"""

from __future__ import annotations

import os
import signal
from contextlib import suppress
from socket import socket

import msgspec

from bridge.policy_server import PolicyDesk, PolicyInfo, Refusal, encode_message, read_request
from cosim.core.errors import UsageError
from cosim.core.framing import Wire
from cosim.episode.policy_caller import Untimed
from cosim.policies.load import load_policy
from scenarios.ipc.observation_codec import ObservationDecoder
from scenarios.ipc.shared_memory import SharedMemory


def serve_alone(socket_descriptor: int, asked_descriptor: int, memory_descriptor: int) -> None:
    """Answer until the socket closes. The first message is the policy's name; the reply is its
    info.

    asked_descriptor: not used, because the environment's process times the calls itself."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.close(asked_descriptor)
    wire = Wire(socket(fileno=socket_descriptor))
    memory = SharedMemory(memory_descriptor, writes=False)
    os.close(memory_descriptor)
    name = wire.receive().decode()
    try:
        driver = load_policy(name, Untimed())  # the process that started this one has the deadline
    except UsageError as error:
        wire.send(encode_message(Refusal("policy", str(error))))
        return
    desk = PolicyDesk(driver.policy, decoder=ObservationDecoder, batch=False)
    info = PolicyInfo("", name, msgspec.to_builtins(driver.manifest), driver.source_hash)
    wire.send(encode_message(info))
    with suppress(EOFError):
        while True:
            (reply,) = desk.replies([read_request(wire.receive())], [memory.map])
            wire.send(encode_message(reply))
