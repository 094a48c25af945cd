"""Building the shipped suites: candidates are drawn, and the expert proves each solvable before it is kept.

python -m scenarios.build long-horizon OUT.json
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec

from cosim.policies.load import load_policy
from cosim.scenario import City, Scenario, Suite, content_hash, write_suite
from cosim.walks import WalkGraph
from scenarios.assemble import place
from scenarios.long_horizon import build
from scenarios.run import episode

CITY_SEEDS = (11, 23, 37, 41)
PER_CITY = 3
EXPERT = "route"
TRIES_PER_SCENARIO = 6


class Proof(msgspec.Struct, frozen=True):
    """That a scenario is solvable: the expert reached its goal without failure, with this state hash."""

    scenario: str
    scenario_hash: str
    expert: str
    expert_version: str
    state_hash: str
    time_s: float


def proved(city: City, number: int, name: str) -> tuple[Scenario, Proof, list[str]]:
    """The first candidate that the expert solves, its proof, and why earlier ones were dropped."""
    _, street_map = place(city)
    graph = WalkGraph(street_map)
    dropped: list[str] = []
    for attempt in range(TRIES_PER_SCENARIO):
        scenario = build(city, street_map, graph, 1000 * attempt + number, name)
        record = episode(scenario, load_policy(EXPERT)).record
        if record.status == "done" and record.measures["success"] == 1.0:
            seconds = record.measures["time_s"] or 0.0
            proof = Proof(name, content_hash(scenario), EXPERT, record.policy_version, record.state_hash, seconds)
            return scenario, proof, dropped
        told = [f"{f.kind} {f.other_kind} at {f.route_s_m:.0f} m" for f in record.failures]
        dropped.append(f"seed {scenario.seed}: {record.status} {record.reason} {record.ended} {told}")
    raise SystemExit(f"{name}: the expert solved none of {TRIES_PER_SCENARIO} candidates: {dropped}")


def candidates() -> Iterator[tuple[City, int, str]]:
    """What the long-horizon suite is made of: city, number within it, id."""
    for seed in CITY_SEEDS:
        for number in range(PER_CITY):
            yield City(seed=seed), number, f"lh-{seed:03d}-{number:02d}"


def main(out: Path) -> None:
    """Build the long-horizon suite at `out`, its proofs beside it."""
    scenarios, proofs = [], []
    for city, number, name in candidates():
        scenario, proof, dropped = proved(city, number, name)
        scenarios.append(scenario)
        proofs.append(proof)
        length_m = scenario.route_line.length_m
        print(f"{name}: {length_m:.0f} m, {len(scenario.events)} events, {proof.time_s:.0f} s; dropped: {dropped}")
    suite = Suite(
        name="long-horizon",
        version="0.1",
        description="Start and goal more than 100 m apart in generated cities; one walkable path; street life.",
        scenarios=tuple(scenarios),
    )
    write_suite(suite, out)
    out.with_suffix(".proof.json").write_bytes(msgspec.json.format(msgspec.json.encode(proofs), indent=1) + b"\n")


if __name__ == "__main__":
    main(Path(sys.argv[2]))
