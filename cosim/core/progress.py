"""Report the progress of long tasks."""

from __future__ import annotations

from typing import Final, Protocol

_LEAST_SHARE: Final = 0.02
"""Of a smaller share the time of the rest is not estimated."""
_LEAST_S: Final = 5.0
"""In the first seconds of a task the time of the rest is not estimated."""


class Progress(Protocol):
    """Receives the stage of a task and, where it is known, the share of it that is done, 0 to 1."""

    def __call__(self, stage: str, share: float | None = None, /) -> None: ...


def ignore(*_: object) -> None:
    """Do nothing: the default of callbacks."""


def time_left_s(share: float, since_s: float) -> float | None:
    """Estimate how long the rest of a task takes, in seconds.

    share: what is done of it, 0 to 1.
    since_s: how long that took. Returns None when it is too early to say.
    """
    if share < _LEAST_SHARE or since_s < _LEAST_S:
        return None
    return since_s * (1.0 - share) / share
