"""Anonymous episode ids and seeds for policies, derived from the run's seed.

Without the run's seed, a policy cannot infer the scenario, its events or its position in the suite.
"""

from __future__ import annotations

import hashlib
import secrets
from typing import Final, NamedTuple

import msgspec

from cosim.core.errors import UsageError
from cosim.spec.scenario import Scenario

_RANDOM_BITS: Final = 53
"""Bits of a random run seed: too many to guess, few enough for every JSON reader."""
_LARGEST_SEED: Final = 2**63 - 1
"""Largest seed of a run."""
_SEED_BYTES: Final = 4
"""Size of a derived seed in bytes."""


class EpisodeId(NamedTuple):
    """Id of an episode for its policy, and the policy's seed, 0 to 2^32 - 1."""

    episode: str
    seed: int


def episode_id_of(run_seed: int, scenario: Scenario) -> EpisodeId:
    """Return the id and seed of a scenario in a run. They depend only on run seed and scenario.

    >>> from scenarios.suites.catalog import load_suite
    >>> episode_id_of(1, load_suite("reactive").scenarios[0]).episode[0]
    'k'
    """
    return EpisodeId(
        "k" + _digest(run_seed, scenario, "episode").hex()[:11],
        seed_for("policy", run_seed, scenario),
    )


def seed_for(purpose: str, run_seed: int, scenario: Scenario) -> int:
    """Return the seed of random draws for one purpose in an episode, 0 to 2^32 - 1.

    Seeds of different purposes are independent.
    """
    return int.from_bytes(_digest(run_seed, scenario, purpose)[:_SEED_BYTES], "big")


def drives_second(run_seed: int, scenario: Scenario) -> bool:
    """Return whether a scenario is driven in the second half of a run with decoys.

    Of an event and its decoy exactly one is, drawn from the run's seed.
    """
    pair = msgspec.structs.replace(scenario, id=scenario.decoy_of or scenario.id)
    return (seed_for("half", run_seed, pair) % 2 == 1) != bool(scenario.decoy_of)


def random_run_seed() -> int:
    """Return a random seed for a run."""
    return secrets.randbits(_RANDOM_BITS)


def check_seed(seed: int | None) -> None:
    """Raise UsageError for an invalid run seed."""
    if seed is not None and not 0 <= seed <= _LARGEST_SEED:
        raise UsageError(f"a seed of {seed}: it must be a whole number from 0 to {_LARGEST_SEED}")


def _digest(run_seed: int, scenario: Scenario, purpose: str) -> bytes:
    """Return a hash keyed by the run's seed (RFC 7693)."""
    what = "\0".join((purpose, scenario.suite, scenario.id)).encode()
    return hashlib.blake2b(what, key=run_seed.to_bytes(8, "big"), digest_size=16).digest()
