"""PolicyDesk: queries one policy for any number of episodes, whatever carries the requests."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import msgspec
import numpy as np
import pytest

from bridge.policy_server import (
    ActReply,
    ActRequest,
    EndRequest,
    EpisodeReply,
    PackedArray,
    PolicyDesk,
    PolicyReply,
    Refusal,
    ResetRequest,
    decode_reply,
    encode_message,
    pack_array,
    read_request,
)
from cosim.core.state import STILL, Command, WaypointCommand
from cosim.episode.interfaces import Observation
from cosim.spec.manifest import Manifest, WaypointRule
from cosim.spec.robot import COURIER
from scenarios.ipc.observation_codec import ObservationDecoder
from scenarios.runs.hosted_policy import HostedCaller, HostedPolicy
from tests.conftest import without_lines

MANIFEST = Manifest("mine", camera=None, waypoints=WaypointRule(index=1))


class RecordsCalls:
    """A policy for one episode that records its calls."""

    manifest = MANIFEST

    def __init__(self, does: Callable[[Any], Any] = lambda _: STILL) -> None:
        self.does = does
        self.calls: list[object] = []

    def reset(self, episode_id: str, seed: int) -> None:
        self.calls.append(("reset", episode_id, seed))

    def act(self, observation: Any) -> Any:
        self.calls.append(observation.episode)
        return self.does(observation)


class RecordsBatchCalls(RecordsCalls):
    """A policy for many episodes that records its calls."""

    def on_reset(self, episode_id: str) -> None:
        self.calls.append(("on_reset", episode_id))
        if episode_id == "bad":
            raise LookupError("no history")

    def ended(self, episode_id: str) -> None:
        self.calls.append(("ended", episode_id))
        if episode_id == "bad":
            raise LookupError("no such episode")

    def act_batch(self, observations: Sequence[Any]) -> Any:
        self.calls += [one.episode for one in observations]
        return self.does(observations)


def act(episode: str, tick: int = 0, step: int = 0, *, reset: bool = False) -> ActRequest:
    return ActRequest("r", episode, "a", step, tick, tick / 20.0, 0.0, 0.0, reset)


def desk_with(policy: Any, *episodes: str, timer: Any = None) -> PolicyDesk:
    """Return a desk at which these episodes are under way."""
    desk = PolicyDesk(policy, timer=timer)
    for episode in episodes:
        assert desk.replies([ResetRequest("r", episode, "a", 7)]) == [
            EpisodeReply("r", episode, "a")
        ]
    return desk


def replies_of_two(does: Callable[[Sequence[Any]], Any]) -> list[PolicyReply]:
    """The replies to "a" and "b", which are queried together."""
    return desk_with(RecordsBatchCalls(does), "a", "b").replies([act("a", 2), act("b", 4)])


def without_line(reply: PolicyReply) -> PolicyReply:
    """The reply without the line of this file that an error names."""
    if not isinstance(reply, Refusal):
        return reply
    words = re.sub(r" in test_policy_desk\.py:\d+$", "", reply.words)
    return msgspec.structs.replace(reply, words=words)


def test_a_batch_is_answered_in_its_order() -> None:
    """Each episode of a batch gets its own command or waypoints."""
    assert replies_of_two(lambda two: [Command(0.1 * one.tick, 9.0) for one in two]) == [
        ActReply("r", "a", "a", 0, 0.2, 9.0),
        ActReply("r", "b", "a", 0, 0.4, 9.0),
    ]
    rows = np.array([[[0.1, 0.0]] * 3, [[0.2, 0.0]] * 3])
    for row, reply in zip(rows, replies_of_two(lambda _: rows), strict=True):
        assert isinstance(reply, ActReply) and reply.waypoints is not None and not reply.planned
        assert bytes(reply.waypoints.data) == row.tobytes()


def test_a_bad_answer_in_a_batch_crashes_only_its_episode() -> None:
    """The other episode gets its answer; numbers that raise when they are read count as bad
    answers."""

    class Pretends(float):
        def __float__(self) -> float:
            raise SystemExit(9)

    good, bad = replies_of_two(lambda _: [STILL, Command(Pretends(1.0), 0.0)])
    assert isinstance(good, ActReply)
    assert without_line(bad) == Refusal("policy", "raised SystemExit: 9")
    good, bad = replies_of_two(lambda _: [STILL, "left"])
    assert isinstance(good, ActReply)
    assert bad == Refusal("policy", "answered 'left': neither a Command nor waypoints")


def plain(reply: Any) -> Refusal:
    """Return a refusal without the line that it names."""
    assert isinstance(reply, Refusal) and " in test_policy_desk.py:" in reply.words
    return msgspec.structs.replace(reply, words=without_lines(reply.words))


def raising(error: BaseException) -> Callable[[Any], NoReturn]:
    def does(_: Any) -> NoReturn:
        raise error

    return does


@pytest.mark.parametrize(
    ("does", "words"),
    [
        (raising(KeyError("no such weight")), "raised KeyError: 'no such weight'"),
        (raising(SystemExit(3)), "raised SystemExit: 3"),
        (lambda _: [STILL], "gave 1 answers to 2 observations"),
        (
            lambda two: (STILL for _ in two),
            "answered a generator: a batch is answered with a sequence",
        ),
        (lambda _: None, "answered a NoneType: a batch is answered with a sequence"),
    ],
    ids=["error", "exit", "one-too-few", "generator", "nothing"],
)
def test_an_invalid_batch_answer_crashes_every_episode_of_it(
    does: Callable[[Any], Any], words: str
) -> None:
    """Each crash says for how many episodes the policy was queried."""
    refused = [without_line(reply) for reply in replies_of_two(does)]
    assert refused == [Refusal("policy", words, together=2)] * 2


def test_a_policy_for_many_episodes_gets_resets_and_ends_of_each() -> None:
    """`on_reset` is called before the following act of its episode, and `ended` once."""
    policy = RecordsBatchCalls(lambda some: [STILL for _ in some])
    desk = desk_with(policy, "a", "b")
    policy.calls.clear()
    desk.replies([act("a", 5, reset=True), act("b", 10)])
    desk.replies([EndRequest("r", "a", "a"), EndRequest("r", "a", "a")])
    assert policy.calls == [("on_reset", "a"), "a", "b", ("ended", "a")]
    assert desk.under_way == 1


def test_an_on_reset_that_raises_crashes_only_its_episode(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """The others of the batch are answered; an `ended` that raises is printed and is no crash."""
    policy = RecordsBatchCalls(lambda some: [STILL for _ in some])
    desk = desk_with(policy, "a", "bad", "c")
    first, bad, last = desk.replies([act(name, 5, reset=True) for name in ("a", "bad", "c")])
    assert (
        isinstance(first, ActReply)
        and isinstance(last, ActReply)
        and policy.calls[-2:] == ["a", "c"]
    )
    assert without_line(bad) == Refusal(
        "policy", "raised LookupError: no history", during="on_reset"
    )
    assert desk.replies([EndRequest("r", "bad", "a")]) == [EpisodeReply("r", "bad", "a")]
    assert "LookupError: no such episode" in capfd.readouterr().err


def test_an_object_serves_one_episode_at_a_time_and_a_class_many() -> None:
    """The second episode finds an object busy; a class has one instance for each, which is reused."""
    made: list[RecordsCalls] = []

    class Made(RecordsCalls):
        def __init__(self) -> None:
            super().__init__()
            made.append(self)

    one = desk_with(RecordsCalls(), "a")
    again, other = one.replies([ResetRequest("r", name, "a", 7) for name in ("a", "b")])
    assert isinstance(again, EpisodeReply) and isinstance(other, Refusal) and other.why == "busy"
    many = desk_with(Made, "a", "b")
    assert len(made) == 2
    many.replies([EndRequest("r", "a", "a")])
    many.replies([ResetRequest("r", "c", "a", 7)])
    assert len(made) == 2 and made[0].calls[-1] == ("reset", "c", 7)
    rgb = {"rgb": pack_array(np.zeros((2, 2, 3), np.uint8))}
    request = ActRequest("r", "b", "a", 0, 0, 0.0, 0.0, 0.0, arrays=rgb)
    first, repeated, later = many.replies([request] * 3)
    assert first == repeated == later and made[1].calls.count("b") == 1


def test_a_request_that_cannot_be_decoded_is_refused() -> None:
    """For garbage and arrays of missing or wrong sizes the policy is not queried, and other
    requests are answered."""
    policy = RecordsCalls()
    desk = desk_with(policy, "a")
    garbage = read_request(b"\x91" * 100_000)
    assert isinstance(garbage, Refusal) and desk.replies([garbage]) == [garbage]
    for array in (
        PackedArray("|u1", (4, 4), at=0),
        PackedArray("|u1", (9, 9)),
        PackedArray("<f8", (1,)),
    ):
        desk = desk_with(policy, "a")
        (refused,) = desk.replies(
            [ActRequest("r", "a", "a", 0, 0, 0.0, 0.0, 0.0, arrays={"rgb": array})]
        )
        assert isinstance(refused, Refusal) and refused.why == "message"
    assert policy.calls == [("reset", "a", 7)] * 4


class ToDesk:
    """Carries requests to a desk in this process."""

    can_lose_episodes = True

    def __init__(self, policy: Any) -> None:
        self.desk = PolicyDesk(policy, decoder=ObservationDecoder)

    def pack(self, arrays: dict[str, Any]) -> dict[str, PackedArray]:
        return {name: pack_array(array) for name, array in arrays.items()}

    def exchange(self, request: ResetRequest | ActRequest) -> bytes:
        (reply,) = self.desk.replies([read_request(encode_message(request))])
        payload = encode_message(reply)
        assert decode_reply(payload) == reply
        return payload

    def report_ended(self, request: EndRequest) -> None:
        self.desk.replies([request])

    def close(self) -> None:
        """Nothing to release."""


def hosted(policy: Any) -> HostedCaller:
    return HostedCaller(HostedPolicy(MANIFEST, ToDesk(policy), "r"), "remote", "")


def observation_at(tick: int, *, reset: bool = False) -> Observation:
    return Observation(tick, tick / 20.0, None, 0.5, 0.0, COURIER, episode="bad", reset=reset)


def test_a_command_keeps_the_waypoints_that_it_follows() -> None:
    """An answer that is a command with its waypoints keeps both, as in this process."""
    plan = np.array([[1.0, 0.0], [2.0, 0.5]], np.float32)
    driver = hosted(RecordsCalls(lambda _: WaypointCommand(0.5, 0.1, plan, 1)))
    driver.reset("a", 0)
    command = driver.act(observation_at(0))
    assert isinstance(command, WaypointCommand) and (command.v_mps, command.w_radps) == (0.5, 0.1)
    assert command.waypoints.tobytes() == plan.tobytes() and command.index == 1
