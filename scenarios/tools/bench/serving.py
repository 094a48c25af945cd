"""Measures the cost of a policy in another process: isolated, over Zenoh, and as a ROS 2 node."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from bridge.policy_server import serve
from bridge.ros2.commands import TWIST_STAMPED, Received
from bridge.ros2.messages import ns_of, stamped_command
from bridge.ros2.node import Network, Ros2Node
from bridge.ros2.types import from_cdr
from bridge.session import open_session
from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.episode.manifest_checks import calibration_of
from cosim.episode.policy_caller import PolicyCaller
from cosim.spec.camera import CameraSpec
from cosim.spec.connection import Connection
from cosim.spec.manifest import Manifest
from cosim.spec.options import PolicyHost
from cosim.spec.robot import COURIER
from cosim.spec.ros2 import CMD_VEL, PUBLISHED_TOPICS, ROS2_SCHEME, Ros2Settings
from scenarios.ipc.observation_codec import ObservationDecoder
from scenarios.runs.isolated_policy import isolated_caller
from scenarios.runs.remote_policy import remote_caller
from scenarios.runs.ros2_policy import ros2_caller
from scenarios.tools.bench.figures import MORE, Figure

_SPEC: Final = CameraSpec(width=512, height=288)
_QUERIES: Final = 500
_TOGETHER: Final = 8
_HERE: Final = "the same policy queried in this process"
_REMOTE: Final = "the remote policy"
_NAME: Final = f"{__name__}:FixedPolicy"


class FixedPolicy:
    """Policy that always returns the same command."""

    manifest = Manifest("fixed", rate_hz=4.0, camera=_SPEC)

    def reset(self, episode_id: str, seed: int) -> None:
        """Do nothing: the policy has no state."""

    def act(self, observation: Observation) -> Command:
        return Command(1.0, 0.0)


class FixedBatchPolicy(FixedPolicy):
    """The same policy for many episodes at once."""

    def act_batch(self, observations: Sequence[Observation]) -> list[Command]:
        return [Command(1.0, 0.0) for _ in observations]


def policy_processes() -> list[Figure]:
    """Time round trips of a 512x288 picture, and answers of one server to eight clients."""
    here = PolicyCaller(FixedPolicy())
    isolated = isolated_caller(
        _NAME, expected=FixedPolicy.manifest, host=PolicyHost(isolated="auto")
    )
    with _served() as host, _ros2_node() as ros2:
        remote = remote_caller("zenoh:fixed", host)
        here_ms, isolated_ms, remote_ms, ros2_ms = _in_turns(here, isolated, remote, ros2)
        remote.close()
        ros2.close()
        a_second = _together(host)
    isolated.close()
    return [
        Figure("isolated policy, 512x288, ms a step", isolated_ms, here_ms, _HERE, 1.0),
        Figure("remote policy on this machine, 512x288, ms a step", remote_ms, here_ms, _HERE, 1.0),
        Figure("ROS 2 node on this machine, 512x288, ms a step", ros2_ms, remote_ms, _REMOTE, 2.0),
        Figure(
            f"remote policy with act_batch, {_TOGETHER} episodes at once, answers per s",
            a_second,
            better=MORE,
        ),
    ]


def _in_turns(*callers: PolicyCaller) -> list[float]:
    """Return the median milliseconds of an answer of each caller."""
    took: list[list[float]] = [[] for _ in callers]
    for caller in callers:
        caller.reset("k1", 1)
    for tick in range(_QUERIES):
        for caller, times in zip(callers, took, strict=True):
            began = time.perf_counter()
            caller.act(_seen(tick))
            times.append(1000.0 * (time.perf_counter() - began))
    return [statistics.median(times) for times in took]


def _together(host: PolicyHost) -> float:
    """Return answers per second of one server with several clients, by the slowest client."""
    code = f"from {__name__} import query_alone; query_alone({host.servers[0].connect!r})"
    clients = [
        subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
        for _ in range(_TOGETHER)
    ]
    rates = [process.communicate()[0] for process in clients]
    return _TOGETHER * min(map(float, rates))


def query_alone(endpoint: str) -> None:
    """Query a served policy for one episode, and print its answers per second."""
    servers = (Connection(role="coordinator", connect=endpoint),)
    caller = remote_caller("zenoh:fixed", PolicyHost(servers=servers, run=str(os.getpid())))
    caller.reset("k1", 1)
    caller.act(_seen(0))
    began = time.perf_counter()
    for tick in range(_QUERIES):
        caller.act(_seen(tick))
    print(_QUERIES / (time.perf_counter() - began))
    caller.ended()
    caller.close()


@contextmanager
def _served() -> Iterator[PolicyHost]:
    """Serve the policy in another process, behind a socket."""
    with tempfile.TemporaryDirectory() as folder:
        endpoint = f"unixsock-stream/{Path(folder)}/hub"
        code = f"from {__name__} import serve_fixed; serve_fixed({endpoint!r})"
        process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL)
        try:
            yield PolicyHost(
                servers=(Connection(role="coordinator", connect=endpoint),), run="bench"
            )
        finally:
            process.kill()
            process.wait()


@contextmanager
def _ros2_node() -> Iterator[PolicyCaller]:
    """Yield the caller of a ROS 2 node in another process, which connects to a hub as in a run."""
    with tempfile.TemporaryDirectory() as folder:
        endpoint = f"unixsock-stream/{Path(folder)}/hub"
        at = Connection(role="coordinator", listen=endpoint, guests=("ros2",))
        code = f"from {__name__} import answer_pictures; answer_pictures({endpoint!r})"
        with open_session(at) as hub:
            process = subprocess.Popen([sys.executable, "-c", code])
            try:
                settings = Ros2Settings(connection=hub.inside)
                yield ros2_caller(ROS2_SCHEME, PolicyHost(ros2=settings))
            finally:
                process.kill()
                process.wait()


def answer_pictures(endpoint: str) -> None:
    """Answer each picture at once with /cmd_vel, until killed."""
    with open_session(Connection(role="coordinator", connect=endpoint)) as session:
        node = Ros2Node(session, Network(), "fixed")
        node.advertise(CMD_VEL, TWIST_STAMPED)
        picture = "/camera/image_raw"

        def answer(got: Received) -> None:
            sent = from_cdr(got.payload, PUBLISHED_TOPICS[picture])
            time_ns = ns_of(sent.header.stamp)
            node.publish(CMD_VEL, stamped_command(Command(1.0, 0.0), time_ns))

        node.subscribe(picture, (PUBLISHED_TOPICS[picture],), answer)
        while True:
            time.sleep(3600.0)


def serve_fixed(endpoint: str) -> None:
    """Serve the policy until killed."""
    serve(FixedBatchPolicy(), listen=endpoint, decoder=ObservationDecoder)


def _seen(tick: int) -> Observation:
    return Observation(tick, tick / 20.0, _RGB, 0.5, 0.0, COURIER, camera=_CALIBRATION)


_RGB: Final[Any] = np.random.default_rng(0).integers(
    0, 255, (_SPEC.height, _SPEC.width, 3), dtype=np.uint8
)
_CALIBRATION: Final = calibration_of(_SPEC, COURIER)
