"""Options that several commands share."""

from __future__ import annotations

import errno
import importlib.util
import inspect
import os
import re
import shlex
from collections.abc import Callable, Collection, Sequence
from copy import copy
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_type_hints

import msgspec
import typer

from cosim.cli.console import err, out
from cosim.cli.progress import doing
from cosim.core.errors import MachineError, UsageError, too_long, unwritable
from cosim.core.units import milliseconds
from cosim.spec.connection import Connection, Role, checked_endpoint

if TYPE_CHECKING:
    from cosim.spec.options import EpisodeOptions
    from cosim.spec.policy_host import PolicyHost
    from cosim.spec.scenario import Scenario, Suite


Choice = Literal["auto", "gl", "bullet", "bullet-egl"]
CAMERA_HELP = (
    "What draws the pictures: gl (OpenGL), bullet (slow, bare, anywhere), bullet-egl (bare, by "
    "OpenGL), or auto: gl where it works, else bullet."
)


def camera_here(choice: Choice) -> Literal["gl", "bullet", "bullet-egl"]:
    """The camera that a choice comes to on this machine; says so where auto is not gl. Raises
    EngineError."""
    from physics.cameras.choice import camera_of_choice

    name = camera_of_choice(choice)
    if choice == "auto" and name == "bullet":
        err.print("No OpenGL here: the bullet camera draws the pictures (`cosim doctor` says why).")
    return name


def size_called(option: str, words: str) -> tuple[int, int]:
    """Width and height of "160x90". Raises UsageError."""
    found = re.fullmatch(r"([1-9][0-9]{0,3})x([1-9][0-9]{0,3})", words, re.ASCII)
    if found is None:
        raise UsageError(f"{option} {words}: give width x height in pixels, such as 160x90")
    return int(found[1]), int(found[2])


DEFAULT = "tcp/127.0.0.1:7447"
DIRECTOR = "tcp/127.0.0.1:7448"
POLICIES_AT = "tcp/127.0.0.1:7449"
EVERY_ADDRESS = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}
"""What stands for all addresses of a machine, and by what it reaches itself."""
LONGEST_WAIT_S = 240.0
"""For a director: an environment process that says nothing for much longer is taken to hang
(`scenarios.runs.environment_slot`)."""

Tls = Annotated[
    str,
    typer.Option(
        "--tls", metavar="FOLDER", help="Guard tls/... endpoints: see `cosim certs --help`."
    ),
]
Insecure = Annotated[
    bool,
    typer.Option(
        "--insecure",
        help="Beyond this machine without TLS: open to all who can reach it, unencrypted.",
    ),
]


def listening(role: Role, option: str, endpoint: str, tls: str, insecure: bool) -> Connection:
    """The end that listens at the endpoint of an option. Raises UsageError."""
    return Connection(
        role=role, listen=checked_endpoint(endpoint, option), tls=tls, insecure=insecure
    )


def connecting(role: Role, option: str, endpoint: str, tls: str, insecure: bool) -> Connection:
    """The end that connects to the endpoint of an option. Raises UsageError."""
    return Connection(
        role=role, connect=checked_endpoint(endpoint, option), tls=tls, insecure=insecure
    )


def ends_of_run(
    live: str | None, director: str | None, policies: Sequence[str], tls: str, insecure: bool
) -> tuple[Connection | None, Connection | None, tuple[Connection, ...]]:
    """Where a run listens, where its director and the servers of its policy are: --tls goes to
    those that are tls/... Raises UsageError."""
    at = {f"--policy-at {end}": end for end in policies}
    given = {
        name: end for name, end in (("--live", live), ("--director", director)) if end is not None
    } | at
    if not given and (tls or insecure):
        raise UsageError(
            f"{'--tls' if tls else '--insecure'} goes with --live, --director or --policy-at"
        )
    guarded = [name for name, end in given.items() if end.startswith("tls/")]
    if tls and not guarded:
        raise UsageError(f"--tls goes with tls/ADDRESS:PORT, not with {', '.join(given.values())}")
    files = {name: tls if name in guarded else "" for name in given}
    return (
        None
        if live is None
        else listening("coordinator", "--live", live, files["--live"], insecure),
        None
        if director is None
        else connecting("coordinator", "--director", director, files["--director"], insecure),
        tuple(
            connecting("coordinator", "--policy-at", end, files[name], insecure)
            for name, end in at.items()
        ),
    )


def reached_by(hub: Connection, role: Role) -> str:
    """The options by which a command in this role reaches a hub from this machine, each after a
    space."""
    protocol, _, address = hub.listen.partition("/")
    host, _, port = address.rpartition(":")
    if host in EVERY_ADDRESS:
        address = f"{_certified(hub.tls) if hub.tls else EVERY_ADDRESS[host]}:{port}"
    options = ["--connect", f"{protocol}/{address}"]
    if hub.tls:
        options += ["--tls", str(Path(hub.tls).parent / role)]
    elif hub.insecure and not hub.of_this_machine and host not in EVERY_ADDRESS:
        options += ["--insecure"]
    return " " + shlex.join(options)


def _certified(folder: str) -> str:
    """The first name in the certificate of a hub, by which others must reach it."""
    from bridge.security.identity import identity_in

    return identity_in(Path(folder)).hosts[0]


def warned(line: str) -> None:
    """Print what is insecure, or ends soon, on standard error."""
    err.print(line, soft_wrap=True, markup=False, highlight=False)


def with_paths_checked(command: Any) -> Any:
    """The same command of Typer's, and those below it; each raises UsageError first where a path it
    is given is too long."""
    if command.callback is not None:
        command.callback = _checked(command.callback)
    for below in getattr(command, "commands", {}).values():
        with_paths_checked(below)
    return command


def _checked(does: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(does)
    def checks_first(**given: Any) -> Any:
        for value in given.values():
            for one in value if isinstance(value, list | tuple) else (value,):
                if isinstance(one, Path):
                    _check(one)
        return does(**given)

    return checks_first


def _check(path: Path) -> None:
    """Raises UsageError where a name in a path, or all of it, is too long."""
    try:
        os.lstat(path)
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise too_long(path) from None


LATENCY_HELP = (
    "Milliseconds from an observation until the command that answers it takes effect, rounded up "
    "to ticks of 50 ms; or 'measured': the median that the policy shows here in the first "
    "episode, driven once before the run."
)
REAL_TIME_HELP = (
    "Each answer takes effect as late as it came on this machine. One process; does not come "
    "again from its seed."
)


def with_latency(
    options: EpisodeOptions,
    asked: str,
    real_time: bool,
    resumed: Path | None,
    whole: Suite,
    first: Scenario,
    policy: str,
    rate_hz: float,
    host: PolicyHost | None = None,
) -> EpisodeOptions:
    """Options with the latency that was asked for; measured by driving `first`, or that of the run
    that is resumed. policy, rate_hz, host: its name, how often it acts, and where. Raises
    UsageError."""
    from cosim.results.run_folder import read_spec
    from cosim.spec.policy_host import PolicyHost
    from scenarios.runs.run import measured_latency

    latency_ms = asked_latency_ms(asked, real_time)
    if latency_ms is not None:
        return msgspec.structs.replace(options, latency_ms=latency_ms, real_time=real_time)
    if resumed is not None:
        return msgspec.structs.replace(options, latency_ms=read_spec(resumed).latency_ms)
    with doing(f"measuring the latency of {policy} in {first.id}"):
        answer_ms, latency_ms = measured_latency(
            whole, first, policy, options, host or PolicyHost()
        )
    err.print(
        f"Latency {latency_ms:g} ms, that of every command of this run: in {first.id} an "
        f"answer took "
        f"{milliseconds(answer_ms)} (median), and commands take effect at whole ticks of 50 ms.",
        soft_wrap=True,
        highlight=False,
    )
    if latency_ms > (period_ms := 1000.0 / rate_hz):
        err.print(
            f"That is longer than its period of {period_ms:g} ms, at which it is asked all the "
            "same. With --real-time it is not asked again before it has answered.",
            soft_wrap=True,
            highlight=False,
        )
    return msgspec.structs.replace(options, latency_ms=latency_ms)


def asked_latency_ms(text: str, real_time: bool) -> float | None:
    """The latency that was asked for, None where it is to be measured before the run. Raises
    UsageError."""
    from cosim.spec.options import MOST_LATENCY_MS

    if real_time and text:
        raise UsageError("--real-time measures the latency of every answer: leave --latency out")
    if text == "measured":
        return None
    try:
        latency_ms = float(text or "0")
    except ValueError:
        raise UsageError(
            f"--latency '{text}': give milliseconds, like 200, or 'measured'"
        ) from None
    if not 0.0 <= latency_ms <= MOST_LATENCY_MS:
        raise UsageError(f"--latency {text}: milliseconds must be from 0 to {MOST_LATENCY_MS:g}")
    return latency_ms


PICTURES = (".png", ".jpg", ".jpeg")


def replaced(path: Path | None) -> str:
    """Asked before a file is written, what is said of it afterwards: that it took another's place,
    or nothing."""
    return ", in place of the one that was there" if path is not None and path.exists() else ""


def check_output(path: Path, what: str = "a picture", endings: tuple[str, ...] = PICTURES) -> None:
    """Before it is made: raises UsageError when no such file can have this name, MachineError
    without its folder."""
    if path.suffix.lower() not in endings:
        raise UsageError(
            f"{path}: cannot be written as {what}; use a name that ends in "
            f"{' or '.join(endings[:2])}"
        )
    if not path.resolve().parent.is_dir():
        raise unwritable(path, NotADirectoryError(f"no folder {path.parent}"))


LOOK = "Look at episodes"
STEP_IN = "Step into running episodes"
MEASURE = "Measure"
PLACES = "Places"
LEARN = "Learn from demonstrations"
TRUST = "Trust what came out"
MANY = "Many machines"


RERUN_HELP = (
    "Write one episode as a recording for the Rerun viewer (package extra [rerun]): it is "
    "replayed for that."
)


def check_rerun(path: Path | None, episodes: int) -> None:
    """Before anything runs, where a recording is asked for: raises UsageError for a name that is
    none, or several episodes, MachineError without the package."""
    if path is None:
        return
    check_output(path, "a Rerun recording", (".rrd",))
    if episodes != 1:
        how = "--scenario of `cosim run`, --episode of `cosim show`"
        raise UsageError(
            f"--rerun is of one episode, and {episodes or 'none'} are asked for: name one ({how})"
        )
    if importlib.util.find_spec("rerun") is None:
        raise MachineError(
            "--rerun needs rerun-sdk, of the extra [rerun]: pip install 'sidewalk-cosim[rerun]'"
        )


def write_rerun(folder: Path, episodes: list[str], path: Path | None) -> None:
    """Write the recording of the one episode of a run, where it is asked for, and say so."""
    check_rerun(path, len(episodes))
    if path is None:
        return
    from scenarios.tools.viewing.rerun_file import record_for_rerun

    instead = replaced(path)
    with doing(f"recording {episodes[0]}") as progress:
        record_for_rerun(folder, episodes[0], path, progress=progress)
    size = f"{path.stat().st_size / 1e6:.1f} MB, the state hash is the record's"
    out.print(
        f"Recording: {path} ({size}){instead}. Open it with: rerun {path}",
        soft_wrap=True,
        highlight=False,
    )


ROBOT_HELP = "In place of the scenario's: which robot drives, by its name (`cosim list`)."
RESIDENTS_HELP = (
    "In place of the scenario's: so many people who sit on benches, look into shop windows, wait "
    "at stops."
)

CROWD_HELP = (
    "Street life in place of the suite's own: so many people, and vehicles; marked in every row."
)
VEHICLES_SHARE = 2 / 3
"""Vehicles that `--crowd` adds, for each person."""
GROUPS_HELP = "Share of the walkers, 0 to 1, who walk in groups of two and three."
ELDERLY_HELP = "Share of the walkers who are elderly: they walk slower."
CHILDREN_HELP = (
    "Share of the walkers who are children, each in a group with an adult: at most half of "
    "--groups."
)


_F = TypeVar("_F", bound=Callable[..., Any])


def taking(
    like: Callable[..., Any], *, without: Collection[str], hidden: Collection[str] = ()
) -> Callable[[_F], _F]:
    """Decorate a command that takes `**asked`: typer gives it the options of `like` there, but for
    some. hidden: those that its help does not show."""

    def decorated(command: _F) -> _F:
        mine, others = inspect.signature(command), inspect.signature(like)
        named = [
            one for one in mine.parameters.values() if one.kind is not inspect.Parameter.VAR_KEYWORD
        ]
        named += [one for name, one in others.parameters.items() if name not in without]
        types = get_type_hints(like, include_extras=True) | get_type_hints(
            command, include_extras=True
        )
        types |= {name: _unshown(types[name]) for name in hidden}
        command.__annotations__ = {one.name: types[one.name] for one in named} | {"return": None}
        only = [
            one.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=types[one.name])
            for one in named
        ]
        command.__signature__ = inspect.Signature(only)  # type: ignore[attr-defined]
        return command

    return decorated


def _unshown(annotated: Any) -> Any:
    """The type of an option, not shown in help."""
    option = copy(annotated.__metadata__[0])
    option.hidden = True
    return Annotated[annotated.__origin__, option]
