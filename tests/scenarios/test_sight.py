"""Event pedestrians and injected people among people: they see the crowd and each other, and walk
round them."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from cosim.core.state import NO_PEOPLE, People, PersonKind
from cosim.people.steering import nearby_people
from cosim.spec.events import Event, EventQuery, EventReply, EventState, NearbyPerson
from cosim.spec.injection import Injected, Injection
from scenarios.events import EVENT_KINDS, react
from scenarios.events.injected_person import (
    InjectedPerson,
    actor_id,
    injected_actor,
    spawn_injected,
    step_injected,
)

TICK_MS = 50
PEOPLE = {"conversing": 3, "queueing": 3, "ped_crossing": 4}
BOX_M = (0.35, 0.275)


def event(kind: str, **fields: object) -> Event:
    """Return an event 50 m along a route on the x axis, on a sidewalk 4 m wide."""
    known = {
        "id": "e0",
        "kind": kind,
        "x_m": 50.0,
        "y_m": 0.0,
        "heading_rad": 0.0,
        "route_s_m": 50.0,
    }
    known |= {"half_width_m": 2.0, "speed_mps": 1.2, "people": PEOPLE.get(kind, 1)}
    known |= {"half_length_m": 5.0} if kind == "ped_crossing" else {}
    return Event(**known | fields)  # type: ignore[arg-type]


def query_at(
    tick: int,
    x_m: float,
    v_mps: float,
    seen: tuple[NearbyPerson, ...],
    events: tuple[Event, ...] = (),
    *states: EventState,
) -> EventQuery:
    """Return the query of a robot at `x_m` on the x axis that faces +x."""
    return EventQuery(
        episode="t",
        tick=tick,
        tick_ms=TICK_MS,
        robot_x_m=x_m,
        robot_y_m=0.0,
        robot_heading_rad=0.0,
        robot_v_mps=v_mps,
        robot_w_radps=0.0,
        route_s_m=x_m,
        robot_length_m=0.7,
        robot_width_m=0.55,
        events=events,
        states=states,
        nearby=seen,
    )


def drive(
    planned: Event, ticks: int, speed_mps: float, start_m: float, *crowd: NearbyPerson
) -> list[tuple[float, EventReply]]:
    """Return (robot x, reply) at every tick of a robot that drives along the x axis, among people
    who walk straight ahead."""
    states: tuple[EventState, ...] = ()
    out = []
    for tick in range(ticks):
        t_s = tick * TICK_MS / 1000
        nearby = tuple(
            NearbyPerson(
                c.id, c.x_m + c.vx_mps * t_s, c.y_m + c.vy_mps * t_s, c.vx_mps, c.vy_mps, c.kind
            )
            for c in crowd
        )
        reply = react(
            query_at(tick, start_m + speed_mps * t_s, speed_mps, nearby, (planned,), *states)
        )
        states = reply.states
        out.append((start_m + speed_mps * t_s, reply))
    return out


def nearby_person(person: InjectedPerson) -> NearbyPerson:
    """Return a person as others of its kind see it."""
    walker = person.walker
    return NearbyPerson(
        actor_id(person.injection),
        walker.x_m,
        walker.y_m,
        walker.vx_mps,
        walker.vy_mps,
        PersonKind.INJECTED,
    )


def gap_m(robot_x_m: float, x_m: float, y_m: float) -> float:
    """Return the gap between the disk of a person and the outline of the robot."""
    away = np.maximum(np.abs([x_m - robot_x_m, y_m]) - BOX_M, 0.0)
    return float(np.hypot(*away)) - 0.3


@pytest.mark.parametrize("kind", EVENT_KINDS)
def test_people_off_the_sidewalk_change_nothing(kind: str) -> None:
    """A person off the sidewalk changes no bit of an event."""
    alone = drive(event(kind), 600, 1.0, 25.0)
    assert drive(event(kind), 600, 1.0, 25.0, NearbyPerson("c1", 50.0, 9.0, 0.0, 0.0)) == alone


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize(
    ("kind", "people"),
    [
        ("conversing", 2),
        ("conversing", 3),
        ("conversing", 4),
        ("queueing", 3),
        ("queueing", 5),
        ("ped_crossing", 4),
    ],
)
def test_the_people_of_an_event_do_not_walk_through_each_other(
    kind: str, people: int, side: int
) -> None:
    """They keep apart on the way to their places, back, and over a crosswalk, and end at their
    places."""
    track = drive(event(kind, people=people, side=side), 1000, 0.4, 38.0)
    for _, reply in track:
        places = [(w.x_m, w.y_m) for w in reply.states[0].walkers]
        assert min(math.dist(a, b) for a, b in itertools.combinations(places, 2)) > 0.4
    if kind != "ped_crossing":
        first = track[0][1].states[0]
        last = track[-1][1].states[0]
        assert last.phase == "over"
        assert [(w.x_m, w.y_m) for w in last.walkers] == [(w.x_m, w.y_m) for w in first.walkers]


def test_an_obstructing_pedestrian_reaches_its_place_past_standing_people() -> None:
    """It walks round a person on its way, and ends in the middle of the sidewalk even if another
    person is there."""
    for x_m, y_m, least in ((50.0, 0.9, 0.54), (50.0, 0.0, -1.0)):
        track = drive(event("obstructing"), 200, 0.5, 40.0, NearbyPerson("c1", x_m, y_m, 0.0, 0.0))
        ways = [(r.states[0].walkers[0].x_m, r.states[0].walkers[0].y_m) for _, r in track]
        assert ways[-1] == (50.0, 0.0)
        assert min(math.dist(xy, (x_m, y_m)) for xy in ways) > least


@pytest.mark.parametrize("y_m", [0.0, 0.2, -0.2])
def test_a_frontal_pedestrian_walks_round_people_and_meets_the_robot(y_m: float) -> None:
    """It passes people on its line and still meets the robot."""
    crowd = (NearbyPerson("c1", 44.0, y_m, 0.0, 0.0), NearbyPerson("c2", 34.0, y_m, 1.1, 0.0))
    track = drive(event("frontal"), 500, 0.06, 31.0, *crowd)
    robots = [x_m for x_m, r in track if r.states[0].phase == "acting"]
    ways = [
        (r.states[0].walkers[0].x_m, r.states[0].walkers[0].y_m)
        for _, r in track
        if r.states[0].phase == "acting"
    ]
    assert min(math.dist(xy, (44.0, y_m)) for xy in ways) > 0.55
    assert min(math.dist(xy, (34.0 + 1.1 * 0.05 * k, y_m)) for k, xy in enumerate(ways)) > 0.5
    assert max(math.dist(a, b) for a, b in itertools.pairwise(ways)) < 1.2 * 0.05 + 1e-9
    assert min(gap_m(x_m, *xy) for x_m, xy in zip(robots, ways, strict=True)) < 0.02


@pytest.mark.parametrize("side", [-1, 1])
def test_a_lateral_pedestrian_walks_round_a_person_and_meets_the_robot(side: int) -> None:
    """It steps round a person on its line and aims again at the robot."""
    track = drive(
        event("lateral", side=side), 400, 0.8, 40.0, NearbyPerson("c1", 50.1, side * 0.9, 0.0, 0.0)
    )
    acting = [(x, r.states[0].walkers[0]) for x, r in track if r.states[0].phase == "acting"]
    assert min(math.dist((w.x_m, w.y_m), (50.1, side * 0.9)) for _, w in acting) > 0.5
    assert min(gap_m(x, w.x_m, w.y_m) for x, w in acting) < 0.02
    assert max(math.hypot(w.vx_mps, w.vy_mps) for _, w in acting) < 2.0 + 1e-9


def test_an_overtaking_pedestrian_overtakes_people_too() -> None:
    """Behind a slow walker on its side it swerves, passes and finishes its event."""
    slow = NearbyPerson("c1", 52.0, 1.6, 0.6, 0.0)
    track = drive(event("overtaking"), 500, 1.0, 45.0, slow)
    ways = [(r.states[0].walkers[0].x_m, r.states[0].walkers[0].y_m) for _, r in track]
    assert min(math.dist(xy, (52.0 + 0.6 * 0.05 * k, 1.6)) for k, xy in enumerate(ways)) > 0.5
    assert track[-1][1].states[0].phase in ("over", "gone")


def test_an_injected_person_walks_round_people_and_ends_beside_one_at_its_goal() -> None:
    """It passes people on its path and ends next to the one at its end."""
    person = spawn_injected(
        Injected(
            tick=0, injection=Injection(id="anna", path=((0.0, 5.0), (10.0, 5.0)), stay_s=100.0)
        )
    )
    standing = (NearbyPerson("c1", 5.0, 5.0, 0.0, 0.0), NearbyPerson("c2", 10.0, 5.0, 0.0, 0.0))
    ways = []
    for tick in range(400):
        itself = nearby_person(person)
        after = step_injected(person, query_at(tick, 90.0, 0.0, (*standing, itself)))
        assert after is not None
        person = after
        ways.append((person.walker.x_m, person.walker.y_m))
    assert all(math.dist(xy, (c.x_m, c.y_m)) > 0.55 for xy in ways for c in standing)
    assert person.arrived_tick is not None and math.dist(ways[-1], (10.0, 5.0)) < 1.0
    assert injected_actor(person, TICK_MS).speed_mps == 0.0


@pytest.mark.parametrize("names", ["ab", "ba", "abc"])
def test_people_injected_at_the_same_place_separate(names: str) -> None:
    """With the same path they are apart after a second, and stay apart until they arrive."""
    path = ((0.0, 5.0), (10.0, 5.0))
    injected_people = [
        spawn_injected(Injected(tick=0, injection=Injection(id=name, path=path))) for name in names
    ]
    for tick in range(120):
        seen = tuple(map(nearby_person, injected_people))
        after = [
            step_injected(person, query_at(tick, 90.0, 0.0, seen)) for person in injected_people
        ]
        injected_people = [person for person in after if person is not None]
        places = [(g.walker.x_m, g.walker.y_m) for g in injected_people]
        gaps = [math.dist(a, b) for a, b in itertools.combinations(places, 2)]
        assert len(injected_people) == len(names) and (tick < 20 or min(gaps) > 0.4)


def test_the_director_gets_people_near_event_pedestrians() -> None:
    """Of a crowd it gets one 3 m from an event pedestrian and the injected person, and nobody
    without event pedestrians."""
    ids = ("u", "s", "t", "a", "r")
    kind = [0, 0, PersonKind.EVENT, PersonKind.EVENT, PersonKind.INJECTED]
    xy = [(3.0, 0.0), (9.0, 0.0), (0.0, 0.0), (0.0, 1.0), (-2.0, 0.0)]
    people = People.of(
        ids, xy, [math.pi / 2] * 5, [1.0, 1.0, 0.0, 0.0, 0.5], ("walk",) * 5, kind=kind
    )
    nearby = nearby_people(people)
    assert [(b.id, b.x_m, b.y_m, b.kind) for b in nearby] == [
        ("u", 3.0, 0.0, 0),
        ("r", -2.0, 0.0, PersonKind.INJECTED),
    ]
    assert [(b.vx_mps, b.vy_mps) for b in nearby] == [
        pytest.approx((0.0, 1.0)),
        pytest.approx((0.0, 0.5)),
    ]
    crowd = People.of(ids[:2], xy[:2], [0.0] * 2, [1.0] * 2, ("walk",) * 2)
    assert nearby_people(crowd) == nearby_people(NO_PEOPLE) == ()


@pytest.mark.parametrize(
    ("kind", "people", "side", "standing"),
    [
        ("queueing", 5, -1, [(51.16, 0.18), (52.06, -0.54)]),
        ("conversing", 3, -1, [(53.27, 1.28), (47.61, 0.54)]),
        ("gesturing", 1, 1, [(50.31, 0.35), (47.0, 1.5)]),
        ("obstructing", 1, 1, [(50.0, 0.5), (50.5, 0.3), (49.5, 0.3), (49.8, -0.4), (50.3, -0.4)]),
    ],
)
def test_standing_people_do_not_keep_event_pedestrians_from_their_places(
    kind: str, people: int, side: int, standing: list[tuple[float, float]]
) -> None:
    """All event pedestrians are at their places within 8 s and stay there."""
    crowd = [NearbyPerson(f"c{k}", *xy, 0.0, 0.0) for k, xy in enumerate(standing)]
    track = drive(event(kind, people=people, side=side), 300, 0.1, 40.0, *crowd)
    late = track[160][1].states[0]
    last = track[-1][1].states[0]
    assert (late.phase, last.phase) == ("acting", "acting")
    assert [(w.x_m, w.y_m) for w in late.walkers] == [(w.x_m, w.y_m) for w in last.walkers]
    alone = drive(event(kind, people=people, side=side), 300, 0.1, 40.0)[-1][1].states[0]
    assert [(w.x_m, w.y_m) for w in last.walkers] == [(w.x_m, w.y_m) for w in alone.walkers]
