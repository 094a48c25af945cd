"""Building the shipped suites: candidates are drawn, and the expert proves each solvable before it is kept.

python -m scenarios.builders.build long-horizon OUT.json
python -m scenarios.builders.build reactive OUT.json --jobs 16
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Literal, NamedTuple

import msgspec
import typer

from cosim.core.errors import SpecError
from cosim.place.walk_graph import WalkGraph
from cosim.policies.load import load_policy
from cosim.records.record import Record
from cosim.spec.scenario import City, Scenario, Suite, content_hash, write_suite
from scenarios.builders import long_horizon, reactive
from scenarios.events import EVENT_KINDS
from scenarios.execution.places import place
from scenarios.execution.run import run_episode
from sumo_nets.city.seeds import shipped_cities

_CITIES = tuple(City(seed=seed) for seed in (11, 23, 37, 41))
_PER_CITY = 3
_REACTIVE_CITIES = 20
_TRIES_PER_SCENARIO = 6


SuiteName = Literal["long-horizon", "reactive"]


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


class Proved(NamedTuple):
    """A scenario that is kept. dropped: why earlier candidates were not."""

    scenario: Scenario
    proof: Proof
    dropped: list[str]


class _Recipe(NamedTuple):
    """How a suite is made. candidates: of the scenarios in one of its cities, told its number."""

    version: str
    description: str
    expert: str
    cities: tuple[City, ...]
    candidates: Callable[[City, int], Iterator[Candidates]]


def long_horizon_candidates(city: City, _number: int) -> Iterator[Candidates]:
    """A few ways in a city."""
    _, street_map = place(city)
    graph = WalkGraph(street_map)
    for number in range(_PER_CITY):
        name = f"lh-{city.seed:03d}-{number:02d}"
        draw = partial(long_horizon.build_long_horizon, city, street_map, graph, scenario_id=name)
        yield Candidates(name, number, draw)


def reactive_candidates(city: City, number: int) -> Iterator[Candidates]:
    """Every event in a city."""
    _, street_map = place(city)
    graph = WalkGraph(street_map)
    for kind in EVENT_KINDS.values():
        name = f"{kind.name}-{city.seed:03d}"
        yield Candidates(
            name, number, partial(reactive.build_reactive, kind, city, street_map, graph, scenario_id=name)
        )


RECIPES: Mapping[SuiteName, _Recipe] = MappingProxyType(
    {
        "long-horizon": _Recipe(
            version="0.3",
            description="Start and goal more than 100 m apart in generated cities; one walkable path; street life.",
            expert="route",
            cities=_CITIES,
            candidates=long_horizon_candidates,
        ),
        "reactive": _Recipe(
            version="0.2",
            description="10 to 20 m of way with one event of pedestrians on it, each event in the same cities.",
            expert="orca",
            cities=shipped_cities(_REACTIVE_CITIES),
            candidates=reactive_candidates,
        ),
    }
)


def proved(candidates: Candidates, expert: str) -> Proved:
    """The first candidate that the expert solves."""
    dropped: list[str] = []
    for attempt in range(_TRIES_PER_SCENARIO):
        seed = 1000 * attempt + candidates.number
        try:
            scenario = candidates.draw(seed)
        except SpecError as error:
            dropped.append(f"seed {seed}: {error}")
            continue
        record = run_episode(scenario, load_policy(expert)).record
        if record.status == "done" and record.measures["success"] == 1.0:
            return Proved(scenario, proof_of(scenario, record, expert), dropped)
        told = [f"{f.kind} {f.other_kind} at {f.route_s_m:.0f} m" for f in record.failures]
        dropped.append(f"seed {scenario.seed}: {record.status} {record.reason} {record.ended} {told}")
    raise SystemExit(f"{candidates.name}: the expert solved none of {_TRIES_PER_SCENARIO} candidates: {dropped}")


def proof_of(scenario: Scenario, record: Record, expert: str) -> Proof:
    """What a solved episode proves."""
    seconds = record.measures["time_s"] or 0.0
    return Proof(
        scenario.id, content_hash(scenario), expert, record.policy_version, record.state_hash, seconds
    )  # fmt: skip


def build_suite(
    name: SuiteName,
    out: Path,
    jobs: Annotated[int, typer.Option(min=1, help="Cities at a time, each in a process of its own.")] = 1,
) -> None:
    """Build a suite at OUT, its proofs beside it. The same suite comes of any number of jobs."""
    recipe = RECIPES[name]
    kept: list[Proved] = []
    with ProcessPoolExecutor(jobs, get_context("spawn"), max_tasks_per_child=1) as pool:
        for found in pool.map(_in_city, repeat(name), range(len(recipe.cities))):
            kept += found
            for scenario, proof, dropped in found:
                way = f"{scenario.route_line.length_m:.0f} m, {proof.time_s:.0f} s"
                print(f"{scenario.id}: {way}; dropped: {dropped}", flush=True)
    first = sum(not one.dropped for one in kept)
    print(f"{first} of {len(kept)} first candidates solved by '{recipe.expert}'")
    suite = Suite(
        name=name,
        version=recipe.version,
        description=recipe.description,
        scenarios=tuple(one.scenario for one in kept),
    )
    write_suite(suite, out)
    proofs = msgspec.json.encode([one.proof for one in kept])
    out.with_suffix(".proof.json").write_bytes(msgspec.json.format(proofs, indent=1) + b"\n")


def _in_city(name: SuiteName, number: int) -> list[Proved]:
    recipe = RECIPES[name]
    return [proved(one, recipe.expert) for one in recipe.candidates(recipe.cities[number], number)]


if __name__ == "__main__":
    typer.run(build_suite)
