"""Report the progress of long tasks."""

from __future__ import annotations

from typing import Final, Protocol

_MIN_SHARE: Final = 0.02
"""Completed share below which the remaining time is not estimated."""
_MIN_S: Final = 5.0
"""Time in seconds below which the remaining time is not estimated."""


class Progress(Protocol):
    """Callback with the stage of a task and, if known, its completed share, 0 to 1."""

    def __call__(self, stage: str, share: float | None = None, /) -> None: ...


def ignore(*_: object) -> None:
    """Ignore the call; the default of callbacks."""


def time_left_s(share: float, since_s: float) -> float | None:
    """Return the estimated remaining time of a task in seconds, or None if it is too early.

    share: completed share, 0 to 1.
    since_s: time that it took, in seconds.
    """
    if share < _MIN_SHARE or since_s < _MIN_S:
        return None
    return since_s * (1.0 - share) / share
