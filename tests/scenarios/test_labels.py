"""Labels of pictures on a hand-made street, and variation of collected scenarios."""

from __future__ import annotations

import math
from types import MappingProxyType

import msgspec
import numpy as np
import pytest
from shapely import MultiPolygon, box

from cosim.core.errors import SpecError
from cosim.core.geometry import Polyline, Pose
from cosim.core.packed_demos import FREE_RAYS
from cosim.core.state import People, PersonKind, RobotState, Signal, Vehicles
from cosim.episode.interfaces import Observation, Privileged
from cosim.spec.demo_options import DemoOptions
from cosim.spec.events import Event
from cosim.spec.robot import COURIER
from cosim.spec.scenario import Scenario
from scenarios.episodes.labels import (
    DOINGS,
    EVENT_NUMBERS,
    FREE_RANGE_M,
    event_numbers,
    event_person,
    label_rows,
    signal_ahead,
)
from scenarios.events import EVENT_KINDS
from scenarios.tools.dataset.variety import varied
from tests.support.driven_runs import short_way

MIDDLE, LEFT, RIGHT = FREE_RAYS // 2, 0, FREE_RAYS - 1
PEOPLE = People.of(
    ("a", "e1", "b", "c"),
    [(9.0, 9.0), (10.0, 12.0), (10.0, 2.0), (10.0, 30.0)],
    [0.0, -math.pi / 2.0, 0.0, 0.0],
    [1.0, 0.5, 1.0, 1.0],
    ("walk", "stop", "walk", "walk"),
    kind=[PersonKind.CROWD, PersonKind.EVENT, PersonKind.CROWD, PersonKind.CROWD],
)
GROUND = box(8.0, 0.0, 12.0, 40.0)


def state(**changes: object) -> Privileged:
    """Return a robot at (10, 5) that looks north, along a sidewalk 4 m wide."""
    fields: dict[str, object] = {
        "robot": RobotState(Pose(10.0, 5.0, math.pi / 2.0)),
        "route": Polyline([(10.0, 0.0), (10.0, 40.0)]),
        "route_s_m": 5.0,
        "people": PEOPLE,
        "vehicles": Vehicles.of((), np.zeros((0, 2)), [], [], np.zeros((0, 2))),
        "signals": MappingProxyType({"x": Signal(walk=False)}),
        "crossings": (("w", 1.0, 3.0), ("x", 20.0, 26.0)),
        "free": GROUND,
    }
    return Privileged(**(fields | changes))  # type: ignore[arg-type]


def rows(**changes: object) -> dict[str, np.ndarray]:
    seen = Observation(0, 0.0, None, 0.0, 0.0, COURIER, privileged=state(**changes))
    return label_rows(seen)


def test_people_ahead_are_in_the_robots_axes_nearest_first() -> None:
    """One person walks to the right 4 m ahead and 1 m to the left, and one holds out a hand 7 m
    ahead. People behind and far away are missing."""
    near = rows()["near"]
    np.testing.assert_allclose(
        near[:2],
        [
            [1.0, 4.0, 1.0, 0.0, -1.0, 1 + DOINGS.index("walk")],
            [1.0, 7.0, 0.0, -0.5, 0.0, 1 + DOINGS.index("stop")],
        ],
        atol=1e-6,
    )
    assert not near[2:].any()


def test_free_distances_end_at_edges_people_and_vehicles() -> None:
    """Free distances are 2 m to either edge, end ahead at a person or a nearer van, and are 0
    outside the ground."""
    half_m = COURIER.width_m / 2.0
    free = rows()["free"]
    assert free[LEFT] == pytest.approx(2.0) and free[RIGHT] == pytest.approx(2.0)
    assert free[MIDDLE] == pytest.approx(7.0 - 0.3 - half_m)
    van = Vehicles.of(("v",), [(10.0, 10.0)], [0.0], [0.0], [(6.0, 2.0)])
    assert rows(vehicles=van)["free"][MIDDLE] == pytest.approx(4.0 - half_m)
    alone = rows(people=PEOPLE.only(np.array([], np.intp)))["free"]
    assert alone[MIDDLE] == FREE_RANGE_M
    assert alone[MIDDLE + 6] == pytest.approx(2.0 / math.cos(math.pi / 4.0))
    two = MultiPolygon([GROUND, box(20.0, 0.0, 30.0, 40.0)])
    np.testing.assert_array_equal(rows(free=two)["free"], free)
    assert not rows(free=box(30.0, 0.0, 31.0, 1.0))["free"].any()


def test_the_signal_is_that_of_the_next_crossing() -> None:
    """A crossing 15 m ahead is red or green; there is no label without a signal, behind the
    crossing, or far before it."""
    assert rows()["scene"].tolist() == [2.0, 0.0]
    walk = MappingProxyType({"x": Signal(walk=True)})
    assert signal_ahead(state(signals=walk)) == 1
    assert signal_ahead(state(signals=MappingProxyType({}))) == 0
    assert signal_ahead(state(route_s_m=27.0)) == 0
    far = (("x", 30.0, 36.0),)
    assert signal_ahead(state(crossings=far)) == 0


def event_of(kind: str, **changes: object) -> Event:
    fields: dict[str, object] = {"id": "e1", "kind": kind, "x_m": 5.0, "y_m": 0.0}
    fields |= {"heading_rad": 0.0, "route_s_m": 5.0, "half_width_m": 1.0}
    return Event(**(fields | changes))  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["gesturing", "frontal", "obstructing", "queueing"])
def test_the_event_is_that_of_the_nearest_directed_person_from_its_trigger_on(kind: str) -> None:
    """An event has no label before its trigger. A decoy without behaviour never has one; a mirrored
    decoy has that of its kind."""
    person = event_person(state())
    assert person == "e1" and event_person(None) == ""
    event = event_of(kind, free_side=0 if EVENT_KINDS[kind].decoy else 1)
    scenario = msgspec.structs.replace(short_way("s"), events=(event,))
    persons, ticks, number = (
        [person, "", "other", person, person],
        [8, 8, 8, 4, 0],
        EVENT_NUMBERS[kind],
    )

    def labels(scenario: Scenario, triggered: dict[str, int]) -> list[float]:
        return event_numbers(scenario, persons, ticks, triggered).tolist()

    assert labels(scenario, {"e1": 4}) == [number, 0, 0, number, 0]
    assert labels(scenario, {}) == [0] * 5
    decoy = msgspec.structs.replace(
        scenario, id="s-decoy", decoy_of="s", events=(EVENT_KINDS[kind].decoy_of(event),)
    )
    mirrored = EVENT_KINDS[kind].decoy is None
    assert labels(decoy, {"e1": 4}) == ([number, 0, 0, number, 0] if mirrored else [0] * 5)


def test_weather_and_start_are_drawn_by_the_id_and_shared_with_the_decoy() -> None:
    """Each start is displaced and turned within limits, and the end of the route stays. Without the
    options scenarios are unchanged; an unknown weather is refused."""
    ways = [short_way(f"s-{k}") for k in range(12)]
    asked = DemoOptions(astray=1.0, weathers=("clear", "rain"))
    made = varied(ways, asked, 0)
    assert made == varied(ways[::-1], asked, 0)[::-1]
    assert {one.conditions.name for one in made} == {"clear", "rain"}
    for before, after in zip(ways, made, strict=True):
        _, aside_m = before.route_line.project(*after.start[:2])
        assert 0.0 < abs(aside_m) <= 0.4 and after.start[2] != before.start[2]
        assert after.route[-1] == before.route[-1] and after.goal == before.goal
    decoy = msgspec.structs.replace(ways[3], id="s-3-decoy", decoy_of="s-3")
    (also,) = varied([decoy], asked, 0)
    assert (also.start, also.weather) == (made[3].start, made[3].weather)
    assert varied(ways, DemoOptions(), 0) == tuple(ways)
    with pytest.raises(SpecError, match="hail"):
        DemoOptions(weathers=("hail",))
