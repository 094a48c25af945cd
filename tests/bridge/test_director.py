"""The director over real Zenoh sessions."""

from __future__ import annotations

import math
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import pytest

from bridge import keys
from bridge.codec import encode
from bridge.director import (
    QueryParts,
    RemoteDirector,
    decode_query,
    encode_query,
    encode_versioned,
    serve_director,
)
from bridge.security import settings
from bridge.session import LocalSession
from cosim.core.errors import DirectorLost, EngineError, SpecError
from cosim.core.state import PersonKind
from cosim.spec.events import Actor, Event, EventQuery, EventReply, EventState, Walker
from tests.conftest import PATIENCE_S
from tests.support.session_pair import connected_to, listening_at

pytestmark = pytest.mark.engine

KEY = keys.director("test", "env")


def query(tick: int = 0) -> EventQuery:
    return EventQuery(
        episode="t",
        tick=tick,
        tick_ms=50,
        robot_x_m=0.0,
        robot_y_m=0.0,
        robot_heading_rad=0.0,
        robot_v_mps=0.0,
        robot_w_radps=0.0,
        route_s_m=0.0,
        robot_length_m=0.7,
        robot_width_m=0.55,
        events=(),
    )


def echo(sent: EventQuery) -> EventReply:
    return EventReply(episode=sent.episode, tick=sent.tick, states=(), actors=())


def endpoint(folder: Path) -> str:
    return f"unixsock-stream/{folder}/hub.sock"


def open_sockets() -> set[str]:
    """The sockets of this process."""
    links = []
    for file in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # a socket that is closed by now
            links.append(str(file.readlink()))
    return {link for link in links if link.startswith("socket:")}


def test_an_episodes_own_director_answers_in_the_calling_thread() -> None:
    """Over a Zenoh session without a socket its replies equal the pure function's, tick by tick."""
    before, threads = open_sockets(), set()

    def seen(sent: EventQuery) -> EventReply:
        threads.add(threading.get_ident())
        return echo(sent)

    with LocalSession() as session:
        serve_director(session, KEY, seen, version="cafe")
        director = RemoteDirector(session, KEY, version="cafe")
        assert [director.react(query(tick)) for tick in range(100)] == [
            echo(query(tick)) for tick in range(100)
        ]
        assert open_sockets() <= before and threads == {threading.get_ident()}
        with pytest.raises(EngineError, match="'feed' met behaviours 'cafe'"):
            RemoteDirector(session, KEY, version="feed").react(query())
        with pytest.raises(EngineError, match=r"no reply .* within 0\.5 s"):
            RemoteDirector(session, keys.director("test", "nobody"), wait_s=0.5).react(query())


def test_ctrl_c_during_a_query_of_the_own_director_is_not_lost() -> None:
    """An interrupt ends the query, an exception is an engine error, and the next query works."""
    raised: list[BaseException] = [KeyboardInterrupt(), RuntimeError("no idea")]

    def broken(sent: EventQuery) -> EventReply:
        if raised:
            raise raised.pop(0)
        return echo(sent)

    with LocalSession() as session:
        serve_director(session, KEY, broken)
        director = RemoteDirector(session, KEY)
        with pytest.raises(KeyboardInterrupt):
            director.react(query(1))
        with pytest.raises(EngineError, match=r"tick 2 of 't'.*RuntimeError: no idea") as failed:
            director.react(query(2))
        assert not isinstance(failed.value, DirectorLost)  # it is in this process
        assert director.react(query(3)).tick == 3


def test_a_director_that_raises_is_reported_with_its_message(tmp_path: Path) -> None:
    """An exception in the director comes back as the reason, not as silence."""

    def broken(sent: EventQuery) -> EventReply:
        raise RuntimeError("no idea")

    with listening_at(endpoint(tmp_path)) as hub, connected_to(endpoint(tmp_path)) as client:
        serve_director(hub, KEY, broken)
        with pytest.raises(DirectorLost, match=r"tick 7 of 't'.*RuntimeError: no idea"):
            RemoteDirector(client, KEY).react(query(7))


def test_a_missing_director_is_waited_for_and_then_lost(tmp_path: Path) -> None:
    """A query to a missing director is retried until its timeout and then fails."""
    with listening_at(endpoint(tmp_path)), connected_to(endpoint(tmp_path)) as client:
        began = time.monotonic()
        with pytest.raises(DirectorLost, match=r"no reply .* within 0\.5 s"):
            RemoteDirector(client, KEY, wait_s=0.5).react(query())
        assert time.monotonic() - began > 0.4


def test_a_director_that_restarts_is_found_again(tmp_path: Path) -> None:
    """The director's session closes and another takes its place: the next query is answered."""
    with listening_at(endpoint(tmp_path)), connected_to(endpoint(tmp_path)) as client:
        director = RemoteDirector(client, KEY)
        for tick in range(3):
            with connected_to(endpoint(tmp_path)) as server:
                serve_director(server, KEY, echo)
                assert director.react(query(tick)).tick == tick


def test_an_answer_to_another_tick_is_refused(tmp_path: Path) -> None:
    """A reply that belongs to another tick or episode is a protocol error."""
    with listening_at(endpoint(tmp_path)) as hub, connected_to(endpoint(tmp_path)) as client:
        serve_director(
            hub,
            KEY,
            lambda sent: EventReply(episode="t", tick=sent.tick + 1, states=(), actors=()),
        )
        with pytest.raises(DirectorLost, match="answered tick 1"):
            RemoteDirector(client, KEY).react(query(0))


def event(**fields: object) -> Event:
    known: dict[str, object] = {
        "id": "e0",
        "kind": "frontal",
        "x_m": 0.0,
        "y_m": 0.0,
        "heading_rad": 0.0,
    }
    return Event(**known | {"route_s_m": 5.0, "half_width_m": 1.0} | fields)  # type: ignore[arg-type]


SANE = EventState(
    phase="waiting", since_tick=0, walkers=(Walker(x_m=1.0, y_m=0.0, heading_rad=0.0),)
)
NOWHERE = msgspec.structs.replace(SANE, walkers=(Walker(x_m=math.nan, y_m=0.0, heading_rad=0.0),))
CROWDED = msgspec.structs.replace(SANE, walkers=SANE.walkers * 3)
SHOWN = Actor(
    id="e0", x_m=1.0, y_m=0.0, heading_rad=0.0, speed_mps=0.0, doing="stand", kind=PersonKind.EVENT
)
FAST = msgspec.structs.replace(SHOWN, speed_mps=math.inf)
DISGUISED = msgspec.structs.replace(SHOWN, kind=PersonKind.RESIDENT)
STRANGER = msgspec.structs.replace(SHOWN, id="e7")


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"tick": 4}, "it answered tick 4 of 't'"),
        ({"episode": "u"}, "it answered tick 5 of 'u'"),
        ({"states": ()}, "0 states for 1 events"),
        ({"states": (SANE,) * 10_000}, "10000 states for 1 events"),
        ({"states": (CROWDED,)}, "or with other people"),
        ({"states": (NOWHERE,)}, "no number"),
        ({"actors": (FAST,)}, "no number"),
        ({"actors": (STRANGER,)}, "people of no event, or twice: e7"),
        ({"actors": (DISGUISED,)}, "people of events as others: e0"),
        ({"actors": (SHOWN, SHOWN)}, "people of no event, or twice"),
    ],
)
def test_an_invalid_reply_is_refused_with_a_reason(
    tmp_path: Path, fields: dict[str, Any], words: str
) -> None:
    """Replies to another tick or episode, with too many states, unknown people or impossible places
    are refused."""
    sent = msgspec.structs.replace(query(5), events=(event(),))
    sane = EventReply(episode="t", tick=5, states=(SANE,), actors=(SHOWN,))
    with listening_at(endpoint(tmp_path)) as hub, connected_to(endpoint(tmp_path)) as client:
        serve_director(
            hub, KEY, lambda _: msgspec.structs.replace(sane, **fields if sent.states else {})
        )
        director = RemoteDirector(client, KEY)
        assert director.react(sent) == sane
        sent = msgspec.structs.replace(sent, states=sane.states)
        with pytest.raises(DirectorLost, match=f"tick 5 of 't'.*{words}"):
            director.react(sent)


@pytest.mark.parametrize("theirs", ["feed", ""])
def test_a_director_of_other_behaviours_is_refused(tmp_path: Path, theirs: str) -> None:
    """Both ends sign with the version of their behaviours, and each refuses another version."""
    with listening_at(endpoint(tmp_path)) as hub, connected_to(endpoint(tmp_path)) as client:
        serve_director(hub, KEY, echo, version=theirs)
        with pytest.raises(
            DirectorLost, match=f"'cafe' met behaviours '{theirs}': .* from the same code"
        ):
            RemoteDirector(client, KEY, version="cafe").react(query())
        lax = keys.director("test", "lax")
        hub.serve(
            lax, lambda payload: encode_versioned(echo(decode_query(payload, "cafe")), theirs)
        )
        with pytest.raises(DirectorLost, match=f"'{theirs}' met behaviours 'cafe'"):
            RemoteDirector(client, lax, version="cafe").react(query())


def test_one_director_answers_every_run_and_episode(tmp_path: Path) -> None:
    """Served on a key with wildcards it answers any concrete key, and still no wildcard query."""
    with listening_at(endpoint(tmp_path)) as hub, connected_to(endpoint(tmp_path)) as client:
        serve_director(hub, keys.EVERY_DIRECTOR, echo)
        for run, env in (("a", "x"), ("b", "y")):
            assert RemoteDirector(client, keys.director(run, env)).react(query(2)).tick == 2
        with pytest.raises(EngineError, match="ask for exactly"):
            client.query(
                keys.director("a", "x").replace("a", "*", 1),
                encode_query(query(), ""),
                timeout_s=PATIENCE_S,
            )


@pytest.mark.parametrize(
    "payload",
    [b"", b"\xc1", b"\x80", b"\xdd\xff\xff\xff\xff", b"\x91" * 100_000, b"\x80\x04."],
    ids=["empty", "unused byte", "map", "long array", "deep", "pickled"],
)
def test_garbage_is_refused_without_harm(tmp_path: Path, payload: bytes) -> None:
    """Broken, huge-length, deeply nested and pickled payloads get an error reply; the next query
    works."""
    with listening_at(endpoint(tmp_path)) as hub, connected_to(endpoint(tmp_path)) as client:
        serve_director(hub, KEY, echo)
        with pytest.raises(EngineError, match=r"not a (VersionedMessage|QueryParts) message"):
            client.query(KEY, payload, timeout_s=PATIENCE_S)
        assert RemoteDirector(client, KEY).react(query(3)).tick == 3


def test_a_wildcard_query_does_not_reach_a_director(tmp_path: Path) -> None:
    """A query for every environment at once is refused: each director answers its own key."""
    with listening_at(endpoint(tmp_path)) as hub, connected_to(endpoint(tmp_path)) as client:
        serve_director(hub, KEY, echo)
        with pytest.raises(EngineError, match=f"ask for exactly '{KEY}'"):
            client.query("cosim/*/env/*/director", encode(query()), timeout_s=PATIENCE_S)


def test_a_missing_hub_is_an_error_with_the_endpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A client without a hub fails and names the endpoint."""
    monkeypatch.setattr(settings, "CONNECTS_WITHIN_S", 0.1)
    with pytest.raises(EngineError, match="no hub answers at unixsock-stream"):
        connected_to(endpoint(tmp_path))


def test_names_that_do_not_fit_a_key_are_refused() -> None:
    """Slashes, wildcards and empty names are refused as a chunk of a key; `chunk` makes any name
    fit."""
    for bad in ("", "a/b", "*", "a b", "x" * 65):
        with pytest.raises(SpecError, match="cannot name a run or environment"):
            keys.director("run", bad)
    assert keys.chunk("lh 011/00") == "lh-011-00"


def test_interleaved_queries_hold_the_events_of_their_episode() -> None:
    """Two alternating episodes and one that changes its events get their own; impossible events are
    refused every time."""
    queries = [
        msgspec.structs.replace(query(k), events=(event(route_s_m=5.0 + k % 2),) * (k % 3))
        for k in range(12)
    ]
    assert [decode_query(encode_query(one, "cafe"), "cafe") for one in queries] == queries
    wrong = encode(event()).replace(b"\xa2e0", b"\xa2x0")
    parts = QueryParts(msgspec.Raw(encode(query())), msgspec.Raw(b"\x91" + wrong))
    for _ in range(2):
        with pytest.raises(EngineError, match="ids of event pedestrians start with 'e'"):
            decode_query(encode_versioned(parts, "cafe"), "cafe")
