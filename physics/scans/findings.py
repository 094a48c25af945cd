"""Findings: results of reading, cleaning and checking a scan, a sentence each."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from cosim.core.errors import MapError

Level = Literal["note", "warning", "refused"]
"""Weight of a finding. A scan with a refusal is not imported."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A sentence with the measured value and, unless it is a note, the remedy."""

    level: Level
    words: str

    def __str__(self) -> str:
        return self.words if self.level == "note" else f"{self.level}: {self.words}"


def note(words: str) -> Finding:
    """Return a finding that needs no action."""
    return Finding("note", words)


def warning(words: str) -> Finding:
    """Return a finding about a scan that is usable in spite of it."""
    return Finding("warning", words)


def refusal(words: str) -> Finding:
    """Return a finding that makes a scan unusable."""
    return Finding("refused", words)


def raise_refusals(findings: Iterable[Finding]) -> None:
    """Raise MapError with the first refusal, if there is one."""
    for finding in findings:
        if finding.level == "refused":
            raise MapError(finding.words)
