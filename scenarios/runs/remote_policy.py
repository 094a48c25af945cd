"""A policy behind Zenoh: found by its name at one or several endpoints, asked in lockstep, one
server for an episode.

What is answered late is waited for, and asked again by the same step, for as long as the run has
patience with a policy: the server answers a step that it has answered before from what it kept. A
server that is gone, frozen or begun anew has lost the episode, which is run again from its start.
Sessions are asked in the environment's process: they hold nothing that others watch, and no handler
runs in it.
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
    MOST_MESSAGE_BYTES,
    POLICY_PROTOCOL,
    UNREADABLE,
    Answer,
    AskReset,
    Begun,
    PackedArray,
    PolicyInfo,
    Refusal,
    decode_answered,
    encode_asked,
    packed,
    policy_key,
)
from bridge.session import Session, open_session
from cosim.core.errors import EngineError, MachineError, PolicyError, PolicyServerLost, UsageError
from cosim.episode.manifest_checks import with_goal
from cosim.episode.policy_caller import Timer
from cosim.policies.load import checked_manifest
from cosim.spec.manifest import Manifest
from cosim.spec.policy_host import PolicyHost, PolicyRuns
from scenarios.ipc.shared_arrays import room_for
from scenarios.runs.hosted_policy import HostedDriver, HostedPolicy, PolicyQuestion

DOMAIN: Final = "default"
_FOUND_WITHIN_S: Final = 60.0
"""So long a server is waited for that has gone, before the run ends; it can be resumed."""
_FIRST_FOUND_WITHIN_S: Final = 10.0
_LOST_AFTER_S: Final = 3.0
"""A server that nobody has heard of for so long is gone: a link that was cut is taken up again
sooner."""
_TRY_S: Final = 5.0
_TOLD_WITHIN_S: Final = 1.0
"""So long it is waited for the word that the end of an episode was heard: it may be busy, or
hang."""
_PAUSE_S: Final = 0.05
_QUALITY: Final = 90
"""Of JPEG."""


class _Server(NamedTuple):
    """hub: who it is reached by; "" where that is not itself."""

    session: Session
    info: PolicyInfo
    hub: str

    @property
    def replaced(self) -> bool:
        """Whether another one listens where it did. A link to one that has gone may be seen a
        moment longer."""
        known, now = ({*hub.split(", ")} - {""} for hub in (self.hub, self.session.hub))
        return bool(known and now) and known.isdisjoint(now)


class PolicyServers:
    """The servers of a policy. source: as the run knows it, None where it does not know it yet."""

    def __init__(self, name: str, host: PolicyHost) -> None:
        self.name = name
        self._host = host
        self._wanted: tuple[dict[str, Any], str] | None = None
        self._sessions: dict[str, Session] = {}
        self._server: _Server | None = None
        self._jpeg = False

    def know(self, within_s: float) -> list[PolicyInfo]:
        """Who answers, as soon as somebody does; from now on only servers of the same policy are
        asked."""
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

    def choose(self) -> None:
        """Take the server with the least to do for the next episode. Raises MachineError when there
        is none."""
        found = self._found(_FOUND_WITHIN_S)
        same = [one for one in found if (one.info.manifest, one.info.source) == self._wanted]
        if not same:
            raise MachineError(
                f"policy '{self.name}' was changed while the run was going on: serve the one that "
                "it began with, and add --resume, or begin another run"
            )
        random.shuffle(same)
        self._server = min(same, key=lambda one: one.info.under_way)

    def lay(self, arrays: dict[str, np.ndarray[Any, Any]]) -> dict[str, PackedArray]:
        return {
            name: _as_jpeg(array)
            if self._jpeg and name.rpartition("/")[2] == "rgb"
            else packed(array)
            for name, array in arrays.items()
        }

    def ask(self, question: PolicyQuestion) -> Begun | Answer | Refusal:
        assert self._server is not None
        session, info, _ = self._server
        kind = str(question.__struct_config__.tag)
        key = f"{policy_key(DOMAIN, self.name, info.server)}/{kind}"
        payload = encode_asked(question)
        unheard_since_s = (
            None  # a question that was under way for long says nothing against the server
        )
        to_end = kind == "ended"
        while True:
            heard = session.ask_once(key, payload, timeout_s=_TOLD_WITHIN_S if to_end else _TRY_S)
            if heard.how in ("answered", "refused"):
                return self._read(heard.payload, question)
            if heard.how == "late" and not to_end:
                unheard_since_s = None
                continue
            now_s = time.monotonic()
            unheard_since_s = now_s if unheard_since_s is None else unheard_since_s
            if to_end or self._server.replaced or now_s - unheard_since_s > _LOST_AFTER_S:
                raise PolicyServerLost(f"the server {info.server} of policy '{self.name}' is gone")
            time.sleep(_PAUSE_S)

    def close(self) -> None:
        for session in self._sessions.values():
            session.close()
        self._sessions.clear()

    def _read(self, payload: bytes, question: PolicyQuestion) -> Begun | Answer | Refusal:
        try:
            reply = decode_answered(payload)
        except UNREADABLE as error:
            raise PolicyError(f"sent what is no answer: {error}") from None
        if isinstance(reply, PolicyInfo):
            raise PolicyError("told who it is when it was asked something else")
        if isinstance(reply, Refusal) and reply.why == "unknown":
            raise PolicyServerLost(f"the server of policy '{self.name}' has lost the episode")
        if isinstance(reply, Refusal) and reply.why == "busy":
            raise _ServerBusy(f"the server of policy '{self.name}' is busy: {reply.words}")
        if isinstance(question, AskReset) and isinstance(reply, Answer):
            raise PolicyError("answered a step when it was told of a beginning")
        return reply  # type: ignore[no-any-return]

    def _found(self, within_s: float) -> list[_Server]:
        """All that answer, as soon as there is one. Raises MachineError."""
        until_s = time.monotonic() + within_s
        key = f"{policy_key(DOMAIN, self.name, '*')}/info"
        while True:
            found = []
            for endpoint in self._host.servers:
                with suppress(EngineError):
                    if endpoint.endpoint not in self._sessions:
                        self._sessions[endpoint.endpoint] = open_session(endpoint)
                    session = self._sessions[endpoint.endpoint]
                    told = session.answers(key, timeout_s=2.0)
                    infos = [_info(payload) for payload in told.values()]
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
            time.sleep(_PAUSE_S)


class _ServerBusy(PolicyServerLost):
    """Another episode was faster."""


class RemoteDriver(HostedDriver):
    """The driver of a policy behind Zenoh."""

    def __init__(
        self,
        policy: HostedPolicy,
        servers: PolicyServers,
        runs: PolicyRuns,
        source_hash: str,
        timer: Timer | None,
    ) -> None:
        super().__init__(policy, runs, source_hash, timer)
        self._servers = servers

    def reset(self, episode_id: str, seed: int) -> None:
        """A server that is free is looked for first, which takes no time of the policy's."""
        until_s = time.monotonic() + _FOUND_WITHIN_S
        while True:
            self._servers.choose()
            try:
                return super().reset(episode_id, seed)
            except _ServerBusy:
                if time.monotonic() > until_s:
                    raise
            time.sleep(_PAUSE_S)


def remote_driver(name: str, host: PolicyHost, timer: Timer | None = None) -> RemoteDriver:
    """A policy as `zenoh:NAME`. Raises UsageError for one that cannot be asked so, MachineError
    when nobody answers."""
    called = name.partition(":")[2]
    if not host.servers:
        raise UsageError(f"policy '{name}' needs --policy-at ENDPOINT: where `cosim serve` listens")
    servers = PolicyServers(called, host)
    try:
        infos = servers.know(_FIRST_FOUND_WITHIN_S)
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
        runs: PolicyRuns = "remote, jpeg" if info.jpeg else "remote"
        driver = RemoteDriver(
            HostedPolicy(manifest, servers, host.run), servers, runs, source, timer
        )
        driver.at_once = (
            0 if any(not one.at_once for one in infos) else sum(one.at_once for one in infos)
        )
        return driver
    except BaseException:
        servers.close()
        raise


def _check(name: str, manifest: Manifest) -> None:
    """Raises UsageError for what cannot be asked over a network."""
    if manifest.privileged:
        raise UsageError(
            f"policy '{name}' is told what the simulator knows (privileged), and a remote "
            f"one sees only observations"
        )
    if (size := room_for(manifest)) > MOST_MESSAGE_BYTES:
        raise UsageError(
            f"policy '{name}' asks for {size / 2**20:.0f} MiB of pictures a step, and a message "
            f"holds {MOST_MESSAGE_BYTES / 2**20:.0f} MiB: ask for smaller or fewer ones"
        )


def _info(payload: bytes) -> PolicyInfo | None:
    with suppress(*UNREADABLE):
        told = msgspec.msgpack.decode(payload, type=PolicyInfo)
        return told if isinstance(told, PolicyInfo) else None
    return None


def _as_jpeg(rgb: np.ndarray[Any, Any]) -> PackedArray:
    _, coded = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return PackedArray(rgb.dtype.str, rgb.shape, memoryview(coded.tobytes()), jpeg=True)
