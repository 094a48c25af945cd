"""Client of a policy behind Zenoh, found by its name at one or several endpoints.

Each episode uses one server. A request is repeated until its reply or the run's timeout; the server
replies to a repeated step from its cache. A server that has ended, hangs or was restarted has lost
the episode, which is run again from its start. Sessions belong to the environment's process, and
have no handlers.
"""

from __future__ import annotations

import hashlib
import random
import time
from contextlib import suppress
from typing import Any, Final, NamedTuple

import cv2
import msgspec
import numpy as np

from bridge.policy_server import (
    LARGEST_MESSAGE_BYTES,
    POLICY_PROTOCOL,
    UNREADABLE,
    ActRequest,
    EndRequest,
    PackedArray,
    PolicyInfo,
    ResetRequest,
    encode_message,
    pack_array,
    policy_key,
)
from bridge.session import Session, open_session
from cosim.core.errors import EngineError, MachineError, PolicyServerLost, UsageError
from cosim.episode.manifest_checks import check_unprivileged, with_goal
from cosim.episode.policy_caller import Timer
from cosim.policies.load import checked_manifest
from cosim.spec.manifest import Manifest
from cosim.spec.options import PolicyHost, PolicyProcess
from scenarios.ipc.deadlines import ServerTimes
from scenarios.ipc.observation_codec import Arrays
from scenarios.ipc.shared_memory import observation_bytes
from scenarios.runs.hosted_policy import HostedCaller, HostedPolicy, PolicyServerBusy

DOMAIN: Final = "default"
"""Domain in the keys of policy servers."""
_QUALITY: Final = 90
"""Quality of JPEG pictures, of 100."""


class _Server(NamedTuple):
    """A policy server. hub: Zenoh ids of its session if it listens itself; else ""."""

    session: Session
    info: PolicyInfo
    hub: str

    @property
    def replaced(self) -> bool:
        """Return whether another server listens at its endpoint. A closed link may be listed a
        little longer."""
        known, now = ({*hub.split(", ")} - {""} for hub in (self.hub, self.session.hub))
        return bool(known and now) and known.isdisjoint(now)


class PolicyServers:
    """Carrier of requests to the servers of a policy; each episode uses one of them."""

    can_lose_episodes = True

    def __init__(self, name: str, host: PolicyHost, times: ServerTimes = ServerTimes()) -> None:  # noqa: B008
        self.name = name
        self.times = times
        self._host = host
        self._wanted: tuple[dict[str, Any], str] | None = None
        self._sessions: dict[str, Session] = {}
        self._server: _Server | None = None
        self._jpeg = False

    def find_policy(self, within_s: float) -> list[PolicyInfo]:
        """Find servers, and use only those of the same policy from now on. Raises UsageError if
        their policies differ, MachineError if there is none in time."""
        infos = [one.info for one in self._found(within_s)]
        first = infos[0]
        for info in infos[1:]:
            if (info.manifest, info.source) != (first.manifest, first.source):
                raise UsageError(
                    f"servers of policy '{self.name}' are of two policies: {first.server}, "
                    f"{info.server}"
                )
        self._wanted = (first.manifest, first.source)
        self._jpeg = first.jpeg
        return infos

    def choose_server(self) -> None:
        """Choose the server with the fewest episodes for the next episode. Raises MachineError if
        there is none."""
        found = self._found(self.times.found_s)
        same = [one for one in found if (one.info.manifest, one.info.source) == self._wanted]
        if not same:
            raise MachineError(
                f"policy '{self.name}' was changed during the run: serve the one that "
                "it began with, and add --resume, or begin another run"
            )
        random.shuffle(same)
        self._server = min(same, key=lambda one: one.info.under_way)

    def pack(self, arrays: Arrays) -> dict[str, PackedArray]:
        return {
            name: _as_jpeg(array)
            if self._jpeg and name.rpartition("/")[2] == "rgb"
            else pack_array(array)
            for name, array in arrays.items()
        }

    def exchange(self, request: ResetRequest | ActRequest) -> bytes:
        unreached_since_s = None
        while True:
            outcome, payload = self._send(request, self.times.try_s)
            if outcome in ("answered", "refused"):
                return payload
            now_s = time.monotonic()
            if outcome == "timeout":
                unreached_since_s = None
                continue
            unreached_since_s = now_s if unreached_since_s is None else unreached_since_s
            assert self._server is not None
            if self._server.replaced or now_s - unreached_since_s > self.times.lost_after_s:
                raise self._lost()
            time.sleep(self.times.pause_s)

    def report_ended(self, request: EndRequest) -> None:
        if self._send(request, self.times.end_s)[0] not in ("answered", "refused"):
            raise self._lost()

    def _send(
        self, request: ResetRequest | ActRequest | EndRequest, timeout_s: float
    ) -> tuple[str, bytes]:
        """Send a request once. Returns the outcome and the reply."""
        assert self._server is not None
        kind = str(request.__struct_config__.tag)
        key = f"{policy_key(DOMAIN, self.name, self._server.info.server)}/{kind}"
        reply = self._server.session.query_once(key, encode_message(request), timeout_s=timeout_s)
        return reply.outcome, reply.payload

    def _lost(self) -> PolicyServerLost:
        assert self._server is not None
        return PolicyServerLost(
            f"the server {self._server.info.server} of policy '{self.name}' is gone"
        )

    def close(self) -> None:
        for session in self._sessions.values():
            session.close()
        self._sessions.clear()

    def _found(self, within_s: float) -> list[_Server]:
        """Return all servers that reply, as soon as there is one. Raises MachineError."""
        until_s = time.monotonic() + within_s
        key = f"{policy_key(DOMAIN, self.name, '*')}/info"
        while True:
            found = []
            for endpoint in self._host.servers:
                with suppress(EngineError):
                    if endpoint.endpoint not in self._sessions:
                        self._sessions[endpoint.endpoint] = open_session(endpoint)
                    session = self._sessions[endpoint.endpoint]
                    replies = session.query_all(key, timeout_s=2.0)
                    infos = [_info(payload) for payload in replies.values()]
                    hub = session.hub
                    found += [
                        _Server(session, info, hub * info.listens)
                        for info in infos
                        if info is not None
                    ]
            if found:
                return sorted(found, key=lambda one: one.info.server)
            if time.monotonic() > until_s:
                where = ", ".join(endpoint.endpoint for endpoint in self._host.servers)
                raise MachineError(
                    f"no server of policy '{self.name}' at {where}, waited for {within_s:g} s: "
                    f"start one with `cosim serve package:Policy --name {self.name} --listen "
                    "ENDPOINT`, and add --resume to a run that had begun"
                )
            time.sleep(self.times.pause_s)


class RemoteCaller(HostedCaller):
    """Caller of a policy behind Zenoh."""

    def __init__(
        self,
        policy: HostedPolicy,
        servers: PolicyServers,
        runs: PolicyProcess,
        source_hash: str,
        timer: Timer | None,
    ) -> None:
        super().__init__(policy, runs, source_hash, timer)
        self._servers = servers

    def reset(self, episode_id: str, seed: int) -> None:
        """Reset the policy on a free server. The search does not count as time of the policy."""
        until_s = time.monotonic() + self._servers.times.found_s
        while True:
            self._servers.choose_server()
            try:
                return super().reset(episode_id, seed)
            except PolicyServerBusy:
                if time.monotonic() > until_s:
                    raise
            time.sleep(self._servers.times.pause_s)


def remote_caller(
    name: str,
    host: PolicyHost,
    timer: Timer | None = None,
    times: ServerTimes = ServerTimes(),  # noqa: B008  a frozen value
) -> RemoteCaller:
    """Connect to the servers of policy `zenoh:NAME`. Raises UsageError if it cannot be queried over
    a network, MachineError if no server replies."""
    called = name.partition(":")[2]
    if not host.servers:
        raise UsageError(f"policy '{name}' needs --policy-at ENDPOINT: where `cosim serve` listens")
    servers = PolicyServers(called, host, times)
    try:
        infos = servers.find_policy(times.first_found_s)
        info = infos[0]
        if info.protocol != POLICY_PROTOCOL:
            raise UsageError(
                f"the server of policy '{called}' speaks version {info.protocol} of the protocol, "
                f"and this is version {POLICY_PROTOCOL}: copy bridge/policy_server.py there again"
            )
        manifest = with_goal(checked_manifest(name, info.manifest), None)
        _check(name, manifest)
        source = (
            info.source[:64]
            or hashlib.blake2b(f"{manifest.name}\0{manifest.version}".encode()).hexdigest()[:16]
        )
        runs: PolicyProcess = "remote, jpeg" if info.jpeg else "remote"
        caller = RemoteCaller(
            HostedPolicy(manifest, servers, host.run), servers, runs, source, timer
        )
        caller.at_once = (
            0 if any(not one.at_once for one in infos) else sum(one.at_once for one in infos)
        )
        return caller
    except BaseException:
        servers.close()
        raise


def _check(name: str, manifest: Manifest) -> None:
    """Check that a policy can be queried over a network. Raises UsageError."""
    check_unprivileged(name, manifest, "a remote one")
    if (size := observation_bytes(manifest)) > LARGEST_MESSAGE_BYTES:
        raise UsageError(
            f"policy '{name}' asks for {size / 2**20:.0f} MiB of pictures a step, and a message "
            f"holds {LARGEST_MESSAGE_BYTES / 2**20:.0f} MiB: ask for smaller or fewer ones"
        )


def _info(payload: bytes) -> PolicyInfo | None:
    """Decode the info of a server; None if it is invalid."""
    with suppress(*UNREADABLE):
        return msgspec.msgpack.decode(payload, type=PolicyInfo)
    return None


def _as_jpeg(rgb: np.ndarray[Any, Any]) -> PackedArray:
    _, coded = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return PackedArray(rgb.dtype.str, rgb.shape, memoryview(coded.tobytes()), jpeg=True)
