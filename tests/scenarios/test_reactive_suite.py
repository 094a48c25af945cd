"""Reactive scenarios: routes, gates, obstacles in every lane, decoys and their limits."""

from __future__ import annotations

import itertools
import math
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest
import shapely
from shapely.geometry import Point

from cosim.core.errors import SpecError, UsageError
from cosim.core.geometry import Pose
from cosim.place.walk_graph import WalkGraph
from cosim.policies.schedule.cheats import CHEATS
from cosim.spec.obstacle import Obstacle, footprint
from cosim.spec.robot import COURIER, SCOUT
from cosim.spec.scenario import City, Scenario, Suite, read_suite
from scenarios.events import EVENT_KINDS
from scenarios.places.nets import place
from scenarios.suites.catalog import SUITES, load_suite
from scenarios.suites.decoys import DECOY, decoy_of, differing_fields, limited
from scenarios.suites.gate_fences import drawn_gate
from scenarios.suites.lanes import ENDS_M, free_lanes
from scenarios.suites.obstacles import prove_gap
from scenarios.suites.proofs import Dropped, read_proofs
from scenarios.suites.reactive import Wanted, build_reactive, event_share
from scenarios.suites.recipes import RECIPES, recipe_of
from scenarios.tools.build.build_suite import build_suite
from scenarios.tools.build.claims import CLAIMS, Read
from scenarios.tools.build.place_claims import common_ways, faults_in_places, straight_lanes
from scenarios.tools.build.proving import accepted
from scenarios.tools.exploit import measure
from scenarios.tools.exploit.evaluate import drive
from tests.conftest import Cosim

SMALL = City(seed=1, size_m=500.0)
WANTED = Wanted(19.0, 0.7, -1, 1)
replace = msgspec.structs.replace


@cache
def reactive_scenario(kind: str, seed: int = 0) -> Scenario:
    """Return a scenario of a kind with the wanted length, position and sides."""
    _, street_map = place(SMALL)
    graph = WalkGraph(street_map)
    return build_reactive(EVENT_KINDS[kind], SMALL, street_map, graph, seed, kind, wanted=WANTED)


@pytest.mark.parametrize("kind", EVENT_KINDS)
def test_a_reactive_scenario_is_as_wanted_and_no_straight_lane_is_free(kind: str) -> None:
    """Length, position and sides are those of its slot; 2 to 4 obstacles block nine lanes, leave
    the gap, and are clear of start and goal."""
    _, street_map = place(SMALL)
    scenario = reactive_scenario(kind)
    (event,) = scenario.events
    assert scenario.route_line.length_m == pytest.approx(WANTED.length_m, abs=0.01)
    assert event_share(scenario, EVENT_KINDS[kind]) == pytest.approx(WANTED.share, abs=0.03)
    assert (event.side, event.free_side) == (-1, EVENT_KINDS[kind].has_free_side)
    assert 2.0 <= event.patience_s <= 4.0
    assert 2 <= len(scenario.obstacles) <= 4 and free_lanes(scenario, street_map) == []
    assert list(straight_lanes(scenario, street_map)) == list(common_ways(scenario, street_map))
    prove_gap(scenario, street_map)
    for one in scenario.obstacles:
        assert footprint(one).distance(Point(scenario.start[:2])) > ENDS_M
    graph = WalkGraph(street_map)
    again = build_reactive(EVENT_KINDS[kind], SMALL, street_map, graph, 0, kind, wanted=WANTED)
    assert again == scenario


def test_a_free_lane_is_found() -> None:
    """A lane is free without one of the obstacles."""
    _, street_map = place(SMALL)
    scenario = reactive_scenario("lateral")
    fewer = replace(scenario, obstacles=scenario.obstacles[:1])
    (words,) = straight_lanes(fewer, street_map)
    assert "straight lanes are free" in words
    assert "lanes" in {fault.claim for fault in faults_in_places([fewer], [], None)}


def test_a_path_that_solves_event_and_decoy_is_found() -> None:
    """Without the fences of the gate one path passes the people on both sides."""
    _, street_map = place(SMALL)
    found = [reactive_scenario("obstructing", seed) for seed in range(4)]
    scenario = next(s for s in found if any(one.kind == "fence" for one in s.obstacles))
    assert list(common_ways(scenario, street_map)) == []
    (event,) = scenario.events
    open_gate = replace(event, half_width_m=event.half_width_m + 0.5)
    faults = list(common_ways(replace(scenario, events=(open_gate,)), street_map))
    assert any("are free in the event and in its mirror" in words for words in faults)
    unfenced = replace(scenario, obstacles=())
    assert any("one way" in words for words in common_ways(unfenced, street_map))
    assert "mirrors" in {fault.claim for fault in faults_in_places([unfenced], [], None)}


@pytest.mark.parametrize("sidewalk_half_m", [1.0, 1.3, 1.6, 2.24, 2.88])
def test_fences_close_a_sidewalk_to_the_gate(sidewalk_half_m: float) -> None:
    """Only the gate is wider than 0.1 m, and no fence leaves the sidewalk."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        gate = drawn_gate((0.95, 1.15), sidewalk_half_m, Pose(0.0, 0.0, 0.0), rng, COURIER)
        sidewalk = shapely.box(-1.0, -sidewalk_half_m, 1.0, sidewalk_half_m)
        grounds = [footprint(one) for one in gate.fences]
        bands = [shapely.box(-1.0, g.bounds[1], 1.0, g.bounds[3]) for g in grounds]
        assert all(abs(y) <= sidewalk_half_m for band in bands for y in band.bounds[1::2])
        left = shapely.get_parts(sidewalk.difference(shapely.union_all(bands)))
        wide = [one.bounds for one in left if one.bounds[3] - one.bounds[1] > 0.1]
        low_m, high_m = gate.left_m - gate.half_m, gate.left_m + gate.half_m
        assert len(wide) == 1 and wide[0][1::2] == pytest.approx((low_m, high_m), abs=0.01)
        inner = [min(abs(y - gate.left_m) for _, y in g.exterior.coords) for g in grounds]
        assert inner == pytest.approx([gate.half_m] * len(grounds), abs=0.01)
    with pytest.raises(SpecError, match="too wide"):
        drawn_gate((0.95, 1.15), 4.0, Pose(0.0, 0.0, 0.0), rng, COURIER)


@pytest.mark.parametrize("kind", EVENT_KINDS)
def test_a_decoy_equals_its_scenario_but_for_the_response(kind: str) -> None:
    """A decoy ends at the goal, and its free side is the other one or its people do not act."""
    scenario = reactive_scenario(kind)
    decoy = decoy_of(scenario)
    (event,), (other,) = scenario.events, decoy.events
    mirrored = EVENT_KINDS[kind].decoy is None
    assert (decoy.id, decoy.decoy_of, decoy.ends_at) == (f"{kind}-decoy", kind, "goal")
    assert other.decoy == (not mirrored)
    assert other.free_side == (-event.free_side if mirrored else event.free_side)
    assert differing_fields(scenario, limited(decoy, 9.0, 1.0)) == []
    assert differing_fields(scenario, replace(decoy, seed=9, obstacles=())) == ["seed", "obstacles"]


def test_a_decoy_with_a_person_inside_an_obstacle_is_refused() -> None:
    """It is refused before the expert drives, and the claim finds the person in the decoy alone."""
    event = reactive_scenario("ped_crossing")
    decoy = decoy_of(event)
    ((x_m, y_m),) = EVENT_KINDS["ped_crossing"].stays_of(decoy.events[0], 0)
    thing = Obstacle(kind="bin", x_m=x_m, y_m=y_m, heading_rad=0.0)
    event, decoy = (replace(one, obstacles=(*one.obstacles, thing)) for one in (event, decoy))
    refused = accepted(decoy)
    assert isinstance(refused, Dropped)
    words = "person 'e0' stays 0.30 m inside an obstacle"
    assert (refused.reason, refused.details) == ("person inside an obstacle", words)
    suite = Suite(name="reactive", version="1", scenarios=(event, decoy))
    assert list(CLAIMS["people"](Read(suite, None))) == [f"{decoy.id}: {words}"]


def test_limits_follow_from_the_experts_time_and_the_robots_speed() -> None:
    """Limits are 1.5 times and 3 s for events and 1.3 times for decoys, in whole ticks. A faster
    robot has less time, and a long route keeps its limit."""
    scenario, decoy = reactive_scenario("lateral"), decoy_of(reactive_scenario("lateral"))
    assert limited(scenario, 10.01, None).time_limit_s == 18.05
    quick = limited(decoy, 10.0, 1.25)
    assert (quick.time_limit_s, quick.go_on_mps) == (16.0, 0.75)
    assert limited(decoy_of(reactive_scenario("queueing")), 10.0, 1.25).go_on_mps == 0.0
    faster = SCOUT.cruise_mps / COURIER.cruise_mps
    scout = quick.driven_by("scout")
    assert (scout.time_limit_s, scout.go_on_mps) == (12.0, 0.75 * faster)
    assert scout.driven_by("scout") == scout and quick.driven_by("courier") == quick
    long = replace(scenario, ends_on_failure=False)
    assert limited(long, 10.0, None) == long
    assert long.driven_by("scout").time_limit_s == long.time_limit_s


@pytest.mark.parametrize("redraw", [0, 1])
def test_the_slots_spread_lengths_positions_and_sides_evenly(redraw: int) -> None:
    """In each split every kind has the same lengths and positions, and each side half of the time,
    without correlations; also in a redraw."""
    slots = recipe_of("reactive", redraw).slots
    slots = [slot for slot in slots if slot.wanted and not slot.decoy_of]
    for kind in EVENT_KINDS:
        for split, count in (("val", 80), ("test", 20)):
            wanted_rows = [s.wanted for s in slots if s.structure == kind and s.split == split]
            wanted = np.array([one for one in wanted_rows if one is not None])
            assert len(wanted) == count
            lengths_m = 12.0 + 18.0 * (np.arange(count) + 0.5) / count
            assert np.allclose(np.sort(wanted[:, 0]), lengths_m, atol=0.01)
            assert np.allclose(np.sort(wanted[:, 1]), (np.arange(count) + 0.5) / count)
            assert abs(wanted[:, 2:].sum(axis=0)).max() <= 1
            apart = np.corrcoef(wanted.T) - np.eye(4)
            assert abs(apart).max() < 3.3 / math.sqrt(count)


def test_a_redraw_has_the_same_slots_with_other_draws(tmp_path: Path) -> None:
    """Names, places and splits are equal; seeds, lengths and sides are not. The shipped file is not
    replaced."""
    for name, shipped in RECIPES.items():
        again = [recipe_of(name, number) for number in (1, 2)]
        for slots in zip(shipped.slots, *(one.slots for one in again), strict=True):
            same = [(s.name, s.where, s.split, s.like, s.decoy_of, s.length_m) for s in slots]
            assert len(set(same)) == 1
            assert len({s.seed(0) for s in slots} | {s.seed(1) for s in slots}) == 6
        assert [one.version for one in again] == [
            f"{shipped.version}-redraw-{number}" for number in (1, 2)
        ]
    drawn = [[s.wanted for s in recipe_of("reactive", n).slots if s.wanted] for n in (0, 1, 2)]
    assert all(
        np.mean([p == q for p, q in zip(a, b, strict=True)]) < 0.05
        for a, b in itertools.combinations(drawn, 2)
    )
    assert recipe_of("reactive", 0) is RECIPES["reactive"]
    before = SUITES["reactive"].read_bytes()
    with pytest.raises(UsageError, match="file of its own"):
        build_suite("reactive", SUITES["reactive"], redraw=1)
    assert SUITES["reactive"].read_bytes() == before


@pytest.mark.engine
def test_a_redrawn_pair_is_proved_and_cheats_are_driven_on_it(
    tmp_path: Path,
    cosim: Cosim,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    """A request for an event also builds its decoy, with other seeds than the shipped pair. Both
    keep their claims, and their proofs hold in another process. Cheats are evaluated on the redraw:
    one by default, two with --whole. The decoy of an unsolved event is left out."""
    out = tmp_path / "redraw.json"
    done = cosim("suite", "build", "reactive", str(out), "--redraw", "1", "--only", "*taking-7002")
    assert done.returncode == 0 and "version 2.0-redraw-1" in done.stdout, done.stderr
    suite, proofs = read_suite(out), read_proofs(out)
    shipped = {one.id: one for one in load_suite("reactive").scenarios}
    assert [one.id for one in suite.scenarios] == ["overtaking-7002", "overtaking-7002-decoy"]
    assert all(one.route != shipped[one.id].route for one in suite.scenarios)
    assert all(one.time_limit_s < 60.0 for one in suite.scenarios)
    for claim in ("decoys", "exclusive", "limits", "proofs", "obstacles"):
        assert list(CLAIMS[claim](Read(suite, proofs, out))) == []
    assert list(faults_in_places(suite.scenarios, [suite.scenarios[1].id], proofs)) == []
    more = ("stop-every-2-m",) if request.config.getoption("--whole") else ()
    cheats = {name: CHEATS[name] for name in ("swerve-left", *more)}
    monkeypatch.setattr(measure, "CHEATS", cheats)
    done = cosim("bench", "exploit", "--cheats", "--suite", str(out), "--out", str(tmp_path / "e"))
    assert done.returncode == 0 and "swerve-left" in done.stdout, done.stderr
    assert len((tmp_path / "e" / "evaluations.jsonl").read_text().splitlines()) == len(cheats)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Take two swerves by default, three with --whole."""
    if "cheat" in metafunc.fixturenames:
        rows = [("7007", "swerve-fast-left"), ("7012", "swerve-right")]
        if metafunc.config.getoption("--whole"):
            rows.append(("7010", "swerve-wide-left"))
        metafunc.parametrize(("number", "cheat"), rows)


@pytest.mark.engine
def test_a_swerve_instead_of_giving_way_solves_only_the_decoy(number: str, cheat: str) -> None:
    """It reaches both goals without a failure, but does not give way in the event."""
    name = f"overtaking-{number}"
    ids = (name, name + DECOY)
    twins = [one for one in load_suite("reactive").scenarios if one.id in ids]
    results = [drive(twin, CHEATS[cheat]) for twin in twins]
    assert [(one.done, one.failures) for one in results] == [(1.0, 0.0)] * 2
    assert [one.solved for one in results] == [False, True]
