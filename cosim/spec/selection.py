"""Select scenarios of a suite by id, event, split and number; find options for a selection."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product
from typing import Final, get_args

from cosim.core.errors import UsageError, unknown
from cosim.spec.scenario import Scenario, Split, Suite

STATIC: Final = "static"
"""Structure of `reactive` scenarios without an event, selectable like an event kind."""
_MAX_NAMED: Final = 3
"""Maximum number of scenarios that are listed by name, if no other options select them."""


def select_scenarios(
    suite: Suite,
    ids: Sequence[str] = (),
    episodes: int | None = None,
    kinds: Sequence[str] = (),
    split: str | None = None,
    decoys: bool = True,
) -> tuple[Scenario, ...]:
    """Return the selected scenarios of a suite. Raises UsageError with the valid names.

    ids: ids of scenarios, without their decoys; none for all.
    episodes: number of scenarios, from the first; their decoys are selected too, not counted.
    kinds: event kinds, or `static`.
    split: val or test; None for both.
    decoys: whether decoys are selected.
    """
    by_id = {scenario.id: scenario for scenario in suite.scenarios}
    for scenario_id in ids:
        if scenario_id not in by_id:
            raise unknown("scenario", scenario_id, by_id)
    picked = [by_id[i] for i in dict.fromkeys(ids)] or list(suite.scenarios)
    if not decoys:
        picked = [s for s in picked if not s.decoy_of]
        if not picked:
            raise UsageError(
                f"--no-decoys: only decoys of suite '{suite.name}' are chosen: leave it out"
            )
    available = {kind: None for scenario in picked for kind in _kinds_of(scenario)}
    for kind in kinds:
        if kind not in available and not available:
            raise UsageError(
                f"--event {kind}: suite '{suite.name}' has no events among these scenarios: "
                f"leave it out"
            )
        if kind not in available:
            raise unknown("event", kind, available)
    if kinds:
        picked = [s for s in picked if not _kinds_of(s).isdisjoint(kinds)]
    if split is not None:
        picked = [s for s in picked if s.split == split]
        if not picked:
            raise UsageError(
                f"suite '{suite.name}' has no scenarios of split '{split}' among those chosen"
            )
    first = {s.id for pair in scenario_pairs(picked)[:episodes] for s in pair}
    return tuple(s for s in picked if s.id in first)


def scenario_pairs(scenarios: Sequence[Scenario]) -> list[tuple[Scenario, ...]]:
    """Return scenarios with their decoys behind them; a decoy alone if its scenario is missing."""
    groups: dict[str, list[Scenario]] = {s.id: [s] for s in scenarios if not s.decoy_of}
    for decoy in (s for s in scenarios if s.decoy_of):
        groups.setdefault(decoy.decoy_of, []).append(decoy)
    return [*map(tuple, groups.values())]


def selection_in_words(suite: Suite, ids: Sequence[str]) -> str:
    """Return how many scenarios of a suite are selected, and the options of `cosim run` for them.

    >>> from cosim.spec.scenario import City
    >>> one, other = (
    ...     Scenario(
    ...         id=name, suite="s", place=City(seed=0), seed=0, time_limit_s=9.0,
    ...         start=(0.0, 0.0, 0.0), goal=(9.0, 0.0), route=((0.0, 0.0), (9.0, 0.0)),
    ...     )
    ...     for name in "ab"
    ... )
    >>> selection_in_words(Suite(name="s", version="1", scenarios=(one, other)), ["a"])
    '1 of 2 (--episodes 1)'
    """
    words = " ".join(_options_for(suite, ids)) or (
        "all" if len(ids) == len(suite.scenarios) else "by --scenario"
    )
    return f"{len(ids)} of {len(suite.scenarios)} ({words})"


def _options_for(suite: Suite, ids: Sequence[str]) -> list[str]:
    """Return the fewest options that select exactly these scenarios; none if all are, or no options
    do."""
    picked = [scenario for scenario in suite.scenarios if scenario.id in {*ids}]
    each = [_kinds_of(scenario) for scenario in picked]
    known = [
        *dict.fromkeys(kind for scenario in suite.scenarios for kind in sorted(_kinds_of(scenario)))
    ]
    every = tuple(kind for kind in known if any(kind in kinds for kinds in each))
    common = [(kind,) for kind in known if all(kind in kinds for kinds in each)]
    no_decoys = (
        (False, True) if any(scenario.decoy_of for scenario in suite.scenarios) else (False,)
    )
    choices = product(
        (None, *get_args(Split)),
        ((), *common, every),
        (None, len(scenario_pairs(picked))),
        no_decoys,
    )
    for split, kinds, episodes, without in sorted(choices, key=lambda one: sum(map(bool, one))):
        try:
            found = select_scenarios(suite, (), episodes, kinds, split, not without)
        except UsageError:
            continue
        if {scenario.id for scenario in found} == {*ids}:
            return _as_options(kinds, split, episodes, without)
    return [f"--scenario {name}" for name in ids] if len(ids) <= _MAX_NAMED else []


def _as_options(
    kinds: Iterable[str], split: str | None, episodes: int | None, no_decoys: bool
) -> list[str]:
    options = [f"--event {kind}" for kind in kinds]
    options += [f"--split {split}"] if split else []
    options += [f"--episodes {episodes}"] if episodes else []
    return options + ["--no-decoys"] * no_decoys


def _kinds_of(scenario: Scenario) -> set[str]:
    """Return the names by which `--event` selects a scenario."""
    return {event.kind for event in scenario.events} or (
        {STATIC} if scenario.structure == STATIC else set()
    )
