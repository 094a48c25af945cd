"""Which camera draws: the option, and what it comes to on this machine."""

from __future__ import annotations

from typing import Literal

from cosim.cli.terminal.consoles import err

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
