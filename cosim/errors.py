"""The errors of the project, in one tree.

CosimError                what a user can mend: shown as one message, exit code 1
├── UsageError            a name or an option that does not exist: exit code 2
├── SpecError             a scenario, suite or place that contradicts itself (also a ValueError)
├── MapError              a street net that cannot be read or built
├── PolicyError           a policy that raised, or answered with something unusable
├── EngineError           SUMO, PyBullet or Zenoh failed or was misused
│   └── DirectorLost      the director of the event pedestrians did not answer
└── RunError              a run folder that is locked, broken or of another run
"""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

MOST_LISTED = 30
"""Of more valid choices than these, five are listed: those most like what was asked for, else the first."""


class CosimError(Exception):
    """Root of every error this project raises on purpose. The message says what to do."""


class UsageError(CosimError):
    """A name or option that does not exist; the message lists the valid choices."""


class SpecError(CosimError, ValueError):
    """A spec that contradicts itself or the place it stands in."""


class MapError(CosimError):
    """A street net that cannot be read, built or walked on."""


class PolicyError(CosimError):
    """A policy that raised, or whose answer is not a command."""


class EngineError(CosimError):
    """An engine (SUMO, PyBullet, Zenoh) that failed or was misused."""


class DirectorLost(EngineError):
    """The director of the event pedestrians did not answer in time."""


class RunError(CosimError):
    """A run folder that is in use, broken, or belongs to another run."""


def unknown(what: str, name: str, choices: Iterable[str]) -> UsageError:
    """The error for a `name` that is none of the `choices`, which it lists: unknown("suite", "x", ["unit"])."""
    valid = sorted(choices)
    if len(valid) > MOST_LISTED:
        near = get_close_matches(name, valid, n=5, cutoff=0.5)
        listed = ", ".join(sorted(near) or valid[:5])
        return UsageError(f"unknown {what} '{name}'. Valid choices: {len(valid)}, among them {listed}.")
    return UsageError(f"unknown {what} '{name}'. Valid choices: {', '.join(valid) or 'none'}.")
