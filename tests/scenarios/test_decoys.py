"""Decoys of events: equal until the trigger, and harmless to a robot that continues."""

from __future__ import annotations

import itertools
import math

import msgspec
import numpy as np
import pytest
import shapely

from cosim.core.errors import SpecError
from cosim.core.geometry import Pose, box_disk_gap
from cosim.spec.events import Event, EventQuery, EventReply
from cosim.spec.robot import COURIER
from scenarios.events import EVENT_KINDS, react
from scenarios.events.gates import closed_m, gate_faults, open_interval_m
from scenarios.events.react import pose_of
from scenarios.events.standing import CLOSED_M

TICK_S = 0.05
HALF_M = (COURIER.length_m / 2, COURIER.width_m / 2)
MIRRORED = [name for name, kind in EVENT_KINDS.items() if kind.blocked is not None]
GO_ON = [name for name, kind in EVENT_KINDS.items() if kind.decoy is not None]


def event(kind: str, half_width_m: float | None = None, **fields: object) -> Event:
    """Return an event 50 m along a route on the x axis, with a free side where its kind has one."""
    row = EVENT_KINDS[kind]
    gate = row.layout.gate_half_m if row.layout is not None else None
    known = {
        "id": "e0",
        "kind": kind,
        "x_m": 50.0,
        "y_m": 0.0,
        "heading_rad": 0.0,
        "route_s_m": 50.0,
        "half_width_m": half_width_m or (sum(gate) / 2 if gate else 1.6),
        "people": row.people[0],
        "half_length_m": 3.2 if row.layout is None else 0.0,
        "free_side": 1 if row.has_free_side else 0,
    }
    return Event(**known | fields)  # type: ignore[arg-type]


def drive(
    planned: Event,
    v_mps: float,
    start_m: float,
    to_m: float,
    left_m: float = 0.0,
    weaves_m: float = 0.0,
) -> list[tuple[Pose, EventReply]]:
    """Return pose and reply at every tick of a robot that drives beside the x axis."""
    track: list[tuple[Pose, EventReply]] = []
    states: tuple[object, ...] = ()
    for tick in itertools.count():
        x_m = start_m + v_mps * tick * TICK_S
        if x_m > to_m:
            return track
        pose = Pose(x_m, left_m + weaves_m * math.sin(0.5 * x_m), 0.0)
        query = EventQuery(
            episode="t",
            tick=tick,
            tick_ms=50,
            robot_x_m=pose.x_m,
            robot_y_m=pose.y_m,
            robot_heading_rad=0.0,
            robot_v_mps=v_mps,
            robot_w_radps=0.0,
            route_s_m=x_m,
            robot_length_m=COURIER.length_m,
            robot_width_m=COURIER.width_m,
            events=(planned,),
            states=states,  # type: ignore[arg-type]
        )
        reply = react(query)
        states = reply.states
        track.append((pose, reply))
    raise AssertionError


def least_gap_m(track: list[tuple[Pose, EventReply]]) -> float:
    poses = np.array([pose for pose, _ in track])
    people = np.array([[(w.x_m, w.y_m) for w in reply.states[0].walkers] for _, reply in track])
    return float(box_disk_gap(poses, *HALF_M, people).min()) - 0.3


@pytest.mark.parametrize("kind", EVENT_KINDS)
def test_event_and_decoy_are_equal_until_the_trigger_and_then_differ(kind: str) -> None:
    """Event and decoy are equal tick by tick under the same motion of the robot, also with a given
    trigger distance."""
    own_m = {"overtaking": -1.5, "ped_crossing": 3.0, "lateral": 3.3}.get(kind, 8.5)
    for side, trigger_m in itertools.product((-1, 1), (None, own_m)):
        planned = event(kind, side=side, trigger_m=trigger_m)
        tracks = [
            drive(twin, 1.5, 25.0, 62.0, weaves_m=0.3)
            for twin in (planned, EVENT_KINDS[kind].decoy_of(planned))
        ]
        pairs = [(a[1], b[1]) for a, b in zip(*tracks, strict=True)]
        triggers = [a.states[0].triggered_tick for a, _ in pairs]
        first = next(tick for tick in triggers if tick is not None)
        assert all(a == b for a, b in pairs[:first]) and first > 0
        assert {b.states[0].triggered_tick for _, b in pairs[first:]} == {first}
        assert any(a.actors != b.actors for a, b in pairs[first:])


@pytest.mark.parametrize("kind", MIRRORED)
def test_free_sides_of_an_event_and_its_mirror_exclude_each_other(kind: str) -> None:
    """Over the half widths of its row a robot passes on one side alone; beyond them it does not."""
    row = EVENT_KINDS[kind]
    assert row.layout is not None and row.layout.gate_half_m is not None
    low_m, high_m = row.layout.gate_half_m
    for half_m in np.linspace(low_m, high_m, 7).tolist():
        counts = range(row.people[0], row.people[1] + 1)
        if row.group is not None:
            counts = range(row.group(half_m, None), row.group(half_m, None) + 1)  # type: ignore[arg-type]
        for people, free in itertools.product(counts, (-1, 1)):
            planned = event(kind, half_m, people=people, free_side=free)
            assert not list(gate_faults(row, planned))
            assert closed_m(row, planned) <= CLOSED_M + 1e-9
            low, high = open_interval_m(row, planned)
            assert -math.copysign(1, low + high) != free
    fewest, most = (event(kind, 2.0, people=n) for n in row.people)
    narrow = msgspec.structs.replace(most, half_width_m=0.5 * _taken_m(kind, most) + 0.5)
    wide = msgspec.structs.replace(fewest, half_width_m=_taken_m(kind, fewest) + 0.3)
    assert "free side is only" in next(gate_faults(row, narrow))
    assert "in its mirror" in next(gate_faults(row, wide))


def _taken_m(kind: str, planned: Event) -> float:
    low, high = open_interval_m(EVENT_KINDS[kind], planned)
    return 2.0 * planned.half_width_m - (high - low)


@pytest.mark.parametrize("kind", MIRRORED)
def test_people_are_in_place_before_the_fastest_robot_arrives(kind: str) -> None:
    """From either edge people reach the closed side, and stand where the row says."""
    row = EVENT_KINDS[kind]
    assert row.layout is not None and row.layout.gate_half_m is not None
    for half_m, side, free in itertools.product(row.layout.gate_half_m, (-1, 1), (-1, 1)):
        people = row.people[1] if row.group is None else row.group(half_m, None)  # type: ignore[arg-type]
        planned = event(kind, half_m, people=people, side=side, free_side=free, speed_mps=1.1)
        track = drive(planned, 2.5, 38.0, 48.4, left_m=30.0)
        before, now = track[-2][1].states[0].walkers, track[-1][1].states[0].walkers
        assert [(w.x_m, w.y_m) for w in before] == [(w.x_m, w.y_m) for w in now]
        right_m, left_m = row.blocked(planned)  # type: ignore[misc]
        assert min(w.y_m for w in now) - 0.3 == pytest.approx(right_m)
        assert max(w.y_m for w in now) + 0.3 == pytest.approx(left_m)


@pytest.mark.parametrize("kind", MIRRORED)
def test_a_blind_robot_meets_people_of_the_event_or_of_its_mirror(kind: str) -> None:
    """A blind robot meets people of one of the two at any lane and speed."""
    row = EVENT_KINDS[kind]
    assert row.layout is not None and row.layout.gate_half_m is not None
    half_m = row.layout.gate_half_m[1]
    people = row.people[0] if row.group is None else row.group(half_m, None)  # type: ignore[arg-type]
    for left_m, v_mps in itertools.product(np.linspace(-half_m, half_m, 9).tolist(), (0.5, 2.5)):
        planned = event(kind, half_m, people=people)
        gaps = [
            least_gap_m(drive(twin, v_mps, 39.0, 52.0, left_m))
            for twin in (planned, row.decoy_of(planned))
        ]
        between = kind == "conversing" and min(gaps) < 0.1
        assert min(gaps) < 0.0 or between


@pytest.mark.parametrize("kind", GO_ON)
def test_a_robot_that_continues_passes_the_people_of_a_decoy(kind: str) -> None:
    """A robot on the middle of the way at its cruising speed passes, on ways of several widths."""
    row = EVENT_KINDS[kind]
    for half_m, side, speed_mps in itertools.product((1.3, 1.6, 2.88), (-1, 1), (1.1, 1.65)):
        if kind == "overtaking" and half_m < 1.4:
            continue
        for people in range(row.people[0], row.people[1] + 1):
            planned = event(kind, half_m, side=side, speed_mps=speed_mps, people=people)
            sides = (1, -1, 0) if row.has_free_side else (0,)
            for free in sides:
                twin = row.decoy_of(msgspec.structs.replace(planned, free_side=free))
                gap_m = least_gap_m(drive(twin, 1.5, 25.0, 75.0))
                assert gap_m > 0.12, (half_m, side, people, gap_m)


def test_decoys_of_gestures_show_one_of_four_others_at_the_same_place() -> None:
    """The place decides which; the person neither walks nor turns differently."""
    row = EVENT_KINDS["gesturing"]
    shown = {
        pose_of(row, row.decoy_of(event("gesturing", x_m=float(x_m)))) for x_m in range(50, 90)
    }
    assert shown == {"wave", "call", "point", "scratch"}
    planned = event("gesturing")
    pairs = zip(
        *(drive(twin, 1.5, 36.0, 49.0) for twin in (planned, row.decoy_of(planned))), strict=True
    )
    for (_, a), (_, b) in pairs:
        assert [(w.x_m, w.y_m, w.heading_rad) for w in a.states[0].walkers] == [
            (w.x_m, w.y_m, w.heading_rad) for w in b.states[0].walkers
        ]


@pytest.mark.parametrize("kind", EVENT_KINDS)
def test_people_of_decoys_stay_where_the_row_says(kind: str) -> None:
    """When the robot has passed, they are at their places; people without a place still walk."""
    row = EVENT_KINDS[kind]
    for side, left_m in itertools.product((-1, 1), (-0.3, 0.0, 0.3)):
        decoy = row.decoy_of(event(kind, side=side, people=row.people[1]))
        states = [reply.states[0] for _, reply in drive(decoy, 1.0, 25.0, 62.0, left_m)]
        last = [state for state in states if state.phase == "acting"][-1]
        for number, walker in enumerate(last.walkers):
            places = row.stays_of(decoy, number)
            ground = shapely.MultiPoint(places).convex_hull
            if places:
                assert ground.distance(shapely.Point(walker.x_m, walker.y_m)) < 1e-6
            else:
                assert math.hypot(walker.vx_mps, walker.vy_mps) > 0.5


@pytest.mark.parametrize("patience_s", [2.0, 4.0])
@pytest.mark.parametrize("kind", ["frontal", "lateral", "ped_crossing"])
def test_people_wait_before_a_standing_robot_until_their_patience_ends(
    kind: str, patience_s: float
) -> None:
    """Then they walk round it without touching it."""
    planned = event(kind, 1.9, patience_s=patience_s)
    states: tuple[object, ...] = ()
    x_m, met, went = 44.0, None, None
    gaps = []
    for tick in range(500):
        near = bool(states) and abs(states[0].walkers[0].x_m - x_m) < 1.9  # type: ignore[attr-defined]
        stands = met is not None or (near and states[0].phase == "acting")  # type: ignore[attr-defined]
        v_mps = 0.0 if stands else 1.0
        met = tick if stands and met is None else met
        query = EventQuery(
            episode="t",
            tick=tick,
            tick_ms=50,
            robot_x_m=x_m,
            robot_y_m=0.0,
            robot_heading_rad=0.0,
            robot_v_mps=v_mps,
            robot_w_radps=0.0,
            route_s_m=x_m,
            robot_length_m=0.7,
            robot_width_m=0.55,
            events=(planned,),
            states=states,  # type: ignore[arg-type]
        )
        states = react(query).states
        x_m += v_mps * TICK_S
        walker = states[0].walkers[0]  # type: ignore[attr-defined]
        at = np.array([[(walker.x_m, walker.y_m)]])
        gaps.append(
            float(box_disk_gap(np.array([Pose(x_m, 0.0, 0.0)]), *HALF_M, at)[0].min()) - 0.3
        )
        if (
            met is not None
            and went is None
            and tick > met + 30
            and walker.vx_mps**2 + walker.vy_mps**2
        ):
            went = tick
    assert met is not None and went is not None and min(gaps) > 0.0
    assert (went - met) * TICK_S == pytest.approx(patience_s, abs=0.15)


def test_a_decoy_needs_a_kind_with_decoys() -> None:
    """Mirrored kinds need a free side; an event that is marked as a decoy needs a row's behaviour."""
    with pytest.raises(SpecError, match="needs free_side -1 or 1, not 0"):
        EVENT_KINDS["queueing"].decoy_of(event("queueing", free_side=0))
    with pytest.raises(SpecError, match="'queueing' has no behaviour of decoys"):
        drive(event("queueing", decoy=True), 1.0, 39.0, 45.0)
