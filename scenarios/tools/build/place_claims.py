"""Claims of a shipped suite that need its places and its expert.

They concern nets, one walkable path, gaps, and bitwise equal proofs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Final, NamedTuple

import numpy as np

from cosim.core.errors import CosimError
from cosim.place.barriers import prove_single_path
from cosim.place.street_map import Port, StreetMap
from cosim.spec.robot import robot_called
from cosim.spec.scenario import Place, Scenario, Suite
from cosim.spec.selection import STATIC
from scenarios.events import EVENT_KINDS
from scenarios.events.gates import gate_faults
from scenarios.places.nets import place
from scenarios.suites.decoys import DECOY
from scenarios.suites.fits import misfits
from scenarios.suites.lanes import LANES, free_lanes, standing_ground
from scenarios.suites.long_horizon import WAY_SPARE_M
from scenarios.suites.obstacles import Room, prove_gap
from scenarios.suites.proofs import Dropped, Proof, Proofs
from scenarios.suites.recipes import LONG_WAY
from scenarios.tools.build.proving import proved

PLACE_CLAIMS: Final = (
    "nets",
    "fits its place",
    "single path",
    "gaps",
    "lanes",
    "mirrors",
    "proofs to the bit",
)


class FalseClaim(NamedTuple):
    """Violated claim. words: message that begins with the name of the scenario."""

    claim: str
    words: str


class _Look(NamedTuple):
    """Task of a process. proofs: of the scenarios that are driven again."""

    where: Place
    scenarios: tuple[Scenario, ...]
    proofs: tuple[Proof, ...]


def sample_of(suite: Suite, count: int) -> list[Scenario]:
    """Return `count` scenarios of each structure, always the same ones of a suite."""
    rng = np.random.default_rng(int(suite.content_hash, 16) % 2**32)
    by_structure: dict[str, list[Scenario]] = {}
    for scenario in suite.scenarios:
        by_structure.setdefault(scenario.structure, []).append(scenario)
    return [
        those[int(i)]
        for those in by_structure.values()
        for i in rng.permutation(len(those))[:count]
    ]


def faults_in_places(
    scenarios: Sequence[Scenario], driven: Sequence[str], proofs: Proofs | None, jobs: int = 1
) -> Iterator[FalseClaim]:
    """Yield the violated claims of scenarios in their places.

    driven: names of the scenarios that the expert drives again.
    jobs: processes, one for each place. A place whose process dies is a fault.
    """
    known = {proof.scenario: proof for proof in proofs.proofs} if proofs is not None else {}
    there: dict[Place, list[Scenario]] = {}
    for scenario in scenarios:
        there.setdefault(scenario.place, []).append(scenario)
    looks = [
        _Look(
            where,
            tuple(those),
            tuple(known[s.id] for s in those if s.id in driven and s.id in known),
        )
        for where, those in there.items()
    ]
    if jobs == 1:
        for look in looks:
            yield from _look(look)
        return
    with ProcessPoolExecutor(jobs, get_context("spawn"), max_tasks_per_child=1) as pool:
        for look, future in [(look, pool.submit(_look, look)) for look in looks]:
            try:
                yield from future.result()
            except BrokenProcessPool:
                yield FalseClaim(
                    PLACE_CLAIMS[-1],
                    f"{look.scenarios[0].id}: a process died: check it alone, with --jobs 1",
                )


def _look(look: _Look) -> list[FalseClaim]:
    """Return all violated claims in one place."""
    try:
        _, street_map = place(look.where)
    except CosimError as error:
        return [FalseClaim("nets", f"{scenario.id}: {error}") for scenario in look.scenarios]
    faults = [
        FalseClaim("fits its place", words.removeprefix("scenario "))
        for words in misfits(look.scenarios, street_map)
    ]
    proofs = {proof.scenario: proof for proof in look.proofs}
    for scenario in look.scenarios:
        faults += [
            FalseClaim("single path", f"{scenario.id}: {words}")
            for words in ways_left(scenario, street_map)
        ]
        faults += [
            FalseClaim("gaps", f"{scenario.id}: {words}")
            for words in narrow_places(scenario, street_map)
        ]
        faults += [
            FalseClaim("lanes", f"{scenario.id}: {words}")
            for words in straight_lanes(scenario, street_map)
        ]
        faults += [
            FalseClaim("mirrors", f"{scenario.id}: {words}")
            for words in common_ways(scenario, street_map)
        ]
        if scenario.id in proofs:
            faults += [
                FalseClaim("proofs to the bit", f"{scenario.id}: {words}")
                for words in _driven(scenario, proofs)
            ]
    return faults


def ways_left(scenario: Scenario, street_map: StreetMap) -> Iterator[str]:
    """Yield why a long route has not exactly one walkable path to its goal."""
    if scenario.structure != LONG_WAY:
        return
    half_width_m = robot_called(scenario.robot).width_m / 2 + WAY_SPARE_M
    try:
        prove_single_path(
            street_map,
            scenario.route_line,
            scenario.barriers,
            _ports(scenario, street_map),
            half_width_m,
        )
    except CosimError as error:
        yield str(error)


def narrow_places(scenario: Scenario, street_map: StreetMap) -> Iterator[str]:
    """Yield where obstacles leave less than the width of the robot and half a metre.

    Without obstacles nothing is claimed.
    """
    if not scenario.obstacles:
        return
    try:
        prove_gap(scenario, street_map)
    except CosimError as error:
        yield str(error)


def straight_lanes(scenario: Scenario, street_map: StreetMap) -> Iterator[str]:
    """Yield the straight lanes that a reactive scenario leaves free from start to goal."""
    if scenario.structure != STATIC and scenario.structure not in EVENT_KINDS:
        return
    if free := free_lanes(scenario, street_map):
        where = ", ".join(f"{left_m:+.2f}" for left_m in free)
        yield f"{len(free)} of {LANES} straight lanes are free, {where} m to the left of the route"


def common_ways(scenario: Scenario, street_map: StreetMap) -> Iterator[str]:
    """Yield whether one way solves a scenario and the decoy that is its mirror, or none solves one.

    Both ways are as wide as the robot, among people who stand.
    """
    if scenario.structure not in EVENT_KINDS or scenario.decoy_of:
        return
    kind = EVENT_KINDS[scenario.structure]
    for event in scenario.events:
        if kind.blocked is None or not event.free_side:
            continue
        yield from gate_faults(kind, event, robot_called(scenario.robot).width_m)
        sides = [standing_ground(one, kind) for one in (event, kind.decoy_of(event))]
        room = Room(scenario, street_map)
        for people, name in zip(
            sides, (scenario.id, f"its decoy {scenario.id}{DECOY}"), strict=True
        ):
            if not room.passable(scenario.obstacles, people):
                yield f"{name}: people and obstacles leave no gap of {room.gap_m:.2f} m"
        if room.shares_way(scenario.obstacles, sides):
            yield "one way from start to goal is free both in it and in its decoy"


def _driven(scenario: Scenario, proofs: dict[str, Proof]) -> Iterator[str]:
    """Yield a message if the expert does not reach the same state again."""
    proof = proofs[scenario.id]
    again = proved(scenario, proof.expert)
    if isinstance(again, Dropped):
        yield f"is not solved any more: {again.reason} {again.details}"
    elif again.state_hash != proof.state_hash:
        yield (
            f"its state is {again.state_hash}, but was {proof.state_hash}: other code, or other "
            f"versions"
        )


def _ports(scenario: Scenario, street_map: StreetMap) -> list[Port]:
    """Return the ports of the strips of a route."""
    line = scenario.route_line
    poses = [line.at(float(s_m)) for s_m in np.arange(0.0, line.length_m, 0.5)]
    strips = dict.fromkeys(street_map.locate(pose.x_m, pose.y_m, 0.05).edge for pose in poses)
    return [Port(strip, end) for strip in strips if strip in street_map.strips for end in (0, 1)]
