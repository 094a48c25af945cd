"""What each role may do on a hub: plain Zenoh tries it over TLS on loopback; what is refused is
seen to do nothing."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import get_args

import pytest
import zenoh

from bridge.live import MAX_MESSAGE_B
from bridge.security.authority import issue, make_authority
from bridge.session import open_session
from cosim.core.errors import EngineError
from cosim.spec.connection import Connection, Role
from tests.conftest import PATIENCE_S, wait_until
from tests.support.plain import free_port, plain_zenoh
from tests.support.session_pair import listening_at

pytestmark = pytest.mark.engine

ENV = "cosim/r/env/e"
POLICY = "cosim/r/policy/ours/act"
TOLD = tuple(f"{ENV}/{topic}" for topic in ("clock", "robot", "crowd", "signals", "events"))
JOBS = tuple(f"cosim/r/jobs/{act}" for act in ("claim", "report"))
SEEN = (f"{ENV}/status", f"{ENV}/log", f"{ENV}/camera", "cosim/r/status")
ASKED = (*JOBS, *SEEN, "cosim/r/nets/0", f"{ENV}/inject", f"{ENV}/director", POLICY)
OWN = b"asked by the one who tries"
GIVEN_UP_S = 2.0
"""What is refused is waited for so long: nothing comes, on any machine."""
MAY_ASK: dict[str, tuple[str, ...]] = {
    "worker": (*JOBS, "cosim/r/status", "cosim/r/nets/0", f"{ENV}/director", POLICY),
    "viewer": SEEN,
    "injector": (f"{ENV}/inject", f"{ENV}/status"),
    "policy": (),
    "coordinator": (f"{ENV}/director", POLICY),
    "director": (),
    "ros2": (),
}
"""At a coordinator's hub. A director has no business there: others connect to it."""


@pytest.fixture(scope="module")
def certs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates of all roles; of those who listen for localhost."""
    folder = tmp_path_factory.mktemp("tls") / "certs"
    make_authority(folder, ["localhost"], 365)
    for role in get_args(Role):
        if role != "coordinator":
            issue(folder, role, ["localhost"] if role in ("director", "policy") else [], 365)
    return folder


def replies(session: zenoh.Session, key: str) -> list[str]:
    """What a query is answered, errors included."""
    got = session.get(
        key, payload=OWN, timeout=PATIENCE_S, consolidation=zenoh.ConsolidationMode.NONE
    )
    return [said.payload.to_string() for one in got if (said := one.ok or one.err) is not None]


class Air:
    """A hub, its run's own process, and a policy server. seen: the keys of what was asked of them
    and told to them; alive: of the tokens that were shown."""

    def __init__(self, certs: Path | None, stack: ExitStack) -> None:
        protocol, tls = ("tcp", "") if certs is None else ("tls", str(certs / "coordinator"))
        self.certs = certs
        self.at = f"{protocol}/localhost:{free_port()}"
        self.hub = stack.enter_context(
            open_session(Connection(role="coordinator", listen=self.at, tls=tls))
        )
        self.run = stack.enter_context(open_session(self.hub.inside))
        self.inside = stack.enter_context(plain_zenoh(self.hub.inside.connect, None, ""))
        self.policy = stack.enter_context(plain_zenoh(self.at, certs, "policy"))
        self.seen: list[str] = []
        for key in ASKED:
            if key != POLICY:
                end = self.run if key.startswith(ENV) else self.hub
                end.serve(key, lambda _, key=key: self._saw(key), found=key == f"{ENV}/status")  # type: ignore[misc]
        self.policy.declare_queryable(POLICY, self._answer)
        self.hub.subscribe("cosim/**", lambda key, *_: self.seen.append(key))
        self.run.subscribe("cosim/**", lambda key, *_: self.seen.append(key))
        wait_until(lambda: self.hub.query(POLICY, b"", timeout_s=PATIENCE_S) == POLICY.encode())

    def _saw(self, key: str) -> bytes:
        self.seen.append(key)
        return key.encode()

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, self._saw(str(query.key_expr)))

    def settle(self) -> None:
        """Until what was routed before has arrived: what the run tells and what the hub tells goes
        after it."""
        for end in (self.run, self.hub):
            mark = f"{ENV}/mark{time.monotonic_ns()}"
            end.publish_lossy(mark, b"")
            wait_until(lambda mark=mark: self.seen.count(mark) == 2)  # type: ignore[misc]


class Guest:
    """A client that tries everything. heard: the keys of what was told or asked that was none of
    its own doing."""

    def __init__(self, air: Air, role: str, stack: ExitStack) -> None:
        self.air = air
        self.session = stack.enter_context(plain_zenoh(air.at, air.certs, role))
        self.heard: list[str] = []
        self.session.declare_queryable("cosim/r/policy/theirs/info", self._answer)
        everything = [] if role in ("policy", "") else [POLICY, "cosim/*/policy/**", "cosim/**"]
        for key in (*JOBS, *SEEN, *TOLD, f"{ENV}/inject", f"{ENV}/director", *everything):
            self.session.declare_queryable(key, self._answer)
        for key in (*TOLD, *JOBS, POLICY, "cosim/r/policy/**", "cosim/**", "**"):
            self.session.declare_subscriber(key, self._hear)
        self.token = self.session.liveliness().declare_token("cosim/r/workers/one")

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            if query.payload is None or query.payload.to_bytes() != OWN:
                self.heard.append(str(query.key_expr))
            query.reply(query.key_expr, b"FORGED")

    def _hear(self, sample: zenoh.Sample) -> None:
        # Nobody else deletes: it hears its own when a thread of its own comes to it.
        if sample.kind == zenoh.SampleKind.PUT and sample.payload.to_string() != "FORGED":
            self.heard.append(str(sample.key_expr))

    def passed(self, may_ask: tuple[str, ...]) -> None:
        """Until all that it sent before is with the hub: what it asks, or is asked, goes after
        that."""
        if may_ask:
            wait_until(lambda: may_ask[0] in replies(self.session, may_ask[0]))
        else:
            self.answers()
        self.air.settle()

    def answers(self) -> bool:
        """Whether what it answers as a policy is heard."""
        try:
            return self.air.hub.query("cosim/r/policy/theirs/info", b"", timeout_s=0.5) == b"FORGED"
        except (TimeoutError, EngineError):
            return False


@pytest.fixture(scope="module")
def air(certs: Path) -> Iterator[Air]:
    with ExitStack() as stack:
        yield Air(certs, stack)


def try_all(
    air: Air, guest: Guest, may_ask: tuple[str, ...], *, watches: bool, answers: bool, shows: bool
) -> None:
    """Try all acts; what is allowed works, and nothing else has any effect."""
    guest.passed(may_ask)
    # to ask
    air.seen.clear()
    for key in ASKED:
        if key in may_ask:
            wait_until(lambda key=key: key in replies(guest.session, key))  # type: ignore[misc]
        else:
            assert [one for one in replies(guest.session, key) if one != "FORGED"] == [], key
    wide = [
        one
        for key in ("cosim/**", "cosim/*/jobs/*", f"{ENV}/*", "**")
        for one in replies(guest.session, key)
    ]
    assert [one for one in wide if one != "FORGED" and "ask for exactly" not in one] == []
    assert {key for key in air.seen if "/mark" not in key} == set(may_ask)
    # to tell, and to take back
    air.seen.clear()
    for key in (*TOLD, *JOBS, f"{ENV}/inject", POLICY, "cosim/r/status", f"{ENV}/*", "cosim/**"):
        guest.session.put(key, b"FORGED")
        guest.session.delete(key)
    guest.passed(may_ask)
    assert {key for key in air.seen if "/mark" not in key} <= set(may_ask[:1])
    # to hear what is told, and what is asked of a policy
    guest.heard.clear()
    for key in TOLD:
        air.run.publish_lossy(key, b"true")
    air.hub.query(POLICY, b"secret", timeout_s=PATIENCE_S)
    if watches:
        wait_until(lambda: set(TOLD) <= set(guest.heard))
    guest.passed(may_ask)
    foreign = {"cosim/r/policy/theirs/info"} if answers else set()
    assert {key for key in guest.heard if key not in TOLD} - foreign == set()
    assert watches == bool(set(TOLD) & set(guest.heard))
    # to answer in the place of others, and as a policy
    for key in (*JOBS, *SEEN, f"{ENV}/inject"):
        assert air.hub.query(key, b"", timeout_s=PATIENCE_S) == key.encode()
    assert guest.answers() is answers
    # to be seen as a worker
    alive = [
        str(one.ok.key_expr)
        for one in air.inside.liveliness().get("cosim/*/workers/*", timeout=PATIENCE_S)
    ]
    assert (alive == ["cosim/r/workers/one"]) is shows


@pytest.mark.parametrize("role", MAY_ASK)
def test_a_role_may_do_its_own_and_nothing_else(air: Air, role: str) -> None:
    """Asking, telling, listening, answering, being alive, wildcards: each tried by each role, with
    its certificate."""
    with ExitStack() as stack:
        guest = Guest(air, role, stack)
        try_all(
            air,
            guest,
            MAY_ASK[role],
            watches=role == "viewer",
            answers=role == "policy",
            shows=role == "worker",
        )


def test_without_certificates_nobody_tells_where_the_robot_is() -> None:
    """On loopback everybody may do what the roles may together, but not speak for the run or its
    hub."""
    with ExitStack() as stack:
        air = Air(None, stack)
        may = tuple(key for key in ASKED if any(key in theirs for theirs in MAY_ASK.values()))
        try_all(air, Guest(air, "", stack), may, watches=True, answers=True, shows=True)


@pytest.mark.parametrize(("hub", "key"), [("director", f"{ENV}/director"), ("policy", POLICY)])
def test_who_is_asked_is_asked_by_runs_alone(certs: Path, hub: Role, key: str) -> None:
    """At the hub of a director or a policy server, workers and coordinators ask; others do not, and
    nobody answers."""
    at = f"tls/localhost:{free_port()}"
    asked: list[bytes] = []
    with ExitStack() as stack:
        session = stack.enter_context(
            open_session(Connection(role=hub, listen=at, tls=str(certs / hub)))
        )
        session.serve(key, lambda payload: asked.append(payload) or b"honest")  # type: ignore[func-returns-value]
        guests = {
            role: stack.enter_context(plain_zenoh(at, certs, role)) for role in get_args(Role)
        }
        for role, guest in guests.items():
            if role != "policy" or hub != "policy":  # one policy server may answer beside another
                guest.declare_queryable(key, lambda query: query.reply(query.key_expr, b"FORGED"))
        for role in ("worker", "coordinator"):
            wait_until(lambda role=role: "honest" in replies(guests[role], key))  # type: ignore[misc]
        asked.clear()
        for role in ("director", "policy", "viewer", "injector"):
            assert set(replies(guests[role], key)) <= {"FORGED"}, (
                "its own answer, and nobody else's"
            )
        assert asked == []
        assert session.query(key, b"x", timeout_s=PATIENCE_S) == b"honest"


COPIED = """
import sys
from bridge.policy_server import serve

class Mine:
    manifest = {"name": "mine", "rate_hz": 5.0}
    def reset(self, episode_id, seed): print(f"reset of {episode_id}", flush=True)

serve(Mine, listen=sys.argv[1], tls=sys.argv[2])
"""


def test_the_file_that_is_copied_is_asked_by_runs_alone(certs: Path) -> None:
    """`serve` of policy_server.py by itself: workers and coordinators ask, one server at a time;
    else nobody."""
    at = f"tls/localhost:{free_port()}"
    words = [sys.executable, "-c", COPIED, at, str(certs / "policy")]
    with ExitStack() as stack:
        server = stack.enter_context(subprocess.Popen(words, stdout=subprocess.PIPE, text=True))
        stack.callback(server.kill)
        assert server.stdout is not None and "answers at" in server.stdout.readline()
        guests = {
            role: stack.enter_context(plain_zenoh(at, certs, role)) for role in get_args(Role)
        }
        info = "cosim/default/policy/mine/*/info"
        for role in ("worker", "coordinator"):
            wait_until(lambda role=role: len(list(guests[role].get(info))) == 1)  # type: ignore[misc]
        for role in ("director", "policy", "viewer", "injector"):
            assert list(guests[role].get(info)) == [], role
        guests["viewer"].declare_queryable(
            "cosim/**", lambda query: query.reply(query.key_expr, b"FORGED")
        )
        begin = b"\x85\xa4type\xa5reset\xa3run\xa1r\xa7episode\xa1e\xa7attempt\xa1a\xa4seed\x00"
        (wide,) = guests["worker"].get(info.replace("info", "reset"), payload=begin)
        assert b"not a question" in wide.err.payload.to_bytes()
        (told,) = guests["worker"].get(info)
        (begun,) = guests["worker"].get(
            str(told.ok.key_expr).replace("info", "reset"), payload=begin
        )
        assert (
            b"begun" in begun.ok.payload.to_bytes() and server.stdout.readline() == "reset of e\n"
        )


@pytest.mark.parametrize(
    "written", ["application/python-serialized-object", "application/x-unheard-of"]
)
def test_what_would_have_to_be_unpickled_is_not_read(tmp_path: Path, written: str) -> None:
    """A message that says it is a Python object, or something unheard of, is refused with what is
    read here."""
    asked: list[bytes] = []
    at = f"unixsock-stream/{tmp_path}/hub.sock"
    with listening_at(at) as hub, plain_zenoh(at, None, "") as guest:
        hub.serve("cosim/r/jobs/claim", lambda payload: asked.append(payload) or b"taken")  # type: ignore[func-returns-value]
        got = [
            one.err.payload.to_string()
            for one in guest.get("cosim/r/jobs/claim", payload=b"x", encoding=written)
        ]
        assert (
            got == [f"'{written}' is not read here: send application/msgpack or application/json"]
            and not asked
        )
        for fine in ("application/json", "application/msgpack", None):
            (one,) = guest.get("cosim/r/jobs/claim", payload=b"x", encoding=fine)
            assert one.ok.payload.to_bytes() == b"taken"


def test_what_is_too_long_is_dropped_unread(certs: Path) -> None:
    """A message longer than 64 KiB is dropped, and one of a role without rights ends no link."""
    at = f"tls/localhost:{free_port()}"
    lengths: list[int] = []
    with ExitStack() as stack:
        hub = stack.enter_context(
            open_session(Connection(role="coordinator", listen=at, tls=str(certs / "coordinator")))
        )
        for key in (f"{ENV}/inject", f"{ENV}/status"):
            hub.serve(key, lambda payload: lengths.append(len(payload)) or b"taken")  # type: ignore[func-returns-value]
        guest = stack.enter_context(plain_zenoh(at, certs, "injector"))
        wait_until(lambda: replies(guest, f"{ENV}/status") == ["taken"])
        lengths.clear()
        for length in (MAX_MESSAGE_B, MAX_MESSAGE_B + 1, 1 << 20, 20 << 20):
            list(guest.get(f"{ENV}/inject", payload=bytes(length), timeout=GIVEN_UP_S))
        wait_until(lambda: replies(guest, f"{ENV}/status") == ["taken"])
        assert lengths == [MAX_MESSAGE_B, len(OWN)]
