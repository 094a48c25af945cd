"""Serve a policy to `cosim run --policy zenoh:NAME --policy-at ENDPOINT`, from any Python >= 3.9.

Copy this file next to a policy; it needs eclipse-zenoh, msgspec and numpy. `serve` queries the
policy in the thread that calls it. cosim itself imports this file: the messages, `PolicyDesk` and
the faults of policies are the same for isolated policies, served ones and the shared renderer.
A request is signed with run, episode, attempt and step: a repeated one gets the cached reply.
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
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from ipaddress import ip_address
from itertools import repeat
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, Optional, Union

import msgspec
import numpy as np

POLICY_PROTOCOL = 2
"""Raised whenever the messages below change their meaning."""
MOST_WORDS = 500
"""Characters of an error's message that are quoted."""
MOST_MESSAGE_BYTES = 16 << 20
"""Bytes of one message over Zenoh."""
_WINDOW_S = 0.002
"""Seconds that a policy with act_batch waits for further requests before it answers a batch."""
_MOST_SEATS = 4096
"""Episodes under way in one server; beyond that the longest idle one is dropped."""
FORGET_AFTER_S = 300.0
"""Seconds without a request after which a server drops an episode."""
_TAKEN_OVER_AFTER_S = 30.0
"""Seconds without a request after which a policy object for one episode at a time is free again."""
_MOST_ANSWER_BYTES = 2 << 20
"""Bytes of an answer; of a larger array only the shape is sent, and the simulator refuses it."""
_ARRAYS = {"|u1", "<f4"}
_QUESTIONS = ("reset", "act", "ended")
_OWN_PACKAGES = {"cosim", "scenarios", "sumo_nets", "physics", "bridge"}
_PICTURE = ("rgb", "depth", "labels")
_NUMBERS = ("tick", "time_s", "v_mps", "w_radps", "reset")


class PackedArray(msgspec.Struct, frozen=True):
    """An array as it travels. data: its bytes, or those of a picture as JPEG; at: where it begins
    in shared memory, -1 where it is in the message."""

    dtype: str
    shape: tuple[int, ...]
    data: memoryview = memoryview(b"")
    at: int = -1
    jpeg: bool = False


class AboutEpisode(msgspec.Struct, frozen=True):
    """The constants of an episode. robot: its size and limits. knowledge: as in `AskAct`.

    cameras: K (3 x 3), distortion (5) and pose on the robot (4 x 4); "" is the policy's first one.
    """

    robot: dict[str, Union[str, float]] = {}
    cameras: dict[str, tuple[list[list[float]], list[float], list[list[float]]]] = {}
    knowledge: bytes = b""


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
    """An observation; with the first one about. step: the number of this request, from 0.

    arrays: by names like "rgb", those of a goal "goal.rgb", of a further camera "left/rgb".
    knowledge: for a privileged policy in the shared renderer, encoded by cosim.
    """

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
    knowledge: bytes = b""


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
    """The policy's answer at a step: two speeds, or waypoints; planned: both, a plan with its
    command."""

    step: int
    v_mps: float = 0.0
    w_radps: float = 0.0
    waypoints: Optional[PackedArray] = None
    planned: bool = False


class Refusal(msgspec.Struct, frozen=True, tag="refusal"):
    """There is no answer. during, together: see `PolicyFault`.

    why: "policy", its fault; "unknown", the episode did not begin here; "busy", with another
    episode; "message", it cannot be decoded; "renderer", the shared renderer itself failed.
    """

    why: str
    words: str
    during: str = ""
    together: int = 1


PolicyRequest = Union[AskReset, AskAct, AskEnded]
PolicyReply = Union[Begun, Answer, Refusal]
encode_message = msgspec.msgpack.Encoder().encode
decode_request = msgspec.msgpack.Decoder(PolicyRequest).decode
decode_reply = msgspec.msgpack.Decoder(PolicyReply).decode
decode_info = msgspec.msgpack.Decoder(Union[PolicyInfo, Refusal]).decode
UNREADABLE = (msgspec.DecodeError, RecursionError, ValueError, TypeError, OverflowError)
"""What decoding bytes of unknown origin may raise."""


def packed(array: Any) -> PackedArray:
    """Pack an array into a message."""
    array = np.ascontiguousarray(array)
    return PackedArray(array.dtype.str, tuple(array.shape), array.reshape(-1).view(np.uint8).data)


class PolicyFault(Exception):
    """Something that a policy did wrong, in printable words.

    during: in which call, "" for the requested one. together: for so many episodes at once.
    """

    def __init__(self, words: str, during: str = "", together: int = 1) -> None:
        words = words.encode("utf-8", "replace").decode()
        words = "".join(c if c.isprintable() or c == "\n" else "?" for c in words)
        super().__init__(words)
        self.words = words[: 2 * MOST_WORDS]
        self.during = during
        self.together = together


def said_by(error: BaseException) -> str:
    """Return the message of an error as printable text of bounded length."""
    try:
        text = PolicyFault(str(error)).args[0]
    except BaseException:  # noqa: BLE001  even the message of an error can raise
        return "(its message cannot be read)"
    if len(text) <= MOST_WORDS:
        return str(text)
    return f"{text[:MOST_WORDS]} ... ({len(text)} characters)"


@contextmanager
def policy_call(
    doing: str, tick: int = 0, timer: Any = None, passes: tuple[type[BaseException], ...] = ()
) -> Iterator[None]:
    """Guard a call of a policy: whatever it raises becomes a PolicyFault, but for Ctrl-C.

    timer: its `starts(doing, tick)` and `stops()` are called. passes: errors that are not the
    policy's, or that have their words already. A copy of the process that the policy forked ends.
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
        said = said_by(error)
        words = f"raised {type(error).__name__}{': ' * bool(said)}{said}{_line_of(error)}"
        raise PolicyFault(words) from error
    finally:
        if os.getpid() != process:
            os._exit(1)
        if timer is not None:
            timer.stops()


def _line_of(error: BaseException) -> str:
    """Return the file and line of the user's code that an error came from, as " in mine.py:12";
    else ""."""
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
    """A goal, a pose or a picture. For numpy: its picture or only array, else its numbers."""

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        held = {name: value for name, value in vars(self).items() if value is not None}
        values = list(held.values())
        if all(isinstance(value, (int, float)) for value in values):
            return np.array(values, dtype)
        array = values[0] if len(values) == 1 else held.get("rgb")
        if not isinstance(array, np.ndarray):
            raise TypeError(f"this is no array: read its {', '.join(held)}")
        return np.array(array, dtype)


class EpisodeDecoder:
    """Decodes the observations of one episode to plain objects with the names of
    `cosim.Observation`.

    A subclass that decodes to other objects overrides `makes`, the maker of each part, and
    `privileged`. They raise an error for wrong values.
    """

    makes: ClassVar[dict[str, Any]] = {
        **dict.fromkeys(("camera", "picture", "odometry"), _Given),
        **dict.fromkeys(("robot", "observation"), SimpleNamespace),
        "goal": lambda type, **fields: _Given(**fields),
    }

    def __init__(self, episode: str, about: AboutEpisode) -> None:
        self.episode = episode
        self.about = about
        self.robot = self.makes["robot"](**about.robot)
        self.cameras = {}
        for name, camera in about.cameras.items():
            parts = zip(("matrix", "distortion", "on_robot"), map(np.array, camera))
            self.cameras[name] = self.makes["camera"](**dict(parts))

    def decoded(self, one: AskAct, arrays: dict[str, Any]) -> Any:
        """Return the observation in a request with these arrays."""
        makes = self.makes
        pictures = {}
        for name in [name for name in self.cameras if name]:
            parts = {kind: arrays.get(f"{name}/{kind}") for kind in _PICTURE}
            pictures[name] = makes["picture"](camera=self.cameras[name], **parts)
        goal = {name[5:]: one for name, one in arrays.items() if name.startswith("goal.")}
        pose = dict(zip(("x_m", "y_m", "heading_rad"), one.odometry or ()))
        return makes["observation"](
            **{kind: arrays.get(kind) for kind in _PICTURE},
            **{name: getattr(one, name) for name in _NUMBERS},
            robot=self.robot,
            privileged=self.privileged(one.knowledge) if one.knowledge else None,
            episode=self.episode,
            goal=makes["goal"](**one.goal, **goal) if one.goal else None,
            odometry=makes["odometry"](**pose) if pose else None,
            camera=self.cameras.get(""),
            pictures=pictures,
        )

    def privileged(self, knowledge: bytes) -> Any:
        """Decode what a privileged policy gets: nothing here."""
        return None


class _Seat:
    """An episode under way. called: its name before the policy. step: the last one, with its
    reply."""

    def __init__(self, called: str, attempt: str) -> None:
        self.policy: Any = None
        self.called = called
        self.attempt = attempt
        self.decoder: Any = None
        self.step = -1
        self.reply: PolicyReply = Refusal("message", "the episode did not begin")
        self.answered = False
        self.used_at_s = time.monotonic()


class PolicyDesk:
    """Queries a policy for any number of episodes, whatever carries requests and replies.

    policy: an object; or a class or function that makes one for each episode under way. An object
    with `act_batch` answers for any number at once, unless batch is False; any other for one.
    decoder: an `EpisodeDecoder`. timer: see `policy_call`. forget_after_s: when idle ones end.
    """

    def __init__(
        self,
        policy: Any,
        *,
        decoder: Any = EpisodeDecoder,
        timer: Any = None,
        batch: bool = True,
        forget_after_s: float = FORGET_AFTER_S,
    ) -> None:
        self._make: Any = policy if isinstance(policy, type) or not hasattr(policy, "act") else None
        self.policy: Any = policy if self._make is None else self._make()
        self._for_many = callable(getattr(self.policy, "act_batch", None))
        self.batches = batch and self._for_many
        self.at_once = int(not self.batches and self._make is None)
        self._idle = [] if self.batches else [self.policy]
        self._seats: dict[tuple[str, str], _Seat] = {}
        self._decoder = decoder
        self._timer = timer
        most_s = _TAKEN_OVER_AFTER_S if self.at_once else forget_after_s
        self._forget_after_s = min(forget_after_s, most_s)

    @property
    def under_way(self) -> int:
        """How many episodes have begun and not ended."""
        return len(self._seats)

    def wait_s(self, waiting: int, expected: int, since_s: float) -> float:
        """Return how long a batch of requests, the first of since_s, waits for those expected."""
        if not self.batches or waiting >= expected:
            return 0.0
        return max(since_s + _WINDOW_S - time.monotonic(), 0.0)

    def replies(
        self, requests: Sequence[Union[PolicyRequest, Refusal]], memories: Sequence[Any] = ()
    ) -> list[PolicyReply]:
        """Return the reply to each request. A Refusal is a request that could not be decoded.

        memories: for each request the buffer of its arrays that are not in the message.
        """
        began = {i: self._begin(one) for i, one in enumerate(requests) if isinstance(one, AskReset)}
        fresh = {}
        for one, memory in zip(requests, memories or repeat(None)):
            seat = self._seat(one) if isinstance(one, AskAct) else None
            if seat is not None and isinstance(one, AskAct) and one.step == seat.step + 1:
                fresh[id(seat)] = seat, one, memory
        self._act(list(fresh.values()))
        return [began[i] if i in began else self._reply(one) for i, one in enumerate(requests)]

    def _seat(self, one: Any) -> _Seat | None:
        seat = self._seats.get((one.run, one.episode))
        return seat if seat is not None and seat.attempt == one.attempt else None

    def _reply(self, one: Any) -> PolicyReply:
        if isinstance(one, Refusal):
            return one
        seat = self._seat(one)
        if isinstance(one, AskEnded):
            self._end((one.run, one.episode), seat)
            return Begun(*one.signature)
        if seat is None:
            return Refusal("unknown", "this episode did not begin here, or was dropped")
        seat.used_at_s = time.monotonic()
        if one.step != seat.step:
            return Refusal("message", f"step {one.step} was requested after step {seat.step}")
        return seat.reply

    def _begin(self, one: AskReset) -> PolicyReply:
        key = one.run, one.episode
        seat = self._seat(one)
        if seat is not None and seat.step < 0:  # a repeated request: the reply was lost
            return seat.reply
        self._end(key, self._seats.get(key))
        self._forget()
        if self.at_once and not self._idle:
            return Refusal("busy", "this policy answers for one episode at a time: serve its class")
        # Two runs of one seed may begin at once: the names of their episodes must differ.
        taken = any(other.called == one.episode for other in self._seats.values())
        called = f"{one.episode}-{one.run[:4]}" if taken else one.episode
        self._seats[key] = seat = _Seat(called, one.attempt)
        try:
            with policy_call("reset", timer=self._timer):
                seat.policy = self.policy if self.batches else (self._idle or [self._make()]).pop()
                seat.policy.reset(seat.called, one.seed)
            seat.reply = Begun(*one.signature)
        except PolicyFault as fault:
            seat.reply = _refused(fault)
        return seat.reply

    def _end(self, key: tuple[str, str], seat: _Seat | None) -> None:
        if seat is None or self._seats.pop(key, None) is None or seat.policy is None:
            return
        if not self.batches:
            self._idle.append(seat.policy)
        try:
            if self._for_many and callable(ended := getattr(seat.policy, "ended", None)):
                with policy_call("ended", timer=self._timer):
                    ended(seat.called)
        except PolicyFault as fault:
            _refused(fault)  # printed; the episode is over

    def _forget(self) -> None:
        """Drop idle episodes, and the longest idle one where there are too many."""
        now = time.monotonic()
        seats = sorted(self._seats.items(), key=lambda item: item[1].used_at_s)
        for number, (key, seat) in enumerate(seats):
            if now - seat.used_at_s > self._forget_after_s or len(seats) - number >= _MOST_SEATS:
                self._end(key, seat)

    def _act(self, asked: list[tuple[_Seat, AskAct, Any]]) -> None:
        """Query the policy. Each seat gets its reply."""
        seen = [(seat, one, self._observation(seat, one, memory)) for seat, one, memory in asked]
        ready = [one for one in seen if one[2] is not None]
        for group in [ready] * bool(ready) if self.batches else [[one] for one in ready]:
            self._answer(group)

    def _observation(self, seat: _Seat, one: AskAct, memory: Any) -> Any:
        """Decode an observation, and report a reset to the policy; None if refused."""
        seat.step = one.step
        seat.used_at_s = time.monotonic()
        try:
            if seat.decoder is None or one.about is not None:
                seat.decoder = self._decoder(seat.called, one.about or AboutEpisode())
            arrays = {name: unpacked(array, memory) for name, array in one.arrays.items()}
            observation = seat.decoder.decoded(one, arrays)
        except Exception as error:  # noqa: BLE001  whatever is wrong with the message
            seat.reply = Refusal("message", f"not an observation: {error}"[:MOST_WORDS])
            return None
        try:
            if one.reset and callable(on_reset := getattr(seat.policy, "on_reset", None)):
                with policy_call("on_reset", one.tick, self._timer):
                    on_reset(*([seat.called] if self._for_many else []))
        except PolicyFault as fault:
            fault.during = "on_reset"
            seat.reply = _refused(fault)
            return None
        return observation

    def _answer(self, group: list[tuple[_Seat, AskAct, Any]]) -> None:
        """Query the policy for observations together. A bad answer concerns its own episode."""
        doing = "act" if all(seat.answered for seat, _, _ in group) else "first act"
        observations = tuple(observation for _, _, observation in group)
        try:
            with policy_call(doing, max(one.tick for _, one, _ in group), self._timer):
                if self.batches:
                    answers = _as_many(self.policy.act_batch(observations), len(group))
                else:
                    answers = [group[0][0].policy.act(observations[0])]
        except PolicyFault as fault:
            fault.together = len(group)
            refusal = _refused(fault)
            for seat, _, _ in group:
                seat.reply = refusal
            return
        for (seat, one, _), answer in zip(group, answers):
            seat.answered = True
            try:
                with policy_call(doing, one.tick, self._timer):
                    seat.reply = _packed_answer(one, answer)
            except PolicyFault as fault:
                seat.reply = _refused(fault)


def _as_many(answers: Any, count: int) -> list[Any]:
    """Return the answers of a batch. Raises PolicyFault unless there is one for each
    observation."""
    if not hasattr(answers, "__len__") or not hasattr(answers, "__getitem__"):
        kind = type(answers).__name__
        raise PolicyFault(f"answered a {kind}: a batch is answered with a sequence")
    if len(answers) != count:
        raise PolicyFault(f"gave {len(answers)} answers to {count} observations")
    return [answers[i] for i in range(count)]


def _refused(fault: PolicyFault) -> Refusal:
    """Print the traceback of a fault, and return it as a message."""
    cause = fault.__cause__
    if cause is not None:
        traceback.print_exception(type(cause), cause, cause.__traceback__)
    return Refusal("policy", fault.words, fault.during, fault.together)


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


def read_request(payload: bytes) -> Union[PolicyRequest, Refusal]:
    """Decode a request; a Refusal where it is none."""
    try:
        request: PolicyRequest = decode_request(payload)
        return request
    except UNREADABLE as error:
        return Refusal("message", f"not a question: {error}"[:MOST_WORDS])


def unpacked(array: PackedArray, memory: Any = None) -> Any:
    """Return a copy of an array of an observation. Raises ValueError for what is none."""
    if array.jpeg:
        return _from_jpeg(array.data).reshape(array.shape)
    if array.dtype not in _ARRAYS or any(side < 0 for side in array.shape):
        raise ValueError(f"an array of {array.dtype} {array.shape}")
    count = int(np.prod(array.shape, dtype=np.int64))
    if array.at < 0:
        return np.frombuffer(array.data, array.dtype).reshape(array.shape).copy()
    if memory is None:
        raise ValueError("no memory is shared")
    return np.frombuffer(memory, array.dtype, count, array.at).reshape(array.shape).copy()


def _packed_answer(one: AskAct, answer: Any) -> Answer:
    """Pack a policy's answer. Raises PolicyFault for what is none, and whatever reading it
    raises."""
    if isinstance(answer, dict) and set(answer) == {"v_mps", "w_radps"}:
        answer = SimpleNamespace(**answer)
    if not (hasattr(answer, "v_mps") and hasattr(answer, "w_radps")):
        return Answer(*one.signature, one.step, waypoints=_packed_waypoints(answer))
    speeds = answer.v_mps, answer.w_radps
    numbers = (int, float, np.integer, np.floating)
    if not all(isinstance(v, numbers) and not isinstance(v, bool) for v in speeds):
        shown = "Command(v_mps={!r}, w_radps={!r})".format(*speeds)[:MOST_WORDS]
        raise PolicyFault(f"answered {shown}: both must be finite numbers")
    v_mps, w_radps = map(_float, speeds)
    plan = getattr(answer, "waypoints", None)
    if plan is None:
        return Answer(*one.signature, one.step, v_mps, w_radps)
    return Answer(*one.signature, one.step, v_mps, w_radps, _packed_waypoints(plan), planned=True)


def _float(value: Any) -> float:
    return np.inf if isinstance(value, int) and value.bit_length() > 1000 else float(value)


def _packed_waypoints(answer: Any) -> PackedArray:
    array = np.asarray(None)
    with suppress(TypeError, ValueError):  # rows of different lengths
        array = np.asarray(answer)
    if array.ndim == 0 or array.dtype.kind not in "biufc":
        shown = repr(answer)
        shown = shown if len(shown) <= 80 and shown.isprintable() else f"a {type(answer).__name__}"
        raise PolicyFault(f"answered {shown}: neither a Command nor waypoints")
    if array.nbytes > _MOST_ANSWER_BYTES:
        return PackedArray(array.dtype.str, array.shape)
    return packed(array)


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
    decoder: Any = EpisodeDecoder,
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
    desk = PolicyDesk(policy, decoder=decoder)
    manifest = msgspec.to_builtins(desk.policy.manifest if told is None else told)
    name = name or manifest["name"]
    server = secrets.token_hex(4)
    if not all(re.fullmatch(r"[A-Za-z0-9_-]{1,64}", part) for part in (name, domain)):
        raise ValueError(
            f"'{name}' or '{domain}' cannot stand in a key: use 1 to 64 of A-Za-z0-9_-"
        )
    below = policy_key(domain, name, server)
    source = source or _source_of(desk.policy)
    asked: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def tell(query: Any) -> None:
        with query:
            busy = desk.at_once, desk.under_way
            info = PolicyInfo(server, name, manifest, source, *busy, jpeg, bool(listen))
            query.reply(f"{below}/info", encode_message(info))

    opens = nullcontext(session) if session else _opened(listen, connect, tls, insecure)
    with opens as opened, suppress(KeyboardInterrupt):
        answers = {"info": tell, **dict.fromkeys(_QUESTIONS, asked.put)}
        _declared = [
            opened.declare_queryable(f"{below}/{kind}", answer, complete=True)
            for kind, answer in answers.items()
        ]
        where = f"at {listen or connect} as server {server}"
        print(f"policy '{name}' answers {where}; stop with Ctrl-C", flush=True)
        while True:
            _answer_waiting(desk, asked)


def _answer_waiting(desk: PolicyDesk, asked: Any) -> None:
    """Answer the waiting requests, at least one."""
    queries = [asked.get()]
    since_s = time.monotonic()
    with suppress(queue.Empty):
        while True:
            wait_s = desk.wait_s(len(queries), desk.under_way, since_s)
            queries.append(asked.get(timeout=wait_s))
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
    """What the keys of a server begin with; _QUESTIONS of questions, and `info`, stand below."""
    return f"cosim/{domain}/policy/{name}/{server}"


def _source_of(policy: Any) -> str:
    with suppress(OSError, TypeError):
        kind = type(policy)
        source = Path(inspect.getfile(kind)).read_bytes() + kind.__qualname__.encode()
        return hashlib.blake2b(source, digest_size=8).hexdigest()
    return ""


def _opened(listen: str, connect: str, tls: str, insecure: bool) -> Any:
    """A Zenoh session that reaches no further than it says."""
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
        guard: dict[str, Any] = {"enable_mtls": True, "verify_name_on_connect": True}
        for end in ("listen", "connect"):
            guard.update({f"{end}_{what}": path for what, path in ours.items()})
        guard["root_ca_certificate"] = str(Path(tls, "ca.pem"))
        settings["transport/link/tls"] = guard
    if listen and found[1]:  # runs may ask; nobody else may, and nobody may answer in its place
        may = {"permission": "allow", "key_exprs": ["cosim/*/policy/**"]}
        flows = {"ingress": ["query"], "egress": ["declare_queryable", "reply"]}
        rules = [{"id": flow, "flows": [flow], "messages": flows[flow], **may} for flow in flows]
        who = {"link_protocols": ["tcp"]}
        if tls:
            who = {"cert_common_names": ["worker", "coordinator"]}
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
