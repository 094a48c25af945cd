"""What a long task says of itself while it runs."""

from __future__ import annotations

from typing import Protocol


class Tell(Protocol):
    """Takes in what is being done now, and which share of it, 0 to 1, where that is known."""

    def __call__(self, stage: str, share: float | None = None, /) -> None: ...


def untold(stage: str, share: float | None = None, /) -> None:
    """Nobody wants to know."""
