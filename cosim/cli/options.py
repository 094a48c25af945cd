"""Options that several commands share."""

from __future__ import annotations

import errno
import importlib.util
import os
import re
import shlex
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from cosim.cli.console import err, out
from cosim.cli.progress import doing
from cosim.core.errors import MachineError, UsageError, too_long, unwritable
from cosim.spec.connection import Connection, Role
from cosim.spec.run_config import CameraChoice, help_of

Camera = Annotated[CameraChoice, typer.Option("--camera", metavar="CAMERA", help=help_of("camera"))]
NO_OPENGL = "No OpenGL here: the bullet camera draws the pictures (`cosim doctor` says why)."


def camera_here(choice: CameraChoice) -> Literal["gl", "bullet", "bullet-egl"]:
    """The camera that a choice comes to on this machine; says so where auto is not gl. Raises
    EngineError."""
    from physics.cameras.choice import camera_of_choice

    name = camera_of_choice(choice)
    if choice == "auto" and name == "bullet":
        err.print(NO_OPENGL)
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

Tls = Annotated[str, typer.Option("--tls", metavar="FOLDER", help=help_of("tls"))]
Insecure = Annotated[bool, typer.Option("--insecure", help=help_of("insecure"))]


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


RERUN_HELP = help_of("rerun")


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
            "--rerun needs rerun-sdk, of the extra [rerun]: pip install -e '.[rerun]' in the "
            "checkout"
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
