"""The check that scenarios fit their places, on a crossroads drawn by hand."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
import shapely
from shapely.geometry import LineString, box

from cosim.core.errors import SpecError
from cosim.place.street_map import Corner, Port, StreetMap, Strip
from cosim.spec.events import Event
from cosim.spec.obstacle import Obstacle
from cosim.spec.robot import ROBOTS
from cosim.spec.scenario import (
    Barrier,
    City,
    CityMap,
    CrowdSpec,
    Light,
    RouteCrossing,
    Scenario,
    Suite,
)
from scenarios.suites import fits
from scenarios.suites.fits import check_places, misfits


def crossroads() -> StreetMap:
    """Sidewalks of 3.2 m x 40 m to the west and the north of a corner of 4 m x 4 m, a crossing to
    the east."""
    arms = {"east": (1, 0), "north": (0, 1), "west": (-1, 0)}
    strips = {}
    for name, (dx, dy) in arms.items():
        line = np.array([[2.0 * dx, 2.0 * dy], [42.0 * dx, 42.0 * dy]])
        polygon = shapely.buffer(LineString(line), 1.6, cap_style="flat")
        kind: Any = "crossing" if name == "east" else "sidewalk"
        strips[name] = Strip(
            name, kind, line, 3.2, polygon, ("middle", None), signalised=name == "east"
        )
    corner = Corner("middle", box(-2, -2, 2, 2), tuple(Port(name, 0) for name in arms))
    return StreetMap("cross", (-42, -42, 42, 42), strips, {"middle": corner}, {}, {})


def event(**changes: Any) -> Event:
    at: dict[str, Any] = {"x_m": -10.0, "y_m": 0.0, "route_s_m": 20.0}
    return Event(id="e0", kind="obstructing", heading_rad=0.0, half_width_m=1.6, **at | changes)


def barrier(**changes: Any) -> Barrier:
    at: dict[str, Any] = {
        "x_m": 0.0,
        "y_m": 3.0,
        "heading_rad": 1.5708,
        "length_m": 3.4,
        "strip": "north",
        "end": 0,
    }
    return Barrier(**at | changes)


def a_bin(**at: float) -> Obstacle:
    return Obstacle(kind="bin", heading_rad=0.0, **at)


def from_west_to_east(**changes: Any) -> Scenario:
    """A route of 60 m along the sidewalk and over the crossing, the north closed, with a person on
    the way."""
    fields: dict[str, Any] = {
        "route": ((-30.0, 0.0), (0.0, 0.0), (30.0, 0.0)),
        "crossings": (RouteCrossing(id="east", enter_s_m=32.0, leave_s_m=60.0, signalised=True),),
        "barriers": (barrier(),),
        "events": (event(),),
    }
    fields |= changes
    route = fields["route"]
    return Scenario(
        id="s",
        suite="t",
        place=City(seed=1),
        seed=1,
        start=(*route[0], 0.0),
        goal=route[-1],
        **fields,
    )


def test_a_fitting_scenario_has_no_faults() -> None:
    """Its way is on sidewalk and crossing, its barrier closes a branch, and its event is on the
    way."""
    assert list(misfits([from_west_to_east()], crossroads())) == []


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            {"route": ((-30.0, 1.8), (0.0, 0.0), (30.0, 0.0))},
            "start is off the walkable area at (-30.00, 1.80), 0.0 m along the route",
        ),
        (
            {"route": ((-30.0, 0.0), (-15.0, 3.2), (0.0, 0.0), (30.0, 0.0))},
            "route is off the walkable area at (-22.15, 1.67), 8.0 m along the route",
        ),
        ({"events": (event(y_m=9.0),)}, "event 'e0' is off the walkable area at (-10.00, 9.00)"),
        (
            {"barriers": (barrier(strip="south"),)},
            "barriers[0].strip 'south' is none of map 'cross'",
        ),
        (
            {"barriers": (barrier(), barrier(x_m=30.0, y_m=0.0, heading_rad=0.0, length_m=0.2))},
            "barriers[1] stands 28 m from strip 'north', which it should close",
        ),
        (
            {"barriers": (barrier(x_m=-10.0, y_m=0.0, heading_rad=0.0, strip="west"),)},
            "barriers[0] on strip 'west' stands across the route",
        ),
        (
            {
                "crossings": (
                    RouteCrossing(id="west", enter_s_m=1.0, leave_s_m=28.0, signalised=False),
                )
            },
            "crossing 'west' is none of map 'cross'",
        ),
        (
            {
                "crossings": (
                    RouteCrossing(id="east", enter_s_m=32.0, leave_s_m=60.0, signalised=False),
                )
            },
            "crossing 'east': signalised is True on the map, not False",
        ),
        (
            {
                "crossings": (
                    RouteCrossing(id="east", enter_s_m=2.0, leave_s_m=20.0, signalised=True),
                )
            },
            "crossing 'east' is not where the route is from enter_s_m to leave_s_m",
        ),
        (
            {"obstacles": (a_bin(x_m=-15.0, y_m=1.0), a_bin(x_m=-15.0, y_m=2.5))},
            "obstacles[1] (bin) is off the walkable area at (-15.00, 2.50)",
        ),
        (
            {"obstacles": (a_bin(x_m=-29.4, y_m=0.3),)},
            "obstacles[0] (bin) stands where the robot starts",
        ),
        ({"obstacles": (a_bin(x_m=29.9, y_m=0.0),)}, "obstacles[0] (bin) stands on the goal"),
    ],
    ids=[
        "start-off",
        "route-off",
        "event-off",
        "unknown-strip",
        "far-barrier",
        "barrier-across",
        "no-crossing",
        "other-signal",
        "crossing-elsewhere",
        "obstacle-off",
        "obstacle-at-start",
        "obstacle-on-goal",
    ],
)
def test_a_fault_is_named_with_its_place(changes: dict[str, Any], expected: str) -> None:
    """The message has field, number or id, and position."""
    assert list(misfits([from_west_to_east(**changes)], crossroads())) == [
        f"scenario 's': {expected}"
    ]


def test_a_density_respects_the_limit_of_people(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The number depends on the map: 400 m2 hold 60 people at 150 per 1000 m2."""
    monkeypatch.setattr(fits, "MAX_PERSONS", 59)
    dense = from_west_to_east(crowd=CrowdSpec(density=150.0))
    assert list(misfits([dense], crossroads())) == [
        "scenario 's': crowd density 150 within 80 m of the start makes 60 persons, and at most "
        "59 can be had: lower density or radius_m"
    ]


def test_a_scenario_far_from_everything_is_not_on_the_map() -> None:
    """One message says so, however many parts are off."""
    far = from_west_to_east(
        route=((5000.0, 0.0), (5060.0, 0.0)), crossings=(), barriers=(), events=()
    )
    assert list(misfits([far], crossroads())) == [
        "scenario 's': start (5000.0, 0.0) is not on map 'cross'"
    ]


def test_every_place_is_read_once_and_all_faults_are_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Scenarios of a place may be in any order; an unknown robot or sky is reported once."""
    made = []

    def place(where: City) -> tuple[None, StreetMap]:
        made.append(where.seed)
        return None, crossroads()

    monkeypatch.setattr(fits, "place", place)
    fine = from_west_to_east()
    odd = from_west_to_east(robot="tank", light=Light(hdri="nowhere.hdr"), events=(event(y_m=9.0),))
    scenarios = tuple(
        msgspec.structs.replace(one, id=f"{name}-{i}", place=City(seed=seed))
        for i in range(3)
        for name, one, seed in (("fine", fine, 1), ("odd", odd, 2))
    )
    suite = Suite(name="w", version="1", scenarios=scenarios)
    with pytest.raises(SpecError) as caught:
        check_places(suite, scenarios)
    assert made == [1, 2]
    head, *faults = str(caught.value).splitlines()
    assert head == "suite 'w': 5 faults:"
    assert f"unknown robot 'tank'. Valid choices: {', '.join(sorted(ROBOTS))}" in faults[0]
    assert "hdri 'nowhere.hdr' does not exist" in faults[1]
    assert all(f"scenario 'odd-{i}': event 'e0' is off" in faults[2 + i] for i in range(3))
    check_places(suite, [s for s in scenarios if s.id.startswith("fine")])


def test_several_processes_report_the_same_faults() -> None:
    """Many places give the same faults in the same order as with one process."""
    where = [CityMap(map=f"nowhere-{i}") for i in range(16)]
    lost = tuple(
        msgspec.structs.replace(from_west_to_east(), id=f"s{i}", place=at)
        for i, at in enumerate(where)
    )
    suite = Suite(name="w", version="1", scenarios=lost)
    messages = []
    for jobs in (1, 2):
        with pytest.raises(SpecError) as refusal:
            check_places(suite, lost, jobs=jobs)
        messages.append(str(refusal.value))
    assert (
        messages[0] == messages[1]
        and "16 faults" in messages[0]
        and "scenario 's4': unknown map 'nowhere-4'" in messages[0]
    )
