"""Pseudonyms of scenarios, which reveal nothing to a policy without the run's seed."""

from __future__ import annotations

import re

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.core.errors import UsageError
from cosim.spec.episode_id import episode_id_of, random_run_seed, seed_for
from cosim.spec.options import EpisodeOptions
from tests.support.shipped import all_shipped


@settings(max_examples=12)
@given(st.integers(0, 2**63 - 1), st.integers(0, 2**63 - 1))
def test_pseudonyms_of_two_runs_are_distinct(expected: int, other: int) -> None:
    """Names and seeds of all shipped scenarios are distinct within a run, and between runs of
    different seeds."""
    called = [episode_id_of(expected, scenario) for scenario in all_shipped()]
    assert len({name for name, _ in called}) == len(all_shipped()) == len(set(called))
    if expected != other:
        assert not {name for name, _ in called} & {
            episode_id_of(other, scenario).episode for scenario in all_shipped()
        }


def test_a_pseudonym_reveals_neither_event_nor_order() -> None:
    """It is twelve characters of a hash, and their order changes with the seed and is never the
    suite's."""
    orders = []
    for seed in range(6):
        names = [episode_id_of(seed, scenario).episode for scenario in all_shipped()]
        assert all(re.fullmatch("k[0-9a-f]{11}", name) for name in names)
        orders.append(tuple(sorted(range(len(names)), key=names.__getitem__)))
        of_event = [
            k for k, i in enumerate(orders[-1]) if all_shipped()[i].id.startswith("gesturing")
        ]
        assert len({k * 4 // len(names) for k in of_event}) == 4  # in every quarter of the run
    assert len(set(orders)) == 6 and tuple(range(len(all_shipped()))) not in orders


def test_a_pseudonym_is_stable_across_versions() -> None:
    """It depends on seed and scenario alone and is fixed here, so that another version can finish a
    run."""
    scenario = all_shipped()[0]
    assert episode_id_of(5, scenario) == episode_id_of(
        5, msgspec.structs.replace(scenario, robot="scout")
    )
    assert episode_id_of(5, scenario) != episode_id_of(
        5, msgspec.structs.replace(scenario, suite="other")
    )
    assert (
        seed_for("policy", 5, scenario)
        == episode_id_of(5, scenario).seed
        != seed_for("goal", 5, scenario)
    )


def test_a_run_draws_a_seed_that_cannot_be_guessed() -> None:
    """Each draw gives another seed, of 53 bits."""
    drawn = [random_run_seed() for _ in range(200)]
    assert (
        len(set(drawn)) == 200 and max(drawn) > 2**48 and all(0 <= seed < 2**53 for seed in drawn)
    )


@pytest.mark.parametrize("seed", [-1, 2**63], ids=["negative", "too-large"])
def test_an_invalid_seed_is_refused(seed: int) -> None:
    """It is refused with a reason before anything runs."""
    with pytest.raises(
        UsageError,
        match=f"a seed of {seed}: it must be a whole number from 0 to 9223372036854775807",
    ):
        EpisodeOptions(seed=seed)
