"""Building the shipped suites: candidates are drawn, and the expert proves each solvable before it is kept.

python -m scenarios.builders.build long-horizon OUT.json
python -m scenarios.builders.build reactive OUT.json
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import msgspec

from cosim.core.errors import unknown
from cosim.place.walk_graph import WalkGraph
from cosim.policies.load import load_policy
from cosim.records.record import Record
from cosim.spec.events import GROUPS
from cosim.spec.scenario import City, Scenario, Suite, content_hash, write_suite
from scenarios.builders import long_horizon, reactive
from scenarios.execution.places import place
from scenarios.execution.run import run_episode
from sumo_nets.city.seeds import shipped_cities

CITY_SEEDS = (11, 23, 37, 41)
PER_CITY = 3
REACTIVE_CITIES = 20
TRIES_PER_SCENARIO = 6


class Proof(msgspec.Struct, frozen=True):
    """That a scenario is solvable: the expert came to its end without failure, with this state hash."""

    scenario: str
    scenario_hash: str
    expert: str
    expert_version: str
    state_hash: str
    time_s: float


class Candidates(NamedTuple):
    """The candidates of one scenario. number: seed of the first one; draw: from a seed to a candidate."""

    name: str
    number: int
    draw: Callable[[int], Scenario]


class _Recipe(NamedTuple):
    """How a suite is made. candidates: scenario by scenario, those of one place together: a place is read once."""

    version: str
    description: str
    expert: str
    candidates: Callable[[], Iterator[Candidates]]


def long_horizon_candidates() -> Iterator[Candidates]:
    """A few ways in each of a few cities."""
    for seed in CITY_SEEDS:
        city = City(seed=seed)
        _, street_map = place(city)
        graph = WalkGraph(street_map)
        for number in range(PER_CITY):
            name = f"lh-{seed:03d}-{number:02d}"
            yield Candidates(
                name, number, partial(long_horizon.build_long_horizon, city, street_map, graph, scenario_id=name)
            )


def reactive_candidates() -> Iterator[Candidates]:
    """Every event in each of the first shipped cities."""
    for number, city in enumerate(shipped_cities(REACTIVE_CITIES)):
        _, street_map = place(city)
        graph = WalkGraph(street_map)
        for kind in GROUPS:
            name = f"{kind}-{city.seed:03d}"
            yield Candidates(
                name, number, partial(reactive.build_reactive, kind, city, street_map, graph, scenario_id=name)
            )


RECIPES: Mapping[str, _Recipe] = MappingProxyType(
    {
        "long-horizon": _Recipe(
            version="0.2",
            description="Start and goal more than 100 m apart in generated cities; one walkable path; street life.",
            expert="route",
            candidates=long_horizon_candidates,
        ),
        "reactive": _Recipe(
            version="0.1",
            description="10 to 20 m of way with one event of pedestrians on it, each event in the same cities.",
            expert="orca",
            candidates=reactive_candidates,
        ),
    }
)


def proved(candidates: Candidates, expert: str) -> tuple[Scenario, Proof, list[str]]:
    """The first candidate that the expert solves, its proof, and why earlier ones were dropped."""
    dropped: list[str] = []
    for attempt in range(TRIES_PER_SCENARIO):
        scenario = candidates.draw(1000 * attempt + candidates.number)
        record = run_episode(scenario, load_policy(expert)).record
        if record.status == "done" and record.measures["success"] == 1.0:
            return scenario, proof_of(scenario, record, expert), dropped
        told = [f"{f.kind} {f.other_kind} at {f.route_s_m:.0f} m" for f in record.failures]
        dropped.append(f"seed {scenario.seed}: {record.status} {record.reason} {record.ended} {told}")
    raise SystemExit(f"{candidates.name}: the expert solved none of {TRIES_PER_SCENARIO} candidates: {dropped}")


def proof_of(scenario: Scenario, record: Record, expert: str) -> Proof:
    """What a solved episode proves."""
    seconds = record.measures["time_s"] or 0.0
    return Proof(
        scenario.id, content_hash(scenario), expert, record.policy_version, record.state_hash, seconds
    )  # fmt: skip


def build_suite(name: str, out: Path) -> None:
    """Build a suite at `out`, its proofs beside it."""
    if name not in RECIPES:
        raise unknown("suite", name, RECIPES)
    recipe = RECIPES[name]
    scenarios, proofs, redrawn = [], [], 0
    for candidates in recipe.candidates():
        scenario, proof, dropped = proved(candidates, recipe.expert)
        scenarios.append(scenario)
        proofs.append(proof)
        redrawn += bool(dropped)
        print(
            f"{scenario.id}: {scenario.route_line.length_m:.0f} m, {proof.time_s:.0f} s; dropped: {dropped}", flush=True
        )
    print(f"{len(scenarios) - redrawn} of {len(scenarios)} first candidates solved by '{recipe.expert}'")
    suite = Suite(name=name, version=recipe.version, description=recipe.description, scenarios=tuple(scenarios))
    write_suite(suite, out)
    out.with_suffix(".proof.json").write_bytes(msgspec.json.format(msgspec.json.encode(proofs), indent=1) + b"\n")


if __name__ == "__main__":
    build_suite(sys.argv[1], Path(sys.argv[2]))
