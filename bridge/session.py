"""Zenoh sessions: the one place that imports zenoh.

Over one explicit endpoint, or within one session: no scouting, no shared memory. A handler that
raises answers with its error instead of silence. `open_session` opens all that reach another
process, as a `Connection` says.
"""

from __future__ import annotations

import json
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, NamedTuple, Self

import zenoh

from bridge.security.settings import settings_alone, settings_of
from cosim.core.errors import AccessError, EngineError
from cosim.spec.connection import Connection

Handler = Callable[[bytes], bytes]
_Heard = zenoh.Subscriber["zenoh.Handler[zenoh.Sample]"]

_SOURCE_LINE = re.compile(r" at /\S+\.rs:\d+\.?")
"""In zenoh's errors: where it was built, of no use to anybody here."""

_ANSWER = "answer"
_WRITTEN = (
    "zenoh/bytes",
    "application/msgpack",
    "application/json",
    "text/json",
    "text/plain",
    "zenoh/string",
)
"""How a message may say that it is written: as none that makes objects of any kind."""
_LONGEST_FOLDER = 70
"""Letters: the whole path of a Unix socket has at most 107."""
_FIRST_RETRY_S = 0.005
_LONGEST_RETRY_S = 0.2


class Query:
    """A query that waits for its reply, from any thread. key: what was asked; payload: what came
    with it."""

    def __init__(self, query: zenoh.Query) -> None:
        self.key = str(query.key_expr)
        self.payload = bytes(query.payload.to_bytes()) if query.payload is not None else b""
        self._query: zenoh.Query | None = query

    def answer(self, payload: bytes) -> None:
        """Reply, once; to who is gone already nothing happens."""
        query = self._query
        self._query = None
        if query is not None:
            with suppress(zenoh.ZError), query:
                query.reply(self.key, payload)

    def refuse(self, words: str) -> None:
        """Reply with an error."""
        query = self._query
        self._query = None
        if query is not None:
            with suppress(zenoh.ZError), query:
                query.reply_err(words.encode())


HowHeard = Literal["answered", "refused", "late", "nobody"]


class QueryHeard(NamedTuple):
    """What came of a query: an answer, an error of the other side's, nothing in time, or nobody is
    there."""

    how: HowHeard
    payload: bytes = b""


class Session:
    """An open Zenoh session. Use as a context manager: a session left open keeps the process alive.

    inside: of one that listens: how processes of its own run on this machine reach it, by a socket
    that nobody else may open. They may do all; everybody else what their role may.
    """

    def __init__(
        self, session: zenoh.Session, inside: Connection | None = None, folder: Path | None = None
    ) -> None:
        self._session = session
        self._inside = inside
        self._folder = folder
        self._queryables: list[zenoh.Queryable[None]] = []
        self._subscribers: list[zenoh.Subscriber[Any]] = []
        self._tokens: list[zenoh.LivelinessToken] = []

    @property
    def itself(self) -> zenoh.Session:
        """What Zenoh opened, for the one file that answers by it without this one
        (`bridge.policy_server`)."""
        return self._session

    @property
    def inside(self) -> Connection:
        assert self._inside is not None, "this session listens nowhere"
        return self._inside

    @property
    def hub(self) -> str:
        """Which hub this end is connected to now, by an id that no other one has; "" for none."""
        return ", ".join(str(one) for one in self._session.info.routers_zid())

    def serve(self, key: str, handler: Handler, *, found: bool = False) -> None:
        """Answer queries on `key` with `handler(payload)`; its exceptions become error replies.

        key: may hold wildcards; then queries on every key of that form are answered, each on its
        own. found: queries on key expressions that include `key` are answered too.
        """

        def answer(query: zenoh.Query) -> None:
            with query:
                if objection := _objection(query, key, found=found):
                    query.reply_err(objection.encode())
                    return
                payload = query.payload.to_bytes() if query.payload is not None else b""
                asked = str(query.key_expr)
                try:
                    query.reply(key if "*" in asked else asked, handler(payload))
                except Exception as error:  # noqa: BLE001  a silent callback would look like a lost peer
                    query.reply_err(f"{type(error).__name__}: {error}".encode())

        self._queryables.append(self._session.declare_queryable(key, answer, complete=True))

    def collect(self, key: str, take: Callable[[Query], None], *, found: bool = False) -> None:
        """Hand queries on `key` over to `take`, in a thread of Zenoh's, where nothing may wait:
        they are answered later, elsewhere. found: see `serve`; such a query is to be answered on
        `key`."""

        def handed(query: zenoh.Query) -> None:
            asked = Query(query)
            if objection := _objection(query, key, found=found):
                asked.refuse(objection)
                return
            asked.key = key if "*" in asked.key else asked.key
            take(asked)

        self._queryables.append(self._session.declare_queryable(key, handed, complete=True))

    def send(
        self,
        key: str,
        payload: bytes,
        replied: Callable[[bytes | None, str], None],
        *,
        timeout_s: float,
    ) -> None:
        """Ask once, without waiting. `replied` is called once, in a thread of Zenoh's, where
        nothing may wait: with the reply; or with None, and the other side's error, "" where nobody
        answered in time."""
        found: list[bytes] = []
        errors: list[str] = []

        def heard(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                found.append(bytes(reply.ok.payload.to_bytes()))
            elif reply.err is not None and (words := reply.err.payload.to_string()) != "Timeout":
                errors.append(words)

        def over() -> None:
            replied(found[0] if found else None, errors[0] if errors else "")

        hears = zenoh.handlers.Callback(heard, over, indirect=False)
        self._session.get(
            key,
            hears,
            payload=payload,
            timeout=timeout_s,
            consolidation=zenoh.ConsolidationMode.NONE,
        )

    def stand(self, key: str) -> Callable[[], None]:
        """Be seen at `key` by those who `watch` it, as long as this session is there, or until what
        is returned is called."""
        token = self._session.liveliness().declare_token(key)
        self._tokens.append(token)

        def leave() -> None:
            self._tokens.remove(token)
            token.undeclare()  # type: ignore[no-untyped-call]

        return leave

    def watch(self, key: str, heard: Callable[[str, bool], None]) -> None:
        """Call `heard(key, there)` for everybody who `stand`s at a key expression now or later, and
        when they go."""

        def told(sample: zenoh.Sample) -> None:
            heard(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        self._subscribers.append(
            self._session.liveliness().declare_subscriber(key, told, history=True)
        )

    def answers(self, key: str, *, timeout_s: float) -> dict[str, bytes]:
        """Everybody's replies to one empty query on a key expression, by their keys; errors are
        left out."""
        replies = self._session.get(key, timeout=timeout_s)
        return {
            str(r.ok.key_expr): bytes(r.ok.payload.to_bytes()) for r in replies if r.ok is not None
        }

    def tell(self, key: str, payload: bytes) -> None:
        """Publish; whoever is slow to listen misses it."""
        self._session.put(key, payload, congestion_control=zenoh.CongestionControl.DROP)

    def listen(self, key: str, handler: Callable[[str, bytes], None]) -> None:
        """Call `handler(key, payload)` for whatever is published on a key expression."""

        def heard(sample: zenoh.Sample) -> None:
            handler(str(sample.key_expr), sample.payload.to_bytes())

        self._subscribers.append(self._session.declare_subscriber(key, heard))

    def ask_once(self, key: str, payload: bytes, *, timeout_s: float) -> QueryHeard:
        """What comes of one query, whoever answers it first."""
        began_s = time.monotonic()
        # Unconsolidated: else a reply is held back until every other side has said that it has
        # none.
        one_by_one = zenoh.ConsolidationMode.NONE
        for reply in self._session.get(
            key, payload=payload, timeout=timeout_s, consolidation=one_by_one
        ):
            if reply.ok is not None:
                return QueryHeard("answered", bytes(reply.ok.payload.to_bytes()))
            message = bytes(reply.err.payload.to_bytes()) if reply.err is not None else b""
            if message != b"Timeout":
                return QueryHeard("refused", message)
        # Where both ends run out of time at once, a query may end without that message.
        return QueryHeard("late" if time.monotonic() - began_s >= timeout_s else "nobody")

    def ask(self, key: str, payload: bytes, *, timeout_s: float) -> bytes:
        """The reply to one query. Asks again while nobody answers, until `timeout_s` is over.

        Raises TimeoutError when nobody answered, EngineError when the other side answered with an
        error.
        """
        deadline = time.monotonic() + timeout_s
        pause_s = _FIRST_RETRY_S
        while (left_s := deadline - time.monotonic()) > 0:
            heard = self.ask_once(key, payload, timeout_s=left_s)
            if heard.how == "answered":
                return heard.payload
            if heard.how == "refused":
                raise EngineError(f"'{key}' answered: {heard.payload.decode(errors='replace')}")
            time.sleep(min(pause_s, max(deadline - time.monotonic(), 0.0)))
            pause_s = min(2 * pause_s, _LONGEST_RETRY_S)
        raise TimeoutError(f"nobody answered on '{key}' for {timeout_s:g} s")

    def close(self) -> None:
        """Close the session; closing twice is fine."""
        with suppress(zenoh.ZError):
            for queryable in self._queryables:
                queryable.undeclare()  # type: ignore[no-untyped-call]
            self._queryables.clear()
            for subscriber in self._subscribers:
                subscriber.undeclare()  # type: ignore[no-untyped-call]
            self._subscribers.clear()
            for token in self._tokens:
                token.undeclare()  # type: ignore[no-untyped-call]
            self._tokens.clear()
            self._session.close()  # type: ignore[no-untyped-call]
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _objection(query: zenoh.Query, key: str, *, found: bool) -> str:
    """What is against answering a query on a key, "" for nothing: it asks several at once, or would
    have us unpickle.

    found: whether several may be asked at once."""
    asked = str(query.key_expr)
    written = str(query.encoding or _WRITTEN[0])
    if "*" in asked and not (found and query.key_expr.includes(zenoh.KeyExpr(key))):
        return f"ask for exactly '{key}', not '{asked}'"
    if written not in _WRITTEN:
        return f"'{written[:64]}' is not read here: send {_WRITTEN[1]} or {_WRITTEN[2]}"
    return ""


class LoneSession(Session):
    """A session with nobody else in it and no socket: what it asks it answers itself, in the thread
    that asks.

    For one thread. Question and answer are publications, not a query: a thread of Zenoh's watches
    over the time of a query, and on a busy machine whoever wakes it waits for a turn of its own.
    What interrupts the thread that asks interrupts the handler.
    """

    def __init__(self) -> None:
        super().__init__(
            _open(settings_alone(), "cannot open a session", "Has this machine threads to spare?")
        )
        self._served: list[tuple[_Heard, _Heard, Handler]] = []

    def serve(self, key: str, handler: Handler, *, found: bool = False) -> None:
        """Answer what is asked on `key`, in `ask`."""
        # Of the newest alone: an interrupted `ask` may have left a question or an answer behind.
        question = self._session.declare_subscriber(key, zenoh.handlers.RingChannel(1))
        answer = self._session.declare_subscriber(f"{key}/{_ANSWER}", zenoh.handlers.RingChannel(1))
        self._subscribers += [question, answer]
        self._served.append((question, answer, handler))

    def ask(self, key: str, payload: bytes, *, timeout_s: float) -> bytes:
        """The answer to one question. Raises TimeoutError at once when nobody serves the key,
        EngineError when its handler raised."""
        self._session.put(key, payload)
        for question, answer, handler in self._served:
            if (asked := question.try_recv()) is not None:
                self._answer(f"{key}/{_ANSWER}", handler, asked.payload.to_bytes())
                told = answer.try_recv()
                assert told is not None  # it was put in this thread
                if told.attachment is not None:
                    raise EngineError(f"'{key}' answered: {told.payload.to_string()}")
                return bytes(told.payload.to_bytes())
        raise TimeoutError(f"nobody answers on '{key}'")

    def _answer(self, key: str, handler: Handler, payload: bytes) -> None:
        try:
            answer = handler(payload)
        except Exception as error:  # noqa: BLE001  as over a query
            self._session.put(key, f"{type(error).__name__}: {error}", attachment=b"error")
        else:
            self._session.put(key, answer)


def open_session(connection: Connection, say: Callable[[str], None] = lambda _: None) -> Session:
    """Open one end of a session: a hub where it listens, else a client of the hub that it connects
    to.

    say: told, once it is open, in a line each what is insecure and which certificate ends soon.
    Raises AccessError for certificates that do not fit, here or there (trying again changes
    nothing), EngineError when an endpoint is taken or nobody answers.

    >>> from cosim.spec.connection import Connection
    >>> with open_session(Connection(role="coordinator", listen="tcp/127.0.0.1:7461")) as hub:
    ...     with open_session(hub.inside) as one:
    ...         hub.serve("cosim/r/status", lambda payload: payload.upper())
    ...         one.ask("cosim/r/status", b"well?", timeout_s=60.0)
    b'WELL?'
    """
    notices = notices_of(connection)
    session = _listening(connection) if connection.listen else _connected(connection)
    for line in notices:
        say(line)
    return session


def notices_of(connection: Connection) -> list[str]:
    """What is insecure about a connection, and which certificate ends soon, a line each. Raises
    AccessError."""
    soon = ""
    if connection.tls:
        from bridge.security.identity import checked_identity

        soon = checked_identity(connection)
    return [line for line in (connection.warning, soon) if line]


def _listening(connection: Connection) -> Session:
    remedy = (
        "Choose an address of this machine and a port that nobody uses, like tcp/127.0.0.1:7450."
    )
    failure = f"cannot listen at {connection.listen}"
    if connection.listen.startswith("unixsock-stream/"):
        inside = Connection(role=connection.role, connect=connection.listen)
        return Session(_open(settings_of(connection), failure, remedy), inside)
    brief = tempfile.gettempdir() if len(tempfile.gettempdir()) < _LONGEST_FOLDER else "/tmp"
    folder = Path(tempfile.mkdtemp(prefix="cosim-", dir=brief))
    inside = Connection(role=connection.role, connect=f"unixsock-stream/{folder}/hub.sock")
    try:
        return Session(
            _open(settings_of(connection, [inside.connect]), failure, remedy), inside, folder
        )
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _connected(connection: Connection) -> Session:
    remedy = "Is a process started that listens there, by the same protocol and port?"
    try:
        return Session(
            _open(settings_of(connection), f"no hub answers at {connection.connect}", remedy)
        )
    except EngineError as error:
        if connection.tls:
            from bridge.security.refusal import why_refused

            if why := why_refused(connection):
                raise AccessError(why) from error
        raise


def _open(settings: Mapping[str, object], failure: str, remedy: str) -> zenoh.Session:
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise EngineError(
            f"Zenoh: {failure} ({_SOURCE_LINE.sub('', str(error)).rstrip('.')}). {remedy}"
        ) from error
