"""Serve a policy to `cosim run --policy zenoh:NAME --policy-at ENDPOINT`, from any Python >= 3.9,
here or elsewhere.

One file to copy beside a policy; it needs eclipse-zenoh, msgspec and numpy. `serve` asks the policy
in the thread that calls it. A question is signed with run, episode, attempt and step: one that
comes again gets the cached answer.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import platform
import queue
import re
import secrets
import signal
import time
import traceback
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from ipaddress import ip_address
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Optional, Union

import msgspec
import numpy as np

POLICY_PROTOCOL = 1
"""Raised whenever the messages below change their meaning."""
MOST_WORDS = 500
MOST_MESSAGE_BYTES = 16 << 20
_WINDOW_S = 0.002
"""So long a policy with act_batch is not asked for those who wait, while others are about to."""
_MOST_SEATS = 4096
_FORGOTTEN_AFTER_S = 300.0
_TAKEN_OVER_AFTER_S = 30.0
"""A policy object that answers for one episode at a time is free again when it was asked nothing
for so long."""
_MOST_ANSWER_BYTES = (
    2 << 20
)  # of a larger array only the shape is sent, and the simulator refuses it
_ARRAYS = {"|u1", "<f4"}
_QUESTIONS = ("reset", "act", "ended")
_OWN_PACKAGES = {"cosim", "scenarios", "sumo_nets", "physics", "bridge"}


class PackedArray(msgspec.Struct, frozen=True):
    """An array as it travels. data: its bytes, or those of a picture as JPEG; at: where it begins
    in shared memory, -1 where it is in the message."""

    dtype: str
    shape: tuple[int, ...]
    data: memoryview = memoryview(b"")
    at: int = -1
    jpeg: bool = False


class AboutEpisode(msgspec.Struct, frozen=True):
    """What stays as it is for an episode. robot: its size and limits. cameras: K (3 x 3),
    distortion (5) and pose on the robot (4 x 4) of each; "" is the policy's first one."""

    robot: dict[str, Union[str, float]] = {}
    cameras: dict[str, tuple[list[list[float]], list[float], list[list[float]]]] = {}


class _Signed(msgspec.Struct, frozen=True):
    """run, episode, attempt: so that no answer of another run or attempt is taken for one of
    this."""

    run: str
    episode: str
    attempt: str

    @property
    def signature(self) -> tuple[str, str, str]:
        return self.run, self.episode, self.attempt


class AskReset(_Signed, frozen=True, tag="reset"):
    """An episode begins."""

    seed: int


class AskAct(_Signed, frozen=True, tag="act"):
    """An observation. step: the number of this question in the episode, from 0. about: with the
    first one."""

    step: int
    tick: int
    time_s: float
    v_mps: float
    w_radps: float
    reset: bool = False
    goal: Optional[dict[str, Any]] = None
    odometry: Optional[tuple[float, float, Optional[float]]] = None
    arrays: dict[str, PackedArray] = {}
    about: Optional[AboutEpisode] = None


class AskEnded(_Signed, frozen=True, tag="ended"):
    """Nothing more is asked about an episode."""


class PolicyInfo(msgspec.Struct, frozen=True, tag="info"):
    """Who answers here. source: a hash of the policy's source, "" where that is unknown; at_once:
    for so many episodes it can answer at a time, 0 for any number; under_way: there are so many;
    jpeg: pictures as JPEG; listens: itself."""

    server: str
    name: str
    manifest: dict[str, Any]
    source: str = ""
    at_once: int = 0
    under_way: int = 0
    jpeg: bool = False
    listens: bool = False
    python: str = platform.python_version()
    protocol: int = POLICY_PROTOCOL


class Begun(_Signed, frozen=True, tag="begun"):
    """The policy was reset, or has been told that the episode ended."""


class Answer(_Signed, frozen=True, tag="answer"):
    """What the policy answers at a step: two speeds, or waypoints."""

    step: int
    v_mps: float = 0.0
    w_radps: float = 0.0
    waypoints: Optional[PackedArray] = None


class Refusal(msgspec.Struct, frozen=True, tag="refusal"):
    """There is no answer. why: "policy", it raised or answered what is none; "unknown", an episode
    that did not begin here; "busy", with another episode; "message", which cannot be understood."""

    why: str
    words: str


PolicyRequest = Union[AskReset, AskAct, AskEnded]
encode_asked = msgspec.msgpack.Encoder().encode
decode_asked = msgspec.msgpack.Decoder(PolicyRequest).decode
decode_answered = msgspec.msgpack.Decoder(Union[PolicyInfo, Begun, Answer, Refusal]).decode
UNREADABLE = (msgspec.DecodeError, RecursionError, ValueError, TypeError, OverflowError)
"""What reading bytes of anybody may raise."""


def packed(array: Any) -> PackedArray:
    """An array in a message."""
    array = np.ascontiguousarray(array)
    return PackedArray(array.dtype.str, tuple(array.shape), array.reshape(-1).view(np.uint8).data)


class _Seat:
    """An episode under way. told: what the policy is told that it is called; step: the last one
    answered, by reply."""

    def __init__(self, told: str, attempt: str) -> None:
        self.policy: Any = None
        self.told = told
        self.attempt = attempt
        self.about = AboutEpisode()
        self.step = -1
        self.reply = b""
        self.heard_s = time.monotonic()


class PolicyDesk:
    """Answers the questions about a policy, whatever carries them.

    policy: an object; or a class, or a function without arguments, that makes one for each episode
    under way. An object with `act_batch` answers for any number of episodes at once, unless batch
    is False; any other for one at a time. observe: makes what the policy is given. memory: where
    arrays lie that are not in messages.
    """

    def __init__(
        self, policy: Any, *, observe: Any = None, memory: Any = None, batch: bool = True
    ) -> None:
        self._make: Any = policy if isinstance(policy, type) or not hasattr(policy, "act") else None
        self.policy: Any = policy if self._make is None else self._make()
        self._told_which = callable(getattr(self.policy, "act_batch", None))
        self.batches = batch and self._told_which
        self.at_once = int(not self.batches and self._make is None)
        self._idle = [] if self.batches else [self.policy]
        self._seats: dict[tuple[str, str], _Seat] = {}
        self._observe = observe or _plain_observation
        self._memory = memory

    @property
    def under_way(self) -> int:
        """How many episodes have begun and not ended."""
        return len(self._seats)

    def answers(self, payloads: Sequence[bytes]) -> list[bytes]:
        """The reply to each message; those that ask a policy with act_batch are answered
        together."""
        process = os.getpid()
        try:
            asked = [_read(payload) for payload in payloads]
            told = {i: self._begin(one) for i, one in enumerate(asked) if isinstance(one, AskReset)}
            acts = [(self._seat(one), one) for one in asked if isinstance(one, AskAct)]
            fresh = {
                id(seat): (seat, one)
                for seat, one in acts
                if seat is not None and one.step == seat.step + 1
            }
            self._act(list(fresh.values()))
            return [told[i] if i in told else self._reply(one) for i, one in enumerate(asked)]
        finally:
            if os.getpid() != process:
                os._exit(
                    1
                )  # a child that the policy has forked: the episode goes on in its parent alone

    def _seat(self, one: Any) -> _Seat | None:
        seat = self._seats.get((one.run, one.episode))
        return seat if seat is not None and seat.attempt == one.attempt else None

    def _reply(self, one: Any) -> bytes:
        if isinstance(one, Refusal):
            return encode_asked(one)
        seat = self._seat(one)
        if isinstance(one, AskEnded):
            self._end((one.run, one.episode), seat)
            return encode_asked(Begun(*one.signature))
        if seat is None:
            return encode_asked(
                Refusal("unknown", "this episode did not begin here, or was forgotten")
            )
        seat.heard_s = time.monotonic()
        if one.step != seat.step:
            return encode_asked(
                Refusal("message", f"asked for step {one.step} after step {seat.step}")
            )
        return seat.reply

    def _begin(self, one: AskReset) -> bytes:
        key = (one.run, one.episode)
        seat = self._seat(one)
        if seat is not None and seat.step < 0:  # asked again: the answer was lost
            return seat.reply
        self._end(key, self._seats.get(key))
        self._forget(_TAKEN_OVER_AFTER_S if self.at_once else _FORGOTTEN_AFTER_S)
        if self.at_once and not self._idle:
            return encode_asked(
                Refusal("busy", "this policy answers for one episode at a time: serve its class")
            )
        # Two runs of one seed may ask at once: what their episodes are called must differ.
        taken = any(other.told == one.episode for other in self._seats.values())
        self._seats[key] = seat = _Seat(
            f"{one.episode}-{one.run[:4]}" if taken else one.episode, one.attempt
        )
        try:
            seat.policy = (
                self.policy if self.batches else self._idle.pop() if self._idle else self._make()
            )
            seat.policy.reset(seat.told, one.seed)
            seat.reply = encode_asked(Begun(*one.signature))
        except BaseException as error:  # noqa: BLE001  the policy's crash, not the server's
            seat.reply = _crash(error)
        return seat.reply

    def _end(self, key: tuple[str, str], seat: _Seat | None) -> None:
        if seat is None or self._seats.pop(key, None) is None or seat.policy is None:
            return
        if not self.batches:
            self._idle.append(seat.policy)
        try:
            if self._told_which and callable(told := getattr(seat.policy, "ended", None)):
                told(seat.told)
        except BaseException as error:  # noqa: BLE001  changes nothing any more
            _crash(error)

    def _forget(self, after_s: float) -> None:
        """Leave episodes that nobody has asked about for long, and the oldest where there are too
        many."""
        now, seats = time.monotonic(), sorted(self._seats.items(), key=lambda item: item[1].heard_s)
        for number, (key, seat) in enumerate(seats):
            if now - seat.heard_s > after_s or len(seats) - number >= _MOST_SEATS:
                self._end(key, seat)

    def _act(self, asked: list[tuple[_Seat, AskAct]]) -> None:
        """Ask the policy. Each seat gets its reply, or its crash."""
        ready = [
            (seat, one, seen) for seat, one in asked if (seen := self._seen(seat, one)) is not None
        ]
        for group in ([ready] if ready else []) if self.batches else [[one] for one in ready]:
            try:
                seen = tuple(one[2] for one in group)
                found = (
                    self.policy.act_batch(seen)
                    if self.batches
                    else [group[0][0].policy.act(seen[0])]
                )
                if len(found) != len(group):
                    raise ValueError(f"{len(found)} answers to {len(group)} observations")
                answers = [found[i] for i in range(len(group))]
            except BaseException as error:  # noqa: BLE001  the policy's crash, not the server's
                crash = _crash(
                    error, f", asked for {len(group)} episodes together" if len(group) > 1 else ""
                )
                for seat, _, _ in group:
                    seat.reply = crash
                continue
            for (seat, one, _), answer in zip(group, answers):
                seat.reply = _answered(one, answer)

    def _seen(self, seat: _Seat, one: AskAct) -> Any:
        """What the policy is given, once it knows of a reset; None where that cannot be, which is
        the reply."""
        seat.step = one.step
        seat.heard_s = time.monotonic()
        seat.about = one.about or seat.about
        try:
            arrays = {name: _unpacked(array, self._memory) for name, array in one.arrays.items()}
            seen = self._observe(seat.told, seat.about, one, arrays)
        except UNREADABLE as error:
            seat.reply = encode_asked(
                Refusal("message", f"not an observation: {error}"[:MOST_WORDS])
            )
            return None
        try:
            if one.reset and callable(told := getattr(seat.policy, "on_reset", None)):
                told(*([seat.told] if self._told_which else []))
        except BaseException as error:  # noqa: BLE001  the policy's crash, not the server's
            seat.reply = _crash(error)
            return None
        return seen


def _from_jpeg(data: memoryview) -> Any:
    """(H, W, 3) uint8. Only who asks for JPEG needs OpenCV or Pillow. Raises ValueError."""
    try:
        import cv2

        bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        return np.ascontiguousarray(np.asarray(bgr)[..., ::-1])
    except ImportError:
        from io import BytesIO

        from PIL import Image

        return np.array(Image.open(BytesIO(data)).convert("RGB"))


def _read(payload: bytes) -> Any:
    try:
        return decode_asked(payload)
    except UNREADABLE as error:
        return Refusal("message", f"not a question: {error}"[:MOST_WORDS])


def _unpacked(told: PackedArray, memory: memoryview | None) -> Any:
    if told.jpeg:
        return _from_jpeg(told.data).reshape(told.shape)
    if told.dtype not in _ARRAYS or any(side < 0 for side in told.shape):
        raise ValueError(f"an array of {told.dtype} {told.shape}")
    count = int(np.prod(told.shape, dtype=np.int64))
    if told.at < 0:
        return np.frombuffer(told.data, told.dtype).reshape(told.shape).copy()
    if memory is None:
        raise ValueError("no memory is shared")
    return np.frombuffer(memory, told.dtype, count, told.at).reshape(told.shape).copy()


def _answered(one: AskAct, answer: Any) -> bytes:
    try:
        return encode_asked(_answer(one, answer))
    except BaseException as error:  # noqa: BLE001  whatever was answered
        return _crash(error)


def _answer(one: AskAct, answer: Any) -> Union[Answer, Refusal]:
    """What a policy has answered, as it travels."""
    if isinstance(answer, dict) and set(answer) == {"v_mps", "w_radps"}:
        answer = SimpleNamespace(**answer)
    if hasattr(answer, "v_mps") and hasattr(answer, "w_radps"):
        speeds = [answer.v_mps, answer.w_radps]
        if all(
            isinstance(v, (int, float, np.integer, np.floating)) and not isinstance(v, bool)
            for v in speeds
        ):
            v_mps, w_radps = (
                np.inf if isinstance(v, int) and v.bit_length() > 1000 else float(v) for v in speeds
            )
            return Answer(*one.signature, one.step, v_mps, w_radps)
        return Refusal(
            "policy",
            f"answered Command{tuple(speeds)!r}"[:MOST_WORDS] + ": both must be finite numbers",
        )
    array = np.asarray(None)
    with suppress(TypeError, ValueError):  # rows of different lengths
        array = np.asarray(answer)
    if array.ndim == 0 or array.dtype.kind not in "biufc":
        shown = repr(answer)
        shown = shown if len(shown) <= 80 and shown.isprintable() else f"a {type(answer).__name__}"
        return Refusal("policy", f"answered {shown}: neither a Command nor waypoints")
    told = (
        packed(array)
        if array.nbytes <= _MOST_ANSWER_BYTES
        else PackedArray(array.dtype.str, array.shape)
    )
    return Answer(*one.signature, one.step, waypoints=told)


def _crash(error: BaseException, among: str = "") -> bytes:
    """What is said of whatever came out of a policy; the rest is printed. Ctrl-C stays what it
    is."""
    if (
        isinstance(error, KeyboardInterrupt)
        and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN
    ):
        raise error
    traceback.print_exception(type(error), error, error.__traceback__)
    try:
        said = str(error)
    except BaseException:  # noqa: BLE001  even the message of an error can raise
        said = "(its message cannot be read)"
    said = "".join(
        c if c.isprintable() or c == "\n" else "?" for c in said.encode("utf-8", "replace").decode()
    )
    said = said if len(said) <= MOST_WORDS else f"{said[:MOST_WORDS]} ... ({len(said)} characters)"
    told = f"raised {type(error).__name__}{': ' * bool(said)}{said}{_line_of(error)}{among}"
    return encode_asked(Refusal("policy", told))


def _line_of(error: BaseException) -> str:
    """Name the file and line of the user's code that an error came from, as " in mine.py:12"; else
    ""."""
    found = ""
    stdlib = Path(traceback.__file__).parent
    for frame, line in traceback.walk_tb(error.__traceback__):
        file = Path(frame.f_code.co_filename)
        installed = (
            "site-packages" in file.parts or file.name.startswith("<") or stdlib in file.parents
        )
        ours = (
            frame.f_globals.get("__name__", "").partition(".")[0] in _OWN_PACKAGES
            or str(file) == __file__
        )
        if not installed and not ours:
            found = f" in {file.name}:{line}"
    return found


class _Given(SimpleNamespace):
    """A goal, a pose or a picture. For numpy: its pixels, or its numbers without those that are
    None."""

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        held = vars(self)
        pixels = [held[name] for name in ("rgb", "pixels") if name in held]
        if not pixels and "x_m" not in held:
            raise TypeError(f"this is no array: read its {', '.join(held)}")
        return np.array(
            pixels[0] if pixels else [value for value in held.values() if value is not None], dtype
        )


def _plain_observation(
    told: str, about: AboutEpisode, one: AskAct, arrays: dict[str, Any]
) -> SimpleNamespace:
    """What a policy is given where cosim is not installed: by the names that `cosim.Observation`
    has."""
    names = ("matrix", "distortion", "on_robot")
    cameras = {
        name: _Given(**dict(zip(names, map(np.array, held))))
        for name, held in about.cameras.items()
    }
    goal = dict(one.goal or {})
    kind = goal.pop("type", "")
    if "goal" in arrays:
        goal["rgb" if kind == "image" else "pixels"] = arrays["goal"]
    pose = (
        None
        if one.odometry is None
        else _Given(**dict(zip(("x_m", "y_m", "heading_rad"), one.odometry)))
    )
    further = sorted({name.partition("/")[0] for name in arrays if "/" in name})
    picture = {
        name: {kind: arrays.get(f"{name}/{kind}") for kind in ("rgb", "depth", "labels")}
        for name in further
    }
    return SimpleNamespace(
        tick=one.tick,
        time_s=one.time_s,
        v_mps=one.v_mps,
        w_radps=one.w_radps,
        reset=one.reset,
        episode=told,
        robot=SimpleNamespace(**about.robot),
        goal=_Given(**goal) if goal else None,
        odometry=pose,
        privileged=None,
        camera=cameras.get(""),
        rgb=arrays.get("rgb"),
        depth=arrays.get("depth"),
        labels=arrays.get("labels"),
        pictures={name: _Given(**held, camera=cameras.get(name)) for name, held in picture.items()},
    )


def serve(
    policy: Any,
    *,
    name: str = "",
    listen: str = "",
    connect: str = "",
    domain: str = "default",
    jpeg: bool = False,
    tls: str = "",
    insecure: bool = False,
    told: Any = None,
    source: str = "",
    observe: Any = None,
    session: Any = None,
) -> None:
    """Answer for a policy until Ctrl-C.

    policy: an object; or a class, of which there is then one for each episode (`PolicyDesk`). told:
    its manifest, in place of `policy.manifest`: a mapping with the fields of `cosim.Manifest`;
    source: a hash of what it is written in. name: what runs ask for, else the manifest's. listen;
    or connect, to where `cosim serve` listens. tls: a folder with ca.pem, cert.pem and key.pem
    (`cosim certs`). insecure: it may reach beyond this machine without. jpeg: pictures are to come
    as JPEG. session: an open Zenoh session, in place of all that. Raises ValueError.
    """
    desk = PolicyDesk(policy, observe=observe)
    manifest = msgspec.to_builtins(desk.policy.manifest if told is None else told)
    name = name or manifest["name"]
    server = secrets.token_hex(4)
    if not all(re.fullmatch(r"[A-Za-z0-9_-]{1,64}", part) for part in (name, domain)):
        raise ValueError(
            f"'{name}' or '{domain}' cannot stand in a key: use 1 to 64 of A-Z a-z 0-9 _ -"
        )
    below = policy_key(domain, name, server)
    source = source or _source_of(desk.policy)
    asked: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def tell(query: Any) -> None:
        with query:
            info = PolicyInfo(
                server, name, manifest, source, desk.at_once, desk.under_way, jpeg, bool(listen)
            )
            query.reply(f"{below}/info", encode_asked(info))

    opens = nullcontext(session) if session else _opened(listen, connect, tls, insecure)
    with opens as opened, suppress(KeyboardInterrupt):
        declared = [opened.declare_queryable(f"{below}/info", tell, complete=True)]
        declared += [
            opened.declare_queryable(f"{below}/{kind}", asked.put, complete=True)
            for kind in _QUESTIONS
        ]
        print(
            f"policy '{name}' answers at {listen or connect} as server {server}; stop with Ctrl-C",
            flush=True,
        )
        while True:
            _answer_waiting(desk, asked)


def _answer_waiting(desk: PolicyDesk, asked: Any) -> None:
    """Answer what is waiting, at least one question."""
    queries = [asked.get()]
    until_s = time.monotonic() + _WINDOW_S
    with suppress(queue.Empty):
        while True:
            waits = desk.batches and len(queries) < desk.under_way
            queries.append(
                asked.get(timeout=max(until_s - time.monotonic(), 0.0) if waits else 0.0)
            )
    # What asks several servers at once is no question to any: an answer would be lost.
    read = [query.payload is not None and "*" not in str(query.key_expr) for query in queries]
    payloads = [query.payload.to_bytes() if reads else b"" for query, reads in zip(queries, read)]
    for query, reply in zip(queries, desk.answers(payloads)):
        with query:
            if isinstance(decode_answered(reply), Refusal):
                query.reply_err(reply)
            else:
                query.reply(query.key_expr, reply)


def policy_key(domain: str, name: str, server: str) -> str:
    """What the keys of a server begin with; _QUESTIONS of questions, and `info`, stand below."""
    return f"cosim/{domain}/policy/{name}/{server}"


def _source_of(policy: Any) -> str:
    with suppress(OSError, TypeError):
        source = (
            Path(inspect.getfile(type(policy))).read_bytes() + type(policy).__qualname__.encode()
        )
        return hashlib.blake2b(source, digest_size=8).hexdigest()
    return ""


def _opened(listen: str, connect: str, tls: str, insecure: bool) -> Any:
    """A Zenoh session that reaches no further than it says."""
    import zenoh

    found = re.fullmatch(r"(tcp|tls)/(.+):\d{1,5}|unixsock-stream/.+", listen or connect)
    if not found or (listen and connect):
        raise ValueError(
            f"listen or connect, one of both, like tcp/127.0.0.1:7449, not '{listen}' and "
            f"'{connect}'"
        )
    host = (found[2] or "localhost").strip("[]")
    with suppress(ValueError):
        host = "localhost" if ip_address(host).is_loopback else host
    if host != "localhost" and not insecure and not (tls and found[1] == "tls"):
        raise ValueError(
            f"{found[0]} is beyond this machine and unguarded: whoever can reach it may ask "
            f"the policy and read all "
            "that is sent. Use tls/... with tls=FOLDER (`cosim certs` makes it), or say insecure"
        )
    settings: dict[str, Any] = {
        "mode": "router" if listen else "client",
        "connect/timeout_ms": 0 if listen else 10_000,
        "listen/endpoints": [listen] if listen else [],
        "connect/endpoints": [connect] if connect else [],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": 2000,
        "transport/link/tx/queue/size/data": 16,
        "transport/link/rx/max_message_size": MOST_MESSAGE_BYTES,
    }
    if tls:
        ours = {"certificate": str(Path(tls, "cert.pem")), "private_key": str(Path(tls, "key.pem"))}
        guard = {
            f"{end}_{what}": path for end in ("listen", "connect") for what, path in ours.items()
        }
        guard |= {"root_ca_certificate": str(Path(tls, "ca.pem"))}
        settings["transport/link/tls"] = {
            **guard,
            "enable_mtls": True,
            "verify_name_on_connect": True,
        }
    if listen and found[1]:  # runs may ask; nobody else may, and nobody may answer in its place
        may = {"permission": "allow", "key_exprs": ["cosim/*/policy/**"]}
        flows = {"ingress": ["query"], "egress": ["declare_queryable", "reply"]}
        rules = [
            {"id": flow, "flows": [flow], "messages": messages, **may}
            for flow, messages in flows.items()
        ]
        who = (
            {"cert_common_names": ["worker", "coordinator"]} if tls else {"link_protocols": ["tcp"]}
        )
        settings["access_control"] = {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": [{"id": "runs", **who}],
            "policies": [{"rules": ["ingress", "egress"], "subjects": ["runs"]}],
        }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)
