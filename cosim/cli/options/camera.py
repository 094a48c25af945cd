"""Which camera draws: the option, and what it comes to on this machine."""

from __future__ import annotations

import re
from typing import Literal

from cosim.cli.terminal.consoles import err
from cosim.core.errors import UsageError

Choice = Literal["auto", "gl", "bullet", "bullet-egl"]
CAMERA_HELP = (
    "What draws the pictures: gl (OpenGL), bullet (slow, bare, anywhere), bullet-egl (bare, by OpenGL), or auto: gl "
    "where it works, else bullet."
)


def camera_here(choice: Choice) -> Literal["gl", "bullet", "bullet-egl"]:
    """The camera that a choice comes to on this machine; says so where auto is not gl. Raises EngineError."""
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
