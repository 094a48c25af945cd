"""Kind and age of people are columns: an id is a mere name, and no reader of people interprets it."""

from __future__ import annotations

from typing import NoReturn

import numpy as np

from cosim.core.geometry import Pose
from cosim.core.state import Age, People, PersonKind, RobotState, Street
from cosim.people.gait import Strides
from cosim.people.steering import nearby_people
from cosim.place.street_map import StreetMap
from cosim.report.minimap import EVENT, Minimap
from cosim.results.delay import Tracks
from cosim.spec.scenario import City, Scenario
from physics.people.appearance import family_of
from physics.people.parts import placed_parts
from scenarios.tools.bench.crowd import StreetCounter
from tests.support.tiny_street import tiny_map


class Opaque(str):
    """A name that raises when its letters are read."""

    def _closed(self, *_: object) -> NoReturn:
        raise AssertionError(f"somebody looked into the id {str(self)!r}")

    __getitem__ = startswith = endswith = removeprefix = partition = split = __iter__ = _closed


KINDS = (PersonKind.EVENT, PersonKind.CROWD, PersonKind.INJECTED, PersonKind.RESIDENT)
AGES = (Age.ADULT, Age.CHILD, Age.ELDERLY, Age.ADULT)
NAMES = tuple(map(Opaque, ("cedar", "elm", "nut", "vine")))
XY = [(10.0, 5.0), (11.0, 5.0), (12.0, 5.0), (10.0, 5.2)]
STREET = Street(0, People.of(NAMES, XY, [0.0] * 4, [1.0] * 4, ("walk",) * 4, kind=KINDS, age=AGES))


def test_columns_follow_their_people() -> None:
    """Selected rows and copies have kind and age, which are read-only; one value applies to all."""
    people = STREET.people.only(np.array([1, 3]))
    assert people.kind.tolist() == [
        PersonKind.CROWD,
        PersonKind.RESIDENT,
    ] and people.age.tolist() == [1, 0]
    copy = STREET.people.copied()
    assert copy.age.dtype == copy.kind.dtype == np.int8 and copy.kind.tolist() == list(KINDS)
    assert (
        not copy.kind.flags.writeable
        and not people.age.flags.writeable
        and copy.xy is not STREET.people.xy
    )
    assert STREET.people.are(PersonKind.CROWD, PersonKind.RESIDENT).tolist() == [
        False,
        True,
        False,
        True,
    ]
    assert People.of(
        ("a", "b"), XY[:2], [0, 0], [0, 0], ("stand",) * 2, age=Age.CHILD
    ).age.tolist() == [1, 1]


def test_every_reader_of_people_uses_the_columns() -> None:
    """Bystanders, tally, delays, strides, bodies and the minimap are correct for people with
    misleading names."""
    people = STREET.people
    assert [b.kind for b in nearby_people(people)] == [
        PersonKind.CROWD,
        PersonKind.INJECTED,
        PersonKind.RESIDENT,
    ]
    street_map = tiny_map()
    counter = StreetCounter(street_map, 0.05)
    counter.update(STREET)
    assert counter.counts["overlaps: with an event pedestrian"] == 0.05
    tracks = Tracks()
    tracks.add(people)
    assert set(tracks.began) == set(NAMES)
    Strides(0.05).update(people.ids, people.xy, people.speed, people.age.tolist())
    families = [
        family_of(name, age) for name, age in zip(people.ids, people.age.tolist(), strict=True)
    ]
    assert families[1:3] == ["child", "elder"] and families[0] in ("man", "woman")
    assert len(placed_parts(people, np.zeros(4), 0.0).at_m) == 4
    picture = minimap(street_map).picture(
        RobotState(Pose(8.0, 5.0, 0.0)), STREET, (300, 300), np.array([1.0, 0.0])
    )
    assert (picture == EVENT).all(axis=2).any()


def minimap(street_map: StreetMap) -> Minimap:
    """A minimap of a route along the northern sidewalk."""
    route = ((4.0, 5.0), (30.0, 5.0))
    scenario = Scenario(
        id="t",
        suite="t",
        place=City(seed=1),
        seed=0,
        start=(4.0, 5.0, 0.0),
        goal=route[-1],
        route=route,
    )
    return Minimap(street_map, scenario, (0.7, 0.55))
