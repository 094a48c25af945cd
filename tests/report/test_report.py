"""Drawings of an episode without an engine: legends, labels, the layout of films, the minimap."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import shapely

from cosim.core.geometry import Pose
from cosim.core.state import People, PersonKind, RobotState, Street
from cosim.place.street_map import StreetMap, Strip
from cosim.report.above import EVENT, PERSON, ROUTE
from cosim.report.hud import Layout
from cosim.report.minimap import MINIMAP_REACH_M, NOSE, RED_SIGNAL, Minimap
from cosim.spec.scenario import City, Scenario


@pytest.mark.parametrize(
    "size", [(320, 180), (640, 360), (960, 540), (1280, 720), (1920, 1080), (500, 800)]
)
def test_the_parts_of_a_film_do_not_overlap(size: tuple[int, int]) -> None:
    """View, second view, map and bar fill the picture, and the second view is 4:3."""
    layout = Layout.of(*size)
    boxes = [shapely.box(a.x, a.y, a.x + a.width, a.y + a.height) for a in layout]
    assert sum(box.area for box in boxes) == size[0] * size[1]
    assert shapely.union_all(boxes).bounds == (0.0, 0.0, *map(float, size))
    assert not any(a.intersection(b).area for a, b in itertools.combinations(boxes, 2))
    assert layout.second.width * 3 == layout.second.height * 4
    assert layout.view.width > 2 * layout.second.width and layout.map.height > 40


def minimap() -> Minimap:
    """A minimap with a route of 60 m along the x axis, on a sidewalk 4 m wide."""
    line = np.array([[0.0, 0.0], [60.0, 0.0]])
    polygon = shapely.LineString(line).buffer(2.0, cap_style="flat")
    strip = Strip("s", "sidewalk", line, 4.0, polygon, (None, None))
    street_map = StreetMap("made-up", (0.0, -2.0, 60.0, 2.0), {"s": strip}, {}, {}, {})
    scenario = Scenario(
        id="t",
        suite="test",
        place=City(seed=0),
        seed=0,
        start=(0.0, 0.0, 0.0),
        goal=(60.0, 0.0),
        route=((0.0, 0.0), (60.0, 0.0)),
    )
    return Minimap(street_map, scenario, (0.7, 0.55))


def where(image: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:  # type: ignore[type-arg]
    """Return (N, 2) columns and rows of the pixels of a colour."""
    return np.argwhere((image == colour).all(axis=2))[:, ::-1]


def test_the_map_shows_places_and_headings_of_people() -> None:
    """With east right and north up, event people are orange, others violet, and a stopping hand is
    a red line to the robot."""
    robot = RobotState(Pose(30.0, 0.0, 0.0))
    xy = [[34.0, 5.0], [36.0, 0.0]]
    doing = ("walk", "stop")
    kind = [PersonKind.CROWD, PersonKind.EVENT]
    people = People.of(("u", "t"), xy, [0.5 * np.pi, np.pi], [1.2, 0.0], doing, kind=kind)  # type: ignore[arg-type]
    image = minimap().picture(robot, Street(0, people), (400, 400), np.array([1.0, 0.0]))
    px = 400 / (2.0 * MINIMAP_REACH_M)
    middle = 200.0 + px * (np.array([30.0, 0.0]) - (34.0, 0.0)) * (1.0, -1.0)
    event, other, hand, nose = (
        where(image, colour) for colour in (EVENT, PERSON, RED_SIGNAL, NOSE)
    )
    assert event.mean(axis=0) == pytest.approx(middle + px * np.array([5.9, 0.0]), abs=3.0)
    assert other.mean(axis=0) == pytest.approx(middle + px * np.array([4.0, -5.1]), abs=3.0)
    assert np.ptp(other[:, 1]) > 1.2 * np.ptp(other[:, 0]) and np.ptp(event[:, 0]) > 1.2 * np.ptp(
        event[:, 1]
    )
    assert nose[:, 0].max() < hand[:, 0].mean() < event[:, 0].min() + 1
    assert nose[:, 0].mean() > middle[0] and len(where(image, ROUTE)) > 400


def test_the_map_follows_its_robot() -> None:
    """Ten metres on, everything on the ground moves by ten metres in the picture, to half a pixel."""
    drawn = minimap()
    people = People.of(("e0",), [[36.0, 1.0]], [0.0], [0.0], ("stand",), kind=PersonKind.EVENT)
    east = np.array([1.0, 0.0])
    shift = []
    for x in (30.0, 32.0):
        image = drawn.picture(RobotState(Pose(x, 0.0, 0.0)), Street(0, people), (300, 200), east)
        assert image.shape == (200, 300, 3)
        shift.append(where(image, EVENT).mean(axis=0))
    assert shift[0] - shift[1] == pytest.approx((2.0 * 200 / (2.0 * MINIMAP_REACH_M), 0.0), abs=0.5)
