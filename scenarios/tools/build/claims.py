"""Claims of a shipped suite that need only its file and its proofs.

They concern counts, hashes, routes, spread and duplicates.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np

from cosim.results.go_on import overtaken_at_m
from cosim.spec.scenario import City, CityMap, Scenario, Suite, content_hash
from cosim.spec.selection import STATIC
from scenarios.events import EVENT_KINDS
from scenarios.suites.daylight import FOG_M, LOWEST_SUN_RAD, sun_rises_rad
from scenarios.suites.decoys import (
    differing_fields,
    has_decoy,
    least_pace_mps,
    must_give_way,
    people_in_obstacles,
    time_limit_s,
)
from scenarios.suites.exploits import ALL, Exploit, Share, scenario_kind
from scenarios.suites.lanes import THINGS
from scenarios.suites.long_horizon import LENGTH_SLACK_M
from scenarios.suites.proofs import Proofs, proofs_path
from scenarios.suites.reactive import WAY_M as REACTIVE_WAY_M
from scenarios.suites.reactive import event_share
from scenarios.suites.recipes import ALL_ROUTES_M, LONG_WAY, RECIPES, SCANS_ROUTE_M
from scenarios.suites.unit import STRUCTURES, TURN_RAD, WAY_M, turn_rad
from sumo_nets.maps.import_rules import WHEEL_PLACES

_APART_M: Final = 5.0
"""Least distance between the starts of two scenarios of one structure in one place, in metres. They
may be nearer if the scenarios lead elsewhere.
"""
_MAX_BYTES: Final = 3_000_000
"""Largest size of a suite's file and its proofs, in bytes."""
_EDGE_M: Final = 0.6
"""Largest deviation of a drawn length from the wanted range, in metres."""
_LENGTHS_APART_M: Final = 1.5
"""Largest difference between the lengths of one kind and of all, in metres: means and ranges."""
_THIRDS: Final = ("first third", "middle third", "last third")
_MIN_THIRD: Final = 0.2
_MIN_SIDE: Final = 0.4
_SHARE_EDGE: Final = 0.1
"""Largest deviation of a position from the range of shares, by which crosswalks are measured."""
_LIMIT_EDGE_S: Final = 1e-6
_PACE_EDGE_MPS: Final = 1e-6
_STRAIGHT_RAD: Final = math.radians(10.0)
_SPEEDS_MPS: Final = (1.1, 1.65)
_FEWEST_EVENTS: Final = 5
"""Least number of events of each kind on the long routes."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of claims that differ between suites.

    test_share: share of each structure that is test.
    route_m: shortest and longest long route; a third of this range is short, middle or long.
    all_routes_m: length of all long routes, None without a claim.
    signals_share: least share of long routes with signals.
    fewest_events: least number of events of each kind on long routes.
    side_share: least share of events from either side.
    crossed: whether each long route has a crossing and a barrier.
    """

    test_share: float = 0.2
    route_m: tuple[float, float] = (100.0, 600.0)
    all_routes_m: float | None = ALL_ROUTES_M
    signals_share: float = 0.25
    fewest_events: int = _FEWEST_EVENTS
    side_share: float = 0.35
    crossed: bool = True


LIMITS: Final[Mapping[str, Limits]] = MappingProxyType(
    {
        "scans": Limits(
            test_share=0.4,
            route_m=SCANS_ROUTE_M,
            all_routes_m=None,
            signals_share=0.0,
            fewest_events=0,
            side_share=0.0,
            crossed=False,
        )
    }
)
"""Limits by suite; others have the defaults. Five small scans have two places of test, no signals,
streets without a branch, and no room for every event.
"""


@dataclass(frozen=True)
class Read:
    """Suite with its proofs.

    proofs: None if they are missing or unreadable.
    path: None for a suite made in Python.
    exploit: its exploitability, None if it was not measured.
    """

    suite: Suite
    proofs: Proofs | None
    path: Path | None = None
    exploit: Exploit | None = None

    @property
    def limits(self) -> Limits:
        """Limits of the claims of this suite."""
        return LIMITS.get(self.suite.name, Limits())


def _counts(read: Read) -> Iterator[str]:
    """Check that each structure and split has the number of scenarios in the recipe, with its
    names.
    """
    slots = {slot.name: slot for slot in RECIPES[read.suite.name].slots}
    found = {scenario.id: scenario for scenario in read.suite.scenarios}
    yield from (f"{name}: is missing" for name in slots if name not in found)
    yield from (f"{name}: is none of the recipe's" for name in found if name not in slots)
    for name in slots.keys() & found.keys():
        slot, one = slots[name], found[name]
        where = one.place.seed if isinstance(one.place, City) else one.place.map
        wanted = slot.where.seed if isinstance(slot.where, City) else slot.where.map
        is_one, should = (one.structure, one.split, where), (slot.structure, slot.split, wanted)
        if is_one != should:
            yield f"{name}: is {is_one}, not {should}"


def _split(read: Read) -> Iterator[str]:
    """Check that a fifth of each structure, or the suite's share, is test, in places that val does
    not use.
    """
    wanted = read.limits.test_share
    for structure, those in _by(read.suite.scenarios, lambda s: s.structure).items():
        share = sum(s.split == "test" for s in those) / len(those)
        if abs(share - wanted) > 0.5 / len(those):
            yield f"{structure}: {share:.1%} is test, not {wanted:.0%}"
    val = {s.place.name for s in read.suite.scenarios if s.split == "val"}
    yield from (
        f"{s.id}: is test in {s.place.name}, where val is, too"
        for s in _test(read)
        if s.place.name in val
    )


def _test(read: Read) -> list[Scenario]:
    return [scenario for scenario in read.suite.scenarios if scenario.split == "test"]


def _hashes(read: Read) -> Iterator[str]:
    """Check that each place has one net hash in all scenarios, and the suite the hash that was
    proved.
    """
    nets: dict[str, set[str]] = {}
    for scenario in read.suite.scenarios:
        nets.setdefault(scenario.place.name, set()).add(scenario.place.net_hash)
        if not scenario.place.net_hash:
            yield f"{scenario.id}: its place has no hash"
    yield from (
        f"{name}: has {len(hashes)} nets" for name, hashes in nets.items() if len(hashes) > 1
    )
    if read.proofs is not None and read.proofs.suite_hash != read.suite.content_hash:
        yield (
            f"{read.suite.name}: is {read.suite.content_hash}, but {read.proofs.suite_hash} was "
            f"proved"
        )


def _proofs(read: Read) -> Iterator[str]:
    """Check that each scenario has a proof of its present state, by one version of the expert."""
    if read.proofs is None:
        yield f"{read.suite.name}: has no proofs that can be read"
        return
    proofs = {proof.scenario: proof for proof in read.proofs.proofs}
    for scenario in read.suite.scenarios:
        proof = proofs.pop(scenario.id, None)
        if proof is None:
            yield f"{scenario.id}: has no proof"
        elif proof.scenario_hash != content_hash(scenario):
            yield f"{scenario.id}: was changed since it was proved"
        elif not 0.0 < proof.time_s <= scenario.time_limit_s or not proof.state_hash:
            yield f"{scenario.id}: its proof has no time within the limit, or no state hash"
        elif any(
            room_m is not None and room_m < 0.0 for room_m in (proof.people_m, proof.obstacles_m)
        ):
            yield f"{scenario.id}: its proof has a contact"
    yield from (f"{name}: a proof of no scenario" for name in proofs)
    if len({(proof.expert, proof.expert_version) for proof in read.proofs.proofs}) > 1:
        yield f"{read.suite.name}: is proved by several experts"


def _lengths(read: Read) -> Iterator[str]:
    """Check lengths: 10 to 20 m in `unit`, 12 to 30 m in `reactive`; long routes more than 100 m,
    and 36.5 km +- 1 % in all. On scans, long routes have 60 to 150 m.

    All kinds of reactive scenarios have the same distribution of lengths.
    """
    for scenario in read.suite.scenarios:
        length_m = scenario.route_line.length_m
        low_m, high_m = _wanted_length_m(scenario, read.limits)
        if not low_m - _EDGE_M < length_m < high_m + _EDGE_M:
            yield f"{scenario.id}: is {length_m:.1f} m long"
    short = [scenario for scenario in read.suite.scenarios if _is_reactive(scenario)]
    yield from _other_lengths(short)
    routes_m = sum(s.route_line.length_m for s in read.suite.scenarios if s.structure == LONG_WAY)
    wanted_m = read.limits.all_routes_m
    if routes_m and wanted_m is not None and abs(routes_m / wanted_m - 1.0) > 0.01:
        yield (
            f"{read.suite.name}: its ways are {routes_m / 1000:.2f} km in all, not "
            f"{wanted_m / 1000:g} +- 1 %"
        )


def _other_lengths(scenarios: Sequence[Scenario]) -> Iterator[str]:
    """Yield the structures whose lengths are distributed otherwise than those of all."""
    lengths_m = {
        structure: [one.route_line.length_m for one in those]
        for structure, those in _by(scenarios, lambda s: s.structure).items()
    }
    every_m = [length_m for those in lengths_m.values() for length_m in those]
    measures: list[tuple[str, Callable[[list[float]], float]]] = [
        ("on average", lambda those: float(np.mean(those))),
        ("at least", min),
        ("at most", max),
    ]
    for structure, those_m in lengths_m.items():
        for words, measure in measures:
            if abs(measure(those_m) - measure(every_m)) > _LENGTHS_APART_M:
                yield (
                    f"{structure}: its ways are {measure(those_m):.1f} m long {words}, those of "
                    f"all kinds {measure(every_m):.1f} m"
                )


def _is_reactive(scenario: Scenario) -> bool:
    return scenario.structure == STATIC or scenario.structure in EVENT_KINDS


def _wanted_length_m(scenario: Scenario, limits: Limits) -> tuple[float, float]:
    if scenario.structure == LONG_WAY:
        low_m, high_m = limits.route_m
        return low_m, math.inf if limits.all_routes_m is not None else high_m + LENGTH_SLACK_M
    return REACTIVE_WAY_M if _is_reactive(scenario) else WAY_M


def _positions(read: Read) -> Iterator[str]:
    """Check that events are evenly spread over the positions that fit on their routes."""
    for kind, those in _by(_events_alone(read), lambda s: s.structure).items():
        found = []
        for scenario in those:
            share = event_share(scenario, EVENT_KINDS[kind])
            if not -_SHARE_EDGE <= share <= 1.0 + _SHARE_EDGE:
                yield f"{scenario.id}: its event does not fit where it is on the route"
            found.append(_THIRDS[min(max(int(3.0 * share), 0), 2)])
        yield from _shares(f"{kind}: positions in the", found, _THIRDS, _MIN_THIRD)


def _sides(read: Read) -> Iterator[str]:
    """Check that the free side and the side of walkers are left and right equally often."""
    for kind, those in _by(_events_alone(read), lambda s: s.structure).items():
        for what, sides in (
            ("come from the", [one.events[0].side for one in those]),
            ("free side on the", [one.events[0].free_side for one in those]),
        ):
            if any(sides):
                names = ["left" if side > 0 else "right" for side in sides]
                yield from _shares(f"{kind}: {what}", names, ("left", "right"), _MIN_SIDE)
        if EVENT_KINDS[kind].has_free_side:
            yield from (
                f"{one.id}: its event has no free side"
                for one in those
                if not one.events[0].free_side
            )


def _events_alone(read: Read) -> list[Scenario]:
    """Return the reactive scenarios with an event, without decoys."""
    return [
        one
        for one in read.suite.scenarios
        if one.structure in EVENT_KINDS and one.events and not one.decoy_of
    ]


def _obstacles(read: Read) -> Iterator[str]:
    """Check that reactive scenarios have 2 to 4 obstacles."""
    for one in read.suite.scenarios:
        if _is_reactive(one) and not THINGS[0] <= len(one.obstacles) <= THINGS[1]:
            yield f"{one.id}: has {len(one.obstacles)} obstacles, not {THINGS[0]} to {THINGS[1]}"


def _decoys(read: Read) -> Iterator[str]:
    """Check that each reactive scenario with an event has one decoy, equal but for its response."""
    decoys = _by([one for one in read.suite.scenarios if one.decoy_of], lambda s: s.decoy_of)
    for one in read.suite.scenarios:
        those = decoys.pop(one.id, [])
        if one.structure in EVENT_KINDS and has_decoy(one) and not those:
            yield f"{one.id}: has no decoy: build the suite again, with decoys"
        elif those and not has_decoy(one):
            yield f"{one.id}: has a decoy, but no event"
        for decoy in those if one.events else ():
            if different := differing_fields(one, decoy):
                yield (
                    f"{decoy.id}: differs from {one.id} in {', '.join(different)}: a decoy may "
                    f"differ in its event's free side or decoy, its id and its limits alone"
                )
    yield from (f"{those[0].id}: is the decoy of no scenario" for those in decoys.values())


def _people(read: Read) -> Iterator[str]:
    """Check that people of reactive scenarios and decoys stay at places without obstacles."""
    for one in read.suite.scenarios:
        yield from (f"{one.id}: {words}" for words in people_in_obstacles(one))


def _exclusive(read: Read) -> Iterator[str]:
    """Check that no motion solves both an event in which the robot must give way and its decoy.

    The rules of both are opposite at one speed. The robot alone ends their window, on the route:
    the same motion has the same window in both.
    """
    decoys = {one.decoy_of: one for one in read.suite.scenarios if one.decoy_of}
    for one in filter(must_give_way, read.suite.scenarios):
        if not one.go_on_mps:
            yield f"{one.id}: the robot need not give way: its go_on_mps is 0"
        elif one.id in decoys and (other := decoys[one.id].go_on_mps) != one.go_on_mps:
            yield (
                f"{one.id}: its go_on_mps is {one.go_on_mps:g}, that of its decoy {other:g}: "
                f"motions of a speed between them solve both or none"
            )
        last_m = one.route_line.length_m - one.goal_radius_m
        for event in one.events:
            end_m = overtaken_at_m(event, EVENT_KINDS[event.kind])
            if end_m is None:
                yield f"{one.id}: its person comes from the front and decides when it is passed"
            elif end_m > last_m:
                yield (
                    f"{one.id}: the robot is overtaken until {end_m:.1f} m, but may be at the "
                    f"goal at {last_m:.1f} m"
                )


def _limits(read: Read) -> Iterator[str]:
    """Check that the limits of short scenarios follow from their proofs."""
    proofs = {proof.scenario: proof for proof in read.proofs.proofs} if read.proofs else {}
    for one in read.suite.scenarios:
        proof = proofs.get(one.id)
        if proof is None or not one.ends_on_failure:
            continue
        limit_s = time_limit_s(one, proof.time_s)
        if one.time_limit_s < proof.time_s:
            yield (
                f"{one.id}: its time limit of {one.time_limit_s:g} s is below the expert's "
                f"{proof.time_s:g} s: it should be {limit_s:g} s"
            )
        elif abs(one.time_limit_s - limit_s) > _LIMIT_EDGE_S:
            yield f"{one.id}: its time limit is {one.time_limit_s:g} s, not {limit_s:g}"
        pace_mps = least_pace_mps(one, proof.passing_mps)
        if any(event.decoy for event in one.events) and not pace_mps:
            yield f"{one.id}: its proof has no speed past the person, as decoys need"
        elif abs(one.go_on_mps - pace_mps) > _PACE_EDGE_MPS:
            yield f"{one.id}: its go_on_mps is {one.go_on_mps:g}, not {pace_mps:g}"


def _structures(read: Read) -> Iterator[str]:
    """Check that each scenario matches its structure.

    It is straight, round a corner, over a crosswalk without signals, or straight with its own
    event.
    """
    for one in read.suite.scenarios:
        turn = abs(turn_rad(one.route_line))
        kinds = [event.kind for event in one.events]
        says = {
            "straight": turn <= _STRAIGHT_RAD and not one.crossings and not kinds,
            "curve": TURN_RAD[0] <= turn <= TURN_RAD[1] and not one.crossings and not kinds,
            "crosswalk": len(one.crossings) == 1 and not one.crossings[0].signalised and not kinds,
            STATIC: not kinds and turn <= _STRAIGHT_RAD,
            LONG_WAY: not read.limits.crossed or (bool(one.crossings) and bool(one.barriers)),
        }
        if not says.get(one.structure, kinds == [one.structure] and turn <= _STRAIGHT_RAD):
            yield (
                f"{one.id}: is no '{one.structure}': turns {math.degrees(turn):.0f} degrees, "
                f"events {kinds}"
            )
        if one.ends_on_failure != (one.structure != LONG_WAY):
            yield f"{one.id}: {'ends' if one.ends_on_failure else 'does not end'} on a failure"


def _street_life(read: Read) -> Iterator[str]:
    """Check that short scenarios have only people of the event, and long ones people, vehicles and
    signals.
    """
    for one in read.suite.scenarios:
        crowd = one.crowd
        alone = (
            not crowd.persons and not crowd.vehicles and not crowd.residents and not crowd.density
        )
        if crowd.added or alone != (one.structure != LONG_WAY):
            yield f"{one.id}: {crowd.persons} people and {crowd.vehicles} vehicles around it"
    if routes := [one for one in read.suite.scenarios if one.structure == LONG_WAY]:
        with_signals = sum(any(c.signalised for c in one.crossings) for one in routes)
        if with_signals < read.limits.signals_share * len(routes):
            yield f"{with_signals} of {len(routes)} ways have signals: at least a quarter should"


def _events(read: Read) -> Iterator[str]:
    """Check that long routes have every kind of event several times.

    All events have walking speeds of the paper and come from either side.
    """
    events = [(one, event) for one in read.suite.scenarios for event in one.events]
    for one, event in events:
        if not _SPEEDS_MPS[0] <= event.speed_mps <= _SPEEDS_MPS[1]:
            yield f"{one.id}: {event.kind} walks at {event.speed_mps:.2f} m/s"
    if any(one.structure == LONG_WAY for one in read.suite.scenarios):
        times = Counter(event.kind for _, event in events)
        for kind in EVENT_KINDS:
            if times[kind] < (fewest := read.limits.fewest_events):
                yield f"{kind}: {times[kind]} times on the long ways, fewer than {fewest}"
    if events:
        yield from _shares(
            "events from",
            [("left", "right")[e.side < 0] for _, e in events],
            ("left", "right"),
            read.limits.side_share,
        )


def _spread(read: Read) -> Iterator[str]:
    """Check that lengths, turns, hours, seasons and clouds are spread, some with fog, all in
    daylight.
    """
    whole = read.suite.scenarios
    for one in whole:
        rises = sun_rises_rad(one.light.hour, one.light.day_of_year, one.light.latitude_deg)
        if (
            rises < LOWEST_SUN_RAD
            or (one.light.fog_m or math.inf) < FOG_M[0]
            or one.light.exposure_ev
        ):
            yield f"{one.id}: is too dark or foggy to be seen"
    hours = [
        ("morning", "noon", "afternoon")[int(np.digitize(one.light.hour, (10.0, 14.0)))]
        for one in whole
    ]
    yield from _shares("hours in the", hours, ("morning", "noon", "afternoon"), 0.15)
    seasons = [
        ("winter", "spring", "summer", "autumn")[(one.light.day_of_year + 30) // 92 % 4]
        for one in whole
    ]
    yield from _shares("days in", seasons, ("winter", "spring", "summer", "autumn"), 0.12)
    skies = [("clear", "broken", "grey")[min(int(3.0 * one.light.cloud_cover), 2)] for one in whole]
    yield from _shares("skies that are", skies, ("clear", "broken", "grey"), 0.2)
    foggy = sum(one.light.fog_m is not None for one in whole) / len(whole)
    if not 0.04 <= foggy <= 0.3:
        yield f"{foggy:.1%} of the scenarios have fog, not 4 to 30 %"
    for structure in (*STRUCTURES[:2], LONG_WAY):
        those = [one for one in whole if one.structure == structure]
        low, high = read.limits.route_m if structure == LONG_WAY else WAY_M
        thirds = np.linspace(low, high, 4)[1:3]
        sizes = [
            ("short", "middle", "long")[int(np.digitize(s.route_line.length_m, thirds))]
            for s in those
        ]
        yield from _shares(f"{structure}: ways that are", sizes, ("short", "middle", "long"), 0.15)
    turns = [
        ("left", "right")[turn_rad(one.route_line) < 0.0]
        for one in whole
        if one.structure == STRUCTURES[1]
    ]
    yield from _shares("curves to the", turns, ("left", "right"), 0.3)


def _shares(what: str, found: Sequence[str], wanted: Sequence[str], least: float) -> Iterator[str]:
    """Yield the wanted values that are rarer than a share."""
    for name in wanted if found else ():
        if (share := found.count(name) / len(found)) < least:
            yield f"{what} {name}: {share:.1%}, less than {least:.0%}"


def _duplicates(read: Read) -> Iterator[str]:
    """Check that no two scenarios of a structure are on one spot. Crops of one net count as one
    place.
    """
    whole = [one for one in read.suite.scenarios if not one.decoy_of]
    groups = _by(whole, lambda s: f"{s.structure} {_ground(s)}")
    for those in groups.values():
        for a, b in itertools.combinations(those, 2):
            if on_one_spot(a, b):
                yield f"{b.id}: is on the spot of {a.id}"


def on_one_spot(a: Scenario, b: Scenario) -> bool:
    """Return whether the starts and the goals of two scenarios of one place are near each other."""
    return math.dist(a.start[:2], b.start[:2]) < _APART_M and math.dist(a.goal, b.goal) < _APART_M


def _ground(scenario: Scenario) -> str:
    """Return the place to which the coordinates of a scenario refer."""
    if isinstance(scenario.place, CityMap) and scenario.place.map in WHEEL_PLACES:
        return WHEEL_PLACES[scenario.place.map].net
    return scenario.place.name


def _size(read: Read) -> Iterator[str]:
    """Check that the files of suite and proofs are small."""
    if read.path is not None:
        files = [path for path in (read.path, proofs_path(read.path)) if path.exists()]
        if (size := sum(path.stat().st_size for path in files)) > _MAX_BYTES:
            yield (
                f"{read.path.name}: {size / 1e6:.1f} MB with its proofs, more than "
                f"{_MAX_BYTES / 1e6:g}"
            )


def _by(scenarios: Sequence[Scenario], key: Callable[[Scenario], str]) -> dict[str, list[Scenario]]:
    groups: dict[str, list[Scenario]] = {}
    for scenario in scenarios:
        groups.setdefault(key(scenario), []).append(scenario)
    return groups


def _exploitability(read: Read) -> Iterator[str]:
    """Check that a stored exploitability is of this suite, and that its shares are those of its
    episodes on test.
    """
    exploit, suite = read.exploit, read.suite
    if exploit is None:
        return
    if exploit.suite_hash != suite.content_hash:
        yield f"{suite.name}: is {suite.content_hash}, but {exploit.suite_hash} was searched"
        return
    scenarios = {one.id: one for one in suite.scenarios}
    test = [one for one in _test(read) if not one.decoy_of]
    for one in exploit.found:
        events = {s.id for s in test if one.kind in (ALL, scenario_kind(s))}
        decoys = {s.id for s in suite.scenarios if s.decoy_of in events}
        driven = {episode.scenario: episode for episode in one.episodes}
        if driven.keys() != events | decoys or len(driven) != len(one.episodes):
            yield f"{one.kind}: its schedule was not driven on each test scenario once"
            continue
        solved = {name for name, episode in driven.items() if episode.solved}
        valid = {name for name, episode in driven.items() if episode.status != "invalid"}
        sr = Share(len(solved & events), len(valid & events))
        pairs = [(scenarios[name].decoy_of, name) for name in decoys]
        pairs = [pair for pair in pairs if valid.issuperset(pair)]
        d = Share(sum(solved.issuperset(pair) for pair in pairs), len(pairs)) if decoys else None
        if (sr, d) != (one.sr, one.d):
            yield f"{one.kind}: its shares are not those of its episodes on test"


CLAIMS: Final[Mapping[str, Callable[[Read], Iterator[str]]]] = MappingProxyType(
    {
        "counts": _counts,
        "val and test": _split,
        "hashes": _hashes,
        "proofs": _proofs,
        "lengths": _lengths,
        "structures": _structures,
        "street life": _street_life,
        "events": _events,
        "positions": _positions,
        "sides": _sides,
        "obstacles": _obstacles,
        "decoys": _decoys,
        "people": _people,
        "exclusive": _exclusive,
        "limits": _limits,
        "spread": _spread,
        "duplicates": _duplicates,
        "size": _size,
        "exploitability": _exploitability,
    }
)
"""Checks by name. Each yields one line for each fault, beginning with the scenario's name if it
concerns one.
"""
