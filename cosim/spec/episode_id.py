"""What a policy is told in place of a scenario's name and seed: drawn from the run's seed, so that
nobody who does not know that one can tell from them which scenario of a suite it is, what happens
in it, or where in the suite it stands."""

from __future__ import annotations

import hashlib
import secrets
from typing import Final, NamedTuple

from cosim.core.errors import UsageError
from cosim.spec.scenario import Scenario

_DRAWN_BITS: Final = 53
"""Of a run's own seed: too many to be tried through, and a number that every reader of JSON
keeps."""
_MOST: Final = 2**63 - 1
_SEED_BYTES: Final = 4


class Pseudonym(NamedTuple):
    """What an episode is called before its policy, and the seed of all that the policy draws, 0 to
    2^32 - 1."""

    episode: str
    seed: int


def pseudonym_of(run_seed: int, scenario: Scenario) -> Pseudonym:
    """The same for the same run seed and scenario, on any machine and in any order.

    >>> from scenarios.suites.catalog import load_suite
    >>> pseudonym_of(1, load_suite("reactive").scenarios[0]).episode[0]
    'k'
    """
    return Pseudonym(
        "k" + _digest(run_seed, scenario, "episode").hex()[:11],
        seed_for("policy", run_seed, scenario),
    )


def seed_for(purpose: str, run_seed: int, scenario: Scenario) -> int:
    """A seed, 0 to 2^32 - 1, of what is drawn in an episode for one purpose: of no other one
    anything can be told."""
    return int.from_bytes(_digest(run_seed, scenario, purpose)[:_SEED_BYTES], "big")


def drawn_seed() -> int:
    """The seed of a run that was given none: another one each time."""
    return secrets.randbits(_DRAWN_BITS)


def check_seed(seed: int | None) -> None:
    """Raises UsageError for what can be no run's seed."""
    if seed is not None and not 0 <= seed <= _MOST:
        raise UsageError(f"a seed of {seed}: it must be a whole number from 0 to {_MOST}")


def _digest(run_seed: int, scenario: Scenario, purpose: str) -> bytes:
    """Keyed by the run's seed (RFC 7693)."""
    what = "\0".join((purpose, scenario.suite, scenario.id)).encode()
    return hashlib.blake2b(what, key=run_seed.to_bytes(8, "big"), digest_size=16).digest()
