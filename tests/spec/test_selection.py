"""Which scenarios of a suite are chosen, and by which options they were."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from cosim.core.errors import RunError, UsageError
from cosim.results.run_folder import RunFolder
from cosim.results.run_spec import RunSpec
from cosim.spec.scenario import Suite
from cosim.spec.selection import select_scenarios, selection_in_words
from scenarios.suites.catalog import load_suite
from tests.run_specs import spec_of


@pytest.fixture(scope="module")
def reactive() -> Suite:
    return load_suite("reactive")


def test_static_is_chosen_like_an_event(reactive: Suite) -> None:
    """The hundred scenarios without an event are found by their name, alone and beside an event."""
    assert {s.structure for s in select_scenarios(reactive, kinds=["static"])} == {"static"}
    assert len(select_scenarios(reactive, kinds=["static"])) == 100
    assert len(select_scenarios(reactive, kinds=["frontal", "static"])) == 200
    with pytest.raises(
        UsageError, match=r"unknown event 'statik'. Valid choices: .*, static. Did you mean static"
    ):
        select_scenarios(reactive, kinds=["statik"])
    with pytest.raises(UsageError, match=r"--event static: suite 'unit' has no events"):
        select_scenarios(load_suite("unit"), kinds=["static"])


CHOICES: dict[str, dict[str, object]] = {
    "900 of 900 (all)": {},
    "30 of 900 (--event frontal --episodes 30)": {"kinds": ["frontal"], "episodes": 30},
    "200 of 900 (--event frontal --event static)": {"kinds": ["static", "frontal"]},
    "180 of 900 (--split test)": {"split": "test"},
    "7 of 900 (--event static --split test --episodes 7)": {
        "kinds": ["static"],
        "split": "test",
        "episodes": 7,
    },
    "250 of 900 (--episodes 250)": {"episodes": 250},
    "2 of 900 (--scenario frontal-003 --scenario static-005)": {
        "ids": ["frontal-003", "static-005"]
    },
}


@pytest.mark.parametrize("words", CHOICES)
def test_the_options_that_chose_scenarios_are_found(reactive: Suite, words: str) -> None:
    """From the ids alone: the fewest options that choose these and no others."""
    chosen = select_scenarios(reactive, **CHOICES[words])  # type: ignore[arg-type]
    assert selection_in_words(reactive, [scenario.id for scenario in chosen]) == words


def test_a_run_resumed_with_another_selection_names_the_options(
    reactive: Suite, tmp_path: Path
) -> None:
    """How many scenarios the run has and how many are asked for, with the options of both, in place
    of two lists."""

    def spec(ids: list[str]) -> RunSpec:
        return msgspec.structs.replace(spec_of(reactive), scenarios=tuple(ids))

    every = [scenario.id for scenario in reactive.scenarios]
    some = [scenario.id for scenario in select_scenarios(reactive, kinds=["frontal"], episodes=30)]
    with RunFolder.create(tmp_path / "run", spec(some), reactive):
        pass
    with pytest.raises(RunError) as caught:
        RunFolder.resume(tmp_path / "run", spec(every), reactive)
    assert str(caught.value) == (
        f"{tmp_path / 'run'} is of another run: its choice of scenarios is 30 of 900 "
        f"(--event frontal --episodes 30), "
        "now asked for is 900 of 900 (all). Resume with the same command, or choose another --out."
    )
    apart = spec(some).apart(spec(every))
    assert apart is not None and (apart.mine, apart.theirs) == ("30", f"900, with {every[0]}")
