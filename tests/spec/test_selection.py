"""Selection of a suite's scenarios, and the options that describe a selection."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from cosim.core.errors import RunError, UsageError
from cosim.results.run_folder import RunFolder
from cosim.results.run_spec import RunSpec, Shard
from cosim.spec.episode_id import episode_id_of, seed_for
from cosim.spec.scenario import Suite
from cosim.spec.selection import scenario_pairs, select_scenarios, selection_in_words
from scenarios.suites.catalog import load_suite
from tests.run_specs import spec_of


@pytest.fixture(scope="module")
def reactive() -> Suite:
    return load_suite("reactive")


def test_static_is_chosen_like_an_event(reactive: Suite) -> None:
    """The hundred scenarios without an event are selected by name, alone and with an event."""
    assert {s.structure for s in select_scenarios(reactive, kinds=["static"])} == {"static"}
    assert len(select_scenarios(reactive, kinds=["static"])) == 100
    assert len(select_scenarios(reactive, kinds=["frontal", "static"])) == 300
    with pytest.raises(
        UsageError, match=r"unknown event 'statik'. Valid choices: .*, static. Did you mean static"
    ):
        select_scenarios(reactive, kinds=["statik"])
    with pytest.raises(UsageError, match=r"--event static: suite 'unit' has no events"):
        select_scenarios(load_suite("unit"), kinds=["static"])


CHOICES: dict[str, dict[str, object]] = {
    "1700 of 1700 (all)": {},
    "60 of 1700 (--event frontal --episodes 30)": {"kinds": ["frontal"], "episodes": 30},
    "300 of 1700 (--event frontal --event static)": {"kinds": ["static", "frontal"]},
    "340 of 1700 (--split test)": {"split": "test"},
    "7 of 1700 (--event static --split test --episodes 7)": {
        "kinds": ["static"],
        "split": "test",
        "episodes": 7,
    },
    "473 of 1700 (--episodes 250)": {"episodes": 250},
    "2 of 1700 (--scenario frontal-003 --scenario static-005)": {
        "ids": ["frontal-003", "static-005"]
    },
}


@pytest.mark.parametrize("words", CHOICES)
def test_the_options_that_chose_scenarios_are_found(reactive: Suite, words: str) -> None:
    """The fewest options that select exactly these scenarios are found from the ids."""
    chosen = select_scenarios(reactive, **CHOICES[words])  # type: ignore[arg-type]
    assert selection_in_words(reactive, [scenario.id for scenario in chosen]) == words


def test_a_run_resumed_with_another_selection_names_the_options(
    reactive: Suite, tmp_path: Path
) -> None:
    """The message has both numbers of scenarios and both sets of options, rather than two lists."""

    def spec(ids: list[str]) -> RunSpec:
        return msgspec.structs.replace(spec_of(reactive), scenarios=tuple(ids))

    every = [scenario.id for scenario in reactive.scenarios]
    some = [scenario.id for scenario in select_scenarios(reactive, kinds=["frontal"], episodes=30)]
    with RunFolder.create(tmp_path / "run", spec(some), reactive):
        pass
    with pytest.raises(RunError) as caught:
        RunFolder.resume(tmp_path / "run", spec(every), reactive)
    assert str(caught.value) == (
        f"{tmp_path / 'run'} is of another run: its choice of scenarios is 60 of 1700 "
        f"(--event frontal --episodes 30), "
        "and this command has 1700 of 1700 (all). Resume with the same command, or choose another --out."
    )
    difference = spec(some).difference_from(spec(every))
    assert difference is not None and (difference.mine, difference.theirs) == (
        "60",
        f"1700, with {every[0]}",
    )


def with_decoys_of(reactive: Suite) -> Suite:
    """Ten scenarios of four kinds, and decoys of all but `static` at the end."""
    few = [
        one
        for one in reactive.scenarios
        if one.id[-4:] in ("-001", "-002") and one.structure in _FEW
    ]
    decoys = [
        msgspec.structs.replace(one, id=f"{one.id}-decoy", decoy_of=one.id)
        for one in few
        if one.events
    ]
    return msgspec.structs.replace(reactive, scenarios=(*few, *decoys))


_FEW = ("frontal", "lateral", "gesturing", "obstructing", "static")
PAIRED_CHOICES: dict[str, dict[str, object]] = {
    "18 of 18 (all)": {},
    "10 of 18 (--no-decoys)": {"decoys": False},
    "4 of 18 (--event frontal)": {"kinds": ["frontal"]},
    "2 of 18 (--event frontal --no-decoys)": {"kinds": ["frontal"], "decoys": False},
    "2 of 18 (--event frontal --episodes 1)": {"kinds": ["frontal"], "episodes": 1},
    "2 of 18 (--event static)": {"kinds": ["static"]},
    "3 of 18 (--episodes 3 --no-decoys)": {"episodes": 3, "decoys": False},
    "1 of 18 (--scenario frontal-002-decoy)": {"ids": ["frontal-002-decoy"]},
    "2 of 18 (--scenario lateral-001 --scenario frontal-002-decoy)": {
        "ids": ["lateral-001", "frontal-002-decoy"]
    },
}


@pytest.mark.parametrize("words", PAIRED_CHOICES)
def test_decoys_are_chosen_with_their_scenarios(reactive: Suite, words: str) -> None:
    """Kind, number and split include them unless excluded, an id selects one, and the options are
    found from the ids."""
    suite = with_decoys_of(reactive)
    chosen = select_scenarios(suite, **PAIRED_CHOICES[words])  # type: ignore[arg-type]
    assert selection_in_words(suite, [scenario.id for scenario in chosen]) == words


def test_episodes_counts_pairs_wherever_their_decoys_are(reactive: Suite) -> None:
    """--episodes 3 selects three scenarios and their decoys in suite order, of which `static` has
    none."""
    suite = with_decoys_of(reactive)
    chosen = select_scenarios(suite, episodes=3)
    first = [one.id for one in suite.scenarios[:3]]
    decoys = [one.id for one in suite.scenarios if one.decoy_of in first]
    assert [one.id for one in chosen] == [*first, *decoys] and decoys
    with pytest.raises(UsageError, match="--no-decoys: only decoys of suite 'reactive' are chosen"):
        select_scenarios(suite, ["frontal-001-decoy"], decoys=False)


def test_shards_keep_pairs_together(reactive: Suite) -> None:
    """For any number of shards each scenario is in one, with its decoy."""
    pairs = scenario_pairs(with_decoys_of(reactive).scenarios)
    assert sorted(map(len, pairs)) == [1] * 2 + [2] * 8
    for of in (2, 3, 7):
        parts = [
            [one for pair in Shard(number, of).select(pairs) for one in pair]
            for number in range(1, of + 1)
        ]
        ids = [one.id for part in parts for one in part]
        assert len(ids) == len({*ids}) == 18
        assert all(
            one.decoy_of in {other.id for other in part}
            for part in parts
            for one in part
            if one.decoy_of
        )


def test_nothing_that_a_policy_gets_reveals_a_decoy(reactive: Suite) -> None:
    """Ids, seeds and order of a pair are independent: over many run seeds each puts the decoy first
    half the time."""
    pairs = [pair for pair in scenario_pairs(with_decoys_of(reactive).scenarios) if len(pair) == 2]
    pseudonyms = [
        [episode_id_of(seed, one) for one in pair] for seed in range(250) for pair in pairs
    ]
    drawn = [
        [[seed_for(purpose, seed, one) for one in pair] for seed in range(250) for pair in pairs]
        for purpose in ("policy", "goal", "odometry")
    ]
    assert drawn[0] == [[one.seed for one in pair] for pair in pseudonyms]
    for values in (pseudonyms, *drawn):
        decoy_first = sum(decoy < event for event, decoy in values)
        assert 900 < decoy_first < 1100
    assert all(len(one.episode) == 12 for pair in pseudonyms for one in pair)
