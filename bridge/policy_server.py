"""Serve a policy to `cosim run --policy zenoh:NAME --policy-at ENDPOINT`, from any Python >= 3.9.

Copy this file next to a policy; it needs eclipse-zenoh, msgspec and numpy. cosim imports it, too.
A request carries run, episode, attempt and step: a repeated one gets the cached reply.
"""

from __future__ import annotations

import hashlib
import inspect
import io
import json
import os
import platform
import queue
import re
import secrets
import signal
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from ipaddress import ip_address
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, Optional, Union

import msgspec
import numpy as np

POLICY_PROTOCOL = 2
"""Version of the messages below, increased when their meaning changes."""
LONGEST_MESSAGE = 500
"""Longest quoted error message in characters."""
LARGEST_MESSAGE_BYTES = 16 << 20
"""Largest message over Zenoh in bytes."""
_WINDOW_S = 0.002
"""Seconds that a policy with act_batch waits for further requests before it answers a batch."""
_MAX_SLOTS = 4096
"""Largest number of open episodes of a server; beyond it the longest idle one is dropped."""
CLOSE_AFTER_S = 300.0
"""Seconds without a request after which a server drops an episode."""
_TAKEN_OVER_AFTER_S = 30.0
"""Seconds without a request after which a policy object for one episode at a time is free again."""
_MAX_ANSWER_BYTES = 2 << 20
"""Largest answer in bytes; of a larger array, which is invalid, only the shape is sent."""
_OWN_PACKAGES = {"cosim", "scenarios", "sumo_nets", "physics", "bridge"}
_PICTURE = ("rgb", "depth", "labels")
_NUMBERS = ("tick", "time_s", "v_mps", "w_radps", "reset")


class PackedArray(msgspec.Struct, frozen=True):
    """Serialized array. data: its bytes or JPEG; at: offset in shared memory, -1 if in data."""

    dtype: str
    shape: tuple[int, ...]
    data: memoryview = memoryview(b"")
    at: int = -1
    jpeg: bool = False


class EpisodeConstants(msgspec.Struct, frozen=True):
    """Constants of an episode. cameras: K, distortion, place on the robot. lidar: its `scan`."""

    robot: dict[str, Union[str, float]] = {}
    cameras: dict[str, tuple[list[list[float]], list[float], list[list[float]]]] = {}
    knowledge: bytes = b""
    lidar: dict[str, Any] = {}


class _EpisodeMessage(msgspec.Struct, frozen=True):
    """Message with run, episode and attempt, to reject replies to other runs or attempts."""

    run: str
    episode: str
    attempt: str

    @property
    def signature(self) -> tuple[str, str, str]:
        return self.run, self.episode, self.attempt


class ResetRequest(_EpisodeMessage, frozen=True, tag="reset"):
    """Request: an episode begins."""

    seed: int


class ActRequest(_EpisodeMessage, frozen=True, tag="act"):
    """Request: an observation.

    step: Number of this request, from 0.
    arrays: By names like "rgb", "goal.rgb", "left/rgb" of a further camera, "scan", "people.ids".
    about: Only in the first request. knowledge: For a privileged policy in the shared renderer.
    """

    step: int
    tick: int
    time_s: float
    v_mps: float
    w_radps: float
    reset: bool = False
    goal: Optional[dict[str, Any]] = None
    odometry: Optional[tuple[float, float, Optional[float]]] = None
    imu: Optional[tuple[float, float, float, float, float, float]] = None
    arrays: dict[str, PackedArray] = {}
    about: Optional[EpisodeConstants] = None
    knowledge: bytes = b""


class EndRequest(_EpisodeMessage, frozen=True, tag="ended"):
    """Request: the episode ended."""


class PolicyInfo(msgspec.Struct, frozen=True, tag="info"):
    """Description of a server. at_once: largest number of episodes at a time, 0 for any."""

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


class EpisodeReply(_EpisodeMessage, frozen=True, tag="begun"):
    """Reply: the policy was reset, or the episode was closed."""


class ActReply(_EpisodeMessage, frozen=True, tag="answer"):
    """Reply: a command, waypoints, or with `planned` both."""

    step: int
    v_mps: float = 0.0
    w_radps: float = 0.0
    waypoints: Optional[PackedArray] = None
    planned: bool = False


class Refusal(msgspec.Struct, frozen=True, tag="refusal"):
    """Reply: an error.

    why: "policy", its fault; "unknown", the episode did not begin here; "busy" with another
        episode; "message", decoding failed; "renderer", the shared renderer failed.
    """

    why: str
    words: str
    during: str = ""
    together: int = 1


PolicyRequest = Union[ResetRequest, ActRequest, EndRequest]
PolicyReply = Union[EpisodeReply, ActReply, Refusal]
encode_message = msgspec.msgpack.Encoder().encode
decode_request = msgspec.msgpack.Decoder(PolicyRequest).decode
decode_reply = msgspec.msgpack.Decoder(PolicyReply).decode
decode_info = msgspec.msgpack.Decoder(Union[PolicyInfo, Refusal]).decode
UNREADABLE = (msgspec.DecodeError, RecursionError, ValueError, TypeError, OverflowError)
"""Exceptions that decoding may raise."""


def pack_array(array: Any) -> PackedArray:
    """Serialize an array."""
    array = np.ascontiguousarray(array)
    return PackedArray(array.dtype.str, tuple(array.shape), array.reshape(-1).view(np.uint8).data)


class PolicyFault(Exception):
    """Error of a policy, with the name of the call ("" for the requested one) and its episodes."""

    def __init__(self, words: str, during: str = "", together: int = 1) -> None:
        words = words.encode("utf-8", "replace").decode()
        words = "".join(c if c.isprintable() or c == "\n" else "?" for c in words)
        super().__init__(words)
        self.words = words[: 2 * LONGEST_MESSAGE]
        self.during = during
        self.together = together


def error_text(error: BaseException) -> str:
    """Return the message of an error as printable text of bounded length."""
    try:
        text = str(PolicyFault(str(error)).args[0])
    except BaseException:  # noqa: BLE001  even the message of an error can raise
        return "(its message cannot be read)"
    end = "" if len(text) <= LONGEST_MESSAGE else f" ... ({len(text)} characters)"
    return text[:LONGEST_MESSAGE] + end


@contextmanager
def policy_call(
    doing: str, tick: int = 0, timer: Any = None, passes: tuple[type[BaseException], ...] = ()
) -> Iterator[None]:
    """Guard a call of a policy: convert exceptions to PolicyFault, except Ctrl-C.

    timer: Its `starts(doing, tick)` and `stops()` are called.
    passes: Exceptions that are not the policy's, or already have a message.
    """
    process = os.getpid()
    if timer is not None:
        timer.starts(doing, tick)
    try:
        yield
    except BaseException as error:
        # Where Ctrl-C is ignored only the policy can have raised KeyboardInterrupt.
        ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        if isinstance(error, (PolicyFault, *passes, *([] if ignored else [KeyboardInterrupt]))):
            raise
        said = error_text(error)
        words = f"raised {type(error).__name__}{': ' * bool(said)}{said}{_line_of(error)}"
        raise PolicyFault(words) from error
    finally:
        if os.getpid() != process:  # a copy that the policy forked
            os._exit(1)
        if timer is not None:
            timer.stops()


def _line_of(error: BaseException) -> str:
    """Return " in mine.py:12" for the user's line that raised an error; else ""."""
    found = ""
    stdlib = Path(traceback.__file__).parent
    for frame, line in traceback.walk_tb(error.__traceback__):
        file = Path(frame.f_code.co_filename)
        package = frame.f_globals.get("__name__", "").partition(".")[0]
        installed = "site-packages" in file.parts or stdlib in file.parents
        ours = package in _OWN_PACKAGES or str(file) == __file__
        if not (installed or ours or file.name.startswith("<")):
            found = f" in {file.name}:{line}"
    return found


class _PlainFields(SimpleNamespace):
    """Goal, pose, picture or sensor. As a numpy array: its main array, else its numbers."""

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        fields = {name: value for name, value in vars(self).items() if value is not None}
        values = [v for one in fields.values() for v in (one if isinstance(one, tuple) else [one])]
        if all(isinstance(value, (int, float)) for value in values):
            return np.array(values, dtype)
        array = values[0] if len(values) == 1 else fields.get("rgb", fields.get("ranges_m"))
        array = np.hstack(values[1:]) if "ids" in fields else array
        if not isinstance(array, np.ndarray):
            raise TypeError(f"this is no array: read its {', '.join(fields)}")
        return np.array(array, dtype)


class EpisodeDecoder:
    """Decodes observations of one episode to plain objects with the names of `cosim.Observation`.

    For other types, override `makes`, the constructor of each part, and `privileged`.
    """

    makes: ClassVar[dict[str, Any]] = {
        **dict.fromkeys(("camera", "picture", "odometry", "scan", "imu", "people"), _PlainFields),
        **dict.fromkeys(("robot", "lidar", "observation"), SimpleNamespace),
        "goal": lambda type, **fields: _PlainFields(**fields),
    }

    def __init__(self, episode: str, about: EpisodeConstants) -> None:
        self.episode = episode
        self.about = about
        self.robot = self.makes["robot"](**about.robot)
        self.cameras = {}
        for name, camera in about.cameras.items():
            parts = zip(("matrix", "distortion", "on_robot"), map(np.array, camera))
            self.cameras[name] = self.makes["camera"](**dict(parts))

    def decoded(self, request: ActRequest, arrays: dict[str, Any]) -> Any:
        """Return the observation in a request with these arrays."""
        makes = self.makes
        pictures = {}
        for name in [name for name in self.cameras if name]:
            parts = {kind: arrays.get(f"{name}/{kind}") for kind in _PICTURE}
            pictures[name] = makes["picture"](camera=self.cameras[name], **parts)
        goal = {name[5:]: value for name, value in arrays.items() if name.startswith("goal.")}
        tracks = {k: arrays.get(f"people.{k}") for k in ("ids", "positions_m", "velocities_mps")}
        lidar = makes["lidar"](**self.about.lidar) if "scan" in arrays else None
        pose = dict(zip(("x_m", "y_m", "heading_rad"), request.odometry or ()))
        imu = request.imu
        return makes["observation"](
            **{kind: arrays.get(kind) for kind in _PICTURE},
            **{name: getattr(request, name) for name in _NUMBERS},
            robot=self.robot,
            privileged=self.privileged(request.knowledge) if request.knowledge else None,
            episode=self.episode,
            goal=makes["goal"](**request.goal, **goal) if request.goal else None,
            odometry=makes["odometry"](**pose) if pose else None,
            camera=self.cameras.get(""),
            pictures=pictures,
            scan=makes["scan"](ranges_m=arrays["scan"], spec=lidar) if lidar else None,
            imu=makes["imu"](gyro_radps=imu[:3], accel_mps2=imu[3:]) if imu else None,
            people=None if tracks["ids"] is None else makes["people"](**tracks),
        )

    def privileged(self, knowledge: bytes) -> Any:
        """Decode the knowledge of a privileged policy; None here."""
        return None


class _Slot:
    """Open episode with its last step and reply, by the name that the policy knows."""

    def __init__(self, episode_name: str, attempt: str) -> None:
        self.policy: Any = None
        self.episode_name = episode_name
        self.attempt = attempt
        self.decoder: Any = None
        self.step = -1
        self.reply: PolicyReply = Refusal("message", "the episode did not begin")
        self.answered = False
        self.used_at_s = time.monotonic()


class PolicyDesk:
    """Queries a policy for any number of episodes, independent of the transport.

    policy: An object, or a class or function that makes one for each open episode.
    batch: Use `act_batch`, if the object has it, for any number of episodes at once.
    forget_after_s: Seconds after which idle episodes are closed.
    """

    def __init__(
        self,
        policy: Any,
        *,
        decoder: Any = EpisodeDecoder,
        timer: Any = None,
        batch: bool = True,
        forget_after_s: float = CLOSE_AFTER_S,
    ) -> None:
        self._make: Any = policy if isinstance(policy, type) or not hasattr(policy, "act") else None
        self.policy: Any = policy if self._make is None else self._make()
        self._for_many = callable(getattr(self.policy, "act_batch", None))
        self.batches = batch and self._for_many
        self.at_once = int(not self.batches and self._make is None)
        self._idle = [] if self.batches else [self.policy]
        self._slots: dict[tuple[str, str], _Slot] = {}
        self._decoder = decoder
        self._timer = timer
        most_s = _TAKEN_OVER_AFTER_S if self.at_once else forget_after_s
        self._forget_after_s = min(forget_after_s, most_s)

    @property
    def under_way(self) -> int:
        """Number of open episodes."""
        return len(self._slots)

    def wait_s(self, waiting: int, expected: int, since_s: float) -> float:
        """Return how long to wait for further requests of a batch; its first arrived at since_s."""
        if not self.batches or waiting >= expected:
            return 0.0
        return max(since_s + _WINDOW_S - time.monotonic(), 0.0)

    def replies(
        self, requests: Sequence[Union[PolicyRequest, Refusal]], memories: Sequence[Any] = ()
    ) -> list[PolicyReply]:
        """Return the reply to each request. A Refusal is a request that could not be decoded.

        memories: Shared memory with the arrays of each request that are not in the message.
        """
        resets = [(i, one) for i, one in enumerate(requests) if isinstance(one, ResetRequest)]
        began = {i: self._begin(one) for i, one in resets}
        new = {}
        for one, memory in zip(requests, memories or [None] * len(requests)):
            slot = self._slot(one) if isinstance(one, ActRequest) else None
            if slot is not None and isinstance(one, ActRequest) and one.step == slot.step + 1:
                new[id(slot)] = slot, one, memory
        self._act(list(new.values()))
        return [began[i] if i in began else self._reply(one) for i, one in enumerate(requests)]

    def _slot(self, request: Any) -> _Slot | None:
        slot = self._slots.get((request.run, request.episode))
        return slot if slot is not None and slot.attempt == request.attempt else None

    def _reply(self, request: Any) -> PolicyReply:
        if isinstance(request, Refusal):
            return request
        slot = self._slot(request)
        if isinstance(request, EndRequest):
            self._end((request.run, request.episode), slot)
            return EpisodeReply(*request.signature)
        if slot is None:
            return Refusal("unknown", "this episode did not begin here, or was dropped")
        slot.used_at_s = time.monotonic()
        if request.step != slot.step:
            return Refusal("message", f"step {request.step} was requested after step {slot.step}")
        return slot.reply

    def _begin(self, request: ResetRequest) -> PolicyReply:
        key = request.run, request.episode
        slot = self._slot(request)
        if slot is not None and slot.step < 0:  # a repeated request: the reply was lost
            return slot.reply
        self._end(key, self._slots.get(key))
        self._forget()
        if self.at_once and not self._idle:
            return Refusal("busy", "this policy answers for one episode at a time: serve its class")
        # Two runs of one seed may begin at once: the names of their episodes must differ.
        taken = any(other.episode_name == request.episode for other in self._slots.values())
        episode_name = f"{request.episode}-{request.run[:4]}" if taken else request.episode
        self._slots[key] = slot = _Slot(episode_name, request.attempt)
        with self._call([slot], "reset"):
            slot.policy = self.policy if self.batches else (self._idle or [self._make()]).pop()
            slot.policy.reset(slot.episode_name, request.seed)
            slot.reply = EpisodeReply(*request.signature)
        return slot.reply

    def _end(self, key: tuple[str, str], slot: _Slot | None) -> None:
        if slot is None or self._slots.pop(key, None) is None or slot.policy is None:
            return
        if not self.batches:
            self._idle.append(slot.policy)
        if self._for_many and callable(ended := getattr(slot.policy, "ended", None)):
            with self._call([slot], "ended"):
                ended(slot.episode_name)

    def _forget(self) -> None:
        """Close idle episodes, and the longest idle one if there are too many."""
        now = time.monotonic()
        slots = sorted(self._slots.items(), key=lambda item: item[1].used_at_s)
        for number, (key, slot) in enumerate(slots):
            if now - slot.used_at_s > self._forget_after_s or len(slots) - number >= _MAX_SLOTS:
                self._end(key, slot)

    def _act(self, requests: list[tuple[_Slot, ActRequest, Any]]) -> None:
        """Query the policy and set the reply of each slot."""
        seen = [(slot, one, self._observation(slot, one, memory)) for slot, one, memory in requests]
        ready = [one for one in seen if one[2] is not None]
        for group in [ready] * bool(ready) if self.batches else [[one] for one in ready]:
            self._answer(group)

    def _observation(self, slot: _Slot, request: ActRequest, memory: Any) -> Any:
        """Decode an observation and report a reset to the policy; None if refused."""
        slot.step = request.step
        slot.used_at_s = time.monotonic()
        try:
            if slot.decoder is None or request.about is not None:
                slot.decoder = self._decoder(slot.episode_name, request.about or EpisodeConstants())
            arrays = {name: unpack_array(array, memory) for name, array in request.arrays.items()}
            observation = slot.decoder.decoded(request, arrays)
        except Exception as error:  # noqa: BLE001  whatever is wrong with the message
            slot.reply = Refusal("message", f"not an observation: {error}"[:LONGEST_MESSAGE])
            return None
        earlier = slot.reply
        if request.reset and callable(on_reset := getattr(slot.policy, "on_reset", None)):
            with self._call([slot], "on_reset", request.tick):
                on_reset(*([slot.episode_name] if self._for_many else []))
        return observation if slot.reply is earlier else None

    def _answer(self, group: list[tuple[_Slot, ActRequest, Any]]) -> None:
        """Query the policy for a group; an invalid answer affects only its episode."""
        slots = [slot for slot, _, _ in group]
        doing = "act" if all(slot.answered for slot in slots) else "first act"
        observations = tuple(observation for _, _, observation in group)
        answers: list[Any] = []
        with self._call(slots, doing, max(one.tick for _, one, _ in group)):
            if self.batches:
                answers = _as_many(self.policy.act_batch(observations), len(group))
            else:
                answers = [group[0][0].policy.act(observations[0])]
        for (slot, one, _), answer in zip(group, answers):
            slot.answered = True
            with self._call([slot], doing, one.tick):
                slot.reply = _packed_answer(one, answer)

    @contextmanager
    def _call(self, slots: list[_Slot], doing: str, tick: int = 0) -> Iterator[None]:
        """Guard a call of the policy; print a fault and make it the reply of these slots."""
        try:
            with policy_call(doing, tick, self._timer):
                yield
        except PolicyFault as fault:
            if (cause := fault.__cause__) is not None:
                traceback.print_exception(type(cause), cause, cause.__traceback__)
            during = doing if doing == "on_reset" else fault.during
            for slot in slots:
                slot.reply = Refusal("policy", fault.words, during, len(slots))


def _as_many(answers: Any, count: int) -> list[Any]:
    """Return the answers of a batch. Raises PolicyFault unless there is one per observation."""
    if not hasattr(answers, "__len__") or not hasattr(answers, "__getitem__"):
        kind = type(answers).__name__
        raise PolicyFault(f"answered a {kind}: a batch is answered with a sequence")
    if len(answers) != count:
        raise PolicyFault(f"gave {len(answers)} answers to {count} observations")
    return [answers[i] for i in range(count)]


def _from_jpeg(data: memoryview) -> Any:
    """Decode JPEG to (H, W, 3) uint8 with OpenCV or Pillow. Raises ValueError."""
    try:
        import cv2
    except ImportError:
        from PIL import Image

        return np.array(Image.open(io.BytesIO(data)).convert("RGB"))
    bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    return np.ascontiguousarray(np.asarray(bgr)[..., ::-1])


def read_request(payload: bytes) -> Union[PolicyRequest, Refusal]:
    """Decode a request; return a Refusal if invalid."""
    try:
        request: PolicyRequest = decode_request(payload)
        return request
    except UNREADABLE as error:
        return Refusal("message", f"not a question: {error}"[:LONGEST_MESSAGE])


def unpack_array(array: PackedArray, memory: Any = None) -> Any:
    """Return a copy of an array of an observation. Raises ValueError if invalid."""
    if array.jpeg:
        return _from_jpeg(array.data).reshape(array.shape)
    if array.dtype not in ("|u1", "<f4", "<i4") or any(side < 0 for side in array.shape):
        raise ValueError(f"an array of {array.dtype} {array.shape}")
    count = int(np.prod(array.shape, dtype=np.int64))
    if array.at < 0:
        return np.frombuffer(array.data, array.dtype).reshape(array.shape).copy()
    if memory is None:
        raise ValueError("no memory is shared")
    return np.frombuffer(memory, array.dtype, count, array.at).reshape(array.shape).copy()


def _packed_answer(request: ActRequest, answer: Any) -> ActReply:
    """Serialize an answer. Raises PolicyFault if invalid, and any exception of its attributes."""
    if isinstance(answer, dict) and set(answer) == {"v_mps", "w_radps"}:
        answer = SimpleNamespace(**answer)
    if not (hasattr(answer, "v_mps") and hasattr(answer, "w_radps")):
        return ActReply(*request.signature, request.step, waypoints=_packed_waypoints(answer))
    speeds = answer.v_mps, answer.w_radps
    numbers = (int, float, np.integer, np.floating)
    if not all(isinstance(v, numbers) and not isinstance(v, bool) for v in speeds):
        shown = "Command(v_mps={!r}, w_radps={!r})".format(*speeds)[:LONGEST_MESSAGE]
        raise PolicyFault(f"answered {shown}: both must be finite numbers")
    huge = (isinstance(v, int) and v.bit_length() > 1000 for v in speeds)
    v_mps, w_radps = (np.inf if large else float(v) for v, large in zip(speeds, huge))
    reply = *request.signature, request.step, v_mps, w_radps
    plan = getattr(answer, "waypoints", None)
    return ActReply(*reply) if plan is None else ActReply(*reply, _packed_waypoints(plan), True)


def _packed_waypoints(answer: Any) -> PackedArray:
    array = np.asarray(None)
    with suppress(TypeError, ValueError):  # rows of different lengths
        array = np.asarray(answer)
    if array.ndim == 0 or array.dtype.kind not in "biufc":
        shown = repr(answer)
        shown = shown if len(shown) <= 80 and shown.isprintable() else f"a {type(answer).__name__}"
        raise PolicyFault(f"answered {shown}: neither a Command nor waypoints")
    if array.nbytes > _MAX_ANSWER_BYTES:
        return PackedArray(array.dtype.str, array.shape)
    return pack_array(array)


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
    manifest: Any = None,
    source: str = "",
    decoder: Any = EpisodeDecoder,
    session: Any = None,
) -> None:
    """Serve a policy in the calling thread until Ctrl-C. Raises ValueError for invalid arguments.

    policy: An object, or a class to make one for each episode (`PolicyDesk`).
    name: Name used by runs; the manifest's by default.
    listen, connect: Endpoint to listen at, or where `cosim serve` listens.
    jpeg: Request pictures as JPEG.
    tls: Folder with ca.pem, cert.pem and key.pem (`cosim certs`).
    insecure: Allow endpoints beyond this machine without tls.
    manifest: Replaces `policy.manifest`: a mapping with the fields of `cosim.Manifest`.
    session: Open Zenoh session, in place of an endpoint.
    """
    desk = PolicyDesk(policy, decoder=decoder)
    manifest = msgspec.to_builtins(desk.policy.manifest if manifest is None else manifest)
    name = name or manifest["name"]
    server = secrets.token_hex(4)
    if not all(re.fullmatch(r"[A-Za-z0-9_-]{1,64}", part) for part in (name, domain)):
        raise ValueError(f"'{name}' or '{domain}' cannot stand in a key: use 1-64 of A-Za-z0-9_-")
    below = policy_key(domain, name, server)
    source = source or _source_of(desk.policy)
    requests: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def answer_info(query: Any) -> None:
        with query:
            counts = desk.at_once, desk.under_way
            info = PolicyInfo(server, name, manifest, source, *counts, jpeg, bool(listen))
            query.reply(f"{below}/info", encode_message(info))

    opening = nullcontext(session) if session else _opened(listen, connect, tls, insecure)
    with opening as opened, suppress(KeyboardInterrupt):
        answers = {"info": answer_info, **dict.fromkeys(("reset", "act", "ended"), requests.put)}
        _declared = [
            opened.declare_queryable(f"{below}/{kind}", answer, complete=True)
            for kind, answer in answers.items()
        ]
        where = f"at {listen or connect} as server {server}"
        print(f"policy '{name}' answers {where}; stop with Ctrl-C", flush=True)
        while True:
            _answer_waiting(desk, requests)


def _answer_waiting(desk: PolicyDesk, requests: Any) -> None:
    """Answer the waiting requests, at least one."""
    queries = [requests.get()]
    since_s = time.monotonic()
    with suppress(queue.Empty):
        while True:
            wait_s = desk.wait_s(len(queries), desk.under_way, since_s)
            queries.append(requests.get(timeout=wait_s))
    # A request to several servers at once is refused: an answer would be lost.
    read = [query.payload is not None and "*" not in str(query.key_expr) for query in queries]
    payloads = [query.payload.to_bytes() if reads else b"" for query, reads in zip(queries, read)]
    for query, reply in zip(queries, desk.replies(list(map(read_request, payloads)))):
        with query:
            if isinstance(reply, Refusal):
                query.reply_err(encode_message(reply))
            else:
                query.reply(query.key_expr, encode_message(reply))


def policy_key(domain: str, name: str, server: str) -> str:
    """Return the key prefix of a server; `info`, `reset`, `act` and `ended` follow it."""
    return f"cosim/{domain}/policy/{name}/{server}"


def _source_of(policy: Any) -> str:
    with suppress(OSError, TypeError):
        kind = type(policy)
        source = Path(inspect.getfile(kind)).read_bytes() + kind.__qualname__.encode()
        return hashlib.blake2b(source, digest_size=8).hexdigest()
    return ""


def _opened(listen: str, connect: str, tls: str, insecure: bool) -> Any:
    """Open a Zenoh session at one endpoint, without discovery."""
    import zenoh

    found = re.fullmatch(r"(tcp|tls)/(.+):\d{1,5}|unixsock-stream/.+", listen or connect)
    if not found or (listen and connect):
        got = f"not '{listen}' and '{connect}'"
        raise ValueError(f"listen or connect, one of both, like tcp/127.0.0.1:7449, {got}")
    host = (found[2] or "localhost").strip("[]")
    with suppress(ValueError):
        host = "localhost" if ip_address(host).is_loopback else host
    if host != "localhost" and not insecure and not (tls and found[1] == "tls"):
        raise ValueError(
            f"{found[0]} is beyond this machine and unguarded: anyone who can reach it may query "
            "the policy. Use tls/... with tls=FOLDER (`cosim certs` makes it), or say insecure"
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
        "transport/link/rx/max_message_size": LARGEST_MESSAGE_BYTES,
    }
    if tls:
        ends = ("listen", "connect")
        files = ("certificate", "cert.pem"), ("private_key", "key.pem")
        settings["transport/link/tls"] = {
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "root_ca_certificate": str(Path(tls, "ca.pem")),
            **{f"{end}_{kind}": str(Path(tls, file)) for end in ends for kind, file in files},
        }
    if listen and found[1]:  # only runs may send queries, and only this server may answer
        may = {"permission": "allow", "key_exprs": ["cosim/*/policy/**"]}
        flows = {"ingress": ["query"], "egress": ["declare_queryable", "reply"]}
        rules = [{"id": flow, "flows": [flow], "messages": flows[flow], **may} for flow in flows]
        roles = {"cert_common_names": ["worker", "coordinator"]}
        settings["access_control"] = {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": [{"id": "runs", **(roles if tls else {"link_protocols": ["tcp"]})}],
            "policies": [{"rules": list(flows), "subjects": ["runs"]}],
        }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)
