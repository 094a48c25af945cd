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
from cosim.core.errors import MachineError, UsageError, path_too_long, unwritable
from cosim.spec.connection import Connection, Role
from cosim.spec.run_config import Appearance, CameraChoice, help_of

Camera = Annotated[CameraChoice, typer.Option("--camera", metavar="CAMERA", help=help_of("camera"))]
Appears = Annotated[
    Appearance, typer.Option("--appearance", metavar="APPEARANCE", help=help_of("appearance"))
]
NO_OPENGL = "No OpenGL here: the bullet camera draws the pictures (`cosim doctor` says why)."


def camera_here(choice: CameraChoice) -> Literal["gl", "bullet", "bullet-egl"]:
    """Return the camera of a choice on this machine, with a notice where `auto` is not `gl`.

    Raises EngineError.
    """
    from physics.cameras.choice import camera_of_choice

    name = camera_of_choice(choice)
    if choice == "auto" and name == "bullet":
        err.print(NO_OPENGL)
    return name


def parse_size(option: str, words: str, span: tuple[int, int] = (1, 9999)) -> tuple[int, int]:
    """Return (width, height) of a text such as "160x90".

    option: its name, for the error message.
    span: least and largest width and height, pixels.
    Raises UsageError.
    """
    found = re.fullmatch(r"([1-9][0-9]{0,3})x([1-9][0-9]{0,3})", words, re.ASCII)
    size = (int(found[1]), int(found[2])) if found else (0, 0)
    least, most = span
    if not all(least <= side <= most for side in size):
        raise UsageError(
            f"{option} {words}: give width x height in pixels, such as 160x90, each from {least} "
            f"to {most}"
        )
    return size


DEFAULT = "tcp/127.0.0.1:7447"
DIRECTOR = "tcp/127.0.0.1:7448"
POLICIES_AT = "tcp/127.0.0.1:7449"
WILDCARD_ADDRESSES = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}
"""Wildcard addresses, and the loopback address by which a machine reaches itself."""

Tls = Annotated[str, typer.Option("--tls", metavar="FOLDER", help=help_of("tls"))]
Insecure = Annotated[bool, typer.Option("--insecure", help=help_of("insecure"))]


def connect_options(hub: Connection, role: Role) -> str:
    """Return the options with which a command in a role connects to a hub from this machine.

    Returns: the options with a leading space.
    """
    protocol, _, address = hub.listen.partition("/")
    host, _, port = address.rpartition(":")
    if host in WILDCARD_ADDRESSES:
        address = f"{_certified_host(hub.tls) if hub.tls else WILDCARD_ADDRESSES[host]}:{port}"
    options = ["--connect", f"{protocol}/{address}"]
    if hub.tls:
        options += ["--tls", str(Path(hub.tls).parent / role)]
    elif hub.insecure and not hub.is_local and host not in WILDCARD_ADDRESSES:
        options += ["--insecure"]
    return " " + shlex.join(options)


def _certified_host(folder: str) -> str:
    """Return the first host name in a hub's certificate, which clients must connect to."""
    from bridge.security.identity import identity_in

    return identity_in(Path(folder)).hosts[0]


def with_paths_checked(command: Any) -> Any:
    """Make a Typer command and its subcommands raise UsageError for a path that is too long."""
    if command.callback is not None:
        command.callback = _checked(command.callback)
    for below in getattr(command, "commands", {}).values():
        with_paths_checked(below)
    return command


def _checked(does: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(does)
    def checked(**given: Any) -> Any:
        for value in given.values():
            for one in value if isinstance(value, list | tuple) else (value,):
                if isinstance(one, Path):
                    _check(one)
        return does(**given)

    return checked


def _check(path: Path) -> None:
    """Raise UsageError if a path, or a name in it, is too long."""
    try:
        os.lstat(path)
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise path_too_long(path) from None


PICTURES = (".png", ".jpg", ".jpeg")


def replacement_note(path: Path | None) -> str:
    """Return the remark for a file that is about to be replaced, or "". Call before writing."""
    return ", in place of the one that was there" if path is not None and path.exists() else ""


def check_output(path: Path, what: str = "a picture", endings: tuple[str, ...] = PICTURES) -> None:
    """Check the name and folder of an output file before it is computed.

    Raises UsageError for a wrong ending, MachineError for a missing folder.
    """
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
    """Check before a run that a requested recording can be written.

    Raises UsageError for a wrong name or several episodes, MachineError without rerun-sdk.
    """
    if path is None:
        return
    check_output(path, "a Rerun recording", (".rrd",))
    if episodes != 1:
        how = "--scenario of `cosim run`, --episode of `cosim show`"
        raise UsageError(
            f"--rerun is of one episode, and {episodes or 'none'} are chosen: name one ({how})"
        )
    if importlib.util.find_spec("rerun") is None:
        raise MachineError(
            "--rerun needs rerun-sdk, of the extra [rerun]: pip install -e '.[rerun]' in the "
            "checkout"
        )


def write_rerun(folder: Path, episodes: list[str], path: Path | None) -> None:
    """Write the recording of the only episode of a run to `path`, if given, and print its path."""
    check_rerun(path, len(episodes))
    if path is None:
        return
    from scenarios.tools.viewing.rerun_file import record_for_rerun

    instead = replacement_note(path)
    with doing(f"recording {episodes[0]}") as progress:
        record_for_rerun(folder, episodes[0], path, progress=progress)
    size = f"{path.stat().st_size / 1e6:.1f} MB, the state hash is the record's"
    out.print(
        f"Recording: {path} ({size}){instead}. Open it with: rerun {path}",
        soft_wrap=True,
        highlight=False,
    )
