"""Outcome of a check."""

from __future__ import annotations

from typing import Literal, NamedTuple

CheckEnded = Literal["passed", "warning", "failed", "does not apply"]


class CheckOutcome(NamedTuple):
    """Outcome of a check, with its reason."""

    outcome: CheckEnded
    words: str


def passed(words: str) -> CheckOutcome:
    return CheckOutcome("passed", words)


def doubted(words: str) -> CheckOutcome:
    """Return the outcome of a check that may be right and needs a look."""
    return CheckOutcome("warning", words)


def failed(words: str) -> CheckOutcome:
    return CheckOutcome("failed", words)


def inapplicable(words: str) -> CheckOutcome:
    return CheckOutcome("does not apply", words)
