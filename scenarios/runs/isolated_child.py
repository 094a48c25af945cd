"""The process of an isolated policy: it loads it, is asked over a socket, and has nothing of the
street.

No engine is imported, and nothing of the run is in its memory but observations.
"""

from __future__ import annotations

import mmap
import os
import signal
from contextlib import suppress
from socket import socket

import msgspec

from bridge.policy_server import PolicyDesk, PolicyInfo, Refusal, encode_asked
from cosim.core.errors import UsageError
from cosim.core.framing import Wire
from cosim.episode.policy_caller import Untimed
from cosim.policies.load import load_policy
from scenarios.runs.observation_codec import seen_from_afar


def serve_alone(socket_descriptor: int, asked_descriptor: int, memory_descriptor: int) -> None:
    """Answer until the socket closes. The first message is the policy's name; who it is, or why
    not, is the reply.

    asked_descriptor: is not used, because the environment's process says itself what it waits
    for."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.close(asked_descriptor)
    wire = Wire(socket(fileno=socket_descriptor))
    memory = mmap.mmap(memory_descriptor, os.fstat(memory_descriptor).st_size, prot=mmap.PROT_READ)
    os.close(memory_descriptor)
    name = wire.receive().decode()
    try:
        driver = load_policy(name, Untimed())  # who started this process ends what takes too long
    except UsageError as error:
        wire.send(encode_asked(Refusal("policy", str(error))))
        return
    desk = PolicyDesk(driver.policy, observe=seen_from_afar, memory=memoryview(memory), batch=False)
    wire.send(
        encode_asked(PolicyInfo("", name, msgspec.to_builtins(driver.manifest), driver.source_hash))
    )
    with suppress(EOFError):
        while True:
            wire.send(*desk.answers([wire.receive()]))
