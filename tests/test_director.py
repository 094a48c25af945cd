"""The director over real Zenoh sessions."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from bridge import keys
from bridge.codec import decode, encode
from bridge.director import RemoteDirector, serve_director
from bridge.session import Session
from cosim.errors import DirectorLost, EngineError, SpecError
from cosim.events import EventQuery, EventReply

pytestmark = pytest.mark.engine

KEY = keys.director("test", "env")


def query(tick: int = 0) -> EventQuery:
    return EventQuery(
        episode="t", tick=tick, tick_ms=50, robot_x_m=0.0, robot_y_m=0.0, robot_heading_rad=0.0, robot_v_mps=0.0,
        robot_w_radps=0.0, route_s_m=0.0, robot_length_m=0.7, robot_width_m=0.55, events=(),
    )  # fmt: skip


def echo(asked: EventQuery) -> EventReply:
    return EventReply(episode=asked.episode, tick=asked.tick, states=(), actors=())


def endpoint(folder: Path) -> str:
    return f"unixsock-stream/{folder}/hub.sock"


def test_every_tick_is_answered_in_lockstep(tmp_path: Path) -> None:
    """A thousand queries get a thousand replies, each to its own tick."""
    with Session.hub(endpoint(tmp_path)) as hub, Session.client(endpoint(tmp_path)) as client:
        serve_director(hub, KEY, echo)
        director = RemoteDirector(client, KEY)
        assert [director.react(query(tick)).tick for tick in range(1000)] == list(range(1000))


def test_a_director_that_raises_is_reported_with_its_words(tmp_path: Path) -> None:
    """An exception in the director comes back as the reason, not as silence."""

    def broken(asked: EventQuery) -> EventReply:
        raise RuntimeError("no idea")

    with Session.hub(endpoint(tmp_path)) as hub, Session.client(endpoint(tmp_path)) as client:
        serve_director(hub, KEY, broken)
        with pytest.raises(DirectorLost, match=r"tick 7 of 't'.*RuntimeError: no idea"):
            RemoteDirector(client, KEY).react(query(7))


def test_a_missing_director_is_waited_for_and_then_lost(tmp_path: Path) -> None:
    """Nobody on the key: asked again until the time is over, then an error that says so."""
    with Session.hub(endpoint(tmp_path)), Session.client(endpoint(tmp_path)) as client:
        began = time.monotonic()
        with pytest.raises(DirectorLost, match=r"nobody answered .* for 0\.5 s"):
            RemoteDirector(client, KEY, timeout_s=0.5).react(query())
        assert 0.4 < time.monotonic() - began < 3.0


def test_a_director_that_restarts_is_found_again(tmp_path: Path) -> None:
    """The director's session closes and another takes its place: the next query is answered."""
    with Session.hub(endpoint(tmp_path)), Session.client(endpoint(tmp_path)) as client:
        director = RemoteDirector(client, KEY)
        for tick in range(3):
            with Session.client(endpoint(tmp_path)) as server:
                serve_director(server, KEY, echo)
                assert director.react(query(tick)).tick == tick


def test_an_answer_to_another_tick_is_refused(tmp_path: Path) -> None:
    """A reply that belongs to another tick or episode is a protocol error."""
    with Session.hub(endpoint(tmp_path)) as hub, Session.client(endpoint(tmp_path)) as client:
        serve_director(hub, KEY, lambda asked: EventReply(episode="t", tick=asked.tick + 1, states=(), actors=()))
        with pytest.raises(DirectorLost, match="answered tick 1"):
            RemoteDirector(client, KEY).react(query(0))


@pytest.mark.parametrize("payload", [b"", b"\xc1", b"\x80", b"\xdd\xff\xff\xff\xff", b"\x91" * 100_000, b"\x80\x04."])
def test_garbage_is_refused_without_harm(tmp_path: Path, payload: bytes) -> None:
    """Broken, huge-length, deeply nested and pickled payloads get an error reply; the next query works."""
    with Session.hub(endpoint(tmp_path)) as hub, Session.client(endpoint(tmp_path)) as client:
        serve_director(hub, KEY, echo)
        with pytest.raises(EngineError, match="not a EventQuery message"):
            client.ask(KEY, payload, timeout_s=3.0)
        assert RemoteDirector(client, KEY).react(query(3)).tick == 3


def test_a_wildcard_query_does_not_reach_a_director(tmp_path: Path) -> None:
    """A query for every environment at once is refused: each director answers its own key."""
    with Session.hub(endpoint(tmp_path)) as hub, Session.client(endpoint(tmp_path)) as client:
        serve_director(hub, KEY, echo)
        with pytest.raises(EngineError, match=f"ask for exactly '{KEY}'"):
            client.ask("cosim/*/env/*/director", encode(query()), timeout_s=3.0)


def test_nobody_to_connect_to_is_an_error_with_the_endpoint(tmp_path: Path) -> None:
    """A client without a hub fails within seconds and names the endpoint."""
    with pytest.raises(EngineError, match="no hub answers at unixsock-stream"):
        Session.client(endpoint(tmp_path))


def test_names_that_cannot_stand_in_a_key_are_refused() -> None:
    """Slashes, wildcards and empty names are no chunk of a key; `chunk` makes any name fit."""
    for bad in ("", "a/b", "*", "a b", "x" * 65):
        with pytest.raises(SpecError, match="cannot name a run or environment"):
            keys.director("run", bad)
    assert keys.chunk("lh 011/00") == "lh-011-00"


def test_messages_travel_by_field_name() -> None:
    """A message reads back as it was written, and an unknown field of a newer writer is ignored."""
    assert decode(encode(query(5)), EventQuery) == query(5)
