"""From where an episode is looked at, and how large the picture is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cosim.core.errors import UsageError, unknown

if TYPE_CHECKING:
    from scenarios.viewing.look import Viewpoint


def view_of(name: str) -> Viewpoint:
    """The view called so. Raises UsageError with the valid names."""
    from scenarios.viewing.look import VIEWS

    for view in VIEWS:
        if view == name:
            return view
    raise unknown("view", name, VIEWS)


def size_of(text: str) -> tuple[int, int]:
    """Width and height in "1280x720". Raises UsageError."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdecimal() and 16 <= int(part) <= 4096 for part in parts):
        raise UsageError(f"--size '{text}': give width x height in pixels, each from 16 to 4096, like 1280x720")
    return int(parts[0]), int(parts[1])
