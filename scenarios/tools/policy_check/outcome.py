"""What comes out of a check."""

from __future__ import annotations

from typing import Literal, NamedTuple

CheckEnded = Literal["passed", "warning", "failed", "does not apply"]


class CheckOutcome(NamedTuple):
    """An outcome, and why, in words."""

    outcome: CheckEnded
    words: str


def passed(words: str) -> CheckOutcome:
    return CheckOutcome("passed", words)


def doubted(words: str) -> CheckOutcome:
    """What may be right, and is to be looked at."""
    return CheckOutcome("warning", words)


def failed(words: str) -> CheckOutcome:
    return CheckOutcome("failed", words)


def inapplicable(words: str) -> CheckOutcome:
    return CheckOutcome("does not apply", words)
