"""`cosim suite check`: a suite that keeps all claims, and for each claim a suite that breaks it."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest

from cosim.core.geometry import Polyline
from cosim.place.walk_graph import WalkGraph
from cosim.spec.events import Event
from cosim.spec.obstacle import Obstacle
from cosim.spec.scenario import (
    Barrier,
    City,
    CrowdSpec,
    RouteCrossing,
    Scenario,
    Suite,
    content_hash,
    read_suite,
)
from cosim.spec.schedule import Schedule
from cosim.spec.selection import select_scenarios
from scenarios.events import EVENT_KINDS
from scenarios.places.nets import place
from scenarios.suites.catalog import SUITES, load_suite, with_crowd
from scenarios.suites.daylight import drawn_daylight
from scenarios.suites.decoys import DECOY, decoy_of, least_pace_mps, limited, must_give_way
from scenarios.suites.exploits import ALL, Exploit, FoundSchedule, Share
from scenarios.suites.long_horizon import build_long_horizon
from scenarios.suites.proofs import Dropped, Proof, Proofs, read_proofs, write_proofs
from scenarios.suites.reactive import Wanted, event_range_m
from scenarios.suites.recipes import LONG_WAY, RECIPES, Slot
from scenarios.suites.unit import STRUCTURES, TURN_RAD, build_unit, turn_rad
from scenarios.tools.build.build_suite import build_suite
from scenarios.tools.build.claims import CLAIMS, Read
from scenarios.tools.build.place_claims import faults_in_places, narrow_places, sample_of, ways_left
from sumo_nets.city.store import TEST_SEEDS, VAL_SEEDS
from sumo_nets.maps.import_rules import WHEEL_PLACES
from sumo_nets.maps.map_store import about_map, known_maps
from tests.conftest import Cosim

SMALL = City(seed=1, size_m=500.0)
EXPERT_S = 9.0
EXPERT_MPS = 1.2
BIN = Obstacle(kind="bin", x_m=0.0, y_m=3.0, heading_rad=0.0)
replace = msgspec.structs.replace


@cache
def valid_suite(name: str) -> Read:
    """Return a suite of the recipe's slots that keeps every claim of its file, without a map, with
    proofs."""
    kinds = [*EVENT_KINDS]
    slots = {slot.name: slot for slot in RECIPES[name].slots}
    scenarios: list[Scenario] = []
    for number, slot in enumerate(slots.values()):
        if slot.decoy_of:
            made = decoy_of(scenarios[-1])
        else:
            made = scenario_of_slot(slot, slots.get(slot.like, slot), number, kinds)
        if must_give_way(made):
            made = replace(made, go_on_mps=least_pace_mps(decoy_of(made), EXPERT_MPS))
        scenarios.append(limited(made, EXPERT_S, EXPERT_MPS))
    suite = Suite(name=name, version="1", scenarios=tuple(scenarios))
    return Read(suite, proofs_of(suite))


def scenario_of_slot(slot: Slot, like: Slot, number: int, kinds: list[str]) -> Scenario:
    """Return a scenario that fits its slot. like: the slot whose scenario it repeats, or the slot
    itself."""
    rng = np.random.default_rng(number)
    long = slot.structure == LONG_WAY
    wanted = like.wanted
    length_m = slot.length_m if long else float(rng.uniform(10.0, 20.0))
    length_m = length_m if wanted is None else wanted.length_m
    x_m = 100.0 * number
    route = np.column_stack([x_m + np.linspace(0.0, length_m, 21), np.zeros(21)])
    if slot.structure == "curve":
        side = 1.0 if number % 6 < 3 else -1.0
        route[11:] = route[10] + np.column_stack(
            [np.zeros(10), side * np.linspace(0.5, 5.0, 10) * length_m / 10.0]
        )
    line = Polyline(np.round(route, 3))
    names = (
        kinds[number % 8 : number % 8 + 1]
        if long
        else [slot.structure]
        if slot.structure in kinds
        else []
    )
    crossing = RouteCrossing(
        id="c", enter_s_m=3.0, leave_s_m=8.0, signalised=long and number % 2 == 0
    )
    barrier = Barrier(x_m=x_m, y_m=9.0, heading_rad=0.0, length_m=3.0, strip="s", end=0)
    return Scenario(
        id=slot.name,
        suite=slot.suite,
        place=replace(slot.where, net_hash="net"),
        seed=slot.number,
        start=(*line.points[0].tolist(), 0.0),
        goal=tuple(line.points[-1].tolist()),
        route=tuple((x, y) for x, y in line.points.tolist()),
        crossings=(crossing,) if long or slot.structure == "crosswalk" else (),
        barriers=(barrier,) if long else (),
        obstacles=() if wanted is None else (BIN, BIN),
        events=tuple(event_of(kind, number, wanted) for kind in names),
        crowd=CrowdSpec() if long else CrowdSpec(persons=0, vehicles=0),
        time_limit_s=3000.0 if long else 60.0,
        ends_on_failure=not long,
        light=drawn_daylight(rng, number),
        split=slot.split,
        structure=slot.structure,
    )


def event_of(kind: str, number: int, wanted: Wanted | None = None) -> Event:
    """Return an event of a kind, where its slot wants it."""
    row = EVENT_KINDS[kind]
    event = Event(
        id="e0",
        kind=kind,
        x_m=0.0,
        y_m=0.0,
        heading_rad=0.0,
        route_s_m=5.0,
        half_width_m=1.5,
        side=1 if number // 9 % 2 else -1,
        speed_mps=1.3,
    )
    if wanted is None:
        return event
    trigger_m = None if row.trigger_m is None else 0.6 * row.trigger_m
    half_length_m = 3.0 if row.layout is None else 0.0
    if row.layout is None or trigger_m is None:
        low_m, high_m = 6.5, wanted.length_m - 5.3
    else:
        low_m, high_m = event_range_m(trigger_m, row.layout.after_m, wanted.length_m)
    return replace(
        event,
        route_s_m=low_m + wanted.share * max(high_m - low_m, 0.0),
        half_length_m=half_length_m,
        trigger_m=trigger_m,
        side=wanted.side,
        free_side=wanted.free_side if row.has_free_side else 0,
    )


def proofs_of(suite: Suite) -> Proofs:
    proofs = tuple(
        Proof(
            scenario=s.id,
            scenario_hash=content_hash(s),
            expert="orca",
            expert_version="1",
            state_hash="00",
            time_s=EXPERT_S,
            passing_mps=EXPERT_MPS if s.decoy_of else None,
        )
        for s in suite.scenarios
    )
    return Proofs(
        suite=suite.name,
        suite_hash=suite.content_hash,
        expert="orca 1",
        first=len(proofs),
        dropped={},
        proofs=proofs,
    )


@pytest.mark.parametrize("claim", CLAIMS)
@pytest.mark.parametrize("name", RECIPES)
def test_a_suite_that_keeps_its_claims_has_no_faults(name: str, claim: str) -> None:
    """Each claim of each recipe can be kept."""
    assert list(CLAIMS[claim](valid_suite(name))) == []


def with_scenario(read: Read, index: int, **changed: object) -> Read:
    """Return the suite with one scenario changed, and proofs of the changed scenario."""
    scenarios = list(read.suite.scenarios)
    scenarios[index] = replace(scenarios[index], **changed)
    return with_scenarios(read, scenarios)


def with_all_changed(read: Read, change: Callable[[Scenario], Scenario]) -> Read:
    return with_scenarios(read, [change(s) for s in read.suite.scenarios])


def with_scenarios(read: Read, scenarios: list[Scenario]) -> Read:
    suite = replace(read.suite, scenarios=tuple(scenarios))
    return Read(suite, proofs_of(suite))


def with_proof(read: Read, **changed: object) -> Read:
    """Return the suite with its first proof changed."""
    assert read.proofs is not None
    first, *others = read.proofs.proofs
    return Read(read.suite, replace(read.proofs, proofs=(replace(first, **changed), *others)))


def straightened(scenario: Scenario) -> Scenario:
    """Return the scenario with its route on one line."""
    length_m = scenario.route_line.length_m
    x_m = scenario.start[0]
    ends = ((x_m, 0.0), (x_m + length_m, 0.0))
    return replace(scenario, start=(*ends[0], 0.0), goal=ends[1], route=ends)


def shortened(scenario: Scenario, share: float) -> Scenario:
    """Return the scenario with its route cut to a share of it."""
    points = [
        scenario.route_line.at(float(s)).xy
        for s in np.linspace(0.0, share * scenario.route_line.length_m, 21)
    ]
    route = tuple((float(x), float(y)) for x, y in points)
    bare = {"crossings": (), "events": (), "go_on_mps": 0.0}
    return replace(scenario, goal=route[-1], route=route, **bare)


def bent(scenario: Scenario) -> dict[str, object]:
    """Return a route with a turn of 20 degrees in the middle."""
    (x_m, y_m), half_m = scenario.start[:2], 0.5 * scenario.route_line.length_m
    turn_rad = math.radians(20.0)
    middle = (x_m + half_m, y_m)
    goal = (middle[0] + half_m * math.cos(turn_rad), y_m + half_m * math.sin(turn_rad))
    return {"route": ((x_m, y_m), middle, goal), "goal": goal}


def with_events_at(scenario: Scenario, s_m: float) -> Scenario:
    """Return the scenario with its events at an arc length."""
    return replace(scenario, events=tuple(replace(e, route_s_m=s_m) for e in scenario.events))


def with_sides(scenario: Scenario, **sides: int) -> Scenario:
    """Return the scenario with its events on other sides."""
    return replace(scenario, events=tuple(replace(e, **sides) for e in scenario.events))


def on_spot_of(read: Read, index: int, other: int) -> Read:
    """Return the suite with a scenario moved onto another's spot."""
    occupied = read.suite.scenarios[other]
    fields = {
        name: getattr(occupied, name)
        for name in ("place", "start", "goal", "route", "crossings", "events")
    }
    return with_scenario(read, index, **fields)


@cache
def broken_suites() -> dict[str, tuple[str, Read, str]]:
    """Return suites with one claim broken, the claim, and words of the fault."""
    unit, reactive, long = map(valid_suite, ("unit", "reactive", "long-horizon"))
    curve = next(i for i, s in enumerate(unit.suite.scenarios) if s.structure == "curve")
    crosswalk = next(i for i, s in enumerate(unit.suite.scenarios) if s.structure == "crosswalk")
    night = replace(unit.suite.scenarios[0].light, hour=23.0)
    first = reactive.suite.scenarios[0]
    lateral = next(i for i, s in enumerate(reactive.suite.scenarios) if s.id == "lateral-001-decoy")
    static = next(i for i, s in enumerate(reactive.suite.scenarios) if s.structure == "static")
    overtaken = next(i for i, s in enumerate(reactive.suite.scenarios) if s.id == "overtaking-001")
    return {
        "one-missing": (
            "counts",
            with_scenarios(unit, list(unit.suite.scenarios[1:])),
            "is missing",
        ),
        "one-of-another-structure": (
            "counts",
            with_scenario(unit, 0, structure="curve"),
            "not ('straight'",
        ),
        "one-elsewhere": (
            "counts",
            with_scenario(unit, 0, place=City(seed=99, net_hash="net")),
            "not ('straight', 'val', 1)",
        ),
        "all-val": (
            "val and test",
            with_all_changed(unit, lambda s: replace(s, split="val")),
            "is test, not 20%",
        ),
        "test-where-val-is": (
            "val and test",
            with_scenario(unit, 0, split="test"),
            "where val is, too",
        ),
        "no-net-hash": ("hashes", with_scenario(unit, 0, place=City(seed=1)), "has no hash"),
        "two-nets-of-a-place": (
            "hashes",
            with_scenario(unit, 0, place=City(seed=1, net_hash="other")),
            "has 2 nets",
        ),
        "another-was-proved": ("hashes", Read(unit.suite, reactive.proofs), "was proved"),
        "another-was-searched": (
            "exploitability",
            Read(unit.suite, unit.proofs, exploit=exploit_for("f" * 16)),
            "was searched",
        ),
        "not-driven-on-test": (
            "exploitability",
            Read(unit.suite, unit.proofs, exploit=exploit_for(unit.suite.content_hash)),
            "was not driven on each test scenario",
        ),
        "no-proofs": ("proofs", Read(unit.suite, None), "has no proofs"),
        "a-scenario-changed-since": (
            "proofs",
            with_proof(unit, scenario_hash="other"),
            "was changed since",
        ),
        "a-proof-missing": ("proofs", with_proof(unit, scenario="nobody"), "has no proof"),
        "a-proof-that-touches": ("proofs", with_proof(unit, obstacles_m=-0.1), "has a contact"),
        "a-proof-too-slow": ("proofs", with_proof(unit, time_s=61.0), "no time within the limit"),
        "two-experts": ("proofs", with_proof(unit, expert="route"), "several experts"),
        "too-short": (
            "lengths",
            with_scenarios(unit, [shortened(unit.suite.scenarios[0], 0.4)]),
            "m long",
        ),
        "not-so-far-in-all": (
            "lengths",
            with_all_changed(long, lambda s: shortened(s, 0.95)),
            "34.67 km in all",
        ),
        "a-curve-straightened": (
            "structures",
            with_all_changed(unit, straightened),
            "is no 'curve'",
        ),
        "a-straight-way-bent": (
            "structures",
            with_scenario(unit, curve, structure="straight"),
            "is no 'straight'",
        ),
        "an-event-round-a-bend": (
            "structures",
            with_scenario(reactive, 0, **bent(first)),
            "is no 'obstructing': turns 20 degrees",
        ),
        "a-crosswalk-with-signals": (
            "structures",
            with_scenario(
                unit,
                crosswalk,
                crossings=(RouteCrossing(id="c", enter_s_m=3.0, leave_s_m=8.0, signalised=True),),
            ),
            "is no 'crosswalk'",
        ),
        "another-event": (
            "structures",
            with_scenario(reactive, 0, events=(event_of("frontal", 1),)),
            "is no 'obstructing'",
        ),
        "somebody-in-static": (
            "structures",
            with_scenario(reactive, static, events=(event_of("frontal", 1),)),
            "is no 'static'",
        ),
        "a-long-way-without-barriers": (
            "structures",
            with_scenario(long, 0, barriers=()),
            "is no 'route'",
        ),
        "goes-on-after-a-failure": (
            "structures",
            with_scenario(unit, 0, ends_on_failure=False),
            "does not end",
        ),
        "kinds-of-other-lengths": (
            "lengths",
            with_all_changed(
                reactive, lambda s: shortened(s, 0.8) if s.structure == "lateral" else s
            ),
            "lateral: its ways are 16.8 m long on average",
        ),
        "always-at-the-end": (
            "positions",
            with_all_changed(reactive, lambda s: with_events_at(s, s.route_line.length_m - 3.0)),
            "lateral: positions in the first third: 0.0%",
        ),
        "an-event-before-its-trigger": (
            "positions",
            with_scenario(reactive, 0, events=(replace(first.events[0], route_s_m=2.0),)),
            "does not fit where it is",
        ),
        "all-free-on-the-left": (
            "sides",
            with_all_changed(reactive, lambda s: with_sides(s, free_side=1)),
            "queueing: free side on the right: 0.0%",
        ),
        "all-come-from-the-left": (
            "sides",
            with_all_changed(reactive, lambda s: with_sides(s, side=1)),
            "lateral: come from the right: 0.0%",
        ),
        "no-free-side": (
            "sides",
            with_scenario(reactive, 0, events=(replace(first.events[0], free_side=0),)),
            "has no free side",
        ),
        "one-obstacle": (
            "obstacles",
            with_scenario(reactive, 0, obstacles=(BIN,)),
            "has 1 obstacles",
        ),
        "no-decoys": (
            "decoys",
            with_scenarios(reactive, [s for s in reactive.suite.scenarios if not s.decoy_of]),
            "has no decoy",
        ),
        "a-decoy-elsewhere": (
            "decoys",
            with_scenario(reactive, 1, obstacles=(BIN, BIN, BIN)),
            "differs from obstructing-001 in obstacles",
        ),
        "a-decoy-that-is-its-event": (
            "decoys",
            with_scenario(reactive, 1, events=first.events),
            "differs from obstructing-001 in events",
        ),
        "a-decoy-of-static": (
            "decoys",
            with_scenario(reactive, 1, decoy_of="static-001"),
            "has a decoy, but no event",
        ),
        "a-limit-below-the-experts-time": (
            "limits",
            with_scenario(unit, 0, time_limit_s=8.0),
            "its time limit of 8 s is below the expert's 9 s",
        ),
        "another-time-limit": (
            "limits",
            with_scenario(unit, 0, time_limit_s=60.0),
            "is 60 s, not 16.5",
        ),
        "another-limit-of-a-decoy": (
            "limits",
            with_scenario(reactive, 1, time_limit_s=16.5),
            "is 16.5 s, not 14.7",
        ),
        "no-go-on-rule": (
            "limits",
            with_scenario(reactive, lateral, go_on_mps=0.0),
            "is 0, not 0.72",
        ),
        "no-rule-to-give-way": (
            "exclusive",
            with_scenario(reactive, overtaken, go_on_mps=0.0),
            "need not give way",
        ),
        "a-person-inside-an-obstacle": (
            "people",
            with_scenario(reactive, 1, obstacles=(replace(BIN, y_m=-1.0), replace(BIN, y_m=1.0))),
            "stays 0.30 m inside an obstacle",
        ),
        "another-speed-than-the-decoys": (
            "exclusive",
            with_scenario(reactive, overtaken, go_on_mps=0.9),
            "its go_on_mps is 0.9, that of its decoy 0.72",
        ),
        "a-window-that-people-end": (
            "exclusive",
            with_scenario(
                reactive,
                overtaken,
                events=(replace(reactive.suite.scenarios[overtaken].events[0], trigger_m=2.0),),
            ),
            "comes from the front",
        ),
        "a-window-beyond-the-goal": (
            "exclusive",
            with_scenario(reactive, overtaken, goal_radius_m=5.5),
            "may be at the goal",
        ),
        "walkers-in-a-reactive-one": (
            "street life",
            with_scenario(reactive, 0, crowd=CrowdSpec(persons=12)),
            "12 people",
        ),
        "an-empty-street-on-a-long-way": (
            "street life",
            with_scenario(long, 0, crowd=CrowdSpec(persons=0, vehicles=0)),
            "0 people and 0 vehicles",
        ),
        "a-crowd-that-was-asked-for": (
            "street life",
            Read(with_crowd(long.suite, persons=9), long.proofs),
            "9 people",
        ),
        "no-signals": (
            "street life",
            with_all_changed(long, lambda s: replace(s, crossings=())),
            "0 of 105 ways have signals",
        ),
        "a-runner": (
            "events",
            with_scenario(
                reactive, 0, events=(replace(event_of("obstructing", 1), speed_mps=2.0),)
            ),
            "walks at 2.00 m/s",
        ),
        "a-kind-is-missing-on-long-ways": (
            "events",
            with_all_changed(
                long, lambda s: replace(s, events=tuple(e for e in s.events if e.kind != "lateral"))
            ),
            "lateral: 0 times",
        ),
        "all-from-one-side": (
            "events",
            with_all_changed(
                reactive, lambda s: replace(s, events=tuple(replace(e, side=1) for e in s.events))
            ),
            "events from right",
        ),
        "night": ("spread", with_scenario(unit, 0, light=night), "too dark"),
        "thick-fog": (
            "spread",
            with_scenario(unit, 0, light=replace(night, hour=12.0, fog_m=40.0)),
            "foggy",
        ),
        "always-noon": (
            "spread",
            with_all_changed(unit, lambda s: replace(s, light=replace(night, hour=12.0))),
            "morning: 0.0%",
        ),
        "never-fog": (
            "spread",
            with_all_changed(unit, lambda s: replace(s, light=replace(s.light, fog_m=None))),
            "0.0% of the scenarios have fog",
        ),
        "all-of-one-length": (
            "spread",
            with_all_changed(unit, lambda s: shortened(s, 10.5 / s.route_line.length_m)),
            "long: 0.0%",
        ),
        "the-same-spot-twice": (
            "duplicates",
            on_spot_of(unit, 3, 0),
            "is on the spot of straight-001",
        ),
    }


def exploit_for(suite_hash: str) -> Exploit:
    """Return an exploitability with a schedule that was not driven."""
    schedule = Schedule(name="blind-all")
    shares = {"val_sr": Share(0, 0), "val_d": None, "sr": Share(0, 0), "d": None}
    found = FoundSchedule(
        kind=ALL,
        objective="sr",
        goal="final_point",
        seed=0,
        budget=1,
        evaluations=1,
        schedule=schedule,
        kinds={},
        episodes=(),
        **shares,
    )
    return Exploit(suite="unit", suite_hash=suite_hash, found=(found,))


def test_a_broken_claim_is_found() -> None:
    """A suite with one claim broken has a fault of that claim with the expected words."""
    for name, (claim, read, words) in broken_suites().items():
        assert any(words in fault for fault in CLAIMS[claim](read)), name


def test_every_claim_of_the_file_is_broken_once() -> None:
    """Each claim has a suite that breaks it; size has a test of its own."""
    assert {claim for claim, _, _ in broken_suites().values()} | {"size"} == set(CLAIMS)


def test_a_large_file_is_found(tmp_path: Path) -> None:
    """More than 3 MB of suite and proofs is a fault."""
    path = tmp_path / "unit.json"
    path.write_bytes(b" " * 3_000_001)
    (fault,) = CLAIMS["size"](Read(valid_suite("unit").suite, valid_suite("unit").proofs, path))
    assert "3.0 MB" in fault


def test_the_recipes_have_the_documented_sizes() -> None:
    """They have 330, 1700, 105 and 115 scenarios, the documented shares of test, eleven real
    places, and 36.5 km."""
    counts = {name: len(recipe.slots) for name, recipe in RECIPES.items()}
    assert counts == {"unit": 330, "reactive": 1700, "long-horizon": 105, "scans": 115}
    for name, recipe in RECIPES.items():
        fifths = 2 if name == "scans" else 1
        assert sum(slot.split == "test" for slot in recipe.slots) * 5 == fifths * len(recipe.slots)
        assert len({slot.name for slot in recipe.slots}) == len(recipe.slots)
    assert not set(VAL_SEEDS) & set(TEST_SEEDS) and len(WHEEL_PLACES) == 11
    assert math.isclose(
        sum(slot.length_m for slot in RECIPES["long-horizon"].slots), 36_500.0, abs_tol=5.0
    )
    statics = [slot for slot in RECIPES["reactive"].slots if slot.like]
    assert len(statics) == 100 and {slot.structure for slot in statics} == {"static"}
    decoys = [slot for slot in RECIPES["reactive"].slots if slot.decoy_of]
    assert len(decoys) == 800 and all(slot.name == slot.decoy_of + DECOY for slot in decoys)


def test_scenarios_are_chosen_by_split() -> None:
    """`--split test` keeps the scenarios of test, and `val` those of val."""
    assert {s.split for s in select_scenarios(valid_suite("unit").suite, split="test")} == {"test"}
    assert len(select_scenarios(valid_suite("unit").suite, split="val")) == 264


def test_added_street_life_is_marked() -> None:
    """A requested crowd changes version and hash of a suite, and each scenario is marked."""
    busy = with_crowd(valid_suite("reactive").suite, persons=12, vehicles=8)
    assert (
        busy.version == "1-persons12-vehicles8"
        and busy.content_hash != valid_suite("reactive").suite.content_hash
    )
    assert all(s.crowd.added and s.crowd.persons == 12 for s in busy.scenarios)


def test_real_places_are_known_by_name() -> None:
    """Each of the eleven is a listed map whose file is installed by the SUMO package."""
    known = known_maps()
    for name, one_place in WHEEL_PLACES.items():
        assert known[name].origin == "sumo" and one_place.path.is_file()


def test_proofs_survive_their_file(tmp_path: Path) -> None:
    """Written proofs are read back equal, and dropped candidates are counted by reason."""
    assert valid_suite("unit").proofs is not None
    first, *others = valid_suite("unit").proofs.proofs
    dropped = (
        Dropped(0, "collision with object", "at 3.0 m"),
        Dropped(1000, "collision with object", "at 9.1 m"),
    )
    written = write_proofs(
        tmp_path / "unit.json", "unit", "00", [replace(first, dropped=dropped), *others]
    )
    assert read_proofs(tmp_path / "unit.json") == written
    assert written.dropped == {"collision with object": 2} and written.first == len(others)


@pytest.mark.parametrize("structure", STRUCTURES)
def test_a_unit_scenario_matches_its_structure(structure: str) -> None:
    """Drawn scenarios are 10 to 20 m long without people, with a bend for a curve and one crossing
    for a crosswalk."""
    _, street_map = place(SMALL)
    graph = WalkGraph(street_map)
    drawn = [
        build_unit(structure, SMALL, street_map, graph, seed, f"u-{seed}") for seed in range(4)
    ]  # type: ignore[arg-type]
    again = build_unit(structure, SMALL, street_map, graph, 0, "u-0")  # type: ignore[arg-type]
    assert again == drawn[0]
    for scenario in drawn:
        assert 10.0 <= scenario.route_line.length_m <= 20.0
        assert scenario.ends_on_failure and scenario.time_limit_s == 60.0
        assert scenario.crowd.persons == scenario.crowd.vehicles == 0 and not scenario.events
        assert (abs(turn_rad(scenario.route_line)) >= TURN_RAD[0]) == (structure == "curve")
        assert len(scenario.crossings) == (structure == "crosswalk")


def test_a_long_way_has_the_requested_length() -> None:
    """Lengths are within three metres, though routes cut corners."""
    _, street_map = place(SMALL)
    for length_m in (150.0, 260.0):
        drawn = build_long_horizon(
            SMALL, street_map, WalkGraph(street_map), 3, "long", length_m=length_m
        )
        assert abs(drawn.route_line.length_m - length_m) <= 3.0


@pytest.fixture(scope="module")
def way() -> Scenario:
    """Return a long way in a small city."""
    _, street_map = place(SMALL)
    return build_long_horizon(
        SMALL, street_map, WalkGraph(street_map), 3, "lh-small", length_m=150.0
    )


def test_a_second_path_is_found(way: Scenario) -> None:
    """With its barriers one path leads to the goal, and without one of them another is open."""
    _, street_map = place(SMALL)
    assert list(ways_left(way, street_map)) == []
    for number in range(len(way.barriers)):
        fewer = way.barriers[:number] + way.barriers[number + 1 :]
        if list(ways_left(replace(way, barriers=fewer), street_map)):
            break
    else:
        pytest.fail("no barrier is needed")
    claims = {fault.claim for fault in faults_in_places([replace(way, barriers=fewer)], [], None)}
    assert claims == {"single path"}


def test_a_narrow_gap_is_found(way: Scenario) -> None:
    """Obstacles across the sidewalk leave no gap, and those that were drawn do."""
    _, street_map = place(SMALL)
    assert list(narrow_places(way, street_map)) == []
    x_m, y_m, heading_rad = way.route_line.at(30.0)
    aside = [
        (x_m - left_m * math.sin(heading_rad), y_m + left_m * math.cos(heading_rad))
        for left_m in (-2, -1, 0, 1, 2)
    ]
    wall = tuple(
        Obstacle(kind="box", x_m=x, y_m=y, heading_rad=heading_rad + math.pi / 2 - math.pi, form=2)
        for x, y in aside
    )
    (words,) = narrow_places(replace(way, obstacles=wall), street_map)
    assert "no gap" in words


def test_another_net_and_a_missing_crossing_are_found(way: Scenario) -> None:
    """A scenario of another net, and one whose crossing is not on its map, have faults."""
    other = replace(way, place=replace(way.place, net_hash="other"))
    assert {fault.claim for fault in faults_in_places([other], [], None)} == {"nets"}
    astray = replace(way, crossings=(replace(way.crossings[0], id="nowhere"),))
    assert "fits its place" in {fault.claim for fault in faults_in_places([astray], [], None)}


def test_a_sample_has_every_structure() -> None:
    """A sample has the same number of each, and is the same at every call."""
    sample = sample_of(valid_suite("reactive").suite, 2)
    assert sample == sample_of(valid_suite("reactive").suite, 2) and len(sample) == 2 * 9
    assert len({s.structure for s in sample}) == 9


@pytest.mark.engine
def test_a_build_resumes_and_its_proofs_hold(tmp_path: Path, cosim: Cosim) -> None:
    """A candidate whose process died twice is dropped, a second build repeats nothing, and a wrong
    state in a proof is found."""
    out = tmp_path / "unit.json"
    lines: list[str] = []
    parts = out.with_suffix(".parts")
    parts.mkdir()
    (parts / "straight-001.trying").write_text('{"dropped": [], "begun": 2}')
    suite, proofs = build_suite(
        "unit", out, progress=lambda line, *_: lines.append(line), only=["straight-001"]
    )
    (proof,) = proofs.proofs
    assert proof.dropped == (Dropped(0, "its process died"),) and suite.scenarios[0].seed == 1000
    assert proofs.dropped == {"its process died": 1} and "its process died" in lines[0]
    modified = (parts / "straight-001.json").stat().st_mtime_ns
    assert build_suite("unit", out, only=["straight-001"])[0] == suite == read_suite(out)
    assert (parts / "straight-001.json").stat().st_mtime_ns == modified
    done = cosim("suite", "check", str(out), "--sample", "1", "--drive", "0")
    assert done.returncode == 1 and "curve-001: is missing" in done.stdout
    write_proofs(out, "unit", suite.content_hash, [replace(proof, state_hash="00")])
    (fault,) = faults_in_places(suite.scenarios, ["straight-001"], read_proofs(out))
    assert fault.claim == "proofs to the bit" and "its state is" in fault.words
    (parts / "made-by.txt").write_text("another version")
    refused = cosim("suite", "build", "unit", str(out), "--only", "straight-001")
    assert refused.returncode == 2 and "delete it and build again" in refused.stderr


@pytest.mark.parametrize("name", SUITES)
def test_the_shipped_suites_keep_their_claims(name: str) -> None:
    """Files and proofs of the shipped suites have no faults."""
    path = SUITES[name]
    read = Read(load_suite(name), read_proofs(path), path)
    assert {
        claim: faults for claim, of_claim in CLAIMS.items() if (faults := list(of_claim(read)))
    } == {}


@pytest.mark.engine
@pytest.mark.parametrize("name", [name for name in SUITES if name != "scans"])
def test_a_sample_of_each_shipped_suite_is_valid_on_its_map(name: str) -> None:
    """Net, route, gaps and proof of one scenario hold; `cosim suite check --whole` checks all."""
    suite = load_suite(name)
    short = [s for s in sample_of(suite, 1) if s.structure != LONG_WAY][:1]
    picked = short or sorted(suite.scenarios, key=lambda s: s.route_line.length_m)[:1]
    driven = [s.id for s in short]
    assert list(faults_in_places(picked, driven, read_proofs(SUITES[name]))) == []


def test_a_real_place_states_its_source() -> None:
    """A crop is imported from the net of the SUMO package on first use, with its licences."""
    about = about_map("ingolstadt-1")
    assert about.source == "ingolstadt.net.xml.gz" and any(
        "OpenStreetMap" in words for words in about.licences
    )
